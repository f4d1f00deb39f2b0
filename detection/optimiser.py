"""adam_onecycle of PointRCNN, EPNet and OpenPCDet, and PointRCNN's schedule of the batch normalisation momentum."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class OneCycleSettings:
    """One-cycle schedule (Smith and Topin 2017) with cosine annealing.

    division  start = peak / division; end = start / 10000, where peak is the learning rate of the settings
    rising    share of the steps with a rising rate
    momentum  (high, low) of beta1, which runs against the rate
    decay     decoupled weight decay, times the learning rate, on every parameter (biases and normalisation too)
    clip      largest norm of the gradient
    """

    division: float = 10.0
    rising: float = 0.4
    momentum: tuple[float, float] = (0.95, 0.85)
    decay: float = 0.001
    clip: float = 1.0


def _anneal(start: float, end: float, share: float) -> float:
    return end + (start - end) / 2 * (1 + math.cos(math.pi * share))


def one_cycle(step: int, steps: int, peak: float, settings: OneCycleSettings) -> tuple[float, float]:
    """(learning rate, beta1) of 0-based `step` of `steps`; peak is the highest learning rate."""
    low = peak / settings.division
    turn = int(settings.rising * steps)
    high_momentum, low_momentum = settings.momentum
    if step < turn:
        share = step / turn
        return _anneal(low, peak, share), _anneal(high_momentum, low_momentum, share)
    share = (step - turn) / max(steps - turn, 1)
    return _anneal(peak, low / 1e4, share), _anneal(low_momentum, high_momentum, share)


class AdamOneCycle:
    """Adam (beta2 0.99) with decoupled weight decay before each step, driven by `one_cycle`."""

    def __init__(self, model: nn.Module, steps: int, peak: float, settings: OneCycleSettings) -> None:
        self.settings, self.steps, self.peak = settings, steps, peak
        self.names = [name for name, parameter in model.named_parameters() if parameter.requires_grad]
        self.parameters: list[Tensor] = [parameter for parameter in model.parameters() if parameter.requires_grad]
        self.adam = torch.optim.Adam(self.parameters, lr=peak, betas=(settings.momentum[0], 0.99))

    def step(self, step: int) -> float:
        """Clip, decay and update with the gradients at hand; returns the norm of the gradient before clipping."""
        rate, momentum = one_cycle(step, self.steps, self.peak, self.settings)
        norm = nn.utils.clip_grad_norm_(self.parameters, self.settings.clip)
        for group in self.adam.param_groups:
            group["lr"], group["betas"] = rate, (momentum, 0.99)
        with torch.no_grad():
            torch._foreach_mul_(self.parameters, 1 - self.settings.decay * rate)
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)
        return float(norm)

    def state_tensors(self) -> dict[str, torch.Tensor]:
        """Everything Adam remembers, by parameter name."""
        found = {}
        for name, parameter in zip(self.names, self.parameters):
            for key, value in self.adam.state.get(parameter, {}).items():
                found[f"{key}.{name}"] = value
        return found

    def load_state_tensors(self, tensors: dict[str, torch.Tensor]) -> None:
        """Inverse of `state_tensors`."""
        for name, parameter in zip(self.names, self.parameters):
            keys = ("step", "exp_avg", "exp_avg_sq")
            state = {key: tensors[f"{key}.{name}"].clone() for key in keys if f"{key}.{name}" in tensors}
            if state:
                self.adam.state[parameter] = state


def batchnorm_momentum(step: int, epoch_steps: int) -> float:
    """PointRCNN's momentum at a 0-based step: 0.1, halved every 1000 iterations, at least 0.01.

    The reference calls the schedule only at the start of an epoch, with the number of iterations so far, and its
    one decay step is 1000: 0.1 before, 0.05 after.
    """
    epoch_start = step // max(epoch_steps, 1) * epoch_steps
    return max(0.1 * (0.5 if epoch_start >= 1000 else 1.0), 0.01)
