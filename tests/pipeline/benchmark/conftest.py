"""Two synthetic streets in KITTI's layout."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.simulation.synth import SynthSettings
from pipeline.simulation.writers import write_dataset


@pytest.fixture(scope="session")
def streets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("streets")
    write_dataset(root, SynthSettings(frames=2, seed=3))
    return root
