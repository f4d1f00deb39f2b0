"""Tiny frames of the synthetic world, made once for all tests of this folder."""

from __future__ import annotations

import pytest

from pipeline.simulation.synth import SyntheticFrame, SynthSettings, simulate_frame

SMALL = SynthSettings(frames=3, seed=5, size=(120, 400), stereo=True)


@pytest.fixture(scope="session")
def small_settings() -> SynthSettings:
    return SMALL


@pytest.fixture(scope="session")
def frames() -> list[SyntheticFrame]:
    """Four frames of different streets at a third of KITTI's resolution."""
    return [simulate_frame(SMALL, index) for index in (0, 4, 8, 10)]


@pytest.fixture(scope="session")
def full_frame() -> SyntheticFrame:
    """One frame at KITTI's full size."""
    return simulate_frame(SynthSettings(frames=1, seed=5, size=(375, 1242)), 4)
