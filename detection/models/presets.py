"""The detectors one can ask for by name: network, input and output settings together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

from torch import nn

from detection.inputs import InputSettings
from detection.models.compact import CLASSES, CompactPointRCNN, CompactSettings
from detection.models.lidar_presets import LIDAR_PRESETS, OPENPCDET_PRESETS, openpcdet_features
from detection.models.openpcdet_pointrcnn import OpenPCDetPointRCNN
from detection.models.pointrcnn import PointRCNN, PointRCNNSettings
from detection.models.preset import OutputSettings, Preset
from detection.models.proposals import ProposalSettings
from detection.targets import RoiSamplingSettings

# Values of the released configurations of PointRCNN and EPNet.
_NEAR_FAR_TRAIN = ProposalSettings(before=9000, after=512, iou=0.85, by_distance=True, rotated=False)
_NEAR_FAR_TEST = ProposalSettings(before=9000, after=100, iou=0.8, by_distance=True, rotated=False)


def small(
    features: tuple[str, ...] = ("height", "range"),
    points: int = 8192,
    width: float = 1.0,
    classes: tuple[str, ...] = CLASSES,
) -> Preset:
    """The CPU detector for Car, Pedestrian and Cyclist that this project trains and ships.

    features  point columns; add "source" (and "semantic") for augmented clouds
    width     factor on all layer widths of the first stage
    classes   with "Van" among them vans are told apart from cars instead of counting as such
    """
    features, classes = tuple(features), tuple(classes)
    settings = CompactSettings(classes=classes, features=features).widened(width)
    return Preset(
        name="small",
        classes=classes,
        inputs=InputSettings(points, "balanced", features, cloud=60000),
        # No camera sees fifty objects of a class; what an unsure network adds to them is noise.
        outputs=OutputSettings(0.1, 0.1, probability=True, mirrored_pass=True, vote_iou=0.5, limit=50),
        build=lambda: CompactPointRCNN(settings),
        options={"features": list(features), "points": points, "width": width, "classes": list(classes)},
        skip_empty_frames=False,
    )


def _published(name: str, settings: PointRCNNSettings, inputs: InputSettings, options: dict[str, Any]) -> Preset:
    # The second stage's score threshold equals the mask threshold in both published configurations.
    outputs = OutputSettings(settings.mask_threshold, nms_iou=0.1)
    return Preset(name, ("Car",), inputs, outputs, lambda: PointRCNN(settings), options)


def pointrcnn(fine_location: bool = False, features: tuple[str, ...] = (), segmentation_loss: str = "focal") -> Preset:
    """PointRCNN (Shi et al. 2019). The released weights lack residuals per bin (fine_location False, 52 channels).

    segmentation_loss  of the points in training: focal, dice or bce (RPN.LOSS_CLS)
    """
    settings = PointRCNNSettings(
        extra_channels=len(features),
        fine_location=fine_location,
        soft_decoding=False,
        consistency_weight=0.0,
        mask_threshold=0.3,
        pool_margin=1.0,
        head_width=256,
        iou_branch=False,
        roi_augmentation=True,
        proposals_train=_NEAR_FAR_TRAIN,
        proposals_test=_NEAR_FAR_TEST,
        rois=RoiSamplingSettings(),
        segmentation_loss=segmentation_loss,
    )
    options = {"fine_location": fine_location, "features": list(features), "segmentation_loss": segmentation_loss}
    return _published("pointrcnn", settings, InputSettings(16384, "near_far", tuple(features)), options)


def _epnet_settings(features: tuple[str, ...], iou_branch: bool) -> PointRCNNSettings:
    return PointRCNNSettings(
        extra_channels=len(features),
        fine_location=True,
        soft_decoding=True,
        consistency_weight=5.0,
        mask_threshold=0.2,
        pool_margin=0.2,
        head_width=512,
        iou_branch=iou_branch,
        roi_augmentation=True,
        proposals_train=_NEAR_FAR_TRAIN,
        proposals_test=_NEAR_FAR_TEST,
        rois=RoiSamplingSettings(),
    )


def pointrcnn2(
    features: tuple[str, ...] = (), iou_branch: bool = False, segmentation_loss: str = "focal", raw_iou: bool = False
) -> Preset:
    """EPNet without image fusion, the thesis' "PointRCNN2", with the values of the released code.

    segmentation_loss  of the points in training: focal, dice or bce (RPN.LOSS_CLS)
    raw_iou            the consistency loss takes x and z from the target bins (IOU_LOSS_TYPE raw)
    """
    settings = _epnet_settings(tuple(features), iou_branch)
    settings = replace(settings, segmentation_loss=segmentation_loss, raw_iou=raw_iou)
    options: dict[str, Any] = {"features": list(features), "iou_branch": iou_branch}
    options |= {"segmentation_loss": segmentation_loss, "raw_iou": raw_iou}
    return _published("pointrcnn2", settings, InputSettings(16384, "near_far", tuple(features)), options)


def thesis(features: tuple[str, ...] = (), dense: bool = True) -> Preset:
    """PointRCNN2 as thesis chapter 5 words it: the 8000 best scores, NMS 0.8, 64 boxes, no augmentation of RoIs.

    In training NMS keeps 512 boxes, of which 64 RoIs are drawn, as in the released code; else nothing is left to draw.

    dense     50k uniformly drawn points (completed depth) instead of 16384 by the near/far rule
    features  ("semantic",) for the binary mask of section 5.3
    Train it with scene=None and paste=None.
    """
    proposals = ProposalSettings(before=8000, after=64, iou=0.8, by_distance=False, rotated=True)
    settings = replace(
        _epnet_settings(tuple(features), iou_branch=False),
        roi_augmentation=False,
        proposals_train=replace(proposals, after=512),
        proposals_test=proposals,
    )
    inputs = (
        InputSettings(50000, "uniform", tuple(features)) if dense else InputSettings(16384, features=tuple(features))
    )
    return _published("thesis", settings, inputs, {"features": list(features), "dense": dense})


def openpcdet_pointrcnn() -> Preset:
    """OpenPCDet's PointRCNN, for imported weights: inference only, boxes in the LiDAR frame."""
    inputs = InputSettings(16384, frame="lidar", features=("intensity",))
    outputs = OutputSettings(0.1, 0.1, nms_per_class=False)
    return Preset("openpcdet_pointrcnn", CLASSES, inputs, outputs, OpenPCDetPointRCNN)


