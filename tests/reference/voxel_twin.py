"""The voxel detectors written the long way: dense convolutions with masks on a plain state dict, loops for the rest.

Shares nothing with `detection.models` but the names of the weights.
"""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

State = dict[str, Tensor]


def norm(state: State, name: str, x: Tensor, eps: float, axis: int = 1) -> Tensor:
    """Batch normalisation with running statistics along `axis`."""
    shape = [1] * x.dim()
    shape[axis] = -1
    mean, var, scale, shift = (
        state[f"{name}.{key}"].view(shape) for key in ("running_mean", "running_var", "weight", "bias")
    )
    return (x - mean) / torch.sqrt(var + eps) * scale + shift


def sparse_layer(
    state: State,
    name: str,
    dense: Tensor,
    active: Tensor,
    stride: tuple[int, ...] = (1, 1, 1),
    padding: tuple[int, ...] | None = None,
) -> tuple[Tensor, Tensor]:
    """Convolution `name.0`, normalisation `name.1`, ReLU on (1, C, Z, Y, X) with its mask; no padding: submanifold."""
    weight = state[f"{name}.0.weight"].permute(0, 4, 1, 2, 3)
    if padding is None:
        out, mask = F.conv3d(dense, weight, padding=1), active
    else:
        out = F.conv3d(dense, weight, stride=stride, padding=padding)
        mask = F.conv3d(active, torch.ones(1, 1, *weight.shape[2:]), stride=stride, padding=padding).clamp(max=1)
    return F.relu(norm(state, f"{name}.1", out, 1e-3)) * mask, mask


def sparse_backbone(state: State, dense: Tensor, active: Tensor) -> tuple[list[tuple[Tensor, Tensor]], Tensor]:
    """x_conv1 ... x_conv4 with their masks, and the bird's-eye map (1, C * D, Y, X)."""
    p = "backbone_3d."
    x = sparse_layer(state, p + "conv_input", dense, active)
    x = sparse_layer(state, p + "conv1.0", *x)
    levels = [x]
    for level, padding in ((2, (1, 1, 1)), (3, (1, 1, 1)), (4, (0, 1, 1))):
        x = sparse_layer(state, f"{p}conv{level}.0", *x, stride=(2, 2, 2), padding=padding)
        x = sparse_layer(state, f"{p}conv{level}.1", *x)
        x = sparse_layer(state, f"{p}conv{level}.2", *x)
        levels.append(x)
    out, _ = sparse_layer(state, p + "conv_out", *x, stride=(2, 1, 1), padding=(0, 0, 0))
    _, c, d, h, w = out.shape
    bev = torch.stack([out[0, channel, layer] for channel in range(c) for layer in range(d)])
    return levels, bev.view(1, c * d, h, w)


def bev_backbone(state: State, bev: Tensor, layers: tuple[int, ...], strides: tuple[int, ...]) -> Tensor:
    """2D backbone; the upsampling is read off the transposed kernels."""
    ups = []
    for i, (count, stride) in enumerate(zip(layers, strides)):
        name = f"backbone_2d.blocks.{i}"
        for k in range(count + 1):
            weight = state[f"{name}.{3 * k + 1}.weight"]
            bev = F.conv2d(bev, weight, stride=stride if k == 0 else 1, padding=1)
            bev = F.relu(norm(state, f"{name}.{3 * k + 2}", bev, 1e-3))
        weight = state[f"backbone_2d.deblocks.{i}.0.weight"]
        up = F.conv_transpose2d(bev, weight, stride=weight.shape[-1])
        ups.append(F.relu(norm(state, f"backbone_2d.deblocks.{i}.1", up, 1e-3)))
    return torch.cat(ups, dim=1)


