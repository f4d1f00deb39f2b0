"""The losses of PointRCNN (Shi et al. 2019), EPNet (Huang et al. 2020) and OpenPCDet's PointRCNN."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from detection.models.box_coding import BinCoder, BinTargets


def sigmoid_focal(logits: Tensor, targets: Tensor, alpha: float = 0.25, gamma: float = 2.0) -> Tensor:
    """Element-wise focal loss (Lin et al. 2017, eq. 5) of logits against targets in {0, 1}; same shape."""
    cross_entropy = F.binary_cross_entropy_with_logits(logits, targets, reduction="none")
    probability = logits.sigmoid()
    missing = targets * (1 - probability) + (1 - targets) * probability
    weight = targets * alpha + (1 - targets) * (1 - alpha)
    return weight * missing.pow(gamma) * cross_entropy


def foreground_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """RPN classification: focal loss summed over all points of the batch / max(positives, 1).

    logits  (B, N) or (B, N, classes)
    labels  (B, N) int64: 0 background, c >= 1 class c, -1 ignored
    """
    if logits.dim() == labels.dim():
        logits = logits.unsqueeze(-1)
    classes = torch.arange(1, logits.shape[-1] + 1, device=labels.device)
    targets = (labels.unsqueeze(-1) == classes).to(logits.dtype)
    loss = sigmoid_focal(logits, targets)
    kept = (labels >= 0).to(logits.dtype).unsqueeze(-1)
    return (loss * kept).sum() / (labels > 0).sum().clamp(min=1)


def dice_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """PointRCNN's DiceLoss: 1 - sum min(p, t) / max(sum max(p, t), 1) over all points that are not ignored.

    logits (B, N) or (B, N, 1), p = sigmoid        labels (B, N) int64: 0 background (t = 0), 1 (t = 1), -1 ignored
    """
    probability, kept = logits.reshape(labels.shape).sigmoid(), labels >= 0
    probability, target = probability[kept], (labels[kept] > 0).to(logits.dtype)
    union = torch.maximum(probability, target).sum().clamp(min=1.0)
    return 1.0 - torch.minimum(probability, target).sum() / union


def weighted_bce(logits: Tensor, labels: Tensor, foreground_weight: float = 15.0) -> Tensor:
    """PointRCNN's BinaryCrossEntropy: foreground counts `foreground_weight` times (FG_WEIGHT), mean over labels >= 0.

    logits (B, N) or (B, N, 1)        labels (B, N) int64: 0 background, 1 foreground, -1 ignored
    The sum is divided by the number of points, not by their weights.
    """
    kept = labels >= 0
    target = (labels[kept] > 0).to(logits.dtype)
    weight = 1.0 + (foreground_weight - 1.0) * target
    logits = logits.reshape(labels.shape)[kept]
    loss = F.binary_cross_entropy_with_logits(logits, target, weight=weight, reduction="sum")
    return loss / kept.sum().clamp(min=1)


# PointRCNN's RPN.LOSS_CLS: SigmoidFocalLoss (its configuration), DiceLoss, BinaryCrossEntropy.
SEGMENTATION_LOSSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "focal": foreground_loss,
    "dice": dice_loss,
    "bce": weighted_bce,
}


@dataclass(frozen=True)
class BoxLoss:
    """The parts of a box loss, scalars."""

    location: Tensor
    heading: Tensor
    size: Tensor

    def total(self) -> Tensor:
        """location + heading + 3 * size."""
        return self.location + self.heading + 3.0 * self.size


def _of_bin(residuals: Tensor, index: Tensor) -> Tensor:
    """(R, n) residuals, (R,) target bins -> (R,) the residual of the target bin; other bins get no gradient."""
    return residuals.gather(1, index.unsqueeze(1)).squeeze(1)


def bin_box_loss(code: Tensor, targets: BinTargets, coder: BinCoder) -> BoxLoss:
    """Bin losses of R foreground points or valid RoIs, each term a mean over them (PointRCNN eq. 3 and 7).

    code  (R, coder.channels). Location: cross entropy of the x and z bins, smooth L1 of their residuals and of y (m);
    heading: cross entropy and smooth L1; size: smooth L1 over R x 3. With R = 0 every part is a differentiable zero.
    """
    if len(code) == 0:
        zero = code.sum() * 0.0
        return BoxLoss(zero, zero, zero)
    x_bin, z_bin, x_res, z_res, y, ry_bin, ry_res, size_res = coder.split(code)
    location = F.cross_entropy(x_bin, targets.x_bin) + F.cross_entropy(z_bin, targets.z_bin)
    location = location + F.smooth_l1_loss(y.squeeze(1), targets.y_offset)
    if coder.fine_location:
        location = location + F.smooth_l1_loss(_of_bin(x_res, targets.x_bin), targets.x_res)
        location = location + F.smooth_l1_loss(_of_bin(z_res, targets.z_bin), targets.z_res)
    heading = F.cross_entropy(ry_bin, targets.ry_bin)
    heading = heading + F.smooth_l1_loss(_of_bin(ry_res, targets.ry_bin), targets.ry_res)
    return BoxLoss(location, heading, F.smooth_l1_loss(size_res, targets.size_res))


def _of_target_bins(code: Tensor, targets: BinTargets, coder: BinCoder) -> tuple[Tensor, Tensor]:
    """(R,) x and z in metres where the residuals of the target bins put them, whatever the bins' logits."""
    _, _, x_res, z_res, *_ = coder.split(code)
    centres = coder.bin_centres(code)
    x = centres[targets.x_bin] + _of_bin(x_res, targets.x_bin) * coder.bin_size
    z = centres[targets.z_bin] + _of_bin(z_res, targets.z_bin) * coder.bin_size
    return x, z


