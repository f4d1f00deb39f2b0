"""16-bit depth PNGs: numbers worked out by hand and the round trip."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.base.errors import DataError
from pipeline.data.depth_png import decode_depth, encode_depth, read_depth_png, write_depth_png


def test_codes_are_metres_times_256_rounded() -> None:
    depth = np.array([[0.0, 1.0, 80.0, 0.0021, 0.0001, 300.0]])
    np.testing.assert_array_equal(encode_depth(depth), [[0, 256, 20480, 1, 1, 65535]])


@given(st.floats(0.002, 255.99))
def test_a_depth_comes_back_within_half_a_step(depth: float) -> None:
    assert abs(float(decode_depth(encode_depth(np.array([[depth]])))[0, 0]) - depth) <= 0.5 / 256 + 1e-9


def test_every_code_survives(tmp_path: Path) -> None:
    depth = (np.arange(65536).reshape(256, 256) / 256).astype(np.float32)
    write_depth_png(tmp_path / "a.png", depth)
    np.testing.assert_array_equal(read_depth_png(tmp_path / "a.png"), depth)


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_what_is_no_depth_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match="finite metres >= 0"):
        encode_depth(np.array([[value]]))


def test_colour_images_are_no_depth(tmp_path: Path) -> None:
    import cv2

    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 5, 3), np.uint16))
    with pytest.raises(DataError, match="one channel, got 3 channels"):
        read_depth_png(tmp_path / "a.png")


@pytest.mark.real_data
def test_real_ground_truth(kitti_depth: Path) -> None:
    path = kitti_depth / "2011_09_26_drive_0001_sync_0000000005" / "groundtruth_depth.png"
    depth = read_depth_png(path)
    assert 0.15 < float((depth > 0).mean()) < 0.25
    assert float(depth.max()) < 90
