"""Random numbers of a training: they derive from (seed, purpose, step, ...), and the caller's generators stay as they
are, so that equal seeds give equal weights whatever a program drew before."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch


def derived_seed(seed: int, *purpose: int) -> int:
    """A seed in [0, 2**63) for torch from a run's seed and what it is for (purpose, step, rank)."""
    return int(np.random.SeedSequence([seed, *purpose]).generate_state(1, np.uint64)[0] >> 1)


@contextmanager
def torch_seeded(seed: int, device: torch.device) -> Iterator[None]:
    """Torch's own generators (first weights, dropout) of the CPU and of `device` are seeded inside and as before after.

    `torch.manual_seed` is not used: it seeds every GPU, `fork_rng` restores the named one alone.
    """
    cuda = [device.index if device.index is not None else torch.cuda.current_device()] if device.type == "cuda" else []
    metal = torch.mps.get_rng_state() if device.type == "mps" else None
    try:
        with torch.random.fork_rng(devices=cuda):
            torch.default_generator.manual_seed(seed)
            if cuda:
                with torch.cuda.device(cuda[0]):
                    torch.cuda.manual_seed(seed)
            if metal is not None:
                torch.mps.manual_seed(seed)
            yield
    finally:
        if metal is not None:
            torch.mps.set_rng_state(metal)
