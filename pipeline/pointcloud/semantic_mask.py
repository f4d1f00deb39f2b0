"""Which pixels belong to relevant objects (thesis 5.3.4.2): hard mask, dilated mask or soft score."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from auglidar_base.errors import SettingsError
from pipeline.pointcloud.radius_gather import Radii

# Cityscapes trainIds of what the thesis names: vehicles, pedestrians and cyclists.
VEHICLES = (13, 14, 15)
OBJECTS = (11, 12, 13, 14, 15, 17, 18)


def _one_radius() -> Radii:
    """0.3 m at every distance (5.3.4.2)."""
    return Radii(0.3, 0.3)


@dataclass(frozen=True)
class SemanticMask:
    """Keep relevant points and the background near them.

    dilate     pixels by which the mask grows (square neighbourhood); 0 = hard mask
    threshold  score from which a pixel is relevant, when a score map is given instead of labels
    context    radii within which points around relevant points are kept too, or None for relevant points only
    """

    dilate: int = 0
    threshold: float = 0.5
    context: Radii | None = field(default_factory=_one_radius)

    def __post_init__(self) -> None:
        if self.dilate < 0:
            raise SettingsError(f"semantic mask: expected a dilation >= 0 pixels, got {self.dilate}")
        if not 0 <= self.threshold <= 1:
            raise SettingsError(f"semantic mask: expected a threshold in [0, 1], got {self.threshold:g}")


def object_score(semantics: NDArray[Any], classes: tuple[int, ...]) -> NDArray[np.float32]:
    """(H, W) float32 in [0, 1], how sure a pixel belongs to a relevant object.

    semantics  (H, W) uint8 Cityscapes trainIds: 1 for `classes`, else 0; or a (H, W) float32 score map, taken as it is.

    Raises ValueError for other shapes and types and for scores outside [0, 1].
    """
    if semantics.ndim != 2:
        raise ValueError(f"semantics: expected an (H, W) map, got shape {semantics.shape}")
    if semantics.dtype == np.uint8:
        relevant = np.zeros(256, np.float32)
        relevant[list(classes)] = 1
        return relevant[semantics]
    if semantics.dtype != np.float32:
        raise ValueError(f"semantics: expected uint8 trainIds or a float32 score map, got {semantics.dtype}")
    if not ((semantics >= 0) & (semantics <= 1)).all():
        raise ValueError("semantics: expected scores in [0, 1], got values outside it or NaN")
    return semantics


def semantic_mask(score: NDArray[np.float32], mask: SemanticMask) -> NDArray[np.bool_]:
    """(H, W) score -> (H, W) mask: score >= threshold, grown by `dilate` pixels to every side."""
    relevant = score >= np.float32(mask.threshold)
    if mask.dilate == 0:
        return relevant
    import cv2

    size = 2 * mask.dilate + 1
    return cv2.dilate(relevant.astype(np.uint8), np.ones((size, size), np.uint8)).astype(np.bool_)
