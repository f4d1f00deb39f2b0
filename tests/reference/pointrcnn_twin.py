"""PointRCNN written the long way from its description: planar 1x1 convolutions on a plain state dict, loops for boxes.

Shares nothing with `detection.models` but the names of the weights; the point operations have twins of their own.
"""

from __future__ import annotations

import math
import re

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from detection.ops import ball_query, furthest_point_sample, three_nn

RADII = ((0.1, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, 4.0))
LEVELS = [(points, radii, (16, 32)) for points, radii in zip((4096, 1024, 256, 64), RADII)]


def conv(state: dict[str, Tensor], prefix: str, x: Tensor, relu: bool = True) -> Tensor:
    """(C, ...) -> (C', ...): convolution, batch normalisation in eval mode when there is one, ReLU."""
    weight = state[f"{prefix}.conv.weight"].flatten(1)
    y = torch.einsum("oc,c...->o...", weight, x)
    shape = [-1] + [1] * (x.dim() - 1)
    if f"{prefix}.conv.bias" in state:
        y = y + state[f"{prefix}.conv.bias"].view(shape)
    if f"{prefix}.bn.bn.weight" in state:
        mean, var = state[f"{prefix}.bn.bn.running_mean"].view(shape), state[f"{prefix}.bn.bn.running_var"].view(shape)
        y = (y - mean) / (var + 1e-5).sqrt()
        y = y * state[f"{prefix}.bn.bn.weight"].view(shape) + state[f"{prefix}.bn.bn.bias"].view(shape)
    return F.relu(y) if relu else y


def mlp(state: dict[str, Tensor], prefix: str, x: Tensor) -> Tensor:
    """layer0, layer1, ... in turn."""
    k = 0
    while f"{prefix}.layer{k}.conv.weight" in state:
        x = conv(state, f"{prefix}.layer{k}", x)
        k += 1
    return x


def set_abstraction(
    state: dict[str, Tensor],
    prefix: str,
    xyz: Tensor,
    features: Tensor | None,
    level: tuple[int, tuple[float, ...], tuple[int, ...]],
) -> tuple[Tensor, Tensor]:
    """xyz (N, 3), features (C, N) -> centres (M, 3), features (C', M)."""
    points, radii, counts = level
    centres = xyz[furthest_point_sample(xyz, points)]
    out = []
    for branch, (radius, count) in enumerate(zip(radii, counts)):
        index = ball_query(xyz, centres, radius, count)
        group = (xyz[index] - centres[:, None]).permute(2, 0, 1)
        if features is not None:
            group = torch.cat([group, features[:, index]])
        out.append(mlp(state, f"{prefix}.mlps.{branch}", group).amax(dim=2))
    return centres, torch.cat(out)


def backbone(state: dict[str, Tensor], points: Tensor) -> Tensor:
    """points (N, 3 + E) -> (128, N)."""
    prefix = "rpn.backbone_net"
    xyz = [points[:, :3].contiguous()]
    features = [points[:, 3:].T.contiguous() if points.shape[1] > 3 else None]
    for k, level in enumerate(LEVELS):
        centres, described = set_abstraction(state, f"{prefix}.SA_modules.{k}", xyz[-1], features[-1], level)
        xyz.append(centres)
        features.append(described)
    for k in (3, 2, 1, 0):
        distance, index = three_nn(xyz[k], xyz[k + 1])
        inverse = 1 / (distance + 1e-8)
        weight = (inverse / inverse.sum(dim=1, keepdim=True)).float()
        known = features[k + 1]
        assert known is not None
        mixed = (known[:, index] * weight).sum(dim=2)
        skip = features[k]
        features[k] = mlp(state, f"{prefix}.FP_modules.{k}.mlp", mixed if skip is None else torch.cat([mixed, skip]))
    assert features[0] is not None
    return features[0]


def heads(state: dict[str, Tensor], features: Tensor) -> tuple[Tensor, Tensor]:
    """(128, N) -> class logits (N,), codes (N, C)."""
    names = ("rpn.rpn_cls_layer", "rpn.rpn_reg_layer")
    cls, reg = (conv(state, f"{name}.2", conv(state, f"{name}.0", features), relu=False) for name in names)
    return cls[0], reg.T


