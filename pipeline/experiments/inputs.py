"""The input cloud of a detection experiment as data: which depth, how spoiled, sampled, filtered and joined."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from auglidar_base.errors import SettingsError
from pipeline.base.errors import UsageError
from pipeline.base.seeds import derive_seed
from pipeline.base.settings import nearest_name, plain, with_changes
from pipeline.data import Frame
from pipeline.geometry.in_view import lidar_pixels, value_at
from pipeline.pointcloud.presets import PRESETS, AugmentSettings
from pipeline.pointcloud.semantic_mask import object_score
from pipeline.pointcloud.taxonomy import CLEAN, Taxonomy, label_noise
from pipeline.run_folder.own_methods import is_own
from pipeline.simulation.noise import NoiseSettings, add_noise

if TYPE_CHECKING:
    from completion.types import CompletedDepth
    from pipeline.semantics.sources import SemanticsSource

DEPTHS = ("completed", "classical", "truth", "semi_dense")
FULL_ROWS = 64
# Metres by which the stored clouds reach beyond the detectors' area; each detector cuts to its own border.
MARGIN = 0.2


@dataclass(frozen=True)
class InputRecipe:
    """One kind of cloud.

    preset   settings of the point-cloud stage (`pipeline.pointcloud.presets`); `changes` replaces some of them
    depth    "completed" by the budget's network, "classical" (no network), "truth", "semi_dense" pseudo truth,
             or module:Class, a completion method of one's own
    rows     LiDAR rows: 64, 32, 16, 8, of the raw points and of the completion's input
    noise    added to the depth before anything else (thesis 5.3.2)
    masks    "objects": the budget's source of masks; "boxes": the labelled 2D boxes (Table 5.9)
    """

    preset: str = "L"
    changes: Mapping[str, Any] = field(default_factory=dict)
    depth: str = "completed"
    rows: int = FULL_ROWS
    noise: NoiseSettings = field(default_factory=NoiseSettings)
    masks: str = "objects"

    def __post_init__(self) -> None:
        if self.preset not in PRESETS:
            raise SettingsError(f"preset: {nearest_name(self.preset, PRESETS)}, got {self.preset!r}")
        if self.depth not in DEPTHS and not is_own("completion", self.depth):
            raise SettingsError(f"depth: expected one of {', '.join(DEPTHS)} or module:Class, got {self.depth!r}")
        if self.masks not in ("objects", "boxes"):
            raise SettingsError(f"masks: expected 'objects' or 'boxes', got {self.masks!r}")
        if self.rows < 1 or FULL_ROWS % self.rows:
            raise SettingsError(f"rows: expected a divisor of {FULL_ROWS}, got {self.rows}")

    @property
    def settings(self) -> AugmentSettings:
        """Settings of the point-cloud stage."""
        return with_changes(PRESETS[self.preset], self.changes, "input.changes")

    @property
    def extra_features(self) -> tuple[str, ...]:
        """Point columns that tell kinds of points apart: the source where two are mixed, the mask where asked for."""
        settings = self.settings
        both = ("source",) if settings.lidar and settings.completed else ()
        return both + (("semantic",) if "semantic" in settings.columns else ())

    @property
    def depth_name(self) -> str | None:
        """The depth that is needed: "completed" and the like, or None when only raw LiDAR is used."""
        return self.depth if self.settings.completed else None

    def is_possible(self, frame: Frame) -> bool:
        """Whether frames of this kind have what the recipe needs: scans ring by ring for fewer rows, true depth."""
        depth_is_there = self.depth_name not in ("truth", "semi_dense") or frame.has("target_depth")
        return depth_is_there and (self.rows == FULL_ROWS or _has_rings(frame))

    def record(self) -> dict[str, Any]:
        """Plain values that decide the points; what does not matter (the depth of raw LiDAR) is left out."""
        settings = self.settings
        record: dict[str, Any] = {"settings": plain(settings), "rows": self.rows}
        if settings.needs_semantics:
            record["masks"] = self.masks
        if settings.completed:
            record |= {"depth": self.depth, "noise": plain(self.noise)}
        return record


@dataclass(frozen=True)
class InputCloud:
    """The points a detector may see, and what is wrong with each.

    points   (N, 5 + C) float32, as `AugmentedCloud.points`, inside the image and the detectors' area
    kind     (N,) uint8 label of `pipeline.pointcloud.taxonomy`; measured points are clean, 0 = truth unknown
    objects  (N,) bool, the point's pixel truly shows a relevant object
    counts   (step, points in, points out) of the point-cloud stage
    """

    points: NDArray[np.float32]
    kind: NDArray[np.uint8]
    objects: NDArray[np.bool_]
    counts: tuple[tuple[str, int, int], ...] = ()


def _has_rings(frame: Frame) -> bool:
    """Whether the frame has a scan in the sensor's order; that of Virtual KITTI 2 is drawn from its depth."""
    return frame.has("points") and "/" not in frame.id


