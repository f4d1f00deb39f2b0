"""Boxes as network targets: the bins of PointRCNN (Shi et al. 2019, sec. 3.2-3.3) and the residuals of OpenPCDet.

Offsets are metres in the frame the box is expressed in: the camera frame round a point (RPN) or the frame of a proposal
(RCNN). Sizes are h, w, l throughout.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

# Mean h, w, l of the KITTI training set per class; PointRCNN's CLS_MEAN_SIZE for cars, rounded means for the others.
MEAN_SIZES: dict[str, tuple[float, float, float]] = {
    "Car": (1.52563191462, 1.62856739989, 3.88311640418),
    "Pedestrian": (1.76, 0.66, 0.84),
    "Cyclist": (1.74, 0.60, 1.76),
    "Van": (2.21, 1.90, 5.08),
}


@dataclass(frozen=True)
class BinTargets:
    """What the bin losses compare with, all with leading shape (R,).

    x_bin, z_bin, ry_bin  int64 bin of the target        x_res, z_res  residual in bins, [-0.5, 0.5]
    ry_res                residual in half bins, [-1, 1]  y_offset      metres
    size_res              (R, 3) (size - mean) / mean for h, w, l
    """

    x_bin: Tensor
    x_res: Tensor
    z_bin: Tensor
    z_res: Tensor
    y_offset: Tensor
    ry_bin: Tensor
    ry_res: Tensor
    size_res: Tensor


@dataclass(frozen=True)
class BinCoder:
    """Bin-based box code.

    scope          the bins cover [-scope, scope] metres along x and z
    bin_size       metres
    heading_bins   bins over the full circle, or over +-45 degrees when `folded_heading`
    fine_location  a residual per x and z bin (LOC_XZ_FINE); without it a box sits at a bin centre
    folded_heading headings are folded by 180 degrees onto +-90 and clamped to +-45 (second stage, get_ry_fine)
    Channels: x bins, z bins, [x residuals, z residuals,] y offset, heading bins, heading residuals, h w l residuals.
    """

    scope: float
    bin_size: float
    heading_bins: int
    fine_location: bool
    folded_heading: bool

    @property
    def location_bins(self) -> int:
        """Bins per horizontal axis."""
        return int(self.scope / self.bin_size) * 2

    @property
    def heading_bin_size(self) -> float:
        """Radians covered by a heading bin."""
        return (math.pi / 2 if self.folded_heading else 2 * math.pi) / self.heading_bins

    @property
    def block_sizes(self) -> tuple[int, ...]:
        """Channels of x bins, z bins, x residuals, z residuals, y, heading bins, heading residuals, sizes."""
        n, fine = self.location_bins, self.location_bins if self.fine_location else 0
        return (n, n, fine, fine, 1, self.heading_bins, self.heading_bins, 3)

    @property
    def channels(self) -> int:
        """Length of the code: 76 or 52 (RPN, fine or not), 46 (RCNN)."""
        return sum(self.block_sizes)

    def split(self, code: Tensor) -> tuple[Tensor, ...]:
        """(..., channels) -> the eight blocks of `block_sizes`."""
        return code.split(list(self.block_sizes), dim=-1)

    def encode_location(self, offset: Tensor) -> tuple[Tensor, Tensor]:
        """Offset in metres -> (bin, residual in bins)."""
        shifted = (offset + self.scope).clamp(0, 2 * self.scope - 1e-3)
        index = (shifted / self.bin_size).floor()
        residual = (shifted - (index * self.bin_size + self.bin_size / 2)) / self.bin_size
        return index.long(), residual

    def encode_heading(self, ry: Tensor) -> tuple[Tensor, Tensor]:
        """Heading in radians (relative to the proposal when folded) -> (bin, residual in half bins)."""
        angle = ry.remainder(2 * math.pi)
        size = self.heading_bin_size
        if self.folded_heading:
            opposite = (angle > math.pi / 2) & (angle < 3 * math.pi / 2)
            angle = torch.where(opposite, (angle + math.pi).remainder(2 * math.pi), angle)
            shifted = (angle + math.pi / 2).remainder(2 * math.pi) - math.pi / 4
            shifted = shifted.clamp(1e-3, math.pi / 2 - 1e-3)
        else:
            shifted = (angle + size / 2).remainder(2 * math.pi)
        index = (shifted / size).floor().clamp(max=self.heading_bins - 1)
        return index.long(), (shifted - (index * size + size / 2)) / (size / 2)

    def encode(self, offsets: Tensor, sizes: Tensor, ry: Tensor, mean_sizes: Tensor) -> BinTargets:
        """Targets of R boxes.

        offsets     (R, 3) dx dy dz in metres        sizes  (R, 3) h w l
        ry          (R,) radians                     mean_sizes  (3,) or (R, 3) h w l of the class
        """
        x_bin, x_res = self.encode_location(offsets[:, 0])
        z_bin, z_res = self.encode_location(offsets[:, 2])
        ry_bin, ry_res = self.encode_heading(ry)
        size_res = (sizes - mean_sizes) / mean_sizes
        return BinTargets(x_bin, x_res, z_bin, z_res, offsets[:, 1], ry_bin, ry_res, size_res)

    def bin_centres(self, like: Tensor) -> Tensor:
        """(location_bins,) centres in metres relative to the anchor."""
        index = torch.arange(self.location_bins, device=like.device, dtype=like.dtype)
        return index * self.bin_size + self.bin_size / 2 - self.scope

    def expected_location(self, logits: Tensor, residuals: Tensor) -> Tensor:
        """Soft decoding (EPNet): sum over bins of softmax * (centre + residual), metres. (..., n) -> (...)."""
        return (logits.softmax(dim=-1) * (self.bin_centres(logits) + residuals * self.bin_size)).sum(dim=-1)

    def best_location(self, logits: Tensor, residuals: Tensor) -> Tensor:
        """Hard decoding (PointRCNN): centre of the best bin plus its residual, metres. (..., n) -> (...)."""
        best = logits.argmax(dim=-1, keepdim=True)
        location = self.bin_centres(logits)[best.squeeze(-1)]
        if self.fine_location:
            location = location + residuals.gather(-1, best).squeeze(-1) * self.bin_size
        return location

    def decode_heading(self, logits: Tensor, residuals: Tensor) -> Tensor:
        """Always the best bin: radians in (-pi, pi], or +-45 degrees when folded."""
        best = logits.argmax(dim=-1, keepdim=True)
        size = self.heading_bin_size
        offset = residuals.gather(-1, best).squeeze(-1) * (size / 2)
        best = best.squeeze(-1).to(residuals.dtype)
        if self.folded_heading:
            return best * size + size / 2 + offset - math.pi / 4
        ry = (best * size + offset).remainder(2 * math.pi)
        return torch.where(ry > math.pi, ry - 2 * math.pi, ry)

    def decode(self, code: Tensor, mean_sizes: Tensor, soft: bool) -> tuple[Tensor, Tensor, Tensor]:
        """(..., channels) -> offsets (..., 3) metres, sizes (..., 3) h w l, ry (...).

        soft  expectation over the location bins (EPNet) instead of the best bin (PointRCNN); needs fine residuals
        Sizes are linear in the code and may be <= 0 early in training.
        """
        x_bin, z_bin, x_res, z_res, y, ry_bin, ry_res, size_res = self.split(code)
        if soft and not self.fine_location:
            raise ValueError("soft bin decoding needs residuals per bin (fine_location); this code has none")
        locate = self.expected_location if soft else self.best_location
        offsets = torch.stack([locate(x_bin, x_res), y.squeeze(-1), locate(z_bin, z_res)], dim=-1)
        return offsets, size_res * mean_sizes + mean_sizes, self.decode_heading(ry_bin, ry_res)


def rpn_coder(fine_location: bool = True) -> BinCoder:
    """First stage: 12 bins of 0.5 m over +-3 m, 12 heading bins over the circle; 76 channels (52 when not fine)."""
    return BinCoder(3.0, 0.5, 12, fine_location, folded_heading=False)


def rcnn_coder() -> BinCoder:
    """Second stage: 6 bins of 0.5 m over +-1.5 m, 9 heading bins of 10 degrees; 46 channels."""
    return BinCoder(1.5, 0.5, 9, fine_location=True, folded_heading=True)


def rotate_y(points: Tensor, angle: Tensor) -> Tensor:
    """Rotate the x and z of points (..., 3) by R_y(angle), angle of broadcastable shape (...).

    x' = x cos + z sin, z' = -x sin + z cos: takes offsets of a box frame with heading `angle` into the scene.
    """
    cos, sin = angle.cos(), angle.sin()
    x, y, z = points.unbind(-1)
    return torch.stack([x * cos + z * sin, y, z * cos - x * sin], dim=-1)


def boxes_from_points(points: Tensor, code: Tensor, coder: BinCoder, mean_sizes: Tensor, soft: bool) -> Tensor:
    """First-stage decoding: (..., 3) points and their codes -> boxes (..., 7) x y z(bottom centre) h w l ry.

    The code's y is the box centre; half the decoded height brings it to the bottom (y points down).
    """
    offsets, sizes, ry = coder.decode(code, mean_sizes, soft)
    centre = points + offsets
    bottom = torch.stack([centre[..., 0], centre[..., 1] + sizes[..., 0] / 2, centre[..., 2]], dim=-1)
    return torch.cat([bottom, sizes, ry.unsqueeze(-1)], dim=-1)


def boxes_from_rois(rois: Tensor, code: Tensor, coder: BinCoder, mean_sizes: Tensor, soft: bool) -> Tensor:
    """Second-stage decoding: boxes (..., 7) refined in the frames of their RoIs (..., 7); y is bottom to bottom."""
    offsets, sizes, ry = coder.decode(code, mean_sizes, soft)
    bottom = rois[..., :3] + rotate_y(offsets, rois[..., 6])
    return torch.cat([bottom, sizes, (ry + rois[..., 6]).unsqueeze(-1)], dim=-1)


def to_roi_frame(boxes: Tensor, rois: Tensor) -> Tensor:
    """Boxes (..., 7) expressed in the frame of their RoI (..., 7): centre at its bottom centre, x along its length.

    Delta ry = ry - (ry_roi mod 2 pi), as PointRCNN computes it.
    """
    local = rotate_y(boxes[..., :3] - rois[..., :3], -rois[..., 6])
    delta = boxes[..., 6] - rois[..., 6].remainder(2 * math.pi)
    return torch.cat([local, boxes[..., 3:6], delta.unsqueeze(-1)], dim=-1)


def encode_residual(boxes: Tensor, anchors: Tensor) -> Tensor:
    """OpenPCDet's ResidualCoder: (..., 7) boxes and anchors, x y z l w h heading (centre) -> (..., 7) residuals.

    (dx/d, dy/d, dz/h_a, log l/l_a, log w/w_a, log h/h_a, dheading), d = sqrt(l_a^2 + w_a^2); SECOND (Yan et al. 2018).
    """
    diagonal = anchors[..., 3:5].norm(dim=-1, keepdim=True)
    delta = boxes[..., :3] - anchors[..., :3]
    ratios = (boxes[..., 3:6].clamp(min=1e-5) / anchors[..., 3:6].clamp(min=1e-5)).log()
    return torch.cat(
        [delta[..., :2] / diagonal, delta[..., 2:] / anchors[..., 5:6], ratios, boxes[..., 6:] - anchors[..., 6:]],
        dim=-1,
    )


def decode_residual(code: Tensor, anchors: Tensor) -> Tensor:
    """Inverse of `encode_residual`, (..., 7) -> (..., 7)."""
    diagonal = anchors[..., 3:5].norm(dim=-1, keepdim=True)
    centre = anchors[..., :3] + torch.cat([code[..., :2] * diagonal, code[..., 2:3] * anchors[..., 5:6]], dim=-1)
    return torch.cat([centre, code[..., 3:6].exp() * anchors[..., 3:6], code[..., 6:] + anchors[..., 6:]], dim=-1)


def decode_point_residual(points: Tensor, code: Tensor, mean_sizes: Tensor) -> Tensor:
    """OpenPCDet's PointResidualCoder: (..., 3) LiDAR points, (..., 8) codes, (..., 3) mean l w h -> (..., 7) boxes."""
    diagonal = mean_sizes[..., :2].norm(dim=-1, keepdim=True)
    centre = points + torch.cat([code[..., :2] * diagonal, code[..., 2:3] * mean_sizes[..., 2:]], dim=-1)
    heading = torch.atan2(code[..., 7], code[..., 6])
    return torch.cat([centre, code[..., 3:6].exp() * mean_sizes, heading.unsqueeze(-1)], dim=-1)
