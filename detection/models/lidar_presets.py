"""The voxel detectors by name: OpenPCDet's KITTI configurations, and sizes that a CPU can train."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from torch import nn

from auglidar_base.errors import SettingsError
from detection.inputs import InputSettings
from detection.models.anchor_head import KITTI_ANCHORS, AnchorClass
from detection.models.bev_backbone import BevSettings
from detection.models.lidar_rois import TwoStageSettings
from detection.models.pointpillars import KITTI_PILLAR_BEV, KITTI_PILLARS, PillarSettings, PointPillars
from detection.models.preset import OutputSettings, Preset
from detection.models.proposals import ProposalSettings
from detection.models.pv_rcnn import PVRCNN, GridPoolSettings
from detection.models.second import KITTI_BEV, KITTI_VOXELS, SECOND, VoxelSettings
from detection.models.voxel_backbone import KITTI_WIDTHS
from detection.models.voxel_rcnn import VoxelPoolSettings, VoxelRCNN
from detection.models.voxel_set_abstraction import BallSpec, KeypointSettings
from detection.ops.voxelize import VoxelGrid
from detection.targets import RoiSamplingSettings

INTENSITY = ("intensity",)
ALL_CLASSES = tuple(kind.name for kind in KITTI_ANCHORS)

_SMALL_PILLARS = VoxelGrid((0, -39.68, -3), (69.12, 39.68, 1), (0.32, 0.32, 4), 16, (12000, 20000))
_SMALL_PILLAR_BEV = BevSettings((2, 3, 3), (2, 2, 2), (32, 64, 128), (2, 4, 8), (48, 48, 48))
_SMALL_VOXELS = VoxelGrid((0, -40, -3), (70.4, 40, 1), (0.1, 0.1, 0.1), 5, (16000, 40000))
_SMALL_WIDTHS = (8, 16, 24, 32, 32, 48)
_SMALL_BEV = BevSettings((2, 3), (1, 2), (64, 96), (2, 4), (64, 64))
_SMALL_KEYPOINTS = KeypointSettings(
    count=768,
    raw=BallSpec((0.4, 0.8), (16, 16), (16, 16)),
    levels=(
        BallSpec((0.4, 0.8), (16, 16), (16, 16)),
        BallSpec((0.8, 1.2), (16, 16), (16, 16)),
        BallSpec((1.2, 2.4), (16, 16), (32, 32)),
        BallSpec((2.4, 4.8), (16, 16), (32, 32)),
    ),
    channels=64,
)
_SMALL_ROIS = RoiSamplingSettings(rois=64, foreground=0.55, background=0.55, easy=0.1, hard_share=0.8, noise_tries=0)


def _anchor_classes(names: Sequence[str]) -> tuple[AnchorClass, ...]:
    known = {kind.name: kind for kind in KITTI_ANCHORS}
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise SettingsError(f"classes: expected some of {', '.join(known)}, got {', '.join(names) or 'none'}")
    return tuple(known[name] for name in names)


def _stages(before: int, after: int, rois: RoiSamplingSettings | None = None) -> TwoStageSettings:
    """Test budgets of the proposals; training follows OpenPCDet (9000, 512, 0.8) or, with `rois`, doubles them."""
    test = ProposalSettings(before, after, 0.7, by_distance=False, rotated=True)
    if rois is None:
        return TwoStageSettings(ProposalSettings(9000, 512, 0.8, by_distance=False, rotated=True), test)
    train = ProposalSettings(2 * before, 2 * after, 0.8, by_distance=False, rotated=True)
    return TwoStageSettings(train, test, rois)


def _preset(
    name: str,
    features: Sequence[str],
    classes: Sequence[str],
    score_threshold: float,
    nms_iou: float,
    build: Callable[[], nn.Module],
    cell: dict[str, float] | None = None,
) -> Preset:
    options: dict[str, Any] = {"features": list(features), "classes": list(classes), **(cell or {})}
    inputs = InputSettings(0, "all", tuple(features), frame="lidar")
    # The best 500 of all classes together remain (OpenPCDet's NMS_POST_MAXSIZE).
    outputs = OutputSettings(score_threshold, nms_iou, probability=True, nms_per_class=False, limit=500)
    # Short CPU runs need running statistics that follow faster than OpenPCDet's momentum of 0.01.
    return Preset(name, tuple(classes), inputs, outputs, build, options, norm_schedule=name.endswith("_small"))


def pointpillars(features: Sequence[str] = INTENSITY, classes: Sequence[str] = ALL_CLASSES) -> Preset:
    """PointPillars (pointpillar.yaml). features: point columns beside x y z, "intensity" raw."""
    settings = PillarSettings(KITTI_PILLARS, 3 + len(features), 64, KITTI_PILLAR_BEV, _anchor_classes(classes))
    return _preset("pointpillars", features, classes, 0.1, 0.01, lambda: PointPillars(settings))


def _coarser(grid: VoxelGrid, cell: float, usual: float) -> tuple[VoxelGrid, dict[str, float]]:
    """The grid with cells of `cell` metres seen from above, and the option that says so; none for the usual size.

    Its far and outer borders move out so that every stride divides the number of cells (multiples of 16).
    """
    if cell == usual:
        return grid, {}
    length = 16 * cell * math.ceil((grid.high[0] - grid.low[0]) / (16 * cell) - 1e-6)
    half = 8 * cell * math.ceil((grid.high[1] - grid.low[1]) / (16 * cell) - 1e-6)
    low = (grid.low[0], -half, grid.low[2])
    high = (grid.low[0] + length, half, grid.high[2])
    return replace(grid, low=low, high=high, size=(cell, cell, grid.size[2])), {"cell": cell}


def pointpillars_small(
    features: Sequence[str] = INTENSITY, classes: Sequence[str] = ALL_CLASSES, cell: float = 0.32
) -> Preset:
    """PointPillars for a CPU: pillars of 32 cm (`cell` in metres), half the channels, fewer convolutions."""
    grid, option = _coarser(_SMALL_PILLARS, cell, 0.32)
    settings = PillarSettings(grid, 3 + len(features), 32, _SMALL_PILLAR_BEV, _anchor_classes(classes))
    return _preset("pointpillars_small", features, classes, 0.1, 0.01, lambda: PointPillars(settings), option)


def _voxels(features: Sequence[str], classes: Sequence[str], bev: BevSettings) -> VoxelSettings:
    return VoxelSettings(KITTI_VOXELS, 3 + len(features), KITTI_WIDTHS, bev, _anchor_classes(classes))


def _small_voxels(
    features: Sequence[str], classes: Sequence[str], cell: float
) -> tuple[VoxelSettings, dict[str, float]]:
    grid, option = _coarser(_SMALL_VOXELS, cell, 0.1)
    return VoxelSettings(grid, 3 + len(features), _SMALL_WIDTHS, _SMALL_BEV, _anchor_classes(classes)), option


def second(features: Sequence[str] = INTENSITY, classes: Sequence[str] = ALL_CLASSES) -> Preset:
    """SECOND (second.yaml)."""
    settings = _voxels(features, classes, KITTI_BEV)
    return _preset("second", features, classes, 0.1, 0.01, lambda: SECOND(settings))


def second_small(
    features: Sequence[str] = INTENSITY, classes: Sequence[str] = ALL_CLASSES, cell: float = 0.1
) -> Preset:
    """SECOND for a CPU: voxels of 10 cm (`cell` in metres, seen from above), about half the channels."""
    settings, option = _small_voxels(features, classes, cell)
    return _preset("second_small", features, classes, 0.1, 0.01, lambda: SECOND(settings), option)


def voxel_rcnn(features: Sequence[str] = INTENSITY, classes: Sequence[str] = ("Car",)) -> Preset:
    """Voxel-RCNN (voxel_rcnn_car.yaml); only cars, as published."""
    settings = _voxels(features, classes, BevSettings((5, 5), (1, 2), (64, 128), (1, 2), (128, 128)))
    stages = _stages(2048, 100)
    return _preset("voxel_rcnn", features, classes, 0.3, 0.1, lambda: VoxelRCNN(settings, stages, VoxelPoolSettings()))


def voxel_rcnn_small(
    features: Sequence[str] = INTENSITY, classes: Sequence[str] = ALL_CLASSES, cell: float = 0.1
) -> Preset:
    """Voxel-RCNN for a CPU, all classes: the trunk of `second_small`, 64 grid points per RoI."""
    settings, option = _small_voxels(features, classes, cell)
    stages = _stages(512, 64, _SMALL_ROIS)
    pool = VoxelPoolSettings(grid=4, radii=(0.8, 1.6, 3.2), channels=16, width=128)
    return _preset("voxel_rcnn_small", features, classes, 0.1, 0.1, lambda: VoxelRCNN(settings, stages, pool), option)


def pv_rcnn(features: Sequence[str] = INTENSITY, classes: Sequence[str] = ALL_CLASSES) -> Preset:
    """PV-RCNN (pv_rcnn.yaml)."""
    settings, stages = _voxels(features, classes, KITTI_BEV), _stages(1024, 100)
    return _preset(
        "pv_rcnn",
        features,
        classes,
        0.1,
        0.1,
        lambda: PVRCNN(settings, stages, KeypointSettings(), GridPoolSettings()),
    )


def pv_rcnn_small(
    features: Sequence[str] = INTENSITY, classes: Sequence[str] = ALL_CLASSES, cell: float = 0.1
) -> Preset:
    """PV-RCNN for a CPU: the trunk of `second_small`, 768 keypoints, 64 grid points per RoI."""
    settings, option = _small_voxels(features, classes, cell)
    stages = _stages(512, 64, _SMALL_ROIS)
    pool = GridPoolSettings(4, BallSpec((0.8, 1.6), (16, 16), (32, 32)), 128)
    return _preset(
        "pv_rcnn_small", features, classes, 0.1, 0.1, lambda: PVRCNN(settings, stages, _SMALL_KEYPOINTS, pool), option
    )


LIDAR_PRESETS: dict[str, Callable[..., Preset]] = {
    "pointpillars": pointpillars,
    "pointpillars_small": pointpillars_small,
    "second": second,
    "second_small": second_small,
    "voxel_rcnn": voxel_rcnn,
    "voxel_rcnn_small": voxel_rcnn_small,
    "pv_rcnn": pv_rcnn,
    "pv_rcnn_small": pv_rcnn_small,
}


def openpcdet_features(point_channels: int) -> tuple[str, ...]:
    """Point columns of an imported network: x y z intensity, then the columns of an augmented cloud in their order."""
    names = ("intensity", "source", "semantic")
    if not 3 <= point_channels <= 3 + len(names):
        raise SettingsError(
            f"expected 3 to {3 + len(names)} point channels (x y z {' '.join(names)}), "
            f"the checkpoint has {point_channels}"
        )
    return names[: point_channels - 3]


# Architecture of an OpenPCDet checkpoint -> its configuration.
OPENPCDET_PRESETS: dict[str, Callable[..., Preset]] = {
    "pointpillar": pointpillars,
    "second": second,
    "voxel_rcnn": voxel_rcnn,
    "pv_rcnn": pv_rcnn,
}
