"""The point-cloud stage: completed depth and raw LiDAR -> augmented LiDAR (thesis section 5.3.4).

`augment_frame` is the section read aloud: one line per step. The small functions below it decide whether the settings
ask for a step and count its points; the arithmetic of each step is in the file of its name.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from completion.types import CompletedDepth
from pipeline.base.errors import UsageError
from pipeline.geometry.back_project import back_project
from pipeline.geometry.calibration import Calibration
from pipeline.geometry.clouds import DenseCloud
from pipeline.geometry.in_view import lidar_pixels, value_at
from pipeline.pointcloud.columns import completed_columns, measured_columns
from pipeline.pointcloud.depth_sampling import back_project_and_sample
from pipeline.pointcloud.grid_sampling import grid_sampling
from pipeline.pointcloud.presets import PRESETS, AugmentSettings, preset
from pipeline.pointcloud.radius_gather import radius_gather
from pipeline.pointcloud.range_image import range_sample
from pipeline.pointcloud.semantic_mask import object_score, semantic_mask
from pipeline.pointcloud.sigma_filter import sigma_filter

BASE_COLUMNS = ("x", "y", "z", "intensity", "source")
MEASURED, COMPLETED = 0.0, 1.0

__all__ = ["PRESETS", "AugmentSettings", "AugmentedCloud", "augment_frame", "preset"]

Semantics = NDArray[np.uint8] | NDArray[np.float32]


@dataclass(frozen=True)
class AugmentedCloud:
    """Augmented LiDAR.

    points   (N, 5 + C) float32: x y z in metres (LiDAR frame), intensity (0 for completed points),
             source (0 = measured, 1 = completed), then the asked-for columns; measured points first
    columns  names of all 5 + C columns
    counts   (step, points in, points out) in the order of the steps
    """

    points: NDArray[np.float32]
    columns: tuple[str, ...]
    counts: tuple[tuple[str, int, int], ...]


def augment_frame(
    completed: CompletedDepth,
    points: NDArray[np.float32],
    calibration: Calibration,
    settings: AugmentSettings,
    semantics: Semantics | None = None,
    seed: int = 0,
) -> AugmentedCloud:
    """Augmented LiDAR of one frame.

    completed    completed depth; with surfaces when the settings use sigma (see `pseudo_sigma`)
    points       (N, 4) float32 x y z intensity, LiDAR frame, metres
    semantics    (H, W) uint8 Cityscapes trainIds, or float32 scores in [0, 1], or None when the settings need none
    seed         decides which points stay when there are more than `settings.max_points`

    Raises UsageError when the settings need a part that is not given, ValueError for NaN or wrong shapes.
    """
    frame = _StageFrame.checked(completed, points, calibration, settings, semantics)
    lidar = _seen_by_camera(frame)
    keep = _without_smeared_pixels(frame)
    dense = _points_of(frame, keep)
    dense = _resampled_like_lidar(frame, dense)
    dense = _objects_and_context(frame, dense)
    dense = _near_raw_lidar(frame, dense, lidar)
    lidar = _objects_of_lidar(frame, lidar)
    return _capped(frame, _joined(frame, lidar, dense), seed)


@dataclass(frozen=True)
class _StageFrame:
    """One frame, its settings, and the growing list of counts."""

    completed: CompletedDepth
    points: NDArray[np.float32]
    calibration: Calibration
    settings: AugmentSettings
    score: NDArray[np.float32] | None
    counts: list[tuple[str, int, int]] = field(default_factory=list)

    @classmethod
    def checked(
        cls,
        completed: CompletedDepth,
        points: NDArray[np.float32],
        calibration: Calibration,
        settings: AugmentSettings,
        semantics: Semantics | None,
    ) -> _StageFrame:
        """The frame, or one clear error about what is wrong with it."""
        if points.ndim != 2 or points.shape[1] != 4 or points.dtype != np.float32:
            raise ValueError(f"augment: expected (N, 4) float32 x y z intensity, got {points.shape} {points.dtype}")
        if not np.isfinite(points).all():
            bad = int((~np.isfinite(points)).any(axis=1).sum())
            raise ValueError(f"augment: {bad} of {len(points)} LiDAR points hold NaN or infinite values; drop them")
        if settings.needs_surfaces and not completed.has_surfaces:
            raise UsageError("augment: these settings use sigma, but the depth has one surface; see pseudo_sigma")
        if not settings.needs_semantics:
            return cls(completed, points, calibration, settings, None)
        if semantics is None:
            raise UsageError("augment: these settings use semantics; give a semantics source or choose others")
        if semantics.shape != completed.size:
            raise ValueError(f"augment: semantics are {semantics.shape}, the completed depth is {completed.size}")
        return cls(completed, points, calibration, settings, object_score(semantics, settings.classes))

    def count(self, step: str, before: int | np.integer, after: int | np.integer) -> None:
        """Note what a step did."""
        self.counts.append((step, int(before), int(after)))

    def pixels(self, lidar: NDArray[np.float32]) -> NDArray[np.int64]:
        """Pixel of each raw return, -1 outside the image."""
        return lidar_pixels(lidar, self.calibration, self.completed.size)


def _seen_by_camera(frame: _StageFrame) -> NDArray[np.float32]:
    """Raw returns in the image: completed points and labels exist nowhere else."""
    if not frame.settings.crop_lidar:
        return frame.points
    seen = frame.points[frame.pixels(frame.points) >= 0]
    frame.count("crop_lidar", len(frame.points), len(seen))
    return seen


def _without_smeared_pixels(frame: _StageFrame) -> NDArray[np.bool_]:
    """5.3.4.1, on pixels."""
    valid = frame.completed.depth > 0
    if not frame.settings.completed:
        return np.zeros_like(valid)
    keep = valid if frame.settings.sigma is None else sigma_filter(frame.completed, frame.settings.sigma)
    if frame.settings.sigma is not None:
        frame.count("sigma_filter", np.count_nonzero(valid), np.count_nonzero(keep))
    return keep


def _points_of(frame: _StageFrame, keep: NDArray[np.bool_]) -> DenseCloud:
    """5.3.1 and 5.3.4.2: back-projection, and a grid that makes the cloud equally dense near and far.

    Both in one pass when nothing comes between them; the result is the same as of one after the other.
    """
    settings, pixels = frame.settings, int(np.count_nonzero(keep))
    if settings.grid is None or settings.range_image is not None or not settings.completed:
        return back_project(frame.completed.depth, frame.calibration, keep)
    sampled = back_project_and_sample(frame.completed.depth, frame.calibration, keep, settings.grid)
    frame.count("grid_sampling", pixels, len(sampled))
    return sampled


def _resampled_like_lidar(frame: _StageFrame, dense: DenseCloud) -> DenseCloud:
    """Tables 5.5 and 5.7: one point per beam, then the grid if there is one."""
    settings = frame.settings
    if settings.range_image is None or not settings.completed:
        return dense
    sampled = dense.select(range_sample(dense.points, settings.range_image))
    frame.count("range_image", len(dense), len(sampled))
    if settings.grid is None:
        return sampled
    gridded = grid_sampling(sampled, settings.grid)
    frame.count("grid_sampling", len(sampled), len(gridded))
    return gridded


def _objects_and_context(frame: _StageFrame, dense: DenseCloud) -> DenseCloud:
    """5.3.4.2: points of relevant objects, and those within r of them."""
    mask = frame.settings.semantic
    if mask is None or frame.score is None or not frame.settings.completed:
        return dense
    relevant = dense.look_up(semantic_mask(frame.score, mask))
    frame.count("semantic_mask", len(dense), np.count_nonzero(relevant))
    if mask.context is None:
        return dense.select(relevant)
    forward = dense.look_up(frame.completed.depth)
    kept = relevant | radius_gather(dense.points, forward, dense.points[relevant], mask.context)
    frame.count("context", np.count_nonzero(relevant), np.count_nonzero(kept))
    return dense.select(kept)


def _near_raw_lidar(frame: _StageFrame, dense: DenseCloud, lidar: NDArray[np.float32]) -> DenseCloud:
    """5.3.4.3: points within r1 or r2 of a raw return."""
    if frame.settings.near_lidar is None or not frame.settings.completed:
        return dense
    forward = dense.look_up(frame.completed.depth)
    gathered = dense.select(radius_gather(dense.points, forward, lidar, frame.settings.near_lidar))
    frame.count("near_lidar", len(dense), len(gathered))
    return gathered


def _objects_of_lidar(frame: _StageFrame, lidar: NDArray[np.float32]) -> NDArray[np.float32]:
    """The raw returns of the output: all, those of relevant objects ("Sem. Lidar" of Table 5.6), or none."""
    mask = frame.settings.semantic
    if not frame.settings.lidar:
        return lidar[:0]
    if not frame.settings.semantic_lidar or mask is None or frame.score is None:
        return lidar
    relevant = value_at(frame.pixels(lidar), semantic_mask(frame.score, mask))
    if mask.context is not None:
        forward = frame.calibration.velo_to_cam(lidar)[:, 2].astype(np.float32)
        relevant = relevant | radius_gather(lidar[:, :3], forward, lidar[relevant], mask.context)
    frame.count("semantic_lidar", len(lidar), np.count_nonzero(relevant))
    return lidar[relevant]


def _joined(frame: _StageFrame, lidar: NDArray[np.float32], dense: DenseCloud) -> NDArray[np.float32]:
    """Measured points, then completed ones, with source flag and columns."""
    names = frame.settings.columns
    joined = np.zeros((len(lidar) + len(dense), len(BASE_COLUMNS) + len(names)), np.float32)
    measured, completed = joined[: len(lidar)], joined[len(lidar) :]
    measured[:, :4], measured[:, 4] = lidar, MEASURED
    completed[:, :3], completed[:, 4] = dense.points, COMPLETED
    if names:
        measured[:, 5:] = measured_columns(names, frame.pixels(lidar), frame.score)
        completed[:, 5:] = completed_columns(names, dense, frame.completed, frame.score, frame.points)
    frame.count("join", len(lidar) + len(dense), len(joined))
    return joined


def _capped(frame: _StageFrame, joined: NDArray[np.float32], seed: int) -> AugmentedCloud:
    """At most `max_points`, order kept: completed points are thinned first, measured ones only when they alone are
    too many."""
    limit = frame.settings.max_points
    if limit and len(joined) > limit:
        measured = int(np.count_nonzero(joined[:, 4] == MEASURED))
        random = np.random.default_rng(seed)
        sure = np.arange(measured if measured <= limit else 0)
        pool = np.arange(measured, len(joined)) if measured <= limit else np.arange(measured)
        drawn = random.choice(pool, limit - len(sure), replace=False)
        chosen = np.sort(np.concatenate([sure, drawn]))
        frame.count("max_points", len(joined), limit)
        joined = joined[chosen]
    return AugmentedCloud(joined, BASE_COLUMNS + frame.settings.columns, tuple(frame.counts))
