"""Completed depth of other methods: a folder of PNGs, whole or cropped, and what is refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.base.errors import DataError
from pipeline.data.depth_folder import read_depth_folder


def test_folder_of_pngs(tmp_path: Path) -> None:
    stored = np.zeros((4, 6), np.uint16)
    stored[3, 5] = 256 * 20 + 128
    cv2.imwrite(str(tmp_path / "000007.png"), stored)
    assert read_depth_folder(tmp_path, "000007", (4, 6)).depth[3, 5] == 20.5
    placed = read_depth_folder(tmp_path, "000007", (6, 10)).depth
    assert placed.shape == (6, 10)
    assert placed[5, 7] == 20.5
    assert np.count_nonzero(placed) == 1


def test_folder_refuses_missing_and_unusable_files(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="000001"):
        read_depth_folder(tmp_path, "000001", (4, 6))
    cv2.imwrite(str(tmp_path / "000001.png"), np.zeros((4, 6), np.uint8))
    with pytest.raises(DataError, match="uint16"):
        read_depth_folder(tmp_path, "000001", (4, 6))
    cv2.imwrite(str(tmp_path / "000002.png"), np.ones((4, 6), np.uint16))
    with pytest.raises(DataError, match="at most 3 x 3"):
        read_depth_folder(tmp_path, "000002", (3, 3))
    cv2.imwrite(str(tmp_path / "000003.png"), np.zeros((4, 6), np.uint16))
    with pytest.raises(DataError, match="no pixel has a value"):
        read_depth_folder(tmp_path, "000003", (4, 6))