def pillar_features(state: State, points: list[list[float]], centre: tuple[float, float, float], slots: int) -> Tensor:
    """(C,) feature of one pillar from its points; empty slots are zero rows."""
    rows = torch.tensor(points)
    mean = rows[:, :3].mean(dim=0)
    full = torch.cat([rows, rows[:, :3] - mean, rows[:, :3] - torch.tensor(centre)], dim=1)
    full = torch.cat([full, torch.zeros(slots - len(rows), full.shape[1])])
    out = full @ state["vfe.pfn_layers.0.linear.weight"].T
    return F.relu(norm(state, "vfe.pfn_layers.0.norm", out, 1e-3)).max(dim=0).values


def decoded_anchors(
    state: State,
    bev: Tensor,
    classes: list[tuple[tuple[float, float, float], float]],
    low: tuple[float, ...],
    high: tuple[float, ...],
) -> tuple[np.ndarray, np.ndarray]:
    """(A, classes) logits and (A, 7) boxes of one map, one anchor after the other; classes: (l w h, bottom height)."""
    cls, box, facing = (
        F.conv2d(bev, state[f"dense_head.{name}.weight"], state[f"dense_head.{name}.bias"])[0].double().numpy()
        for name in ("conv_cls", "conv_box", "conv_dir_cls")
    )
    _, rows, columns = cls.shape
    scores, boxes = [], []
    for j in range(rows):
        for i in range(columns):
            for k, ((l, w, h), bottom) in enumerate(classes):
                for r, turn in enumerate((0.0, 1.57)):
                    a = 2 * k + r
                    x = low[0] + i * (high[0] - low[0]) / (columns - 1)
                    y = low[1] + j * (high[1] - low[1]) / (rows - 1)
                    t = box[7 * a : 7 * a + 7, j, i]
                    d = math.hypot(l, w)
                    side = int(facing[2 * a + 1, j, i] > facing[2 * a, j, i])
                    angle = t[6] + turn - 0.78539
                    angle = angle - math.floor(angle / math.pi) * math.pi + 0.78539 + math.pi * side
                    size = (l * math.exp(t[3]), w * math.exp(t[4]), h * math.exp(t[5]))
                    boxes.append((x + t[0] * d, y + t[1] * d, bottom + h / 2 + t[2] * h, *size, angle))
                    scores.append(cls[len(classes) * a : len(classes) * (a + 1), j, i])
    return np.array(scores), np.array(boxes)


def grid_points(roi: list[float], size: int) -> list[tuple[float, float, float]]:
    """The grid of one RoI (LiDAR form), x outermost."""
    x, y, z, l, w, h, heading = roi
    found = []
    for i in range(size):
        for j in range(size):
            for k in range(size):
                a, b, c = (((n + 0.5) / size - 0.5) * s for n, s in zip((i, j, k), (l, w, h)))
                cos, sin = math.cos(heading), math.sin(heading)
                found.append((x + a * cos - b * sin, y + a * sin + b * cos, z + c))
    return found


def refined(roi: list[float], code: list[float]) -> list[float]:
    """The box a code (7,) makes of a RoI (7,)."""
    x, y, z, l, w, h, heading = roi
    d = math.hypot(l, w)
    a, b = code[0] * d, code[1] * d
    cos, sin = math.cos(heading), math.sin(heading)
    sizes = [l * math.exp(code[3]), w * math.exp(code[4]), h * math.exp(code[5])]
    return [x + a * cos - b * sin, y + a * sin + b * cos, z + code[2] * h, *sizes, heading + code[6]]


def voxel_neighbours(
    place: tuple[float, float, float],
    active: Tensor,
    low: tuple[float, ...],
    size: tuple[float, ...],
    stride: int,
    radius: float,
) -> list[tuple[int, int, int]]:
    """Active voxels (z, y, x) of a mask (Z, Y, X), within 4 voxels and the radius of a place, at most 16, in order."""
    home = [math.floor(math.floor((p - start) / step) / stride) for p, start, step in zip(place, low, size)]
    found: list[tuple[int, int, int]] = []
    for z in range(home[2] - 4, home[2] + 5):
        for y in range(home[1] - 4, home[1] + 5):
            for x in range(home[0] - 4, home[0] + 5):
                inside = 0 <= z < active.shape[0] and 0 <= y < active.shape[1] and 0 <= x < active.shape[2]
                if not inside or not active[z, y, x]:
                    continue
                centre = [(n + 0.5) * step * stride + start for n, step, start in zip((x, y, z), size, low)]
                if math.dist(centre, place) <= radius and len(found) < 16:
                    found.append((z, y, x))
    return found


