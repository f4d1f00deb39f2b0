"""A small segmentation network of our own, for scenes like the synthetic ones and without any download.

    image 1/1 -> 1/2 (16) -> 1/4 (32) -> 1/8 (96): six separable blocks, dilated 1 2 4 8 4 2 -> 1/4 (48) -> 19 classes

The logits are a quarter of the image wide and high; labels come from their bilinear enlargement.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from pipeline.errors import DataError
from pipeline.semantics.conventions import CLASSES, NONE

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


def train_segmenter(
    samples: Sequence[LabelledImage],
    out: Path,
    steps: int = 3000,
    batch: int = 6,
    crop: tuple[int, int] = (256, 384),
    rate: float = 3e-3,
    seed: int = 0,
    progress: Callable[[int, float], None] | None = None,
) -> Path:
    """Train on random crops by cross-entropy and write OUT.safetensors with its card OUT.json; returns the weights.

    Rare classes count more (inverse square root of their frequency in the first 50 samples). AdamW with one cosine
    cycle. `progress(step, loss)` is called every 50 steps. The same arguments give the same weights on one machine.
    """
    if not len(samples) or steps < 1:
        raise ValueError(f"segmentation training: expected samples and steps, got {len(samples)} and {steps}")
    torch.manual_seed(seed)
    random = np.random.default_rng(seed)
    model = StreetSegmenter().train()
    optimiser = torch.optim.AdamW(model.parameters(), lr=rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=steps)
    weights = _class_weights(samples)
    losses = []
    for step in range(steps):
        images, labels = _crops(samples, batch, crop, random)
        logits = F.interpolate(model(images), size=crop, mode="bilinear", align_corners=False)
        loss = F.cross_entropy(logits, labels, weight=weights, ignore_index=NONE)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        losses.append(float(loss.detach()))
        if progress is not None and (step % 50 == 49 or step == steps - 1):
            progress(step + 1, float(np.mean(losses[-50:])))
    training = {"steps": steps, "batch": batch, "crop": list(crop), "rate": rate, "seed": seed, "samples": len(samples)}
    return save_segmenter(model.eval(), out, {**training, "final_loss": float(np.mean(losses[-50:]))})


def _class_weights(samples: Sequence[LabelledImage]) -> Tensor:
    """(19,) weights, 1 on average over the classes that occur."""
    seen = min(50, len(samples))
    counts = sum(np.bincount(samples[i].semantics.reshape(-1), minlength=256)[: len(CLASSES)] for i in range(seen))
    frequency = np.asarray(counts, dtype=np.float64) / max(float(np.sum(counts)), 1.0)
    weights = np.where(frequency > 0, 1 / np.sqrt(np.maximum(frequency, 1e-4)), 0)
    return torch.from_numpy(weights / weights[weights > 0].mean()).float()


def _crops(
    samples: Sequence[LabelledImage], batch: int, crop: tuple[int, int], random: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """(B, 3, h, w) images and (B, h, w) labels: random places, mirrored half of the time, brightness changed."""
    images, labels = [], []
    for _ in range(batch):
        sample = samples[int(random.integers(len(samples)))]
        image, semantics = _padded(sample.image, crop), _padded(sample.semantics, crop, NONE)
        top = int(random.integers(image.shape[0] - crop[0] + 1))
        left = int(random.integers(image.shape[1] - crop[1] + 1))
        image = image[top : top + crop[0], left : left + crop[1]]
        semantics = semantics[top : top + crop[0], left : left + crop[1]]
        if random.random() < 0.5:
            image, semantics = image[:, ::-1], semantics[:, ::-1]
        bright = np.clip(image * random.uniform(0.7, 1.3) + random.uniform(-20, 20, 3), 0, 255).astype(np.uint8)
        images.append(image_tensor(bright))
        labels.append(torch.from_numpy(np.ascontiguousarray(semantics)).long())
    return torch.cat(images), torch.stack(labels)


def _padded(values: NDArray[Any], crop: tuple[int, int], fill: int = 0) -> NDArray[Any]:
    """At least the crop's size, filled at the bottom and on the right."""
    missing = [max(0, want - have) for want, have in zip(crop, values.shape[:2])]
    borders = [(0, missing[0]), (0, missing[1])] + [(0, 0)] * (values.ndim - 2)
    return np.pad(values, borders, constant_values=fill) if any(missing) else values


def save_segmenter(model: StreetSegmenter, out: Path, training: dict[str, Any]) -> Path:
    """Write OUT.safetensors and its card OUT.json."""
    from safetensors.torch import save_file

    weights = out.with_suffix(".safetensors")
    weights.parent.mkdir(parents=True, exist_ok=True)
    save_file({name: value.contiguous() for name, value in model.state_dict().items()}, str(weights))
    card = {
        "architecture": "StreetSegmenter",
        "classes": list(CLASSES),
        "convention": "cityscapes_trainIds",
        "data": "synthetic street scenes of this project",
        "training": training,
    }
    out.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")
    return weights


def load_segmenter(path_or_name: str | Path) -> NetworkSegmenter:
    """Weights from a .safetensors file, or embedded ones by name ("street-small").

    Raises DataError when there are none or when they are of another network.
    """
    from safetensors.torch import load_file

    path = Path(path_or_name)
    path = path if path.suffix == ".safetensors" else WEIGHTS / f"{path_or_name}.safetensors"
    if not path.is_file():
        have = ", ".join(sorted(file.stem for file in WEIGHTS.glob("*.safetensors"))) or "none"
        raise DataError(path, "weights of the segmentation network", "no such file", f"embedded: {have}")
    model = StreetSegmenter()
    try:
        model.load_state_dict(load_file(str(path)))
    except RuntimeError as error:
        raise DataError(path, "weights of StreetSegmenter", str(error).splitlines()[0]) from None
    return NetworkSegmenter(model)
