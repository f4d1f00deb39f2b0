"""How large and how long a completion experiment is: smoke (tests), small (this project's results), paper (GPU)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

# Where the seconds per step below were measured; another machine needs another time, not other results.
MACHINE = "one core of a 2-core Xeon server (2.6 GHz), torch 2.13, process time"


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
    steps        optimiser steps; batch: crops of a step
    schedule     "cosine", or "halving" every sixth of the run (published)
    seconds_per_step   measured on MACHINE, by network
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
    data_seed: int = 40
    seconds_per_step: Mapping[str, float] = field(default_factory=dict)
    seconds_per_test_frame: Mapping[str, float] = field(default_factory=dict)
    seconds_per_data_frame: float = 6.0


COMPLETION: dict[str, CompletionBudget] = {
    "smoke": CompletionBudget(2, 2, (96, 320), (64, 96), 0, 0, 4, 8, 20, 2, 1, 1e-3),
    "small": CompletionBudget(200, 60, (188, 620), (96, 192), 144, 320, 8, 8, 40, 400, 2, 3e-3),
    "paper": CompletionBudget(
        5000, 420, None, (256, 1216), 256, 1216, 64, 64, 80, 105_000, 4, 1e-3, "xavier", "unit", "halving"
    ),
}
