"""Turning and enlarging whole training frames (the augmentation of Park et al., ECCV 2020, after Ma and Karaman 2018).

Depth keeps measured values: it is read at the nearest pixel, and an enlarged view is a nearer one.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from completion.types import FloatMap

Views = tuple[FloatMap, NDArray[np.uint8], FloatMap]


def turned(views: Views, degrees: float) -> Views:
    """Sparse (H, W), RGB (H, W, 3) and target (H, W) turned counter-clockwise about the centre; 0 where nothing was."""
    sparse, image, target = views
    height, width = sparse.shape
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, 1.0)

    def warp(values: NDArray[np.generic], how: int) -> NDArray[np.generic]:
        return np.asarray(cv2.warpAffine(values, matrix, (width, height), flags=how))

    depths = [np.asarray(warp(depth, cv2.INTER_NEAREST), np.float32) for depth in (sparse, target)]
    return depths[0], np.asarray(warp(image, cv2.INTER_CUBIC), np.uint8), depths[1]


def enlarged(views: Views, factor: float) -> Views:
    """The same at int(H x factor) rows, columns in proportion; depths over the factor. ValueError for a factor < 1."""
    if factor < 1:
        raise ValueError(f"factor: expected >= 1, got {factor}")
    sparse, image, target = views
    height, width = sparse.shape
    size = (int(width * factor), int(height * factor))
    depths = [
        cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST) / np.float32(factor) for depth in (sparse, target)
    ]
    colours = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(depths[0], np.float32), np.asarray(colours, np.uint8), np.asarray(depths[1], np.float32)
