"""What cameras do to a picture: over-exposure, white balance, dark corners, blur, JPEG. For training."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from auglidar_base.errors import SettingsError

# JPEG files worse than this are no camera's.
_WORST_QUALITY = 20


@dataclass(frozen=True)
class SensorEffects:
    """How strong each may be; drawn anew for every picture, each in about every second one. All zero: none.

    exposure  largest factor by which a picture is too bright, less one (0.7: up to 1.7 times, then clipped)
    balance   largest relative change of a colour channel against the others
    vignette  largest share of light that the farthest corner loses
    blur      largest standard deviation of a Gaussian blur, pixels
    jpeg      lowest quality of JPEG compression, 20 to 100; 0: none
    """

    exposure: float = 0.0
    balance: float = 0.0
    vignette: float = 0.0
    blur: float = 0.0
    jpeg: int = 0

    def __post_init__(self) -> None:
        if self.jpeg and not _WORST_QUALITY <= self.jpeg <= 100:
            raise SettingsError(f"jpeg: expected 0 or a quality of {_WORST_QUALITY} to 100, got {self.jpeg}")
        if not 0 <= self.vignette <= 1:
            raise SettingsError(f"vignette: expected a share of 0 to 1, got {self.vignette}")

    def apply(self, image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
        """(H, W, 3) RGB -> the same picture by a worse camera."""
        if self == SensorEffects():
            return image
        values = image.astype(np.float32)
        if self.exposure and rng.random() < 0.5:
            values *= rng.uniform(1, 1 + self.exposure)
        if self.balance and rng.random() < 0.5:
            values *= rng.uniform(1 - self.balance, 1 + self.balance, 3).astype(np.float32)
        if self.vignette and rng.random() < 0.5:
            values *= 1 - rng.uniform(0, self.vignette) * _distance(image.shape[0], image.shape[1], rng)[..., None]
        if self.blur and rng.random() < 0.5:
            values = cv2.GaussianBlur(values, (0, 0), max(0.1, rng.uniform(0, self.blur))).astype(np.float32)
        changed = values.clip(0, 255).round().astype(np.uint8)
        if self.jpeg and rng.random() < 0.5:
            changed = _compressed(changed, int(rng.integers(self.jpeg, 101)))
        return changed


def _distance(height: int, width: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """(H, W) squared distance from a centre that is drawn anywhere in a crop's width, 1 at the farthest pixel."""
    row = (np.arange(height) - height / 2) / width
    column = np.arange(width) / width - rng.random()
    squared = row[:, None] ** 2 + column[None] ** 2
    return (squared / squared.max()).astype(np.float32)


def _compressed(image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    written = cv2.imencode(".jpg", np.ascontiguousarray(image), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(written, cv2.IMREAD_COLOR), np.uint8)
