"""How good a segmentation network is on held-out frames while it is trained."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F

from pipeline.semantics.conventions import CLASSES, NONE
from pipeline.semantics.inference import SegmentationNetwork
from pipeline.semantics.pictures import LabelledImage, image_tensor


def validation_figures(
    model: SegmentationNetwork, frames: Sequence[LabelledImage], device: torch.device
) -> dict[str, float]:
    """Shares in [0, 1] of the labelled pixels, at half size as the network labels: "pixel_accuracy", and "mean_iou"
    over the classes that the frames show. The network should be in evaluation mode.
    """
    count = len(CLASSES)
    confusion = np.zeros((count, count), np.int64)  # truth, found
    for frame in frames:
        truth = frame.semantics[::2, ::2]
        with torch.inference_mode():
            logits = model(image_tensor(frame.image, model.normalisation).to(device))
            half = F.interpolate(logits, size=truth.shape, mode="bilinear", align_corners=False)
            found = half.argmax(dim=1)[0].cpu().numpy()
        known = (truth != NONE) & (truth < count)
        pairs = truth[known].astype(np.int64) * count + found[known]
        confusion += np.bincount(pairs, minlength=count * count).reshape(count, count)
    hit, shown = np.diag(confusion), confusion.sum(axis=1)
    seen = shown > 0
    union = shown + confusion.sum(axis=0) - hit
    return {
        "pixel_accuracy": float(hit.sum() / max(shown.sum(), 1)),
        "mean_iou": float((hit[seen] / union[seen]).mean()) if seen.any() else 0.0,
    }
