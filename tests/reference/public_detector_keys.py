"""The tensors of the public detector checkpoints, name by name and shape by shape, without our networks.

Written from the published code: PointRCNN (sshaoshuai/PointRCNN 1d0dee9, lib/net), EPNet without LI-Fusion
(happinesslz/EPNet 0123c34, lib/net) and OpenPCDet (open-mmlab/OpenPCDet 8cacccec, pcdet/models).
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

Shapes = dict[str, tuple[int, ...]]

# Output channels of the three layers of each branch, per set abstraction level; what the first layer is given.
SET_ABSTRACTION = [
    (3, [(16, 16, 32), (32, 32, 64)]),
    (99, [(64, 64, 128), (64, 96, 128)]),
    (259, [(128, 196, 256), (128, 196, 256)]),
    (515, [(256, 256, 512), (256, 384, 512)]),
]
FEATURE_PROPAGATION = [(256, 128, 128), (608, 256, 256), (768, 512, 512), (1536, 512, 512)]
REFINEMENT = [(131, 128, 128, 128), (131, 128, 128, 256), (259, 256, 256, 512)]


def norm(prefix: str, channels: int) -> Shapes:
    shapes: Shapes = {f"{prefix}.{name}": (channels,) for name in ("weight", "bias", "running_mean", "running_var")}
    return {**shapes, f"{prefix}.num_batches_tracked": ()}


def pointrcnn(codes: int, hidden: int, extra: int = 0, iou_branch: bool = False) -> Shapes:
    """PointRCNN.pth has codes 52 and hidden 256; EPNet's without fusion 76 and 512.

    extra  1 with the intensity in the first stage (RPN.USE_INTENSITY); the second stage has its own switch, off here
    """
    shapes: Shapes = {}
    for level, (given, branches) in enumerate(SET_ABSTRACTION):
        for branch, widths in enumerate(branches):
            channels = (given + (extra if level == 0 else 0), *widths)
            for layer in range(3):
                name = f"rpn.backbone_net.SA_modules.{level}.mlps.{branch}.layer{layer}"
                shapes[f"{name}.conv.weight"] = (channels[layer + 1], channels[layer], 1, 1)
                shapes |= norm(f"{name}.bn.bn", channels[layer + 1])
    for level, (given, first, second) in enumerate(FEATURE_PROPAGATION):
        name = f"rpn.backbone_net.FP_modules.{level}.mlp"
        shapes[f"{name}.layer0.conv.weight"] = (first, given + (extra if level == 0 else 0), 1, 1)
        shapes[f"{name}.layer1.conv.weight"] = (second, first, 1, 1)
        shapes |= norm(f"{name}.layer0.bn.bn", first) | norm(f"{name}.layer1.bn.bn", second)
    for head, channels_out in (("rpn_cls_layer", 1), ("rpn_reg_layer", codes)):
        shapes[f"rpn.{head}.0.conv.weight"] = (128, 128, 1)
        shapes |= norm(f"rpn.{head}.0.bn.bn", 128)
        shapes |= {f"rpn.{head}.2.conv.weight": (channels_out, 128, 1), f"rpn.{head}.2.conv.bias": (channels_out,)}
    plain = {
        "xyz_up_layer.layer0": (128, 5, 1, 1),
        "xyz_up_layer.layer1": (128, 128, 1, 1),
        "merge_down_layer.layer0": (128, 256, 1, 1),
    }
    for level, widths in enumerate(REFINEMENT):
        for layer in range(3):
            plain[f"SA_modules.{level}.mlps.0.layer{layer}"] = (widths[layer + 1], widths[layer], 1, 1)
    heads = [("cls_layer", 1), ("reg_layer", 46)] + [("iou_branch", 1)] * iou_branch
    for head, channels_out in heads:
        # A dropout stands at index 1.
        plain |= {f"{head}.0": (hidden, 512, 1), f"{head}.2": (hidden, hidden, 1)}
        plain[f"{head}.3"] = (channels_out, hidden, 1)
    for name, shape in plain.items():
        shapes |= {f"rcnn_net.{name}.conv.weight": shape, f"rcnn_net.{name}.conv.bias": shape[:1]}
    return shapes


def openpcdet_pointrcnn() -> Shapes:
    """pointrcnn.yaml, three classes, x y z intensity."""
    shapes: Shapes = {"global_step": (1,)}
    for level, (given, branches) in enumerate(SET_ABSTRACTION):
        for branch, widths in enumerate(branches):
            channels = (given + (1 if level == 0 else 0), *widths)
            shapes |= _plain_layers(f"backbone_3d.SA_modules.{level}.mlps.{branch}", channels, (1, 1))
    for level, widths in enumerate(FEATURE_PROPAGATION):
        channels = (widths[0] + (1 if level == 0 else 0), *widths[1:])
        shapes |= _plain_layers(f"backbone_3d.FP_modules.{level}.mlp", channels, (1, 1))
    for head, codes in (("cls_layers", 3), ("box_layers", 8)):
        shapes |= _plain_layers(f"point_head.{head}", (128, 256, 256), ())
        shapes |= {f"point_head.{head}.6.weight": (codes, 256), f"point_head.{head}.6.bias": (codes,)}
    for name, shape in (
        ("xyz_up_layer.0", (128, 5, 1, 1)),
        ("xyz_up_layer.2", (128, 128, 1, 1)),
        ("merge_down_layer.0", (128, 256, 1, 1)),
    ):
        shapes |= {f"roi_head.{name}.weight": shape, f"roi_head.{name}.bias": shape[:1]}
    for level, widths in enumerate(REFINEMENT):
        shapes |= _plain_layers(f"roi_head.SA_modules.{level}.mlps.0", widths, (1, 1))
    for head, codes in (("cls_layers", 1), ("reg_layers", 7)):
        # A dropout stands at index 3.
        name = f"roi_head.{head}"
        shapes |= {f"{name}.0.weight": (256, 512, 1), f"{name}.4.weight": (256, 256, 1)}
        shapes |= norm(f"{name}.1", 256) | norm(f"{name}.5", 256)
        shapes |= {f"{name}.7.weight": (codes, 256, 1), f"{name}.7.bias": (codes,)}
    return shapes


def _plain_layers(prefix: str, channels: tuple[int, ...], kernel: tuple[int, ...]) -> Shapes:
    """Convolution or linear layer without bias at 0, 3, 6, its normalisation at 1, 4, 7."""
    shapes: Shapes = {}
    for layer, (given, made) in enumerate(pairwise(channels)):
        shapes[f"{prefix}.{3 * layer}.weight"] = (made, given, *kernel)
        shapes |= norm(f"{prefix}.{3 * layer + 1}", made)
    return shapes


def filled(shapes: Shapes, seed: int = 0) -> dict[str, Tensor]:
    """Random weights under these names; counters are integers, as torch stores them."""
    generator = torch.Generator().manual_seed(seed)
    counters = ("num_batches_tracked", "global_step")
    return {
        name: torch.full(shape, 7, dtype=torch.long)
        if name.endswith(counters)
        else torch.randn(shape, generator=generator)
        for name, shape in shapes.items()
    }


def openpcdet_pointpillar() -> Shapes:
    """pointpillar.yaml, three classes, x y z intensity."""
    shapes: Shapes = {"global_step": (1,), "vfe.pfn_layers.0.linear.weight": (64, 10)}
    shapes |= norm("vfe.pfn_layers.0.norm", 64)
    return {**shapes, **_bev(64, [(3, 64, 1, 128), (5, 128, 2, 128), (5, 256, 4, 128)]), **_anchor_head(384)}


def openpcdet_second() -> Shapes:
    """second.yaml, three classes, x y z intensity; sparse weights as spconv 2 stores them (out, z, y, x, in)."""
    shapes: Shapes = {"global_step": (1,)}
    cube = (3, 3, 3)
    for name, given, made, kernel in [
        ("conv_input", 4, 16, cube),
        ("conv1.0", 16, 16, cube),
        ("conv2.0", 16, 32, cube),
        ("conv2.1", 32, 32, cube),
        ("conv2.2", 32, 32, cube),
        ("conv3.0", 32, 64, cube),
        ("conv3.1", 64, 64, cube),
        ("conv3.2", 64, 64, cube),
        ("conv4.0", 64, 64, cube),
        ("conv4.1", 64, 64, cube),
        ("conv4.2", 64, 64, cube),
        ("conv_out", 64, 128, (3, 1, 1)),
    ]:
        shapes[f"backbone_3d.{name}.0.weight"] = (made, *kernel, given)
        shapes |= norm(f"backbone_3d.{name}.1", made)
    return {**shapes, **_bev(256, [(5, 128, 1, 256), (5, 256, 2, 256)]), **_anchor_head(512)}


def _bev(given: int, blocks: list[tuple[int, int, int, int]]) -> Shapes:
    """Per block: layers after the first, channels, upsampling, channels after it. A padding stands at index 0."""
    shapes: Shapes = {}
    for block, (layers, channels, up, made) in enumerate(blocks):
        for layer in range(layers + 1):
            name = f"backbone_2d.blocks.{block}"
            shapes[f"{name}.{3 * layer + 1}.weight"] = (channels, channels if layer else given, 3, 3)
            shapes |= norm(f"{name}.{3 * layer + 2}", channels)
        shapes[f"backbone_2d.deblocks.{block}.0.weight"] = (channels, made, up, up)
        shapes |= norm(f"backbone_2d.deblocks.{block}.1", made)
        given = channels
    return shapes


def _anchor_head(given: int) -> Shapes:
    shapes: Shapes = {}
    for head, codes in (("cls", 18), ("box", 42), ("dir_cls", 12)):
        shapes |= {f"dense_head.conv_{head}.weight": (codes, given, 1, 1), f"dense_head.conv_{head}.bias": (codes,)}
    return shapes
