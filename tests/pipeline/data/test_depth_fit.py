"""Depth maps from elsewhere against the LiDAR: the right one is taken, every slip is named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.base.errors import DataError
from pipeline.cli import main
from pipeline.data import open_dataset
from pipeline.data.depth_fit import Depth, require_fit
from pipeline.data.depth_png import encode_depth, write_depth_png

HEIGHT, WIDTH = 375, 1242


def street() -> Depth:
    """A road that recedes to a wall 30 m ahead, with a car's back at 12 m."""
    row = np.arange(HEIGHT, dtype=np.float32)[:, None]
    depth = np.minimum(720 * 1.65 / np.maximum(row - 172, 1e-3), 30.0) * np.ones((1, WIDTH), np.float32)
    depth[180:260, 500:620] = 12.0
    return depth.astype(np.float32)


def scanned(depth: Depth) -> Depth:
    """Every sixth row and third column of it below the horizon, as a LiDAR sees it."""
    lidar = np.zeros_like(depth)
    lidar[150::6, ::3] = depth[150::6, ::3]
    return lidar


SLIPS: dict[str, tuple[Callable[[Depth], Depth], str]] = {
    "millimetres": (lambda depth: depth * np.float32(1000 / 256), "read as millimetres 100 %"),
    "centimetres": (lambda depth: depth * np.float32(100 / 256), "read as centimetres 100 %"),
    "metres without 256": (lambda depth: depth / 256, "read as metres 100 %"),
    "half size": (lambda depth: depth[::2, ::2], "as the image at 1/2 of its size"),
    "40 rows": (lambda depth: np.roll(depth, -40, axis=0), "40 rows lower 100 %"),
    "crop from the corner": (lambda depth: depth[:352, :1216], "at top-left 100 %"),
    "another scene": (lambda depth: np.full_like(depth, 4.0), "augment.check_depth=false"),
}


@pytest.mark.parametrize("slip", SLIPS)
def test_every_slip_is_named(slip: str) -> None:
    change, words = SLIPS[slip]
    with pytest.raises(DataError) as error:
        require_fit(change(street()), scanned(street()), "depths/000000.png")
    assert words in str(error.value)
    assert "depths/000000.png: expected a depth map that fits" in str(error.value)


def test_what_fits_is_taken() -> None:
    depth, lidar = street(), scanned(street())
    require_fit(depth, lidar, "whole")
    require_fit(depth[HEIGHT - 352 :, (WIDTH - 1216) // 2 :][:, :1216], lidar, "the official crop")
    noisy = depth * np.random.default_rng(0).normal(1, 0.08, depth.shape).astype(np.float32)
    require_fit(noisy, lidar, "a poor method, but depth")
    require_fit(np.where(np.arange(HEIGHT)[:, None] < 140, depth, 0).astype(np.float32), lidar, "nothing to compare")


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory, kitti_object: Path) -> dict[str, Path]:
    """Completed depth of one real frame, right and in the five wrong ways that were taken without a word."""
    root = tmp_path_factory.mktemp("maps")
    frame = open_dataset("kitti_object", kitti_object)["000003"]
    from completion.infer import load_completer

    depth = load_completer("classical").complete(frame.sparse_depth, frame.image).depth
    height, width = depth.shape
    kinds: dict[str, Depth] = {
        "right": depth,
        "crop": depth[height - 352 :, (width - 1216) // 2 :][:, :1216],
        "mm": (depth * np.float32(1000 / 256)).clip(0, 255),
        "cm": (depth * np.float32(100 / 256)).clip(0, 255),
        "half": depth[::2, ::2],
        "shifted": np.roll(depth, 40, axis=0),
    }
    for name, values in kinds.items():
        write_depth_png(root / name / "000003.png", values)
    (root / "eight_bit").mkdir()
    cv2.imwrite(str(root / "eight_bit" / "000003.png"), (encode_depth(depth) // 256).astype(np.uint8))
    return {path.name: path for path in root.iterdir()}


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("right", ""),
        ("crop", ""),
        ("mm", "read as millimetres"),
        ("cm", "read as centimetres"),
        ("half", "as the image at 1/2 of its size"),
        ("shifted", "40 rows higher"),
        ("eight_bit", "expected a 16-bit depth PNG (uint16), got uint8"),
    ],
)
def test_the_run_refuses_wrong_folders_by_name(
    kind: str,
    words: str,
    folders: dict[str, Path],
    kitti_object: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    command = ["--config", "kitti", "--stage", "augment", "--data", str(kitti_object), "--frames", "000003"]
    command += ["--depth-from", str(folders[kind]), "--out", str(tmp_path / "run"), "--workers", "1"]
    assert main(command) == (1 if words else 0)
    assert words in capsys.readouterr().err
    assert (tmp_path / "run/cloud/000003.bin").is_file() == (not words)
    if kind == "mm":
        assert main([*command, "--set", "augment.check_depth=false"]) == 0
