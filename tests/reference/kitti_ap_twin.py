"""KITTI AP the obvious way: plain Python loops over lists of objects, one matching per threshold and frame.

Slow on purpose. The rotated overlap is a polygon clip (Sutherland-Hodgman), unlike the fast evaluator's integral.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from detection.kitti_format import KittiObject

Frames = Sequence[Sequence[KittiObject]]
Polygon = list[tuple[float, float]]

NOTHING = -10000000.0
NEIGHBOUR = {"car": "van", "pedestrian": "person_sitting"}


def rectangle(item: KittiObject) -> Polygon:
    (x, _, z), (_, w, l) = item.location, item.size
    cos, sin = math.cos(item.ry), math.sin(item.ry)
    corners = [(l / 2, w / 2), (l / 2, -w / 2), (-l / 2, -w / 2), (-l / 2, w / 2)]
    return [(x + a * cos + b * sin, z - a * sin + b * cos) for a, b in corners]


def area(polygon: Polygon) -> float:
    following = polygon[1:] + polygon[:1]
    return abs(sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(polygon, following))) / 2


def clipped(polygon: Polygon, clip: Polygon) -> Polygon:
    """The part of `polygon` inside the convex clockwise `clip`."""
    for start, end in zip(clip, clip[1:] + clip[:1]):

        def side(p: tuple[float, float], start=start, end=end) -> float:
            return (end[0] - start[0]) * (p[1] - start[1]) - (end[1] - start[1]) * (p[0] - start[0])

        kept: Polygon = []
        for p, q in zip(polygon, polygon[1:] + polygon[:1]):
            if side(p) <= 0:
                kept.append(p)
            if side(p) * side(q) < 0:
                t = side(p) / (side(p) - side(q))
                kept.append((p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])))
        polygon = kept
    return polygon


def overlap(kind: str, detection: KittiObject, label: KittiObject, *, of_detection: bool = False) -> float:
    if kind == "2d":
        a, b = detection.bbox, label.bbox
        width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
        if width <= 0 or height <= 0:
            return 0.0
        shared = width * height
        size_a, size_b = (a[2] - a[0]) * (a[3] - a[1]), (b[2] - b[0]) * (b[3] - b[1])
    else:
        polygon = clipped(rectangle(detection), rectangle(label))
        shared = area(polygon) if len(polygon) > 2 else 0.0
        size_a, size_b = (item.size[1] * item.size[2] for item in (detection, label))
        if kind == "3d":
            tops = [item.location[1] - item.size[0] for item in (detection, label)]
            shared *= max(0.0, min(detection.location[1], label.location[1]) - max(tops))
            size_a, size_b = size_a * detection.size[0], size_b * label.size[0]
    return shared / size_a if of_detection else shared / (size_a + size_b - shared)


def label_flag(item: KittiObject, cls: str, level: int, flavor: str) -> int:
    name = item.type.lower()
    limit = (40, 25, 25)[level]
    low = item.height_2d <= limit if flavor == "python" else item.height_2d < limit
    ignore = low or item.occluded > level or item.truncated > (0.15, 0.3, 0.5)[level]
    if name == cls.lower():
        return 1 if ignore else 0
    return 1 if NEIGHBOUR.get(cls.lower()) == name else -1


def detection_flag(item: KittiObject, cls: str, level: int) -> int:
    if int(abs(item.height_2d)) < (40, 25, 25)[level]:
        return 1
    return 0 if item.type.lower() == cls.lower() else -1


def frame_statistics(labels, detections, kind, cls, level, iou, flavor, threshold):
    """tp, fp, similarity and scores of true positives of one frame; threshold None is the pass that collects scores."""
    flags = [detection_flag(d, cls, level) for d in detections]
    taken = [False] * len(detections)
    out = [threshold is not None and d.score < threshold for d in detections]
    tp, similarity, scores = 0, 0.0, []
    for label in labels:
        flag = label_flag(label, cls, level, flavor)
        if flag == -1:
            continue
        best, best_iou, best_score, ignored = -1, 0.0, NOTHING, False
        for j, detection in enumerate(detections):
            if flags[j] == -1 or taken[j] or out[j]:
                continue
            value = overlap(kind, detection, label)
            if value <= iou:
                continue
            if threshold is None:
                if detection.score > best_score:
                    best, best_score = j, detection.score
            elif flags[j] == 0 and (value > best_iou or ignored):
                best, best_iou, ignored = j, value, False
            elif flags[j] == 1 and best == -1:
                best, ignored = j, True
        if best == -1:
            continue
        taken[best] = True
        if flag == 0 and flags[best] == 0:
            tp += 1
            scores.append(detections[best].score)
            similarity += (1 + math.cos(label.alpha - detections[best].alpha)) / 2
    fp = 0
    for j, detection in enumerate(detections):
        if flags[j] != 0 or taken[j] or out[j]:
            continue
        stuff = [item for item in labels if item.type.lower() == "dontcare"] if flavor == "cpp" or kind == "2d" else []
        if not any(overlap(kind, detection, item, of_detection=True) > iou for item in stuff):
            fp += 1
    return tp, fp, similarity, scores


def thresholds_of(scores: list[float], n_labels: int) -> list[float]:
    scores = sorted(scores, reverse=True)
    chosen, recall = [], 0.0
    for i, score in enumerate(scores):
        left = (i + 1) / n_labels
        last = i == len(scores) - 1
        right = left if last else (i + 2) / n_labels
        if right - recall < recall - left and not last:
            continue
        chosen.append(score)
        recall += 1 / 40
    return chosen


def average_precision(
    labels: Frames,
    detections: Frames,
    cls: str,
    metric: str,
    iou: float,
    level: int,
    *,
    flavor: str = "cpp",
    recall_points: int = 40,
) -> float:
    """AP in percent of one class, metric ("2d", "aos", "bev", "3d") and difficulty level (0, 1, 2)."""
    kind = "2d" if metric == "aos" else metric
    setting = (kind, cls, level, iou, flavor)
    scores: list[float] = []
    for g, d in zip(labels, detections):
        scores += frame_statistics(g, d, *setting, None)[3]
    n_labels = sum(label_flag(item, cls, level, flavor) == 0 for items in labels for item in items)
    samples = [0.0] * 41
    for k, threshold in enumerate(thresholds_of(scores, n_labels)[:41]):
        tp = fp = 0
        similarity = 0.0
        for g, d in zip(labels, detections):
            found = frame_statistics(g, d, *setting, threshold)
            tp, fp, similarity = tp + found[0], fp + found[1], similarity + found[2]
        samples[k] = (similarity if metric == "aos" else tp) / max(tp + fp, 1)
    for k in reversed(range(40)):
        samples[k] = max(samples[k], samples[k + 1])
    kept = samples[1:] if recall_points == 40 else samples[::4]
    return 100 * sum(kept) / recall_points
