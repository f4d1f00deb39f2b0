"""A small training run as a program of its own, for tests that kill it or start it twice.

python -m tests.completion.training_run OUT ARCHITECTURE KILL_AT_SAMPLE   (0: never)
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import torch

from completion.models import default_spec
from completion.samples import Augmentation, TrainingSample
from completion.train import TrainSettings, train
from completion.training_loss import LossSettings, default_kind
from tests.completion.scenes import Streets, street

ARGUMENTS = {
    "twise": {"channels": 4},
    "selection": {"width": 8},
    "nlspn": {"layers": 18, "width": 4, "iterations": 2},
    "penet": {"width": 2},
}


class Mortal(Streets):
    """Kills its process when sample number `last` is read."""

    def __init__(self, count: int, last: int) -> None:
        super().__init__(count, 64, 96)
        self.last, self.read = last, 0

    def __getitem__(self, index: int) -> TrainingSample:
        self.read += 1
        if self.read == self.last:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().__getitem__(index)


def settings(architecture: str, accumulate: int = 2) -> TrainSettings:
    spec = default_spec(architecture, **ARGUMENTS[architecture])
    return TrainSettings(
        spec,
        LossSettings(default_kind(spec)),
        augmentation=Augmentation((64, 64), noise=4.0, drop=0.1),
        epochs=2,
        steps_per_epoch=8,
        halve_every=1,
        batch_size=1,
        accumulate=accumulate,
        validate_every=5,
        save_every=3,
        log_every=2,
    )


def main(out: str, architecture: str, kill_at: str) -> None:
    torch.set_num_threads(1)
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    samples = Mortal(11, int(kill_at))
    train(settings(architecture, 2 // processes), samples, Path(out), [street(99, 64, 96)])
    if processes > 1:
        torch.distributed.destroy_process_group()


if __name__ == "__main__":
    main(*sys.argv[1:])
