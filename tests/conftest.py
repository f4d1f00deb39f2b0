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


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--fast", action="store_true", help="without the tests of tests/slow.txt and those marked slow")


def slow_tests() -> set[str]:
    """Node ids, without parameters, of the tests that take seconds."""
    lines = (ROOT / "tests" / "slow.txt").read_text(encoding="utf-8").splitlines()
    return {line for line in lines if not line.startswith("#")}


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--fast"):
        return
    slow = slow_tests()
    left_out = [item for item in items if item.nodeid.split("[")[0] in slow or item.get_closest_marker("slow")]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if item not in left_out]
