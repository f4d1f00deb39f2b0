"""Which labels count at which difficulty: KITTI's limits, and the thesis' rule for Virtual KITTI 2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from auglidar_base.errors import SettingsError
from detection.evaluation.objects import Array, Mask

LEVELS = ("easy", "moderate", "hard")

# KITTI object devkit: least 2D height in pixels, greatest occlusion level, greatest truncated fraction.
MIN_HEIGHT = (40.0, 25.0, 25.0)
MAX_OCCLUSION = (0, 1, 2)
MAX_TRUNCATION = (0.15, 0.30, 0.50)


@runtime_checkable
class DifficultyRule(Protocol):
    """Decides which labels count at easy, moderate and hard."""

    @property
    def min_height(self) -> tuple[float, float, float]:
        """Detections with a lower 2D box (pixels) are ignored at that level."""
        ...

    def counts(self, height: Array, truncation: Array, occlusion: Array) -> Mask:
        """(3, N) whether each label counts at easy, moderate, hard."""
        ...


@dataclass(frozen=True)
class KittiDifficulty:
    """KITTI's three cumulative levels.

    flavor  "cpp": a label of exactly the least height counts (the devkit ignores height < limit);
            "python": it does not (the widely used port ignores height <= limit)
    """

    flavor: str = "cpp"

    @property
    def min_height(self) -> tuple[float, float, float]:
        """Least 2D height in pixels of a detection that counts."""
        return MIN_HEIGHT

    def counts(self, height: Array, truncation: Array, occlusion: Array) -> Mask:
        """(3, N) whether each label counts; height (N,) pixels, truncation (N,) 0..1, occlusion (N,) 0..3."""
        rows = []
        for level in range(3):
            tall = height > MIN_HEIGHT[level] if self.flavor == "python" else height >= MIN_HEIGHT[level]
            rows.append(tall & (occlusion <= MAX_OCCLUSION[level]) & (truncation <= MAX_TRUNCATION[level]))
        return np.stack(rows)


@dataclass(frozen=True)
class Vkitti2Difficulty:
    """Levels of Virtual KITTI 2 as the thesis words them (section 5.4.1.2), its ambiguities as options.

    easy    height > 40 px, truncation < 0.1 and occlusion < 0.1
    medium  height >= 20 px, 0.1 <= truncation <= 0.5 "or and" 0.1 <= occlusion <= 0.6
    hard    height >= 15 px, 0.5 <= truncation <= 0.9 or occlusion >= 0.6

    medium    "or": one of the two bands is enough, as long as the other value is not beyond its band; "and": both
    nesting   "cumulative": a level also counts the easier objects, as in KITTI; "bands": each object at its own level
    leftover  objects that no sentence covers (clear but between 20 and 40 px high; one value below its band under
              "and"): "next": they join the first level whose upper limits they meet; "ignore": they count nowhere
    """

    medium: str = "or"
    nesting: str = "cumulative"
    leftover: str = "next"

    def __post_init__(self) -> None:
        choices = {"medium": ("or", "and"), "nesting": ("cumulative", "bands"), "leftover": ("next", "ignore")}
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise SettingsError(f"{name}: expected {' or '.join(allowed)}, got {getattr(self, name)!r}")

    @property
    def min_height(self) -> tuple[float, float, float]:
        """Least 2D height in pixels of a detection that counts."""
        return (40.0, 20.0, 15.0)

    def level(self, height: Array, truncation: Array, occlusion: Array) -> NDArray[np.int64]:
        """(N,) 0 easy, 1 medium, 2 hard, 3 none; height in pixels, truncation and occlusion as fractions 0..1."""
        height, truncation, occlusion = (
            np.asarray(value, dtype=np.float64) for value in (height, truncation, occlusion)
        )
        easy = (height > 40) & (truncation < 0.1) & (occlusion < 0.1)
        truncated, occluded = (truncation >= 0.1), (occlusion >= 0.1)
        within = (truncation <= 0.5) & (occlusion <= 0.6)
        in_band = (truncated & occluded) if self.medium == "and" else (truncated | occluded)
        medium = (height >= 20) & within & in_band
        hard = (height >= 15) & (((truncation >= 0.5) & (truncation <= 0.9)) | (occlusion >= 0.6))
        if self.leftover == "next":
            medium |= (height >= 20) & within
            hard |= (height >= 15) & (truncation <= 0.9)
        return np.select([easy, medium, hard], [0, 1, 2], default=3).astype(np.int64)

    def counts(self, height: Array, truncation: Array, occlusion: Array) -> Mask:
        """(3, N) whether each label counts at easy, moderate (medium), hard."""
        level = self.level(height, truncation, occlusion)
        steps = np.arange(3)[:, None]
        return np.asarray(level == steps if self.nesting == "bands" else level <= steps)

    def level_counts(self, height: Array, truncation: Array, occlusion: Array) -> dict[str, int]:
        """How many objects fall to each level by itself, and to none."""
        found = np.bincount(self.level(height, truncation, occlusion), minlength=4)
        return dict(zip((*LEVELS, "none"), found.tolist()))


@dataclass(frozen=True)
class AnyHeight:
    """The rule of another with every height in the image: for results and labels without 2D boxes.

    rule  decides by truncation and occlusion alone
    """

    rule: DifficultyRule

    @property
    def min_height(self) -> tuple[float, float, float]:
        """No detection is too low."""
        return (0.0, 0.0, 0.0)

    def counts(self, height: Array, truncation: Array, occlusion: Array) -> Mask:
        """(3, N) whether each label counts; its height (N,) is not looked at."""
        return self.rule.counts(np.full_like(np.asarray(height, dtype=np.float64), np.inf), truncation, occlusion)


def occlusion_from_fill(occupancy_ratio: Array, full_fill: float) -> Array:
    """(N,) occlusion 0..1 from Virtual KITTI 2's occupancy_ratio (N,), the share of the 2D box the object fills.

    full_fill  the fill of an unoccluded object, e.g. the 95th percentile over tall untruncated objects of that class
    Although documented as visible fraction, the column equals visible pixels / box area, about 0.6 to 0.8 for a
    fully visible car, so 1 - occupancy_ratio would call nearly every car occluded.
    """
    if not 0 < full_fill <= 1:
        raise SettingsError(f"full_fill: expected a fraction in (0, 1], got {full_fill}")
    return np.clip(1 - np.asarray(occupancy_ratio, dtype=np.float64) / full_fill, 0, 1)


def difficulty_named(name: str, flavor: str) -> DifficultyRule:
    """The rule of "kitti" or "vkitti2", the latter with its options appended, as in "vkitti2:and:bands:ignore".

    Options: or, and; cumulative, bands; next, ignore (see Vkitti2Difficulty). Raises ValueError for anything else.
    """
    base, *options = name.split(":")
    if base == "kitti" and not options:
        return KittiDifficulty(flavor)
    fields = {"or": "medium", "and": "medium", "cumulative": "nesting", "bands": "nesting"}
    fields |= {"next": "leftover", "ignore": "leftover"}
    if base != "vkitti2" or not set(options) <= set(fields):
        raise SettingsError(f"difficulty: expected kitti or vkitti2[:{'|'.join(fields)}]..., got {name!r}")
    return Vkitti2Difficulty(**{fields[option]: option for option in options})
