"""Training frustums: around labelled boxes moved a little, with their truth, augmented and gathered in batches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from auglidar_base.errors import SettingsError
from detection.frustum.coding import CLASSES, CLUSTERS, encode_heading, encode_size
from detection.frustum.frustums import LEAST_HEIGHT, ViewedCloud, cut_frustum, rotate, viewed_cloud
from detection.frustum.losses import FrustumTargets
from detection.frustum.regions import Box, Region
from detection.kitti_format import KittiObject
from detection.types import PointFrame

Array = NDArray[np.float64]

SHIFTS = ("intended", "original", "none")


@dataclass(frozen=True, eq=False)
class FrustumSample:
    """A frustum with the truth of its object, rotated to the frustum's middle.

    points  (N, 3 + C) float32     mask  (N,) bool, inside the labelled box
    type    class name             centre  (3,) geometric centre, metres
    heading radians                size  (3,) l w h, metres
    """

    points: NDArray[np.float32]
    mask: NDArray[np.bool_]
    type: str
    centre: Array
    heading: float
    size: Array


def moved_box(bbox: Box, rng: np.random.Generator, shift: float = 0.1) -> Box:
    """A box moved by up to `shift` of its width and height, and scaled by 1 - shift to 1 + shift; x, y, height, width
    are drawn in this order."""
    x1, y1, x2, y2 = bbox
    width, height = x2 - x1, y2 - y1
    x = (x1 + x2) / 2 + width * shift * rng.uniform(-1, 1)
    y = (y1 + y2) / 2 + height * shift * rng.uniform(-1, 1)
    height *= 1 + shift * rng.uniform(-1, 1)
    width *= 1 + shift * rng.uniform(-1, 1)
    return x - width / 2, y - height / 2, x + width / 2, y + height / 2


def inside_box(xyz: Array, item: KittiObject) -> NDArray[np.bool_]:
    """(N,) whether points (N, 3) of the rectified camera lie in the 3D box of a label, its faces included."""
    height, width, length = item.size
    x, up, z = (xyz - np.asarray(item.location)).T
    cos, sin = np.cos(item.ry), np.sin(item.ry)
    along, across = x * cos - z * sin, x * sin + z * cos
    return np.asarray((abs(along) <= length / 2) & (abs(across) <= width / 2) & (up <= 0) & (up >= -height))


def labelled_sample(cloud: ViewedCloud, item: KittiObject, bbox: Box, P2: Array, channels: int) -> FrustumSample | None:
    """The frustum of a box (a label's own, or moved); None for a box lower than 25 px or without an object point."""
    if bbox[3] - bbox[1] < LEAST_HEIGHT:
        return None
    frustum, index = cut_frustum(cloud, Region(item.type, bbox), P2, channels)
    mask = inside_box(cloud.xyz[index], item)
    if not mask.any():
        return None
    height, width, length = item.size
    centre = rotate(np.asarray(item.location) - (0, height / 2, 0), frustum.rotation)
    heading = item.ry - frustum.rotation
    return FrustumSample(frustum.points, mask, item.type, centre, heading, np.array([length, width, height]))


def frame_samples(
    frame: PointFrame,
    labels: Sequence[KittiObject],
    channels: int,
    rng: np.random.Generator | None = None,
    copies: int = 5,
    classes: Sequence[str] = CLASSES,
) -> list[FrustumSample]:
    """The samples of a frame's labels: `copies` of each with boxes moved by `rng`, or one with its own box without."""
    cloud = viewed_cloud(frame)
    found = []
    for item in labels:
        if item.type in classes and min(item.size) > 0:
            boxes = [item.bbox] if rng is None else [moved_box(item.bbox, rng) for _ in range(copies)]
            found += [labelled_sample(cloud, item, box, frame.P2, channels) for box in boxes]
    return [sample for sample in found if sample is not None]


def thinned(sample: FrustumSample, most: int, rng: np.random.Generator) -> FrustumSample:
    """A sample of at most `most` points, drawn so that some of the object stay."""
    if len(sample.points) <= most:
        return sample
    keep = np.sort(rng.choice(len(sample.points), most, replace=False))
    if not sample.mask[keep].any():
        keep[0] = np.flatnonzero(sample.mask)[0]
    return FrustumSample(
        sample.points[keep], sample.mask[keep], sample.type, sample.centre, sample.heading, sample.size
    )


def flipped(sample: FrustumSample) -> FrustumSample:
    """Left and right exchanged."""
    points, centre = sample.points.copy(), sample.centre.copy()
    points[:, 0], centre[0] = -points[:, 0], -centre[0]
    return FrustumSample(points, sample.mask, sample.type, centre, np.pi - sample.heading, sample.size)


def depth_shift(centre: Array, rule: str, rng: np.random.Generator) -> float:
    """Metres by which a sample moves along its frustum.

    rule  "intended": 0.05 of the distance from above, normal, at most four times that; "original": what the published
          code does, which clips the draw to 0.8 to 1.2 of sqrt(x^2 + y^2) and so always moves away; "none"
    """
    if rule == "none":
        return 0.0
    draw = rng.standard_normal()
    if rule == "intended":
        distance = float(np.hypot(centre[0], centre[2]))
        return float(np.clip(draw * 0.05 * distance, -0.2 * distance, 0.2 * distance))
    if rule != "original":
        raise SettingsError(f"depth_shift: expected one of {', '.join(SHIFTS)}, got {rule!r}")
    distance = float(np.hypot(centre[0], centre[1]))
    return float(np.clip(draw * 0.05 * distance, 0.8 * distance, 1.2 * distance))


def augmented(sample: FrustumSample, rule: str, rng: np.random.Generator) -> FrustumSample:
    """A sample flipped with probability 0.5 and moved along the frustum."""
    if rng.random() > 0.5:
        sample = flipped(sample)
    shift = depth_shift(sample.centre, rule, rng)
    points, centre = sample.points.copy(), sample.centre.copy()
    points[:, 2] += np.float32(shift)
    centre[2] += shift
    return FrustumSample(points, sample.mask, sample.type, centre, sample.heading, sample.size)


def drawn_points(points: NDArray[np.float32], count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Indices of `count` points drawn with replacement, always (as published)."""
    return rng.integers(len(points), size=count)


@dataclass(frozen=True)
class FrustumBatch:
    """points (B, N, 3 + C), one_hot (B, 3) and the truth of B frustums."""

    points: Tensor
    one_hot: Tensor
    targets: FrustumTargets


def one_hot_of(types: Sequence[str]) -> NDArray[np.float32]:
    """(B, 3) in the order of `CLASSES`."""
    return np.eye(len(CLASSES), dtype=np.float32)[[CLASSES.index(name) for name in types]]


def collate(
    samples: Sequence[FrustumSample], count: int, rng: np.random.Generator, device: torch.device
) -> FrustumBatch:
    """A batch of `count` points each, on the device."""
    draws = [drawn_points(sample.points, count, rng) for sample in samples]
    types = [sample.type for sample in samples]
    clusters = np.array([CLUSTERS.index(name) for name in types])
    bins, residual = encode_heading(np.array([sample.heading for sample in samples]))
    size = encode_size(np.array([sample.size for sample in samples]), clusters)

    def tensor(values: NDArray[Any], kind: Any) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values.astype(kind))).to(device)

    targets = FrustumTargets(
        mask=tensor(np.stack([s.mask[draw] for s, draw in zip(samples, draws)]), np.int64),
        centre=tensor(np.stack([sample.centre for sample in samples]), np.float32),
        bins=tensor(bins, np.int64),
        heading=tensor(residual, np.float32),
        clusters=tensor(clusters, np.int64),
        size=tensor(size, np.float32),
    )
    points = tensor(np.stack([s.points[draw] for s, draw in zip(samples, draws)]), np.float32)
    return FrustumBatch(points, tensor(one_hot_of(types), np.float32), targets)
