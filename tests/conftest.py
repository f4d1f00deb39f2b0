"""Fixtures shared by all rooms: the real samples when they lie beside the checkout, and seeded generators."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
SAMPLES = Path(os.environ.get("AUGLIDAR_SAMPLES", ROOT.parent / "shared" / "data"))


def sample_folder(name: str) -> Path:
    """A folder of real samples, or a skip that says where it was looked for."""
    folder = SAMPLES / name
    if not folder.is_dir():
        pytest.skip(f"real samples not found: {folder} (set AUGLIDAR_SAMPLES to the folder that holds {name}/)")
    return folder


@pytest.fixture(scope="session")
def kitti_object() -> Path:
    """KITTI object root with training/ frames 000000-000010."""
    return sample_folder("kitti_object")


@pytest.fixture(scope="session")
def kitti_depth() -> Path:
    return sample_folder("kitti_depth")


@pytest.fixture(scope="session")
def nyu() -> Path:
    return sample_folder("nyu")


@pytest.fixture(scope="session")
def ap_tiny() -> Path:
    return sample_folder("ap_tiny")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20261122)
