"""Pictures as tensors, and what training reads of a sample."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Triple = tuple[float, float, float]


class Normalisation(NamedTuple):
    """What is subtracted from red, green and blue (0 to 1), and what the rest is divided by."""

    mean: Triple
    deviation: Triple


IMAGENET = Normalisation((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
# (value - 127) / 128, as EfficientNet-Lite was trained: its published statistics agree with photographs read so.
CENTRED = Normalisation((127 / 255,) * 3, (128 / 255,) * 3)


class LabelledImage(Protocol):
    """What training reads of a sample: `Frame` and `SyntheticFrame` are such."""

    @property
    def image(self) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB."""
        ...

    @property
    def semantics(self) -> NDArray[np.uint8]:
        """(H, W) uint8 trainIds, 255 = not counted."""
        ...


def image_tensor(image: NDArray[np.uint8], normalisation: Normalisation = IMAGENET) -> Tensor:
    """(H, W, 3) uint8 RGB -> (1, 3, H, W) float32, normalised."""
    values = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].float() / 255
    mean, deviation = (torch.tensor(each)[:, None, None] for each in normalisation)
    return (values - mean) / deviation