def _expected(code: Tensor, coder: BinCoder) -> tuple[Tensor, Tensor]:
    """(R,) x and z in metres as the expectations over the bins."""
    x_bin, z_bin, x_res, z_res, *_ = coder.split(code)
    return coder.expected_location(x_bin, x_res), coder.expected_location(z_bin, z_res)


def aligned_iou(
    code: Tensor, targets: BinTargets, sizes: Tensor, mean_sizes: Tensor, coder: BinCoder, raw: bool = False
) -> Tensor:
    """(R,) overlap of coded boxes and their targets as EPNet takes it (sec. 3.4), differentiable.

    sizes  (R, 3) true h w l in metres      mean_sizes  (3,) or (R, 3)
    raw    the predicted x and z are those of the target bins (EPNet's IOU_LOSS_TYPE raw), not the expectations over
           the bins (its cls_mask_with_bin)
    Axis-aligned in the local frame: l along x, h along y, w along z, headings left out. Overlaps are clamped to 1e-3
    per axis, the predicted volume to 1e-3.
    """
    x, z = _of_target_bins(code, targets, coder) if raw else _expected(code, coder)
    *_, y, _, _, size_res = coder.split(code)
    predicted = torch.stack([x, y.squeeze(1), z], dim=1)
    centres = coder.bin_centres(code)
    true_x = centres[targets.x_bin] + targets.x_res * coder.bin_size
    true_z = centres[targets.z_bin] + targets.z_res * coder.bin_size
    true = torch.stack([true_x, targets.y_offset, true_z], dim=1)
    predicted_size = size_res * mean_sizes + mean_sizes
    order = [2, 0, 1]  # h w l -> extents along x (l), y (h), z (w)
    half, true_half = predicted_size[:, order] / 2, sizes[:, order] / 2
    upper = torch.minimum(predicted + half, true + true_half)
    lower = torch.maximum(predicted - half, true - true_half)
    shared = (upper - lower).clamp(min=1e-3).prod(dim=1)
    volume = predicted_size.prod(dim=1).clamp(min=1e-3)
    return shared / (volume + sizes.prod(dim=1) - shared)


def consistency_loss(
    logits: Tensor,
    code: Tensor,
    targets: BinTargets,
    sizes: Tensor,
    mean_sizes: Tensor,
    coder: BinCoder,
    raw: bool = False,
) -> Tensor:
    """EPNet's consistency enforcing loss (sec. 3.4): mean of -log(max(c * IoU, 1e-4)) over R rows.

    logits  (R,) classification logits, c = sigmoid, *not* detached; IoU and the other arguments: see `aligned_iou`
    """
    if len(code) == 0:
        return code.sum() * 0.0
    iou = aligned_iou(code, targets, sizes, mean_sizes, coder, raw)
    return -(logits.sigmoid() * iou).clamp(min=1e-4).log().mean()


def iou_branch_loss(raw: Tensor, iou: Tensor) -> Tensor:
    """EPNet's IoU branch: binary cross entropy of its raw output (R,) against the detached IoU, both clamped.

    No sigmoid: the output is clamped to [1e-4, 0.9999] like the IoU (R,), see `aligned_iou`.
    """
    if len(raw) == 0:
        return raw.sum() * 0.0
    return F.binary_cross_entropy(raw.clamp(1e-4, 0.9999), iou.detach().clamp(1e-4, 0.9999))


def masked_bce(logits: Tensor, labels: Tensor) -> Tensor:
    """Binary cross entropy of logits (R,) against labels in [0, 1], averaged over labels >= 0 (-1 is ignored)."""
    kept = labels >= 0
    if not bool(kept.any()):
        return logits.sum() * 0.0
    return F.binary_cross_entropy_with_logits(logits[kept], labels[kept].to(logits.dtype))


def smooth_l1(difference: Tensor, beta: float = 1.0 / 9.0) -> Tensor:
    """Element-wise smooth L1 with its kink at `beta` (OpenPCDet's WeightedSmoothL1)."""
    size = difference.abs()
    return torch.where(size < beta, 0.5 * size * size / beta, size - 0.5 * beta)


def box_corners(boxes: Tensor) -> Tensor:
    """(R, 7) camera-form boxes -> (R, 8, 3) corners, bottom face first, differentiable."""
    signs_l = boxes.new_tensor([1, 1, -1, -1, 1, 1, -1, -1]) / 2
    signs_w = boxes.new_tensor([1, -1, -1, 1, 1, -1, -1, 1]) / 2
    up = boxes.new_tensor([0, 0, 0, 0, 1, 1, 1, 1])
    x, y, z, h, w, l, ry = boxes.unsqueeze(2).unbind(1)
    along, across = l * signs_l, w * signs_w
    cos, sin = ry.cos(), ry.sin()
    return torch.stack([x + along * cos + across * sin, y - h * up, z - along * sin + across * cos], dim=-1)


def corner_loss(predicted: Tensor, true: Tensor) -> Tensor:
    """OpenPCDet's corner loss: (R,) mean Huber distance of the corners to `true`, or to it turned by pi if nearer.

    predicted, true  (R, 7) camera-form boxes
    """
    corners, straight = box_corners(predicted), box_corners(true)
    turned = box_corners(torch.cat([true[:, :6], true[:, 6:] + math.pi], dim=1))
    distance = torch.minimum((corners - straight).norm(dim=2), (corners - turned).norm(dim=2))
    return smooth_l1(distance, beta=1.0).mean(dim=1)