def decode(code: np.ndarray, scope: float, head_bins: int, fine: bool, soft: bool, folded: bool) -> list[float]:
    """One code -> dx dy dz h w l ry relative to its anchor, number by number."""
    n, size = int(scope / 0.5) * 2, 0.5
    at = 0

    def take(count: int) -> np.ndarray:
        nonlocal at
        at += count
        return code[at - count : at].astype(np.float64)

    x_bin, z_bin = take(n), take(n)
    x_res, z_res = (take(n), take(n)) if fine else (np.zeros(n), np.zeros(n))

    def place(logits: np.ndarray, residual: np.ndarray) -> float:
        positions = [k * size + size / 2 - scope + residual[k] * size for k in range(n)]
        if not soft:
            return positions[int(np.argmax(logits))]
        weights = np.exp(logits - logits.max())
        return float((weights / weights.sum() * positions).sum())

    dx, dz, dy = place(x_bin, x_res), place(z_bin, z_res), float(take(1)[0])
    ry_bin, ry_res = take(head_bins), take(head_bins)
    best = int(np.argmax(ry_bin))
    if folded:
        per = (math.pi / 2) / head_bins
        ry = best * per + per / 2 + ry_res[best] * per / 2 - math.pi / 4
    else:
        per = 2 * math.pi / head_bins
        ry = (best * per + ry_res[best] * per / 2) % (2 * math.pi)
        ry = ry - 2 * math.pi if ry > math.pi else ry
    mean = (1.52563191462, 1.62856739989, 3.88311640418)
    h, w, l = (r * m + m for r, m in zip(take(3), mean))
    return [dx, dy, dz, h, w, l, ry]


def proposal_boxes(points: Tensor, codes: Tensor, fine: bool, soft: bool) -> np.ndarray:
    """(N, 7) boxes with bottom centres."""
    rows = []
    for point, code in zip(points[:, :3].double().numpy(), codes.numpy()):
        dx, dy, dz, h, w, l, ry = decode(code, 3.0, 12, fine, soft, folded=False)
        rows.append([point[0] + dx, point[1] + dy + h / 2, point[2] + dz, h, w, l, ry])
    return np.array(rows)


def pool(points: Tensor, extra: Tensor, roi: np.ndarray, margin: float) -> Tensor | None:
    """(512, 3 + C) the first points inside the enlarged RoI, repeated in a cycle; None when it is empty."""
    x, y, z, h, w, l, ry = roi
    inside = []
    for k, (px, py, pz) in enumerate(points[:, :3].double().numpy()):
        along = (px - x) * math.cos(ry) - (pz - z) * math.sin(ry)
        across = (px - x) * math.sin(ry) + (pz - z) * math.cos(ry)
        near = abs(px - x) <= 10 and abs(pz - z) <= 10
        level = y + margin - (h + 2 * margin) <= py <= y + margin
        if near and level and abs(along) <= l / 2 + margin and abs(across) <= w / 2 + margin:
            inside.append(k)
    if not inside:
        return None
    chosen = [inside[k % len(inside)] for k in range(512)] if len(inside) < 512 else inside[:512]
    return torch.cat([points[:, :3], extra], dim=1)[chosen]


def refine(
    state: dict[str, Tensor],
    points: Tensor,
    logits: Tensor,
    features: Tensor,
    roi: np.ndarray,
    mask: float,
    margin: float,
    soft: bool,
) -> tuple[float, np.ndarray]:
    """Logit and refined box (7,) of one RoI."""
    flag = (logits.sigmoid() > mask).float()[:, None]
    depth = points[:, :3].norm(dim=1, keepdim=True) / 70 - 0.5
    pooled = pool(points, torch.cat([flag, depth, features.T], dim=1), roi, margin)
    pooled = torch.zeros(512, 133) if pooled is None else pooled.clone()
    x, y, z, _, _, _, ry = roi
    dx, dy, dz = pooled[:, 0] - x, pooled[:, 1] - y, pooled[:, 2] - z
    pooled[:, 0] = dx * math.cos(ry) - dz * math.sin(ry)
    pooled[:, 1] = dy
    pooled[:, 2] = dx * math.sin(ry) + dz * math.cos(ry)
    xyz = pooled[:, :3].contiguous()
    local = mlp(state, "rcnn_net.xyz_up_layer", pooled[:, :5].T)
    merged = mlp(state, "rcnn_net.merge_down_layer", torch.cat([local, pooled[:, 5:].T]))
    for k, level in enumerate([(128, (0.2,), (64,)), (32, (0.4,), (64,))]):
        xyz, merged = set_abstraction(state, f"rcnn_net.SA_modules.{k}", xyz, merged, level)
    described = mlp(state, "rcnn_net.SA_modules.2.mlps.0", torch.cat([xyz.T, merged])).amax(dim=1, keepdim=True)
    out = []
    for name in ("rcnn_net.cls_layer", "rcnn_net.reg_layer"):
        hidden = conv(state, f"{name}.2", conv(state, f"{name}.0", described))
        out.append(conv(state, f"{name}.3", hidden, relu=False)[:, 0])
    dx, dy, dz, h, w, l, dry = decode(out[1].numpy(), 1.5, 9, True, soft, folded=True)
    box_x = x + dx * math.cos(ry) + dz * math.sin(ry)
    box_z = z - dx * math.sin(ry) + dz * math.cos(ry)
    return float(out[0][0]), np.array([box_x, y + dy, box_z, h, w, l, ry + dry])


