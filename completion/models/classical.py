"""Completion without weights: linear interpolation in inverse depth, nearest sample, or morphological filling."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from completion.types import CompletedDepth, DepthFrame, FloatMap

if TYPE_CHECKING:
    from collections.abc import Callable

FAR = 100.0  # metres; the morphological method inverts depth against it


def nearest_depth(sparse: FloatMap) -> FloatMap:
    """Every pixel takes the depth of the nearest measured one (Euclidean, in pixels). All zero stays all zero."""
    from scipy.ndimage import distance_transform_edt

    if not (sparse > 0).any():
        return np.zeros_like(sparse)
    rows, columns = distance_transform_edt(sparse == 0, return_distances=False, return_indices=True)
    return np.asarray(sparse[rows, columns])


def linear_inverse_depth(sparse: FloatMap) -> FloatMap:
    """Delaunay triangulation of the samples, linear in 1 / depth inside its hull, the nearest sample outside.

    Exact on planes; invents depths between two objects. Fewer than three samples, or samples on one line: nearest.
    """
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import QhullError

    rows, columns = np.nonzero(sparse)
    filled = nearest_depth(sparse)
    if len(rows) < 3:
        return filled
    try:
        surface = LinearNDInterpolator(np.stack((rows, columns), 1), 1.0 / sparse[rows, columns].astype(np.float64))
    except QhullError:
        return filled
    inverse = surface(*np.mgrid[: sparse.shape[0], : sparse.shape[1]])
    inside = np.isfinite(inverse)
    filled[inside] = 1.0 / inverse[inside]
    return filled


def morphological(sparse: FloatMap) -> FloatMap:
    """Dilate near depths over empty pixels in growing windows, close small holes, smooth; nearest fill for the rest.

    The idea of Ku, Harakeh, Waslander, "In Defense of Classical Image Processing" (CRV 2018): on inverted depth
    (FAR - z) dilation prefers near objects. Samples beyond FAR are ignored.
    """
    import cv2

    inverted = np.where((sparse > 0) & (sparse < FAR), FAR - sparse, 0).astype(np.float32)
    if not inverted.any():
        return np.zeros_like(sparse)
    diamond = np.abs(np.mgrid[-2:3, -2:3]).sum(0) <= 2
    grown = cv2.dilate(inverted, diamond.astype(np.uint8))
    grown = cv2.morphologyEx(grown, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    for window in (7, 15, 31):
        grown = np.where(grown > 0.1, grown, cv2.dilate(grown, np.ones((window, window), np.uint8)))
    smooth = cv2.medianBlur(grown.astype(np.float32), 5)
    depth = np.where(smooth > 0.1, FAR - smooth, 0).astype(np.float32)
    return nearest_depth(depth)


METHODS: dict[str, Callable[[FloatMap], FloatMap]] = {
    "linear": linear_inverse_depth,
    "nearest": nearest_depth,
    "morphological": morphological,
}


class ClassicalCompleter:
    """`complete` by one of METHODS; the image is not used. Without any sample the depth is 0 (no value) everywhere."""

    def __init__(self, method: str = "linear") -> None:
        if method not in METHODS:
            raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
        self.method = method

    def complete(
        self, sparse: FloatMap, image: NDArray[np.uint8], K: NDArray[np.float64] | None = None
    ) -> CompletedDepth:
        """See `infer.Completer`."""
        frame = DepthFrame(image, sparse, None, K)
        return CompletedDepth(METHODS[self.method](frame.sparse))
