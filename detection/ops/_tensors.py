"""What all point operations do at their border: check shapes, treat a single cloud as a batch of one."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def as_batch(values: Any, name: str, last: str, columns: int | None) -> tuple[Tensor, bool]:
    """`values` with a leading batch dimension, and whether it was added.

    last     how messages call the last dimension ("3", "7", "C")
    columns  its required length, None for any
    """
    tensor = torch.as_tensor(values)
    if tensor.ndim not in (2, 3) or (columns is not None and tensor.shape[-1] != columns):
        raise ValueError(f"{name}: expected (B, N, {last}) or (N, {last}), got shape {tuple(tensor.shape)}")
    if not tensor.is_floating_point():
        raise TypeError(f"{name}: expected a floating point tensor, got {tensor.dtype}")
    return (tensor, False) if tensor.ndim == 3 else (tensor[None], True)


def coordinates(values: Any, name: str) -> tuple[Tensor, bool]:
    """(B, N, 3) contiguous float32 without gradient, and whether the batch dimension was added.

    Distances are float32 as in the reference kernels, whatever the dtype that comes in.
    """
    tensor, single = as_batch(values, name, "3", 3)
    tensor = tensor.detach().to(torch.float32).contiguous()
    if tensor.device.type == "cpu" and not bool(torch.isfinite(tensor).all()):
        bad = int((~torch.isfinite(tensor)).any(dim=-1).sum())
        raise ValueError(f"{name}: {bad} points hold NaN or infinite coordinates; drop them first")
    return tensor, single


def check_same_batch(a: Tensor, name_a: str, b: Tensor, name_b: str) -> None:
    """Raise ValueError unless both have as many batch elements and lie on one device."""
    if a.shape[0] != b.shape[0]:
        raise ValueError(f"{name_a} and {name_b}: expected equal batch sizes, got {a.shape[0]} and {b.shape[0]}")
    if a.device != b.device:
        raise ValueError(f"{name_a} and {name_b}: expected one device, got {a.device} and {b.device}")


def positive(value: int, name: str) -> int:
    """`value` as an int of at least 1; raises ValueError otherwise."""
    if int(value) != value or value < 1:
        raise ValueError(f"{name}: expected a whole number of at least 1, got {value}")
    return int(value)


def unbatched(result: Tensor, single: bool) -> Tensor:
    """`result` without the batch dimension that `as_batch` added."""
    return result[0] if single else result
