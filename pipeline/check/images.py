"""Checks of images: red and blue exchanged; does the image belong to the cloud?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.calibration import Calibration
from pipeline.geometry.project import project_points

# Neighbouring frames that are tried when image and cloud do not fit.
OFFSETS = (-2, -1, 1, 2)
_CELL = 4
# A KITTI frame has about 9000 cells with returns.
_FEWEST_CELLS = 1000
# Shifts in cells by which a crop that was not undone moves the image: KITTI's (23, 13) px, the centre crop's (11, 13).
CROP_SHIFTS = tuple(
    (s * rows, s * columns) for rows, columns in ((6, 3), (3, 3), (0, 3), (6, 0), (3, 0)) for s in (1, -1)
)


def colours_swapped(image: NDArray[np.uint8]) -> tuple[float, float] | None:
    """(sky, vegetation) evidence that red and blue of an outdoor (H, W, 3) image are exchanged (grey levels), or None.

    Bright parts of the upper image are bluish (sky, haze: B > R) and greenish pixels are yellowish (leaves: R > B). On
    KITTI's frames both differences are positive (sky 8 to 108, vegetation 1.4 to 9.9 on frames 000000-000010), so after
    an exchange both are negative; one alone (a warm wall, shade) is no evidence.
    """
    pixels = image.astype(np.float32)
    top = pixels[: int(0.45 * len(pixels))]
    brightness = top.mean(axis=-1)
    bright = (brightness > 150) & (brightness < 250)
    red, green, blue = pixels[..., 0], pixels[..., 1], pixels[..., 2]
    greenish = (green > 1.08 * np.maximum(red, blue)) & (green > 40)
    if bright.sum() < 200 or greenish.sum() < 200:
        return None
    sky = float((top[..., 2] - top[..., 0])[bright].mean())
    vegetation = float((red - blue)[greenish].mean())
    return (sky, vegetation) if sky < -6 and vegetation < -1 else None


@dataclass(frozen=True)
class Structure:
    """Small maps (at a quarter of the resolution) by which images and clouds are compared.

    edges  (h, w) int8, strength of the image's edges against their surroundings
    steps  (h, w) uint8, depth steps between a cell's returns and its neighbours', 0 = none
    seen   (h, w) bool, cells with a return
    """

    edges: NDArray[np.int8]
    steps: NDArray[np.uint8]
    seen: NDArray[np.bool_]


def structure(image: NDArray[np.uint8], points: NDArray[np.floating], calibration: Calibration) -> Structure | None:
    """The maps of one frame, None with too few returns to compare; points (N, 3+) in the LiDAR frame."""
    size = (image.shape[0] // _CELL, image.shape[1] // _CELL)
    if min(size) < 8:
        return None
    steps, seen = _depth_steps(points, calibration, size)
    if seen.sum() < _FEWEST_CELLS:
        return None
    return Structure(_image_edges(image, size), steps, seen)


def _image_edges(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.int8]:
    import cv2

    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    strength = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3), cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3))
    cells = strength[: size[0] * _CELL, : size[1] * _CELL]
    small = np.log1p(cv2.resize(cells, (size[1], size[0]), interpolation=cv2.INTER_AREA))
    local = small - cv2.GaussianBlur(small, (0, 0), 12)
    return np.asarray((20 * local).clip(-127, 127), dtype=np.int8)


def _depth_steps(
    points: NDArray[np.floating], calibration: Calibration, size: tuple[int, int]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Largest ratio of the nearest returns within 3 x 3 cells, and the cells with returns."""
    import cv2

    whole = project_points(points, calibration, (size[0] * _CELL, size[1] * _CELL))
    cells = np.where(whole > 0, whole, np.inf).reshape(size[0], _CELL, size[1], _CELL)
    nearest = cells.min(axis=(1, 3))
    seen = np.isfinite(nearest)
    log = np.log(np.where(seen, nearest, 1.0)).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    highest = cv2.dilate(np.where(seen, log, np.float32(-9)), kernel)
    lowest = cv2.erode(np.where(seen, log, np.float32(9)), kernel)
    steps = np.where(seen, (highest - lowest).clip(0, 1), 0)
    return np.asarray(255 * steps, dtype=np.uint8), seen


def agreement(cloud: Structure, image: Structure) -> float:
    """Correlation of the cloud's depth steps with the image's edges over the cells with returns.

    0.08 to 0.26 for the same frame, -0.04 to 0.16 for two different ones (KITTI object 000000-000010).
    """
    height = min(cloud.seen.shape[0], image.edges.shape[0])
    width = min(cloud.seen.shape[1], image.edges.shape[1])
    window = np.s_[:height, :width]
    seen = cloud.seen[window]
    steps, edges = cloud.steps[window][seen].astype(np.float64), image.edges[window][seen].astype(np.float64)
    spread = steps.std() * edges.std() if len(steps) else 0.0
    return float(((steps - steps.mean()) * (edges - edges.mean())).mean() / spread) if spread > 0 else 0.0


def shift_gains(maps: Structure) -> tuple[float, ...]:
    """By how much each of CROP_SHIFTS makes a frame's cloud fit its image better than it does in place.

    Negative for a frame in order (at most +0.03 on KITTI object 000000-000010); 0.1 to 0.26 for the shift of a crop.
    """
    in_place = agreement(maps, maps)
    gains = []
    for rows, columns in CROP_SHIFTS:
        moved = Structure(
            _window(maps.edges, rows, columns),
            _window(maps.steps, -rows, -columns),
            _window(maps.seen, -rows, -columns),
        )
        gains.append(agreement(moved, moved) - in_place)
    return tuple(gains)


def _window(cells: NDArray[Any], rows: int, columns: int) -> NDArray[Any]:
    """The part of a map that is left when it is moved up by `rows` and left by `columns`."""
    height, width = cells.shape
    return cells[max(rows, 0) : height + min(rows, 0), max(columns, 0) : width + min(columns, 0)]
