"""The losses of PointRCNN and EPNet, one box at a time in plain Python."""

from __future__ import annotations

import math

MEAN = (1.52563191462, 1.62856739989, 3.88311640418)


def softmax(values: list[float]) -> list[float]:
    top = max(values)
    exponentials = [math.exp(v - top) for v in values]
    return [e / sum(exponentials) for e in exponentials]


def huber(x: float) -> float:
    return 0.5 * x * x if abs(x) < 1 else abs(x) - 0.5


def location_target(offset: float, scope: float, size: float) -> tuple[int, float]:
    shift = min(max(offset + scope, 0.0), 2 * scope - 1e-3)
    index = math.floor(shift / size)
    return index, (shift - (index * size + size / 2)) / size


def heading_target(ry: float, bins: int, folded: bool) -> tuple[int, float]:
    angle = ry % (2 * math.pi)
    if not folded:
        per = 2 * math.pi / bins
        shift = (angle + per / 2) % (2 * math.pi)
    else:
        per = (math.pi / 2) / bins
        if math.pi / 2 < angle < 1.5 * math.pi:
            angle = (angle + math.pi) % (2 * math.pi)
        shift = (angle + math.pi / 2) % (2 * math.pi) - math.pi / 4
        shift = min(max(shift, 1e-3), math.pi / 2 - 1e-3)
    index = math.floor(shift / per)
    return index, (shift - (index * per + per / 2)) / (per / 2)


def blocks(code: list[float], n: int, heading: int) -> dict[str, list[float]]:
    """A fine code cut into its named parts."""
    sizes = {"xb": n, "zb": n, "xr": n, "zr": n, "y": 1, "rb": heading, "rr": heading, "s": 3}
    found, at = {}, 0
    for name, size in sizes.items():
        found[name] = code[at : at + size]
        at += size
    return found


def box_loss(code: list[float], box: list[float], scope: float, heading: int, folded: bool) -> float:
    """location + heading + 3 size of one box (dx dy dz h w l ry); the size term is the mean over its three parts."""
    n = int(scope / 0.5) * 2
    part = blocks(code, n, heading)
    total = huber(part["y"][0] - box[1])
    for axis, value in (("x", box[0]), ("z", box[2])):
        index, residual = location_target(value, scope, 0.5)
        total += -math.log(softmax(part[axis + "b"])[index]) + huber(part[axis + "r"][index] - residual)
    index, residual = heading_target(box[6], heading, folded)
    total += -math.log(softmax(part["rb"])[index]) + huber(part["rr"][index] - residual)
    sizes = [huber(r - (s - m) / m) for r, s, m in zip(part["s"], box[3:6], MEAN)]
    return total + 3 * sum(sizes) / 3


def consistency(logit: float, code: list[float], box: list[float], scope: float, heading: int) -> float:
    """-log(max(c * IoU, 1e-4)) of one box, axis-aligned and centred in the local frame."""
    n = int(scope / 0.5) * 2
    part = blocks(code, n, heading)

    def expected(axis: str) -> float:
        weights = softmax(part[axis + "b"])
        return sum(w * (k * 0.5 + 0.25 - scope + r * 0.5) for k, (w, r) in enumerate(zip(weights, part[axis + "r"])))

    def target(value: float) -> float:
        index, residual = location_target(value, scope, 0.5)
        return index * 0.5 + 0.25 - scope + residual * 0.5

    h, w, l = (r * m + m for r, m in zip(part["s"], MEAN))
    sides = [
        (expected("x"), l, target(box[0]), box[5]),
        (part["y"][0], h, box[1], box[3]),
        (expected("z"), w, target(box[2]), box[4]),
    ]
    shared = 1.0
    for p, s, t, st in sides:
        shared *= max(min(p + s / 2, t + st / 2) - max(p - s / 2, t - st / 2), 1e-3)
    volume = max(h * w * l, 1e-3)
    iou = shared / (volume + box[3] * box[4] * box[5] - shared)
    return -math.log(max(iou / (1 + math.exp(-logit)), 1e-4))
