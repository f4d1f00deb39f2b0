"""Random crops of labelled images, disturbed in ways that a network of synthetic streets must not mind on real ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from completion.samples import Augmentation, disturb_image
from pipeline.semantics.conventions import CLASSES, NONE

Labelled = tuple[NDArray[np.uint8], NDArray[np.uint8]]
# People, riders and everything on wheels.
_OBJECTS = range(CLASSES.index("person"), len(CLASSES))


@dataclass(frozen=True)
class CropSettings:
    """How crops are drawn and disturbed.

    crop      (height, width) in pixels
    zoom      crops are enlarged by up to this factor or reduced by its inverse
    objects   share of crops that are laid round a pixel of an object (11 and up)
    jitter    of colours, as `completion.samples.Augmentation`
    gamma     of colours, as there
    noise     of colours, as there
    grey      share of crops without colour
    balance   largest relative change of a colour channel against the others (white balance)
    blur      largest standard deviation of a Gaussian blur, pixels; half of the crops stay sharp
    texture   largest standard deviation of grain of all sizes, relative, drawn for each class in a crop: synthetic
              surfaces are plainer than real ones
    """

    crop: tuple[int, int] = (256, 384)
    zoom: float = 1.5
    objects: float = 0.0
    jitter: float = 0.4
    gamma: float = 0.5
    noise: float = 8.0
    grey: float = 0.15
    balance: float = 0.0
    blur: float = 0.0
    texture: float = 0.0


def draw_crop(
    image: NDArray[np.uint8], semantics: NDArray[np.uint8], settings: CropSettings, random: np.random.Generator
) -> Labelled:
    """(h, w, 3) image and (h, w) labels of one crop, from an (H, W, 3) RGB image and its (H, W) trainIds."""
    image, semantics = _cut(image, semantics, settings, random)
    if settings.texture:
        image = _grain(image, semantics, settings.texture, random)
    if settings.balance:
        gains = 1 + random.uniform(-settings.balance, settings.balance, 3)
        image = (image * gains).clip(0, 255).astype(np.uint8)
    if settings.blur and random.random() < 0.5:
        image = cv2.GaussianBlur(image, (0, 0), random.uniform(0.3, settings.blur)).astype(np.uint8)
    colours = Augmentation(jitter=settings.jitter, gamma=settings.gamma, noise=settings.noise)
    image = disturb_image(image, colours, random)
    if random.random() < settings.grey:
        image = np.repeat(image.mean(axis=2, keepdims=True), 3, axis=2).astype(np.uint8)
    return image, semantics


def _cut(
    image: NDArray[np.uint8], semantics: NDArray[np.uint8], settings: CropSettings, random: np.random.Generator
) -> Labelled:
    """A random place at a random size, mirrored half of the time, brought to the crop's size."""
    height, width = settings.crop
    factor = float(np.exp(random.uniform(-1, 1) * np.log(settings.zoom)))
    taken = (round(height / factor), round(width / factor))
    image, semantics = _padded(image, taken), _padded(semantics, taken, NONE)
    top, left = _corner(semantics, taken, settings.objects, random)
    image = image[top : top + taken[0], left : left + taken[1]]
    semantics = semantics[top : top + taken[0], left : left + taken[1]]
    if random.random() < 0.5:
        image, semantics = image[:, ::-1], semantics[:, ::-1]
    size = (width, height)
    resized = cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_LINEAR)
    labels = cv2.resize(np.ascontiguousarray(semantics), size, interpolation=cv2.INTER_NEAREST)
    return resized.astype(np.uint8), labels.astype(np.uint8)


def _corner(
    semantics: NDArray[np.uint8], taken: tuple[int, int], objects: float, random: np.random.Generator
) -> tuple[int, int]:
    """Top and left of a crop: anywhere, or so that it holds a pixel of a randomly chosen class of objects."""
    last = [have - want for have, want in zip(semantics.shape, taken)]
    present = np.intersect1d(np.unique(semantics), _OBJECTS)
    if not objects or random.random() >= objects or not present.size:
        return int(random.integers(last[0] + 1)), int(random.integers(last[1] + 1))
    pixels = np.argwhere(semantics == random.choice(present))
    pixel = pixels[int(random.integers(len(pixels)))]
    corner = [int(at - random.uniform(0.2, 0.8) * want) for at, want in zip(pixel, taken)]
    return min(max(corner[0], 0), last[0]), min(max(corner[1], 0), last[1])


def _grain(
    image: NDArray[np.uint8], semantics: NDArray[np.uint8], texture: float, random: np.random.Generator
) -> NDArray[np.uint8]:
    """The image with multiplicative noise of octaves from one pixel to 32, of another strength in each class."""
    height, width = semantics.shape
    grain = np.zeros((height, width), np.float32)
    for octave in range(6):
        small = random.standard_normal((max(height >> octave, 1), max(width >> octave, 1)), dtype=np.float32)
        grain += random.uniform(0, 1) * cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    strength = random.uniform(0, texture, 256).astype(np.float32)[semantics]
    factor = np.exp(strength * grain / max(float(grain.std()), 1e-6))
    return (image * factor[..., None]).clip(0, 255).astype(np.uint8)


def _padded(values: NDArray[Any], crop: tuple[int, int], fill: int = 0) -> NDArray[Any]:
    """At least the crop's size, filled at the bottom and on the right."""
    missing = [max(0, want - have) for want, have in zip(crop, values.shape[:2])]
    borders = [(0, missing[0]), (0, missing[1])] + [(0, 0)] * (values.ndim - 2)
    return np.pad(values, borders, constant_values=fill) if any(missing) else values
