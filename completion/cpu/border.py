"""Checks before a kernel runs: inside, no index is checked, and a wrong shape would overwrite other memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def require(
    name: str, array: NDArray[np.float32], shape: tuple[int | None, ...], contiguous: bool = False
) -> tuple[int, ...]:
    """The shape of a float32 array. ValueError when it is another than `shape`; None: any length, but not 0.

    contiguous  the array must be C-contiguous too
    """
    found = array.shape
    fits = len(found) == len(shape) and all(
        there == asked if asked is not None else there > 0 for there, asked in zip(found, shape)
    )
    if not fits or array.dtype != np.float32:
        asked = ", ".join("any" if length is None else str(length) for length in shape)
        raise ValueError(f"{name}: expected float32 of shape ({asked}), got {array.dtype} of shape {found}")
    if contiguous and not array.flags.c_contiguous:
        raise ValueError(f"{name}: expected a C-contiguous array, got strides {array.strides}")
    return found
