"""Training samples: crops, flips and disturbances drawn from frames, reproducibly.

Everything random about a step derives from (seed, step, position in the step): the batches of a step are the same
whatever the number of loader processes, and after a resume.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from auglidar_base.errors import SettingsError
from completion.sensor_effects import SensorEffects
from completion.types import DepthFrame, FloatMap
from completion.warping import Views, enlarged, turned
from completion.windows import window_corner, window_intrinsics


@dataclass(frozen=True, eq=False)
class TrainingSample:
    """A frame with a target, and how to draw another sparse map of it (fewer rows, jittered calibration, ...)."""

    frame: DepthFrame
    draw_sparse: Callable[[np.random.Generator], FloatMap] | None = None


@dataclass(frozen=True, eq=False)
class DrawnSample:
    """A frame whose sparse map and target are drawn together, as where what is not given becomes the target."""

    draw: Callable[[np.random.Generator], DepthFrame]


Sample = DepthFrame | TrainingSample | DrawnSample


class SampleSource(Protocol):
    """What training reads: a length, and a frame or a sample for every index."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Sample: ...


@dataclass(frozen=True)
class Augmentation:
    """Disturbances drawn anew for every crop; all zero or off = none.

    crop          (height, width) in pixels, or None for whole frames
    bottom        crops lie at the bottom of the frame (KITTI protocol) rather than anywhere
    flip          probability of a left-right flip
    jitter        half-width of the brightness, contrast and saturation factors round 1 (published: 0.1)
    gamma         exponents between 1 / (1 + gamma) and 1 + gamma
    noise         largest standard deviation of Gaussian image noise, grey levels
    drop          largest share of sparse samples removed at random (published DC: 0.1)
    edge_crops    probability that the crop is the one of four with the most depth edges
    top           rows left out at the top of a frame (published NLSPN on KITTI: 100)
    rotate        largest turn of a frame to either side, degrees (NLSPN: 5)
    scale         largest factor a frame is enlarged by, its depths divided by it (NLSPN: 1.5); 1: none
    sensor        what a worse camera does to the picture
    """

    crop: tuple[int, int] | None = None
    bottom: bool = False
    flip: float = 0.5
    jitter: float = 0.1
    gamma: float = 0.0
    noise: float = 0.0
    drop: float = 0.0
    edge_crops: float = 0.0
    top: int = 0
    rotate: float = 0.0
    scale: float = 1.0
    sensor: SensorEffects = field(default_factory=SensorEffects)

    def __post_init__(self) -> None:
        if self.scale < 1:
            raise SettingsError(f"scale: expected >= 1, got {self.scale}")


class Crop(NamedTuple):
    """Sparse (h, w), RGB (h, w, 3), target (h, w), and where they lie in the window of `completion.windows`.

    place  row and column of the crop in the window at the frame's bottom centre; neither is flipped with the crop
    K      (3, 3) in pixels of the window, NaN when the frame has none
    """

    sparse: FloatMap
    image: NDArray[np.uint8]
    target: FloatMap
    place: tuple[int, int]
    K: NDArray[np.float32]


class Batch(NamedTuple):
    """Sparse and target (B, 1, h, w) float32 metres, rgb (B, 3, h, w) uint8, place (B, 2) and K (B, 3, 3) of `Crop`."""

    sparse: Tensor
    rgb: Tensor
    target: Tensor
    place: Tensor
    K: Tensor


def _corner(frame: DepthFrame, augmentation: Augmentation, rng: np.random.Generator) -> tuple[int, int, int, int]:
    """(top, left, height, width) of a crop. SettingsError when the frame is smaller."""
    height, width = frame.size
    if augmentation.crop is None:
        return 0, 0, height, width
    h, w = augmentation.crop
    if h > height or w > width:
        raise SettingsError(f"crop {h}x{w} is larger than the frame {height}x{width}")

    def draw() -> tuple[int, int, int, int]:
        top = height - h if augmentation.bottom else int(rng.integers(height - h + 1))
        return top, int(rng.integers(width - w + 1)), h, w

    if rng.random() >= augmentation.edge_crops:
        return draw()
    return max((draw() for _ in range(4)), key=lambda box: _edge_count(frame, box))


def _edge_count(frame: DepthFrame, box: tuple[int, int, int, int]) -> int:
    """Pixels of a crop whose target differs from a neighbour's by more than 1 m and 10 %."""
    assert frame.target is not None
    top, left, h, w = box
    target = frame.target[top : top + h, left : left + w]
    count = 0
    for a, b in ((target[:, 1:], target[:, :-1]), (target[1:], target[:-1])):
        near, far = np.minimum(a, b), np.maximum(a, b)
        count += int(((near > 0) & (far - near > 1) & (far > 1.1 * near)).sum())
    return count