def voxel_pool(
    state: State,
    name: str,
    level: tuple[Tensor, Tensor],
    places: list[tuple[float, float, float]],
    low: tuple[float, ...],
    size: tuple[float, ...],
    stride: int,
    radius: float,
) -> Tensor:
    """(M, C) Voxel-RCNN's aggregation at each place."""

    def layer(kind: str, row: Tensor) -> Tensor:
        out = row @ state[f"{name}.{kind}.0.0.weight"].flatten(1).T
        return norm(state, f"{name}.{kind}.0.1", out, 1e-5)

    dense, active = level[0][0], level[1][0, 0]
    pooled = []
    for place in places:
        rows = []
        for z, y, x in voxel_neighbours(place, active, low, size, stride, radius):
            centre = [(n + 0.5) * step * stride + start for n, step, start in zip((x, y, z), size, low)]
            offset = torch.tensor([c - p for c, p in zip(centre, place)])
            rows.append(layer("mlps_in", dense[None, :, z, y, x]) + layer("mlps_pos", offset[None]))
        if not rows:
            rows.append(layer("mlps_pos", torch.zeros(1, 3)))
        best = F.relu(torch.cat(rows)).max(dim=0, keepdim=True).values
        pooled.append(F.relu(layer("mlps_out", best)))
    return torch.cat(pooled)


def ball_pool(
    state: State,
    name: str,
    sources: Tensor,
    features: Tensor,
    places: Tensor,
    radii: tuple[float, ...],
    neighbours: tuple[int, ...],
) -> Tensor:
    """(M, C) set abstraction of PV-RCNN at each place: two layers per ball, empty balls see one row of zeros."""
    columns = []
    for b, (radius, count) in enumerate(zip(radii, neighbours)):
        pooled = []
        for place in places:
            near = [i for i, gap in enumerate((sources - place).square().sum(dim=1).tolist()) if gap < radius**2][
                :count
            ]
            rows = torch.cat([sources[near] - place, features[near]], dim=1)
            if not near:
                rows = torch.zeros(1, 3 + features.shape[1])
            for k in (0, 3):
                rows = rows @ state[f"{name}.mlps.{b}.{k}.weight"].flatten(1).T
                rows = F.relu(norm(state, f"{name}.mlps.{b}.{k + 1}", rows, 1e-5))
            pooled.append(rows.max(dim=0).values)
        columns.append(torch.stack(pooled))
    return torch.cat(columns, dim=1)


def map_value(bev: Tensor, x: float, y: float) -> Tensor:
    """(C,) bilinear value of (C, Y, X); zero where the upper neighbour does not exist (the reference's weights)."""
    x0, y0 = math.floor(x), math.floor(y)
    if x0 + 1 >= bev.shape[2] or y0 + 1 >= bev.shape[1]:
        return torch.zeros(bev.shape[0])
    a, b = x - x0, y - y0
    top = bev[:, y0, x0] * (1 - a) + bev[:, y0, x0 + 1] * a
    return top * (1 - b) + (bev[:, y0 + 1, x0] * (1 - a) + bev[:, y0 + 1, x0 + 1] * a) * b


def layers(state: State, name: str, row: Tensor, indices: tuple[int, ...]) -> Tensor:
    """Products at `indices`, each followed by its normalisation when it has one, and ReLU."""
    for k in indices:
        row = row @ state[f"{name}.{k}.weight"].flatten(1).T
        if f"{name}.{k}.bias" in state:
            row = row + state[f"{name}.{k}.bias"]
        else:
            row = F.relu(norm(state, f"{name}.{k + 1}", row, 1e-5))
    return row
