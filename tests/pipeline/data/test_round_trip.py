"""What our simulation writes is read back by our readers, and the doctor finds nothing in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from detection.boxes import project_to_image
from detection.kitti_format import boxes_of
from pipeline.check.doctor import check
from pipeline.data import open_dataset
from pipeline.data.vkitti2 import read_objects, thesis_split
from pipeline.simulation.synth import SynthSettings
from pipeline.simulation.writers import write_dataset


@pytest.fixture(scope="module")
def vkitti2(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("vkitti2")
    return write_dataset(root, SynthSettings(frames=2, seed=3, layout="vkitti2"))


@pytest.mark.slow
def test_virtual_kitti_boxes_lie_on_their_masks(vkitti2: Path) -> None:
    compared = 0
    for frame in open_dataset("vkitti2", vkitti2):
        objects = read_objects(vkitti2, frame.id)
        rectangles = project_to_image(boxes_of(frame.labels), frame.calibration.P2, frame.image_size)
        for item, rectangle in zip(objects, rectangles):
            v, u = np.nonzero(frame.instances == item.track + 1)
            assert len(v) == item.number_pixels
            if item.truncation_ratio == 0 and item.location[2] > 4:
                # The mask is a part of the projected cuboid.
                assert u.min() >= rectangle[0] - 1.5
                assert v.min() >= rectangle[1] - 1.5
                assert u.max() <= rectangle[2] + 1.5
                assert v.max() <= rectangle[3] + 1.5
                compared += 1
    assert compared >= 5


@pytest.mark.slow
def test_virtual_kitti_depth_meets_the_boxes(vkitti2: Path) -> None:
    for frame in open_dataset("vkitti2", vkitti2):
        for item in read_objects(vkitti2, frame.id):
            inside = frame.target_depth[frame.instances == item.track + 1]
            if item.truncation_ratio == 0 and len(inside) > 50:
                reach = np.hypot(item.length, item.width) / 2 + 0.1
                assert abs(float(np.median(inside)) - item.location[2]) <= reach


@pytest.mark.slow
def test_the_doctor_is_silent_on_synthetic_trees(vkitti2: Path, tmp_path: Path) -> None:
    report = check(vkitti2, workers=1)
    assert (report.format, report.findings) == ("vkitti2", ())
    write_dataset(tmp_path / "kitti", SynthSettings(frames=4, seed=5))
    report = check(tmp_path / "kitti", workers=1)
    assert (report.format, report.frames, report.findings) == ("kitti_object", 4, ())
    assert len(thesis_split(open_dataset("vkitti2", vkitti2), "train")) >= 2
