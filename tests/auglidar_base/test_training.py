"""What the three trainers share: progress, seeds that leave the caller's alone, and the word for a device."""

from __future__ import annotations

import pytest
import torch

from auglidar_base.devices import resolve_device
from auglidar_base.errors import SettingsError
from auglidar_base.progress import Pace
from auglidar_base.seeding import derived_seed, torch_seeded

CPU = torch.device("cpu")


def test_time_left_goes_by_the_pace_of_this_process() -> None:
    """Begun at step 10 after 100 s; 4 steps in 8 s, so the 6 others take 12 s."""
    told = Pace(10, 100.0, 1000.0).progress(14, 20, {"loss": 1.5}, 1008.0)
    assert (told.step, told.steps, told.losses, told.seconds, told.eta) == (14, 20, {"loss": 1.5}, 108.0, 12.0)


def test_seeds_differ_by_purpose_and_step() -> None:
    seeds = {derived_seed(*parts) for parts in ((1, 2, 3), (1, 3, 2), (2, 2, 3), (1, 2, 4), (1, 2, 3, 0, 1))}
    assert len(seeds) == 5
    assert all(0 <= seed < 2**63 for seed in seeds)
    assert derived_seed(1, 2, 3) == derived_seed(1, 2, 3)


def test_seeded_draws_leave_the_callers_generator_alone() -> None:
    drawn = []
    for start in (0, 1):
        torch.manual_seed(start)
        before = torch.get_rng_state()
        with torch_seeded(7, CPU):
            drawn.append(torch.rand(3))
        assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(drawn[0], drawn[1])
    assert torch.equal(drawn[0], torch.rand(3, generator=torch.Generator().manual_seed(7)))


def test_an_error_inside_leaves_the_generator_alone() -> None:
    before = torch.get_rng_state()
    with pytest.raises(RuntimeError), torch_seeded(7, CPU):
        torch.rand(-1)
    assert torch.equal(torch.get_rng_state(), before)


def test_devices_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    assert resolve_device("cpu") == CPU
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    assert resolve_device("auto") == CPU
    for absent in ("cuda", "cuda:1", "mps"):
        with pytest.raises(SettingsError, match="is not there"):
            resolve_device(absent)
    for wrong in ("gpu", "cuda:", "cuda:x", "cpu:0", ""):
        with pytest.raises(SettingsError, match="expected auto, cpu, cuda, cuda:N or mps"):
            resolve_device(wrong)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert (resolve_device("auto"), resolve_device("cuda:1")) == (torch.device("cuda"), torch.device("cuda:1"))
