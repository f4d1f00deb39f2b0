"""What the networks are asked to say: labels of points, and the proposals the second stage is trained on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from detection.ops import iou_3d, iou_3d_aligned, points_in_boxes


def enlarged(boxes: Tensor, margin: float) -> Tensor:
    """Boxes (..., 7) grown by `margin` metres on every side (the bottom sinks by it)."""
    x, y, z, h, w, l, ry = boxes.unbind(-1)
    return torch.stack([x, y + margin, z, h + 2 * margin, w + 2 * margin, l + 2 * margin, ry], dim=-1)


def point_labels(points: Tensor, boxes: Tensor, classes: Tensor, ring: float = 0.2) -> tuple[Tensor, Tensor]:
    """Foreground labels of the first stage.

    points   (N, 3) camera frame         boxes  (G, 7) x y z h w l ry          classes  (G,) int64 >= 1
    ring     points outside a box but within this many metres of it are ignored
    Returns labels (N,): class inside a box, -1 in a ring, 0 elsewhere; and the box (N,) int64 of foreground points.
    Boxes count one after the other: the last box that touches a point decides, as in PointRCNN.
    """
    labels = torch.zeros(len(points), dtype=torch.long, device=points.device)
    if len(boxes) == 0:
        return labels, labels.clone()
    points = points.contiguous()
    inside = points_in_boxes(points, boxes).T
    touched = inside | points_in_boxes(points, enlarged(boxes, ring)).T
    order = torch.arange(1, len(boxes) + 1, device=points.device)
    last = (touched * order).amax(dim=1)
    box = (last - 1).clamp(min=0)
    is_inside = inside.gather(1, box.unsqueeze(1)).squeeze(1)
    labels = torch.where(last > 0, torch.where(is_inside, classes[box], -1), labels)
    return labels, box


@dataclass(frozen=True)
class RoiSamplingSettings:
    """Which proposals train the second stage (PointRCNN; OpenPCDet's values differ as its preset says).

    rois          RoIs per frame, of which at most half foreground
    foreground    IoU3D from which a proposal is foreground      background  below it, background
    easy          below it, easy background; hard_share of the background is hard
    noise_tries   redraws of a foreground RoI's noise while its IoU is below `foreground` (0: no noise at all)
    keep          probability that a try leaves the RoI as it is
    """

    rois: int = 64
    foreground: float = 0.55
    background: float = 0.45
    easy: float = 0.05
    hard_share: float = 0.8
    noise_tries: int = 10
    keep: float = 0.2


# Rows of RoI noise: metres, share of the size, radians ('multiple' of PointRCNN).
_NOISE = np.array(
    [
        [0.2, 0.10, math.pi / 12],
        [0.3, 0.15, math.pi / 12],
        [0.5, 0.15, math.pi / 9],
        [0.8, 0.15, math.pi / 6],
        [1.0, 0.15, math.pi / 3],
    ]
)


def choose_rois(
    best_iou: NDArray[np.floating], settings: RoiSamplingSettings, rng: np.random.Generator
) -> tuple[NDArray[np.int64], int]:
    """Indices of the proposals to train on, foreground first, and how many of them are foreground.

    best_iou  (P,) IoU3D of each proposal with its best ground truth
    Proposals between `background` and `foreground` are never drawn. Foreground is drawn without replacement when there
    is background as well, everything else with replacement. When neither kind exists the highest IoUs count as
    background, so that no frame fails.
    """
    total = settings.rois
    foreground = np.flatnonzero(best_iou >= settings.foreground)
    easy = np.flatnonzero(best_iou < settings.easy)
    hard = np.flatnonzero((best_iou >= settings.easy) & (best_iou < settings.background))
    if not len(easy) and not len(hard):
        if not len(foreground):
            return np.resize(np.argsort(-best_iou, kind="stable"), total), 0
        return rng.choice(foreground, total), total
    count = min(total // 2, len(foreground))
    chosen = [rng.permutation(foreground)[:count]]
    rest = total - count
    hard_count = int(settings.hard_share * rest) if len(easy) and len(hard) else (rest if len(hard) else 0)
    for kind, number in ((hard, hard_count), (easy, rest - hard_count)):
        if number:
            chosen.append(rng.choice(kind, number))
    return np.concatenate(chosen).astype(np.int64), count


def perturb(boxes: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """(R, 7) boxes with a random row of position, size and heading noise each."""
    position, size, heading = _NOISE[rng.integers(len(_NOISE), size=len(boxes))].T
    moved = boxes.copy()
    moved[:, :3] += rng.uniform(-1, 1, (len(boxes), 3)) * position[:, None]
    moved[:, 3:6] *= 1 + rng.uniform(-1, 1, (len(boxes), 3)) * size[:, None]
    moved[:, 6] += rng.uniform(-1, 1, len(boxes)) * heading
    return moved


def add_roi_noise(
    rois: NDArray[np.float64],
    truth: NDArray[np.float64],
    foreground: int,
    settings: RoiSamplingSettings,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """RoIs with noise, and their IoU3D with `truth` (R, 7): the first `foreground` rows get several tries, others one.

    While the IoU is below `settings.foreground` a try leaves the RoI alone with probability `keep`, else perturbs the
    original; every RoI is tried at least once.
    """
    noisy = rois.copy()
    iou = np.zeros(len(rois))
    for attempt in range(settings.noise_tries):
        open_ = np.flatnonzero(iou < settings.foreground)
        if attempt:
            open_ = open_[open_ < foreground]
        if not len(open_):
            break
        moved = perturb(rois[open_], rng)
        kept = rng.uniform(size=len(open_)) < settings.keep
        moved[kept] = rois[open_][kept]
        noisy[open_] = moved
        iou[open_] = iou_3d_aligned(moved, truth[open_])
    return noisy, iou


@dataclass(frozen=True)
class RoiTargets:
    """Training RoIs of one frame.

    rois, truth  (R, 7) camera form; where iou is 0 the truth is arbitrary
    iou          (R,) IoU3D of RoI (with its noise) and truth
    source       (R,) int64 proposal each RoI was made from
    """

    rois: Tensor
    truth: Tensor
    iou: Tensor
    source: Tensor


def sample_rois(
    proposals: Tensor,
    proposal_classes: Tensor,
    boxes: Tensor,
    classes: Tensor,
    settings: RoiSamplingSettings,
    rng: np.random.Generator,
) -> RoiTargets:
    """Draw, perturb and label the RoIs of one frame (PointRCNN's proposal target layer).

    proposals  (P, 7) without padding       proposal_classes  (P,) int64 >= 1
    boxes      (G, 7)                       classes           (G,) int64 >= 1
    A proposal is matched with the ground truth of its own class only.
    Ground truth is not added to the proposals. Raises ValueError without any proposal.
    """
    if not len(proposals):
        raise ValueError("sample_rois: expected at least one proposal, got none")
    candidates = proposals.detach().cpu().double().numpy()
    truth = boxes.detach().cpu().double().numpy()
    same_class = (proposal_classes[:, None] == classes[None, :]).cpu().numpy()
    if len(truth):
        overlap = np.asarray(iou_3d(candidates, truth)) * same_class
        matched, best = overlap.argmax(axis=1), overlap.max(axis=1)
    else:
        matched, best = np.zeros(len(candidates), dtype=np.int64), np.zeros(len(candidates))
    chosen, foreground = choose_rois(best, settings, rng)
    rois, iou = candidates[chosen], best[chosen]
    truth_boxes = truth[matched[chosen]] if len(truth) else rois.copy()
    if settings.noise_tries and len(truth):
        rois, iou = add_roi_noise(rois, truth_boxes, foreground, settings, rng)
        iou = iou * same_class[chosen, matched[chosen]]

    def tensor(values: NDArray[Any]) -> Tensor:
        return torch.as_tensor(values, device=proposals.device).to(proposals.dtype)

    source = torch.as_tensor(chosen, device=proposals.device)
    return RoiTargets(tensor(rois), tensor(truth_boxes), tensor(iou), source)


def classification_labels(iou: Tensor, empty: Tensor) -> Tensor:
    """(R,) labels of RoIs: 1 above IoU 0.6, -1 (ignored) between 0.45 and 0.6 or when no point was pooled, else 0."""
    labels = (iou > 0.6).to(iou.dtype)
    ignored = ((iou > 0.45) & (iou < 0.6)) | empty
    return torch.where(ignored, torch.full_like(labels, -1.0), labels)


def soft_labels(iou: Tensor, low: float = 0.25, high: float = 0.75) -> Tensor:
    """IoU-guided scores: clip((IoU - low) / (high - low), 0, 1) (PV-RCNN, Shi et al. 2020, eq. 6)."""
    return ((iou - low) / (high - low)).clamp(0, 1)