def disturb_image(image: NDArray[np.uint8], augmentation: Augmentation, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Brightness, contrast, saturation, gamma and noise on an RGB crop (H, W, 3)."""
    factors = rng.uniform(1 - augmentation.jitter, 1 + augmentation.jitter, 3).astype(np.float32)
    exponent = float(np.exp(rng.uniform(-1, 1) * np.log1p(augmentation.gamma)))
    deviation = float(rng.uniform(0, augmentation.noise)) if augmentation.noise else 0.0
    if not augmentation.jitter and not augmentation.gamma and not deviation:
        return image
    values = (image.astype(np.float32) / 255) ** exponent * factors[0]
    values = (values - values.mean()) * factors[1] + values.mean()
    grey = values.mean(axis=2, keepdims=True)
    values = (values - grey) * factors[2] + grey
    if deviation:
        values += rng.standard_normal(values.shape, dtype=np.float32) * (deviation / 255)
    return (values.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def _warped(views: Views, augmentation: Augmentation, rng: np.random.Generator) -> Views:
    """The frame without its top rows, turned and enlarged by what is drawn."""
    sparse, image, target = views
    sparse, image, target = sparse[augmentation.top :], image[augmentation.top :], target[augmentation.top :]
    if augmentation.rotate:
        sparse, image, target = turned((sparse, image, target), rng.uniform(-augmentation.rotate, augmentation.rotate))
    if augmentation.scale > 1:
        sparse, image, target = enlarged((sparse, image, target), rng.uniform(1, augmentation.scale))
    return sparse, image, target


def draw_crop(
    sample: Sample, augmentation: Augmentation, rng: np.random.Generator
) -> tuple[FloatMap, NDArray[np.uint8], FloatMap]:
    """Sparse (h, w), RGB (h, w, 3) and target (h, w) of one augmented crop. SettingsError without a target."""
    crop = placed_crop(sample, augmentation, rng)
    return crop.sparse, crop.image, crop.target


def placed_crop(sample: Sample, augmentation: Augmentation, rng: np.random.Generator) -> Crop:
    """An augmented crop and its place. SettingsError without a target."""
    if isinstance(sample, DrawnSample):
        sample = sample.draw(rng)
    if isinstance(sample, DepthFrame):
        sample = TrainingSample(sample)
    frame = sample.frame
    if frame.target is None:
        raise SettingsError("a training frame needs a target depth, this one has none")
    sparse = frame.sparse if sample.draw_sparse is None else sample.draw_sparse(rng)
    if sparse.shape != frame.size:
        raise ValueError(f"draw_sparse: expected a map of {frame.size}, got {sparse.shape}")
    if augmentation.top or augmentation.rotate or augmentation.scale > 1:
        sparse, image, target = _warped((sparse, frame.image, frame.target), augmentation, rng)
        frame = DepthFrame(image, sparse, target)  # whose K was of another view
    assert frame.target is not None
    top, left, h, w = _corner(frame, augmentation, rng)
    rows, columns = slice(top, top + h), slice(left, left + w)
    sparse, target, image = sparse[rows, columns], frame.target[rows, columns], frame.image[rows, columns]
    if augmentation.drop:
        kept = rng.random(sparse.shape) >= rng.uniform(0, augmentation.drop)
        sparse = sparse * kept
    image = augmentation.sensor.apply(disturb_image(image, augmentation, rng), rng)
    if rng.random() < augmentation.flip:
        sparse, target, image = sparse[:, ::-1], target[:, ::-1], image[:, ::-1]
    corner = window_corner(frame.size, "bottom")
    K = np.full((3, 3), np.nan) if frame.K is None else window_intrinsics(frame.K, corner, "frame")
    return Crop(
        np.ascontiguousarray(sparse, np.float32),
        np.ascontiguousarray(image),
        np.ascontiguousarray(target),
        (top - corner[0], left - corner[1]),
        K.astype(np.float32),
    )


class StepBatches:
    """`batches[step]`: the micro-batches of one optimiser step for one process; a map-style data set for a DataLoader.

    Frames follow seeded permutations of the source. With several processes each takes its own part of a step; the
    union over processes is the step of a single process with `processes` times the accumulation.
    """

    def __init__(
        self,
        source: SampleSource,
        augmentation: Augmentation,
        seed: int,
        batch: int,
        accumulate: int,
        crops_per_frame: int,
        rank: int = 0,
        processes: int = 1,
    ) -> None:
        if len(source) == 0:
            raise SettingsError("no training samples")
        if (batch * accumulate) % crops_per_frame:
            raise SettingsError(
                f"crops_per_frame {crops_per_frame} must divide batch_size x accumulate = {batch * accumulate}"
            )
        self.source, self.augmentation, self.seed = source, augmentation, seed
        self.batch, self.accumulate, self.crops_per_frame = batch, accumulate, crops_per_frame
        self.rank, self.processes = rank, processes

    @property
    def frames_per_step(self) -> int:
        """Frames one step reads, over all processes."""
        return self.batch * self.accumulate * self.processes // self.crops_per_frame

    def _index(self, position: int) -> int:
        count = len(self.source)
        order = np.random.default_rng((self.seed, 0, position // count)).permutation(count)
        return int(order[position % count])

    def __getitem__(self, step: int) -> list[Batch]:
        own = self.batch * self.accumulate
        crops = []
        for slot in range(self.rank * own, (self.rank + 1) * own):
            if slot % self.crops_per_frame == 0:
                position = step * self.frames_per_step + slot // self.crops_per_frame
                sample = self.source[self._index(position)]
            crops.append(placed_crop(sample, self.augmentation, np.random.default_rng((self.seed, 1, step, slot))))
        micro = [crops[i : i + self.batch] for i in range(0, own, self.batch)]
        return [self._stack(part) for part in micro]

    @staticmethod
    def _stack(crops: list[Crop]) -> Batch:
        sizes = {crop.sparse.shape for crop in crops}
        if len(sizes) != 1:
            raise SettingsError(f"frames of a batch differ in size {sorted(sizes)}; set a crop or batch_size = 1")
        return Batch(
            torch.from_numpy(np.stack([crop.sparse for crop in crops]))[:, None],
            torch.from_numpy(np.stack([crop.image for crop in crops])).permute(0, 3, 1, 2).contiguous(),
            torch.from_numpy(np.stack([crop.target for crop in crops]))[:, None],
            torch.tensor([crop.place for crop in crops]),
            torch.from_numpy(np.stack([crop.K for crop in crops])),
        )
