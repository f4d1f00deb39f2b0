"""Ball query, and the gathering of features by index that follows it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from detection.ops import _torch_points
from detection.ops._tensors import as_batch, check_same_batch, coordinates, positive, unbatched

_CENTRES = 256  # fewer are not worth another thread


def ball_query(xyz: Tensor, centres: Tensor, radius: float, nsample: int) -> Tensor:
    """For each centre the first `nsample` points, in index order, that lie nearer than `radius`.

    xyz      (B, N, 3) or (N, 3), metres, any device; distances are float32
    centres  (B, P, 3) or (P, 3)
    radius   metres; a point at exactly this distance is outside
    Returns (B, P, nsample) or (P, nsample) int64. It is no nearest-neighbour search: missing neighbours repeat the
    first hit (lowest index), and a ball without points gets index 0 everywhere.
    Raises ValueError for other shapes, an empty cloud, a radius that is not positive, or coordinates not finite.
    """
    points, single = coordinates(xyz, "xyz")
    places, _ = coordinates(centres, "centres")
    check_same_batch(points, "xyz", places, "centres")
    nsample = positive(nsample, "nsample")
    if points.shape[1] == 0:
        raise ValueError("xyz: expected at least one point per cloud, got none")
    if not radius > 0:
        raise ValueError(f"radius: expected a positive number of metres, got {radius}")
    radius2 = np.float32(radius) * np.float32(radius)
    if points.device.type != "cpu":
        return unbatched(_torch_points.ball_query(points, places, float(radius2), nsample), single)

    from detection.ops import _bucket_kernels
    from detection.ops._numba import for_blocks

    index = torch.empty(*places.shape[:2], nsample, dtype=torch.int64)
    source, around, target = points.numpy(), places.numpy(), index.numpy()

    def query(b: slice, p: slice) -> None:
        _bucket_kernels.ball_query(source[b], around[b, p], radius2, target[b, p])

    for_blocks(query, (around.shape[0], around.shape[1]), torch.get_num_threads(), _CENTRES)
    return unbatched(index, single)


def group_points(features: Tensor, index: Tensor) -> Tensor:
    """Gather feature columns by point index; differentiable in `features`.

    features  (B, C, N) or (C, N)
    index     (B, ...) or (...) int64, values in [0, N), e.g. (B, P, S) from `ball_query` or (B, P) from sampling
    Returns (B, C, ...) or (C, ...), as a view whose channels are contiguous in memory (torch's channels_last): whole
    rows are copied, and the 1x1 convolutions that follow read them in that order.
    Raises ValueError for other shapes or differing batch sizes.
    """
    columns, single = as_batch(features, "features", "N", None)
    index = torch.as_tensor(index)
    if single:
        index = index[None]
    check_same_batch(columns, "features", index, "index")
    batch, channels, count = columns.shape
    rows = columns.transpose(1, 2).contiguous().view(batch * count, channels)  # embedding is slow on strided rows
    offsets = (torch.arange(batch, device=index.device) * count).view(-1, *[1] * (index.ndim - 1))
    grouped = torch.nn.functional.embedding(index + offsets, rows)  # (B, ..., C)
    return unbatched(grouped.movedim(-1, 1), single)
