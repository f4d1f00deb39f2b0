"""A small segmentation network of our own, for scenes like the synthetic ones and without any download.

    image 1/1 -> 1/2 (16) -> 1/4 (32) -> 1/8 (96): six separable blocks, dilated 1 2 4 8 4 2 -> 1/4 (48) -> 19 classes

The logits are a quarter of the image wide and high; labels come from their bilinear enlargement.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from auglidar_base.atomic import write_bytes
from pipeline.base.errors import DataError
from pipeline.semantics.conventions import CLASSES

WEIGHTS = Path(__file__).parent / "weights"
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


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


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """3x3 convolution, batch norm, ReLU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class SeparableBlock(nn.Module):
    """Residual block: dilated depthwise 3x3, then 1x1 (Howard et al. 2017; dilation as Yu and Koltun 2016)."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.spatial = nn.Conv2d(channels, channels, 3, 1, dilation, dilation, groups=channels, bias=False)
        self.spatial_norm = nn.BatchNorm2d(channels)
        self.mix = nn.Conv2d(channels, channels, 1, bias=False)
        self.mix_norm = nn.BatchNorm2d(channels)

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, h, w) -> the same shape."""
        spatial = F.relu(self.spatial_norm(self.spatial(features)))
        return F.relu(features + self.mix_norm(self.mix(spatial)))


class StreetSegmenter(nn.Module):
    """About 130,000 parameters; see the figure at the top of this file."""

    def __init__(self, classes: int = len(CLASSES), channels: int = 96) -> None:
        super().__init__()
        self.to_half = _conv(3, 16, stride=2)
        self.to_quarter = _conv(16, 32, stride=2)
        self.to_eighth = _conv(32, channels, stride=2)
        self.context = nn.Sequential(*[SeparableBlock(channels, dilation) for dilation in (1, 2, 4, 8, 4, 2)])
        self.narrow = nn.Conv2d(channels, 48, 1)
        self.skip = nn.Conv2d(32, 48, 1)
        self.refine = SeparableBlock(48, 1)
        self.classify = nn.Conv2d(48, classes, 1)

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W) normalised RGB -> (B, 19, ceil(H / 4), ceil(W / 4)) logits."""
        quarter = self.to_quarter(self.to_half(image))
        eighth = self.context(self.to_eighth(quarter))
        enlarged = F.interpolate(self.narrow(eighth), size=quarter.shape[-2:], mode="bilinear", align_corners=False)
        return self.classify(self.refine(F.relu(enlarged + self.skip(quarter))))


def image_tensor(image: NDArray[np.uint8]) -> Tensor:
    """(H, W, 3) uint8 RGB -> (1, 3, H, W) float32, normalised as usual for ImageNet."""
    values = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].float() / 255
    return (values - torch.tensor(_MEAN)[:, None, None]) / torch.tensor(_STD)[:, None, None]


class NetworkSegmenter:
    """A trained `StreetSegmenter` on images."""

    def __init__(self, model: StreetSegmenter) -> None:
        self.model = model.eval()

    @torch.inference_mode()
    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB -> (H, W) uint8 Cityscapes trainIds."""
        height, width = image.shape[:2]
        logits = self.model(image_tensor(image))
        # Arg max at half size, then doubled: 19 maps of full size would cost more than the network itself.
        half = F.interpolate(logits, size=((height + 1) // 2, (width + 1) // 2), mode="bilinear", align_corners=False)
        labels = half.argmax(dim=1)[0].to(torch.uint8).numpy()
        return np.ascontiguousarray(labels.repeat(2, axis=0).repeat(2, axis=1)[:height, :width])

    @torch.inference_mode()
    def score(self, image: NDArray[np.uint8], classes: tuple[int, ...]) -> NDArray[np.float32]:
        """(H, W) float32 probability that a pixel shows any of `classes` (the soft mask)."""
        probability = self.model(image_tensor(image)).softmax(dim=1)[:, list(classes)].sum(dim=1, keepdim=True)
        full = F.interpolate(probability, size=image.shape[:2], mode="bilinear", align_corners=False)
        return full[0, 0].clamp(0, 1).numpy()


def save_segmenter(model: StreetSegmenter, out: Path, training: dict[str, Any]) -> Path:
    """Write OUT.safetensors and its card OUT.json."""
    from safetensors.torch import save

    weights = out.with_suffix(".safetensors")
    content = save({name: value.contiguous() for name, value in model.state_dict().items()})
    write_bytes(weights, content)
    card = {
        "architecture": "StreetSegmenter",
        "sha256": hashlib.sha256(content).hexdigest(),
        "classes": list(CLASSES),
        "convention": "cityscapes_trainIds",
        "data": "synthetic street scenes of this project",
        "training": training,
    }
    write_bytes(out.with_suffix(".json"), (json.dumps(card, indent=2) + "\n").encode())
    return weights


def load_segmenter(path_or_name: str | Path) -> NetworkSegmenter:
    """Weights from a .safetensors file, or bundled ones by name ("street-small").

    Raises DataError when there are none, when they are not those of their card, or of another network.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    path = Path(path_or_name)
    path = path if path.suffix == ".safetensors" else WEIGHTS / f"{path_or_name}.safetensors"
    if not path.is_file():
        have = ", ".join(sorted(file.stem for file in WEIGHTS.glob("*.safetensors"))) or "none"
        raise DataError(path, "weights of the segmentation network", "no such file", f"bundled: {have}")
    content = path.read_bytes()
    found, stated = hashlib.sha256(content).hexdigest(), _stated_hash(path.with_suffix(".json"))
    if found != stated:
        raise DataError(path, f"SHA-256 {stated[:12]}... as its card says", f"{found[:12]}...")
    model = StreetSegmenter()
    try:
        model.load_state_dict(load(content))
    except (RuntimeError, SafetensorError) as error:
        raise DataError(path, "weights of StreetSegmenter", str(error).splitlines()[0]) from None
    return NetworkSegmenter(model)


def _stated_hash(card: Path) -> str:
    """The SHA-256 in the card of weights. Raises DataError without a card or a hash in it."""
    try:
        return str(json.loads(card.read_text(encoding="utf-8"))["sha256"])
    except OSError:
        raise DataError(card, "the card of the weights beside them", "no such file") from None
    except (ValueError, KeyError, TypeError):
        raise DataError(card, "a JSON object with the SHA-256 of the weights", "none") from None
