"""How large and how long a completion experiment is: smoke (tests), small (this project's results), paper (GPU)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

# Where the seconds per step below were measured; another machine needs another time, not other results.
MACHINE = "process time on one core of a busy 2-core AMD EPYC server, torch 2.13, November 2026"


@dataclass(frozen=True)
class CompletionBudget:
    """Data and training of every completion run.

    train_frames, test_frames   frames of the synthetic world, each street seen once
    size         (height, width) of its images, or None for KITTI's own
    crop         (height, width) of training crops
    test_rows, test_columns   the part that is scored: bottom rows, centred columns; 0 = all
    channels     width of MultiStack and TWISE; resnet_width: of the ResNet's first layer (published: 64 and 64)
    bins         depth bins of Depth Coefficients over 0 to 80 m (published: 80)
    init, rgb    initialisation and colour scaling; published: "xavier", "unit" (see docs/completion.md)
    depth_unit   metres per unit of the networks' depth, except that of coefficients; 0: each network's own (published:
                 80 for twin surfaces, 1 for the others; in units of 80 m sigma needs far longer to learn anything)
    steps        optimiser steps; batch: crops of a step
    schedule     "cosine", or "halving" every sixth of the run (published)
    seconds_per_step, seconds_per_test_frame   on MACHINE, by network; seconds_per_data_frame: of making a frame

    Times are no part of what a run depends on: `settings_of` leaves them out.
    """

    train_frames: int
    test_frames: int
    size: tuple[int, int] | None
    crop: tuple[int, int]
    test_rows: int
    test_columns: int
    channels: int
    resnet_width: int
    bins: int
    steps: int
    batch: int
    learning_rate: float
    init: str = "he"
    rgb: str = "standardised"
    schedule: str = "cosine"
    depth_unit: float = 0.0
    data_seed: int = 40
    seconds_per_step: Mapping[str, float] = field(default_factory=dict)
    seconds_per_test_frame: Mapping[str, float] = field(default_factory=dict)
    seconds_per_data_frame: float = 0.0


# Process time of a step and of scoring a test frame, by network; "paper" is scaled from "small" by operations.
_SMOKE = (
    {"multistack": 0.05, "nlspn": 0.2, "resnet18": 0.1, "resnet18 dc": 0.1},
    {"multistack": 0.2, "nlspn": 0.5, "resnet18": 0.2, "resnet18 dc": 0.3},
)
_SMALL = (
    {"multistack": 0.034, "nlspn": 0.2, "resnet18": 0.04, "resnet18 dc": 0.06},
    {"multistack": 0.2, "nlspn": 0.8, "resnet18": 0.2, "resnet18 dc": 0.4},
)
_PAPER = (
    {"multistack": 140.0, "nlspn": 700.0, "resnet18": 350.0, "resnet18 dc": 400.0},
    {"multistack": 12.0, "nlspn": 60.0, "resnet18": 30.0, "resnet18 dc": 60.0},
)

COMPLETION: dict[str, CompletionBudget] = {
    "smoke": CompletionBudget(
        train_frames=2, test_frames=2, size=(96, 320), crop=(64, 96), test_rows=0, test_columns=0, channels=4,
        resnet_width=8, bins=20, steps=2, batch=1, learning_rate=1e-3, seconds_per_step=_SMOKE[0],
        seconds_per_test_frame=_SMOKE[1], seconds_per_data_frame=1.0,
    ),
    "small": CompletionBudget(
        train_frames=72, test_frames=24, size=(188, 620), crop=(96, 192), test_rows=144, test_columns=384, channels=8,
        resnet_width=8, bins=40, steps=800, batch=1, learning_rate=3e-3, depth_unit=1.0, seconds_per_step=_SMALL[0],
        seconds_per_test_frame=_SMALL[1], seconds_per_data_frame=2.0,
    ),
    "paper": CompletionBudget(
        train_frames=5000, test_frames=420, size=None, crop=(256, 1216), test_rows=256, test_columns=1216, channels=64,
        resnet_width=64, bins=80, steps=105_000, batch=4, learning_rate=1e-3, init="xavier", rgb="unit",
        schedule="halving", seconds_per_step=_PAPER[0], seconds_per_test_frame=_PAPER[1], seconds_per_data_frame=12.0,
    ),
}  # fmt: skip
