"""A trained segmentation network on images: labels, and scores of groups of classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from pipeline.semantics.conventions import GROUPS
from pipeline.semantics.network import StreetSegmenter
from pipeline.semantics.pictures import image_tensor
from pipeline.semantics.pyramid import PyramidSegmenter

SegmentationNetwork = StreetSegmenter | PyramidSegmenter


class NetworkSegmenter:
    """A trained network; one of the pyramid is changed for speed and cannot be trained on.

    thresholds  score (summed probability) from which a pixel is of a group ("vehicles", "people"), whatever else is
                likelier; below it the pixel gets the likeliest class outside. A group without one competes as it is.

    Raises ValueError for an unknown group or a threshold outside [0, 1].
    """

    def __init__(self, model: SegmentationNetwork, thresholds: Mapping[str, float] | None = None) -> None:
        self.thresholds = dict(thresholds or {})
        for group, threshold in self.thresholds.items():
            if group not in GROUPS or not 0 <= threshold <= 1:
                known = ", ".join(GROUPS)
                raise ValueError(f"thresholds: expected {known} in [0, 1], got {group} {threshold:g}")
        self.model = model.eval()
        if isinstance(model, PyramidSegmenter):
            model.fuse()
            model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB -> (H, W) uint8 Cityscapes trainIds."""
        height, width = image.shape[:2]
        # Arg max at half size, then doubled: 19 maps of full size would cost more than the network itself.
        half = ((height + 1) // 2, (width + 1) // 2)
        with torch.inference_mode():
            logits = F.interpolate(self._logits(image), size=half, mode="bilinear", align_corners=False)[0]
            found = _thresholded(logits, self.thresholds) if self.thresholds else logits.argmax(dim=0)
            labels = found.to(torch.uint8).numpy()
        return np.ascontiguousarray(labels.repeat(2, axis=0).repeat(2, axis=1)[:height, :width])

    def scores(self, image: NDArray[np.uint8], groups: Sequence[Sequence[int]]) -> NDArray[np.float32]:
        """(G, H, W) float32 probabilities that a pixel shows any class of each of G groups of trainIds (soft masks)."""
        with torch.inference_mode():
            probability = self._logits(image).softmax(dim=1)
            sums = torch.cat([probability[:, list(group)].sum(dim=1, keepdim=True) for group in groups], dim=1)
            full = F.interpolate(sums, size=image.shape[:2], mode="bilinear", align_corners=False)
        return full[0].clamp(0, 1).numpy()

    def score(self, image: NDArray[np.uint8], classes: Sequence[int]) -> NDArray[np.float32]:
        """(H, W) float32 probability that a pixel shows any of `classes`."""
        return self.scores(image, [classes])[0]

    def _logits(self, image: NDArray[np.uint8]) -> Tensor:
        """(1, 19, ceil(H / 4), ceil(W / 4))."""
        pixels = image_tensor(image, self.model.normalisation)
        logits: Tensor = self.model(pixels.contiguous(memory_format=torch.channels_last))
        return logits.contiguous()


def _thresholded(logits: Tensor, thresholds: Mapping[str, float]) -> Tensor:
    """(19, h, w) logits -> (h, w) labels: the likeliest class outside the groups that have a threshold, but that of a
    group wherever its summed probability reaches it. Where two groups reach theirs, the later in `GROUPS` counts.
    """
    probability = logits.softmax(dim=0)
    groups = {name: list(classes) for name, classes in GROUPS.items() if name in thresholds}
    grouped = {number for classes in groups.values() for number in classes}
    others = torch.tensor([number for number in range(len(logits)) if number not in grouped])
    labels = others[logits[others].argmax(dim=0)]
    for name, classes in groups.items():
        reached = probability[classes].sum(dim=0) >= thresholds[name]
        labels[reached] = torch.tensor(classes)[logits[classes][:, reached].argmax(dim=0)]
    return labels
