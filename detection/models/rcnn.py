"""Second stage of PointRCNN: the points of each region in its own frame -> confidence and refined box."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, nn

from detection.models.box_coding import rcnn_coder
from detection.models.layers import PointLayer, SharedMLP, prediction_head
from detection.models.pointnet2 import GroupAll, SetAbstraction, SetAbstractionSpec


@dataclass(frozen=True)
class RCNNOutput:
    """cls (R, 1) logits, reg (R, 46) box code, iou (R, 1) of the IoU branch or None."""

    cls: Tensor
    reg: Tensor
    iou: Tensor | None


class RCNN(nn.Module):
    """Canonical refinement without batch normalisation (PointRCNN sec. 3.3; EPNet widens its heads).

    head_width  256 (PointRCNN) or 512 (EPNet)        iou_branch  EPNet's optional third head
    """

    def __init__(self, head_width: int, iou_branch: bool, local_channels: int = 5, features: int = 128) -> None:
        super().__init__()
        self.coder = rcnn_coder()
        self.local_channels = local_channels
        self.SA_modules = nn.ModuleList(
            [
                SetAbstraction(features, SetAbstractionSpec(128, (0.2,), (64,), ((128, 128, 128),)), norm=False),
                SetAbstraction(128, SetAbstractionSpec(32, (0.4,), (64,), ((128, 128, 256),)), norm=False),
                GroupAll(256, (256, 256, 512), norm=False),
            ]
        )
        self.xyz_up_layer = SharedMLP((local_channels, 128, 128), norm=False)
        self.merge_down_layer = SharedMLP((128 + features, 128), norm=False)
        hidden = [head_width, head_width]
        self.cls_layer = prediction_head(512, hidden, 1, norm=False, dropout=0.0)
        self.reg_layer = prediction_head(512, hidden, self.coder.channels, norm=False, dropout=0.0)
        self.iou_branch = prediction_head(512, hidden, 1, norm=False, dropout=0.0) if iou_branch else None
        for layer in self.modules():
            if isinstance(layer, PointLayer):
                nn.init.xavier_normal_(layer.conv.weight)
        nn.init.normal_(cast(PointLayer, self.reg_layer[3]).conv.weight, std=0.001)

    def forward(self, pooled: Tensor) -> RCNNOutput:
        """pooled (R, 512, 5 + 128): x y z in the RoI's frame, mask, depth, features -> RCNNOutput."""
        xyz = pooled[..., :3].contiguous()
        local = self.xyz_up_layer(pooled[..., : self.local_channels])
        features = self.merge_down_layer(torch.cat([local, pooled[..., self.local_channels :]], dim=-1))
        for level in list(self.SA_modules)[:2]:
            xyz, features = level(xyz, features)
        described = self.SA_modules[2](xyz, features)
        iou = None if self.iou_branch is None else self.iou_branch(described)
        return RCNNOutput(self.cls_layer(described), self.reg_layer(described), iou)