def lidar_points(frame: Frame, rows: int) -> NDArray[np.float32]:
    """(N, 4) raw returns of every (64 / rows)-th ring. UsageError where the points are in no scan order."""
    from pipeline.geometry.rings import subsample_rows
    from pipeline.stages.clouds import lidar_of

    points = lidar_of(frame)
    if rows == FULL_ROWS:
        return points
    if not _has_rings(frame):
        raise UsageError(f"{frame.where}: {rows} LiDAR rows need scans ring by ring (KITTI, the synthetic world)")
    return subsample_rows(points, FULL_ROWS // rows)


def spoiled(depth: CompletedDepth, recipe: InputRecipe, frame_id: str) -> CompletedDepth:
    """The depth with the recipe's noise (which leaves one surface), the same for every seed of a training."""
    from completion.types import CompletedDepth

    if recipe.noise == NoiseSettings():
        return depth
    return CompletedDepth(add_noise(depth.depth, recipe.noise, derive_seed(0, frame_id, "noise")))


def make_input(
    frame: Frame, recipe: InputRecipe, depth: CompletedDepth | None, masks: SemanticsSource | None, limit: int
) -> InputCloud:
    """The cloud of one frame.

    depth  (H, W) maps before noise; None when the recipe uses raw LiDAR alone
    masks  where object masks come from, for recipes that use some
    limit  most points; completed ones are thinned at random first
    Raises UsageError for a frame without a part the recipe needs.
    """
    from completion.types import CompletedDepth
    from pipeline.pointcloud.augment import augment_frame
    from pipeline.stages.completed import with_sigma

    settings = recipe.settings
    if depth is None:
        depth = CompletedDepth(np.zeros(frame.image_size, np.float32))
    noisy = with_sigma(spoiled(depth, recipe, frame.id), settings)
    semantics = masks.semantics(frame) if masks is not None and settings.needs_semantics else None
    cloud = augment_frame(noisy, lidar_points(frame, recipe.rows), frame.calibration, settings, semantics)
    points = cloud.points[_in_area(frame, cloud.points)]
    points = points[_thinned(points, limit, derive_seed(0, frame.id, "thin"))]
    kind, objects = _what_points_are(frame, points, noisy.depth, settings.classes)
    return InputCloud(points, kind, objects, cloud.counts)


def _in_area(frame: Frame, points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(N,) inside the detectors' border: their field of view, and their area with a margin."""
    from detection.inputs import AREA, openpcdet_field_of_view

    camera = frame.calibration.velo_to_cam(points)
    inside = openpcdet_field_of_view(camera, frame.calibration.P2, frame.image_size)
    for values, (low, high) in zip(camera.T, AREA):
        inside &= (values >= low - MARGIN) & (values <= high + MARGIN)
    return inside


def _thinned(points: NDArray[np.float32], limit: int, seed: int) -> NDArray[np.int64]:
    """Ascending indices of at most `limit` points: all measured ones if they fit, then a draw of the completed ones."""
    measured = np.flatnonzero(points[:, 4] == 0)
    completed = np.flatnonzero(points[:, 4] != 0)
    if len(points) <= limit:
        return np.arange(len(points))
    rng = np.random.default_rng(seed)
    if len(measured) > limit:
        return np.sort(rng.choice(measured, limit, replace=False))
    return np.sort(np.concatenate([measured, rng.choice(completed, limit - len(measured), replace=False)]))


def _what_points_are(
    frame: Frame, points: NDArray[np.float32], depth: NDArray[np.float32], classes: tuple[int, ...]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Kind and object flag of each point, by its pixel; unknown and False where the data set has no dense truth."""
    unknown = np.zeros(len(points), np.uint8), np.zeros(len(points), np.bool_)
    if not (frame.has("target_depth") and frame.has("semantics")):
        return unknown
    objects = object_score(frame.semantics, classes) > 0
    labels = label_noise(depth, frame.target_depth, objects, Taxonomy())
    pixels = lidar_pixels(np.ascontiguousarray(points[:, :3]), frame.calibration, frame.image_size)
    kind = value_at(pixels, labels)
    kind[points[:, 4] == 0] = CLEAN
    return kind, value_at(pixels, objects)
