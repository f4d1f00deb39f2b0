"""Arrays as small pictures inside the page: colour scales, maps, bird's-eye view."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

RGB = NDArray[np.uint8]

# Depth is coloured over this range on a logarithmic scale: a car length matters more at 8 m than at 60 m.
NEAR, FAR = 2.0, 80.0
DEPTH_TICKS = (2, 5, 10, 20, 40, 80)
# Depth error is coloured from 0 to this on a square root scale.
LARGEST_ERROR = 5.0
ERROR_TICKS = (0.0, 0.2, 1.0, 2.5, 5.0)
NO_VALUE = np.array([24, 28, 34], np.uint8)
# Surfaces less than this apart (metres) are one surface to the eye; their sigma is drawn in this grey.
APART, UNDECIDED = 0.5, np.array([70, 76, 84], np.uint8)

# Bird's-eye view, metres: forward from the sensor and to both sides.
FORWARD, SIDE = 80.0, 40.0
BEV_PIXELS_PER_METRE = 8
# Okabe and Ito's palette: told apart with any colour vision, on white and on black.
MEASURED_COLOUR, COMPLETED_COLOUR = (86, 140, 200), (230, 159, 0)


def depth_colours() -> RGB:
    """(256, 3) RGB from near (bright) to far (dark): viridis reversed."""
    import cv2

    ramp = np.arange(255, -1, -1, dtype=np.uint8)[None]
    return np.ascontiguousarray(cv2.applyColorMap(ramp, cv2.COLORMAP_VIRIDIS)[0, :, ::-1])


def sigma_colours() -> RGB:
    """(256, 3) RGB from 0 (all background, blue) over 0.5 (undecided, pale) to 1 (all foreground, orange)."""
    stops = np.array([[33, 102, 172], [146, 197, 222], [247, 247, 247], [244, 165, 66], [179, 88, 6]], float)
    at = np.linspace(0, 1, len(stops))
    steps = np.linspace(0, 1, 256)
    return np.stack([np.interp(steps, at, stops[:, c]) for c in range(3)], axis=1).round().astype(np.uint8)


def colour_depth(depth: NDArray[np.float32]) -> RGB:
    """(H, W) metres -> (H, W, 3) RGB on the shared logarithmic scale; pixels without a value take one dark colour."""
    valid = depth > 0
    share = np.log(np.maximum(depth, NEAR) / NEAR) / np.log(FAR / NEAR)
    picture = depth_colours()[(share.clip(0, 1) * 255).astype(np.uint8)]
    picture[~valid] = NO_VALUE
    return np.asarray(picture, dtype=np.uint8)


def colour_sparse(depth: NDArray[np.float32]) -> RGB:
    """As `colour_depth`, every return drawn three pixels wide; the nearer one wins where they overlap."""
    import cv2

    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    grown = cv2.dilate(inverse, np.ones((3, 3), np.uint8))
    return colour_depth(np.divide(1, grown, out=np.zeros_like(grown), where=grown > 0).astype(np.float32))


def colour_sigma(sigma: NDArray[np.float32], valid: NDArray[np.bool_]) -> RGB:
    """(H, W) in [0, 1] -> RGB; pixels without depth take the dark colour."""
    picture = sigma_colours()[(sigma.clip(0, 1) * 255).round().astype(np.uint8)]
    picture[~valid] = NO_VALUE
    return np.asarray(picture, dtype=np.uint8)


def widened(depth: NDArray[np.float32], nearest: bool) -> NDArray[np.float32]:
    """(H, W) metres, each pixel the nearest (or the farthest) value of its 5 x 5 neighbourhood; 0 = no value."""
    import cv2

    kernel = np.ones((5, 5), np.uint8)
    if not nearest:
        return np.asarray(cv2.dilate(depth, kernel), dtype=np.float32)
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    grown = cv2.dilate(inverse, kernel)
    return np.divide(1, grown, out=np.zeros_like(grown), where=grown > 0).astype(np.float32)


def colour_gap(gap: NDArray[np.float32], valid: NDArray[np.bool_]) -> RGB:
    """(H, W) metres between two surfaces -> RGB on the scale of errors, the largest of every 5 x 5 pixels."""
    share = np.sqrt(widened(gap, nearest=False) / LARGEST_ERROR).clip(0, 1)
    picture = error_colours()[(share * 255).astype(np.uint8)]
    picture[~valid] = NO_VALUE
    return np.asarray(picture, dtype=np.uint8)


def colour_sigma_between(sigma: NDArray[np.float32], gap: NDArray[np.float32], valid: NDArray[np.bool_]) -> RGB:
    """Sigma where the surfaces lie `APART` metres or more apart, drawn wide on grey; elsewhere it decides nothing."""
    import cv2

    kernel = np.ones((5, 5), np.uint8)
    apart = ((gap >= APART) & valid).astype(np.float32)
    weight = cv2.blur(apart, (5, 5))
    mean = np.divide(cv2.blur(sigma * apart, (5, 5)), weight, out=np.zeros_like(sigma), where=weight > 0)
    picture = colour_sigma(mean, valid)
    picture[valid & (cv2.dilate(apart, kernel) == 0)] = UNDECIDED
    return picture


def error_colours() -> RGB:
    """(256, 3) RGB from no error (pale) to large (dark red)."""
    stops = np.array([[255, 247, 236], [253, 212, 158], [252, 141, 89], [215, 48, 31], [90, 0, 0]], float)
    at = np.linspace(0, 1, len(stops))
    steps = np.linspace(0, 1, 256)
    return np.stack([np.interp(steps, at, stops[:, c]) for c in range(3)], axis=1).round().astype(np.uint8)


def colour_error(depth: NDArray[np.float32], target: NDArray[np.float32]) -> RGB:
    """|depth - target| of two (H, W) maps in metres -> RGB; pixels without either take the dark colour."""
    share = np.sqrt(np.abs(depth - target) / LARGEST_ERROR).clip(0, 1)
    picture = error_colours()[(share * 255).astype(np.uint8)]
    picture[(depth <= 0) | (target <= 0)] = NO_VALUE
    return np.asarray(picture, dtype=np.uint8)


def error_position(metres: float) -> float:
    """Place of an error on the legend, percent from the left."""
    return float(100 * np.sqrt(metres / LARGEST_ERROR))


def gradient(colours: RGB) -> str:
    """A CSS gradient of a colour table, left to right, for legends."""
    stops = colours[:: 255 // 15]
    return "linear-gradient(to right, " + ", ".join(f"rgb({r},{g},{b})" for r, g, b in stops) + ")"


def tick_position(metres: float) -> float:
    """Place of a depth on the legend, percent from the left."""
    return float(100 * np.log(metres / NEAR) / np.log(FAR / NEAR))


def data_uri(picture: NDArray[np.uint8], width: int, quality: int) -> str:
    """(H, W, 3 or 4) RGB(A) as an inline WebP no wider than `width`; quality above 100 is lossless."""
    import cv2

    if picture.shape[1] > width:
        height = round(picture.shape[0] * width / picture.shape[1])
        picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    order: Any = [2, 1, 0, 3][: picture.shape[2]]
    done, data = cv2.imencode(".webp", np.ascontiguousarray(picture[:, :, order]), [cv2.IMWRITE_WEBP_QUALITY, quality])
    if not done:
        raise ValueError(f"cannot encode a picture of shape {picture.shape}")
    return "data:image/webp;base64," + base64.b64encode(data.tobytes()).decode("ascii")


@dataclass(frozen=True)
class BirdsEye:
    """Metres of the LiDAR frame to pixels of the bird's-eye view: forward is up, left is left."""

    width: int = int(2 * SIDE * BEV_PIXELS_PER_METRE)
    height: int = int(FORWARD * BEV_PIXELS_PER_METRE)

    def pixels(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """(N, 2+) x y of the LiDAR frame -> (N, 2) column, row."""
        column = (SIDE - points[:, 1].astype(np.float64)) * BEV_PIXELS_PER_METRE
        row = (FORWARD - points[:, 0].astype(np.float64)) * BEV_PIXELS_PER_METRE
        return np.column_stack([column, row])


def birds_eye_picture(points: NDArray[np.floating], measured: NDArray[np.bool_]) -> RGB:
    """(H, W, 4) RGBA of a cloud from above; opacity grows with the number of points, measured ones over completed."""
    view = BirdsEye()
    place = view.pixels(points).astype(np.int64)
    inside = (place >= 0).all(axis=1) & (place[:, 0] < view.width) & (place[:, 1] < view.height)
    picture = np.zeros((view.height, view.width, 4), np.uint8)
    for chosen, colour in ((~measured, COMPLETED_COLOUR), (measured, MEASURED_COLOUR)):
        column, row = place[inside & chosen].T
        counts = np.bincount(row * view.width + column, minlength=view.width * view.height).reshape(picture.shape[:2])
        hit = counts > 0
        picture[hit, :3] = colour
        picture[hit, 3] = (130 + 40 * counts[hit]).clip(0, 255)
    return picture
