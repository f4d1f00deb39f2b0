"""Damaged files of every kind: the doctor reports something about the frame and never falls over."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.check.doctor import check
from tests.pipeline.tiny_kitti import write_tiny_kitti

PARTS = {"image_2": "png", "velodyne": "bin", "calib": "txt", "label_2": "txt", "depth_2": "png", "semantic_2": "png"}


def damaged(data: bytes, kind: str, rng: np.random.Generator) -> bytes:
    if kind == "noise":
        return rng.bytes(max(len(data), 40))
    if kind == "cut":
        return data[: int(rng.integers(1, len(data)))]
    if kind == "zeros":
        return bytes(len(data))
    flipped = bytearray(data)
    for position in rng.integers(0, len(data), 30):
        flipped[position] ^= int(rng.integers(1, 256))
    return bytes(flipped)


@pytest.mark.parametrize("kind", ["noise", "cut", "zeros", "flips"])
@pytest.mark.parametrize("part", ["image_2", "velodyne", "calib", "label_2", "depth_2"])
def test_damage_is_reported_or_harmless(tmp_path: Path, part: str, kind: str) -> None:
    write_tiny_kitti(tmp_path, 3)
    before = found(tmp_path)
    rng = np.random.default_rng(list((part + kind).encode()))
    path = tmp_path / "training" / part / f"000001.{PARTS[part]}"
    path.write_bytes(damaged(path.read_bytes(), kind, rng))
    new = {frame for _, frame in found(tmp_path) - before}
    assert new <= {"000001"}
    if kind in ("noise", "zeros") or (kind == "cut" and part in ("image_2", "depth_2", "velodyne")):
        assert new == {"000001"}


def found(root: Path) -> set[tuple[str, str]]:
    """Faults and frames; the tiny scene has some of its own (its car is wider than long, its road 60 m away)."""
    return {(finding.fault, finding.frame) for finding in check(root, workers=1).findings}


def test_folders_in_place_of_files(tmp_path: Path) -> None:
    write_tiny_kitti(tmp_path, 2)
    before = found(tmp_path)
    path = tmp_path / "training" / "velodyne" / "000001.bin"
    path.unlink()
    path.mkdir()
    assert found(tmp_path) - before == {("unreadable_file", "000001")}
