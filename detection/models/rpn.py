"""First stage of PointRCNN: features of every point, foreground logits, and a bin-coded box per point."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

from torch import Tensor, nn

from detection.models.box_coding import rpn_coder
from detection.models.layers import PointLayer, prediction_head
from detection.models.pointnet2 import PointNet2Backbone


@dataclass(frozen=True)
class RPNOutput:
    """backbone_features (B, 128, N), cls (B, N, 1) logits, reg (B, N, 76 or 52) box code."""

    backbone_features: Tensor
    cls: Tensor
    reg: Tensor


class RPN(nn.Module):
    """PointNet++ with two heads (PointRCNN, Shi et al. 2019, sec. 3.1-3.2).

    rare_foreground  before training every point is foreground with probability 0.01 (for the focal loss); else 0.5
    """

    def __init__(self, extra_channels: int, fine_location: bool, rare_foreground: bool = True) -> None:
        super().__init__()
        self.coder = rpn_coder(fine_location)
        self.backbone_net = PointNet2Backbone(extra_channels)
        channels = self.backbone_net.out_channels
        self.rpn_cls_layer = prediction_head(channels, [128], 1, norm=True, dropout=0.5)
        self.rpn_reg_layer = prediction_head(channels, [128], self.coder.channels, norm=True, dropout=0.5)
        bias = cast(PointLayer, self.rpn_cls_layer[2]).conv.bias
        nn.init.constant_(cast(Tensor, bias), -math.log(0.99 / 0.01) if rare_foreground else 0.0)
        nn.init.normal_(cast(PointLayer, self.rpn_reg_layer[2]).conv.weight, std=0.001)

    def forward(self, points: Tensor) -> RPNOutput:
        """points (B, N, 3 + E), shuffled, rectified camera frame -> RPNOutput in the order of the points."""
        features = self.backbone_net(points)
        return RPNOutput(features.transpose(1, 2), self.rpn_cls_layer(features), self.rpn_reg_layer(features))