PRESETS: dict[str, Callable[..., Preset]] = {
    "small": small,
    "pointrcnn": pointrcnn,
    "pointrcnn2": pointrcnn2,
    "thesis": thesis,
    "openpcdet_pointrcnn": openpcdet_pointrcnn,
    **LIDAR_PRESETS,
}


def _fitting_pointrcnn(model: nn.Module) -> Preset:
    features = ("intensity",) * cast(PointRCNN, model).settings.extra_channels
    return pointrcnn(cast(PointRCNN, model).settings.fine_location, features)


def _fitting_epnet(model: nn.Module) -> Preset:
    settings = cast(PointRCNN, model).settings
    return pointrcnn2(("intensity",) * settings.extra_channels, settings.iou_branch)


def _fitting_openpcdet(architecture: str) -> Callable[[nn.Module], Preset]:
    """The preset of a voxel detector, with the classes and point columns the imported network has."""

    def fitting(model: nn.Module) -> Preset:
        settings = cast(Any, model).settings
        features = openpcdet_features(settings.point_channels)
        return OPENPCDET_PRESETS[architecture](features, [kind.name for kind in settings.classes])

    return fitting


# Architecture of an imported checkpoint -> the preset that runs its network.
IMPORTED_PRESETS: dict[str, Callable[[nn.Module], Preset]] = {
    "pointrcnn": _fitting_pointrcnn,
    "epnet": _fitting_epnet,
    "openpcdet_pointrcnn": lambda model: openpcdet_pointrcnn(),
    **{architecture: _fitting_openpcdet(architecture) for architecture in OPENPCDET_PRESETS},
}
