"""Voxel detectors small enough for twins made of loops, with random weights and running statistics."""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import Tensor, nn

from detection.models.anchor_head import CAR, CYCLIST, PEDESTRIAN
from detection.models.bev_backbone import BevSettings
from detection.models.lidar_rois import TwoStageSettings
from detection.models.pointpillars import PillarSettings, PointPillars
from detection.models.proposals import ProposalSettings
from detection.models.pv_rcnn import PVRCNN, GridPoolSettings
from detection.models.second import SECOND, VoxelSettings
from detection.models.voxel_rcnn import VoxelPoolSettings, VoxelRCNN
from detection.models.voxel_set_abstraction import BallSpec, KeypointSettings
from detection.ops.voxelize import VoxelGrid
from detection.targets import RoiSamplingSettings

LOW, HIGH = (0.0, -1.6, -3.0), (3.2, 1.6, 1.0)
CLASSES = (CAR, PEDESTRIAN, CYCLIST)
VOXELS = VoxelGrid(LOW, HIGH, (0.1, 0.1, 0.1), 5, (500, 1000))
PILLARS = VoxelGrid(LOW, HIGH, (0.2, 0.2, 4.0), 6, (100, 400))
BEV = BevSettings((1, 2), (1, 2), (8, 6), (1, 2), (8, 5))
PROPOSALS = ProposalSettings(60, 6, 0.8, by_distance=False, rotated=True)
STAGES = TwoStageSettings(PROPOSALS, PROPOSALS, RoiSamplingSettings(8, 0.55, 0.55, 0.1, 0.8, noise_tries=0))
KEYPOINTS = KeypointSettings(
    count=40,
    raw=BallSpec((0.2, 0.8), (4, 8), (5, 6)),
    levels=(
        BallSpec((0.2, 0.8), (4, 8), (5, 6)),
        BallSpec((0.4, 1.2), (4, 8), (4, 4)),
        BallSpec((0.8, 1.6), (4, 8), (4, 4)),
        BallSpec((0.8, 2.4), (4, 8), (4, 4)),
    ),
    channels=7,
)
Model = TypeVar("Model", bound=nn.Module)


def settings(point_channels: int = 4) -> VoxelSettings:
    return VoxelSettings(VOXELS, point_channels, (4, 4, 6, 8, 8, 8), BEV, CLASSES)


def randomised(model: Model, seed: int = 0) -> Model:
    """The model in eval mode; weights as large as needed for outputs that vary, statistics of their own."""
    torch.manual_seed(seed)
    with torch.no_grad():
        for module in model.modules():
            if isinstance(module, nn.modules.batchnorm._BatchNorm):
                assert module.running_mean is not None
                assert module.running_var is not None
                module.running_mean.normal_(std=0.1)
                module.running_var.uniform_(0.5, 1.5)
                module.weight.uniform_(0.5, 1.5)
                module.bias.normal_(std=0.2)
        for name, parameter in model.named_parameters():
            if name.endswith(("conv_box.weight", "conv_cls.weight", "reg_pred_layer.weight", "reg_layers.7.weight")):
                parameter.normal_(std=0.1)
    return model.eval()


def tiny_pillars() -> PointPillars:
    bev = BevSettings((1, 2), (2, 2), (8, 6), (1, 2), (8, 5))
    return randomised(PointPillars(PillarSettings(PILLARS, 4, 8, bev, CLASSES)))


def tiny_second() -> SECOND:
    return randomised(SECOND(settings()))


def tiny_voxel_rcnn() -> VoxelRCNN:
    return randomised(VoxelRCNN(settings(), STAGES, VoxelPoolSettings(grid=3, channels=5, width=9)))


def tiny_pv_rcnn() -> PVRCNN:
    pool = GridPoolSettings(3, BallSpec((0.4, 0.8), (4, 6), (5, 6)), 9)
    return randomised(PVRCNN(settings(), STAGES, KEYPOINTS, pool))


def cloud(count: int = 400, seed: int = 1) -> Tensor:
    """(count, 4) points in and a little beyond the range, in clumps."""
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(LOW), torch.tensor(HIGH)
    seeds = low + (high - low) * torch.rand(count // 8, 3, generator=generator)
    xyz = seeds.repeat(8, 1) + 0.12 * torch.randn(count // 8 * 8, 3, generator=generator)
    return torch.cat([xyz, torch.rand(len(xyz), 1, generator=generator)], dim=1)
