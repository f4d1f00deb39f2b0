"""What the three trainers tell while they go on."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TrainProgress:
    """What a progress callback is told.

    step     updates done (1-based), of `steps`
    losses   means since the last call, by name
    seconds  of training so far, over all processes that continued the run
    eta      seconds that remain, at the pace since this process began
    """

    step: int
    steps: int
    losses: dict[str, float]
    seconds: float
    eta: float


@dataclass(frozen=True)
class Pace:
    """Where this process began: at which step, after how many seconds of earlier ones, at which time of its clock."""

    step: int
    before: float
    begun: float

    def spent(self, now: float) -> float:
        """Seconds of training so far; steps that were lost and done again count once."""
        return self.before + now - self.begun

    def progress(self, step: int, steps: int, losses: dict[str, float], now: float) -> TrainProgress:
        """At `step`, at clock time `now` (seconds)."""
        left = (now - self.begun) / (step - self.step) * (steps - step)
        return TrainProgress(step, steps, losses, self.spent(now), left)
