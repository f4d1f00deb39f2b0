"""Inverse-distance interpolation from the three nearest known points (PointNet++ feature propagation)."""

from __future__ import annotations

import torch
from torch import Tensor

from detection.ops import _torch_points
from detection.ops._tensors import as_batch, check_same_batch, coordinates, unbatched

_QUERIES = 1024  # fewer are not worth another thread
_EPSILON = 1e-8  # metres, added to the distance before it is inverted


def three_nn(unknown: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Distances and indices of the three known points nearest to every unknown point.

    unknown  (B, N, 3) or (N, 3), metres, any device; distances are float32
    known    (B, M, 3) or (M, 3)
    Returns distance (B, N, 3) float32 in metres (not squared), ascending, and index (B, N, 3) int64; equally near
    points come in index order. With fewer than three known points the rest has infinite distance and index 0.
    Raises ValueError for other shapes, no known points, or coordinates that are not finite.
    """
    queries, single = coordinates(unknown, "unknown")
    points, _ = coordinates(known, "known")
    check_same_batch(queries, "unknown", points, "known")
    if points.shape[1] == 0:
        raise ValueError("known: expected at least one point per cloud, got none")
    find = _three_nn_cpu if points.device.type == "cpu" else _torch_points.three_nn
    squared, index = find(queries, points)
    return unbatched(squared.sqrt(), single), unbatched(index, single)


def _three_nn_cpu(queries: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    from detection.ops import _bucket_kernels
    from detection.ops._numba import for_blocks

    squared, index = torch.empty_like(queries), torch.empty(queries.shape, dtype=torch.int64)
    source, known, distance, nearest = queries.numpy(), points.numpy(), squared.numpy(), index.numpy()

    def query(b: slice, n: slice) -> None:
        _bucket_kernels.three_nn(source[b, n], known[b], distance[b, n], nearest[b, n])

    for_blocks(query, (source.shape[0], source.shape[1]), torch.get_num_threads(), _QUERIES)
    return squared, index


def interpolation_weights(distance: Tensor) -> Tensor:
    """Weights (..., 3) that sum to 1 from distances (..., 3) in metres: w_k = (1 / (d_k + 1e-8)) / sum."""
    inverse = 1.0 / (distance + _EPSILON)
    return inverse / inverse.sum(dim=-1, keepdim=True)


def three_interpolate(features: Tensor, index: Tensor, weight: Tensor) -> Tensor:
    """Weighted sum of three feature columns per unknown point; differentiable in `features` and `weight`.

    features  (B, C, M) or (C, M) of the known points
    index     (B, N, 3) or (N, 3) int64 from `three_nn`
    weight    (B, N, 3) or (N, 3) from `interpolation_weights`
    Returns (B, C, N) or (C, N). Raises ValueError for other shapes or differing batch sizes.
    """
    columns, single = as_batch(features, "features", "M", None)
    weights, _ = as_batch(weight, "weight", "3", 3)
    index = torch.as_tensor(index)
    if single:
        index = index[None]
    check_same_batch(columns, "features", index, "index")
    if index.shape != weights.shape:
        raise ValueError(
            f"index and weight: expected equal shapes, got {tuple(index.shape)} and {tuple(weights.shape)}"
        )
    batch, channels, count = columns.shape
    rows = columns.transpose(1, 2).contiguous().view(batch * count, channels)  # embedding is slow on strided rows
    offsets = (torch.arange(batch, device=index.device) * count).view(-1, 1, 1)
    flat = (index + offsets).reshape(-1, 3)
    summed = torch.nn.functional.embedding_bag(
        flat, rows, mode="sum", per_sample_weights=weights.reshape(-1, 3).to(rows.dtype)
    )
    return unbatched(summed.view(batch, -1, channels).transpose(1, 2), single)
