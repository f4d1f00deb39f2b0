"""Furthest point sampling."""

from __future__ import annotations

import torch
from torch import Tensor

from detection.ops import _torch_points
from detection.ops._tensors import coordinates, positive, unbatched


def furthest_point_sample(xyz: Tensor, npoint: int) -> Tensor:
    """Indices of points that are each as far as possible from those before (PointNet++, Qi et al. 2017).

    xyz     (B, N, 3) or (N, 3), metres, any device; distances are float32
    npoint  how many to take; may exceed N
    Returns (B, npoint) or (npoint,) int64. The first is index 0 (shuffle the points for a random start); among equally
    far points the lowest index wins; once every distinct point is taken, index 0 repeats.
    Raises ValueError for other shapes, an empty cloud, or coordinates that are not finite.

    On the CPU an exact bucket algorithm skips the points a sample cannot change; elsewhere the plain loop runs.
    """
    points, single = coordinates(xyz, "xyz")
    npoint = positive(npoint, "npoint")
    if points.shape[1] == 0:
        raise ValueError("xyz: expected at least one point per cloud, got none")
    if points.device.type != "cpu":
        return unbatched(_torch_points.furthest_point_sample(points, npoint), single)

    from detection.ops import _bucket_kernels
    from detection.ops._numba import for_ranges

    samples = torch.empty(points.shape[0], npoint, dtype=torch.int64)
    source, target = points.numpy(), samples.numpy()

    def sample(i: int, j: int) -> None:
        _bucket_kernels.furthest_point_sample(source[i:j], target[i:j])

    for_ranges(sample, len(source), torch.get_num_threads(), 1)
    return unbatched(samples, single)
