"""3D boxes from regions of the image: cut the frustums, run the network, turn the boxes back."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from auglidar_base.devices import resolve_device
from detection.frustum.checkpoints import load_frustum_checkpoint
from detection.frustum.coding import decode_heading, decode_size
from detection.frustum.frustums import Frustum, cut_frustum, is_looked_into, rotate, viewed_cloud
from detection.frustum.network import FrustumOutput, FrustumPointNet
from detection.frustum.regions import Region
from detection.frustum.samples import drawn_points, one_hot_of
from detection.kitti_format import KittiObject
from detection.types import PointFrame

Array = NDArray[np.float64]

_LEAST = 1e-12  # probability of an empty mask, whose mean does not exist
_LEAST_SIZE = 0.01  # metres; sizes are means plus residuals and could be negative


@dataclass(frozen=True)
class DecodedBoxes:
    """Boxes of B frustums, still rotated: centre (B, 3) geometric, size (B, 3) l w h, heading (B,), own_score (B,).

    own_score  log of the mean object probability of the masked points, of the best heading and of the best size
    """

    centre: Array
    size: Array
    heading: Array
    own_score: Array


def decode(output: FrustumOutput) -> DecodedBoxes:
    """The best heading bin and size cluster of each frustum with their residuals."""
    rows = np.arange(len(output.box))
    bins = output.heading_scores.argmax(dim=1).cpu().numpy()
    clusters = output.size_scores.argmax(dim=1).cpu().numpy()
    residuals = output.size_residuals.cpu().numpy().astype(np.float64)[rows, clusters]
    heading = decode_heading(bins, output.heading_residuals.cpu().numpy().astype(np.float64)[rows, bins])
    inside = output.mask.to(output.logits)
    probability = (output.logits.softmax(dim=2)[..., 1] * inside).sum(dim=1) / inside.sum(dim=1).clamp(min=1)
    best = output.heading_scores.log_softmax(dim=1).amax(dim=1) + output.size_scores.log_softmax(dim=1).amax(dim=1)
    own = (probability.clamp(min=_LEAST).log() + best).cpu().numpy().astype(np.float64)
    return DecodedBoxes(output.centre.cpu().numpy().astype(np.float64), decode_size(clusters, residuals), heading, own)


@dataclass(frozen=True)
class FrustumDetector:
    """Frustum PointNet on a device.

    points  drawn from every frustum; seed  with the frame's id it gives the draws, so results are always the same
    batch   frustums at once
    """

    model: FrustumPointNet
    device: torch.device
    points: int = 1024
    seed: int = 0
    batch: int = 32

    def detect(self, frame: PointFrame, regions: Sequence[Region]) -> list[KittiObject]:
        """One object for every region of at least 25 px height and 5 points, in the order of the regions.

        The 2D box is the region's, clipped to the image; truncation, occlusion and alpha are not estimated (-1, -1,
        -10), as published. The score is the region's, or the network's own for labelled boxes.
        Raises ValueError when the network wants an intensity that the frame lacks.
        """
        cloud = viewed_cloud(frame)
        cut = [(region, cut_frustum(cloud, region, frame.P2, self.model.channels)[0]) for region in regions]
        kept = [(region, frustum) for region, frustum in cut if is_looked_into(region, frustum)]
        digest = hashlib.sha256(f"{frame.id}/frustums".encode()).digest()
        rng = np.random.default_rng([self.seed, int.from_bytes(digest[:8], "little")])
        found = []
        for first in range(0, len(kept), self.batch):
            some = kept[first : first + self.batch]
            boxes = decode(self._run([f for _, f in some], [r.type for r, _ in some], rng))
            found += [
                _object(region, frustum, boxes, row, frame.image_size) for row, (region, frustum) in enumerate(some)
            ]
        return found

    def _run(self, frustums: Sequence[Frustum], types: Sequence[str], rng: np.random.Generator) -> FrustumOutput:
        points = np.stack([one.points[drawn_points(one.points, self.points, rng)] for one in frustums])
        inputs = (torch.from_numpy(values).to(self.device) for values in (points, one_hot_of(types)))
        with torch.inference_mode():
            output: FrustumOutput = self.model(*inputs, rng=rng)
        return output


def _object(
    region: Region, frustum: Frustum, boxes: DecodedBoxes, row: int, image_size: tuple[int, int]
) -> KittiObject:
    x, y, z = (float(value) for value in rotate(boxes.centre[row], -frustum.rotation))
    length, width, height = (max(float(value), _LEAST_SIZE) for value in boxes.size[row])
    rows, columns = image_size
    x1, y1, x2, y2 = region.bbox
    clipped = (*(min(max(value, 0.0), columns - 1.0) for value in (x1, x2)),)
    across = (*(min(max(value, 0.0), rows - 1.0) for value in (y1, y2)),)
    score = float(boxes.own_score[row]) if region.score is None else region.score
    # The heading is not wrapped again (as published): it may leave [-pi, pi].
    ry = float(boxes.heading[row]) + frustum.rotation
    bbox = (clipped[0], across[0], clipped[1], across[1])
    return KittiObject(region.type, -1, -1, -10.0, bbox, (height, width, length), (x, y + height / 2, z), ry, score)


def load_frustum_detector(path: str | Path, device: str = "cpu", seed: int = 0) -> FrustumDetector:
    """A detector from our own weights. Raises CheckpointError saying what is wrong with them."""
    place = resolve_device(device)
    return FrustumDetector(load_frustum_checkpoint(path, str(place)), place, seed=seed)