def official_names(state: dict[str, Tensor], bare: str) -> dict[str, Tensor]:
    """OpenPCDet's indexed names (0 convolution, 1 normalisation, 2 ReLU, ...) as layer0.conv, layer0.bn.bn, ...

    bare  pattern of the modules whose convolutions follow each other without normalisation (0, 2, ...)
    """
    found = {}
    for name, value in state.items():
        match = re.fullmatch(r"(.*)\.(\d+)\.(\w+)", name)
        if match is None:
            continue
        prefix, index, part = match[1], int(match[2]), match[3]
        period = 2 if re.search(bare, prefix) else 3
        kind = "conv" if index % period == 0 else "bn.bn"
        found[f"{prefix}.layer{index // period}.{kind}.{part}".replace("backbone_3d.", "rpn.backbone_net.")] = value
    return found


def openpcdet_refine(
    state: dict[str, Tensor], points: Tensor, extra: Tensor, roi: np.ndarray
) -> tuple[float, np.ndarray]:
    """Logit and refined box (7,) of one LiDAR-form RoI; extra (N, 2 + 128) score, depth, features."""
    x, y, z, l, w, h, heading = roi
    d = points[:, :3].double().numpy() - [x, y, z]
    c, s = math.cos(heading), math.sin(heading)
    local = np.stack([d[:, 0] * c + d[:, 1] * s, d[:, 1] * c - d[:, 0] * s, d[:, 2]], axis=1)
    inside = np.flatnonzero((np.abs(local) <= [l / 2, w / 2, h / 2]).all(axis=1))[:512]
    rows = torch.zeros(512, 133)
    if len(inside):
        chosen = np.resize(inside, 512)
        rows = torch.cat([torch.tensor(local[chosen], dtype=torch.float32), extra[chosen]], dim=1)
    xyz = rows[:, :3].contiguous()
    up = mlp(state, "roi_head.xyz_up_layer", rows[:, :5].T)
    merged = mlp(state, "roi_head.merge_down_layer", torch.cat([up, rows[:, 5:].T]))
    for k, level in enumerate([(128, (0.2,), (16,)), (32, (0.4,), (16,))]):
        xyz, merged = set_abstraction(state, f"roi_head.SA_modules.{k}", xyz, merged, level)
    described = mlp(state, "roi_head.SA_modules.2.mlps.0", torch.cat([xyz.T, merged])).amax(dim=1, keepdim=True)
    out = []
    for name in ("cls_layers", "reg_layers"):
        hidden = described
        for conv_index, norm_index in ((0, 1), (4, 5)):
            hidden = dense(state, f"roi_head.{name}", conv_index, norm_index, hidden)
        out.append(state[f"roi_head.{name}.7.weight"].flatten(1) @ hidden + state[f"roi_head.{name}.7.bias"][:, None])
    code = out[1][:, 0].double().numpy()
    diagonal = math.hypot(l, w)
    dx, dy = code[0] * diagonal, code[1] * diagonal
    centre = [x + dx * c - dy * s, y + dx * s + dy * c, z + code[2] * h]
    sizes = np.exp(code[3:6]) * [l, w, h]
    return float(out[0][0, 0]), np.array([*centre, *sizes, code[6] + heading])


def dense(state: dict[str, Tensor], prefix: str, conv_index: int, norm_index: int, x: Tensor) -> Tensor:
    """(C, N): convolution without bias, normalisation with running statistics, ReLU, named by index."""
    y = state[f"{prefix}.{conv_index}.weight"].flatten(1) @ x
    weight, bias, mean, var = (
        state[f"{prefix}.{norm_index}.{part}"][:, None] for part in ("weight", "bias", "running_mean", "running_var")
    )
    return F.relu((y - mean) / (var + 1e-5).sqrt() * weight + bias)
