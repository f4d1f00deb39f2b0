"""Learning from one's own recordings: which returns are given, which are asked, and the command that trains on them."""

from __future__ import annotations

import collections
import typing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from completion.checkpoints import load_checkpoint
from completion.samples import Augmentation, DrawnSample, TrainingSample, placed_crop
from completion.types import DepthFrame
from pipeline.base.errors import DataError, UsageError
from pipeline.cli import main
from pipeline.data import Frame, open_dataset
from pipeline.geometry.calibration import Calibration
from pipeline.geometry.held_out import ring_maps
from pipeline.geometry.project import project_points
from pipeline.run_folder.config import load_config
from pipeline.training.held_out_rings import HeldOutRings, rings_of
from pipeline.training.rehearsal import Rehearsal
from pipeline.training.settings import completion_settings
from pipeline.training.stage import completion_samples
from tests.pipeline.tiny_kitti import CALIBRATION, HEIGHT, WIDTH, tiny_frame, write_tiny_kitti

SIZE = (HEIGHT, WIDTH)


def test_maps_by_hand() -> None:
    """Focal length 10, centre (2, 2): a point d metres ahead, d (u - 2) / 10 to the right, falls on column u."""
    camera = Calibration(np.array([[10.0, 0, 2, 0], [0, 10, 2, 0], [0, 0, 1, 0]]), np.eye(3), AHEAD)
    on = {"given": (1, 1, 20.0), "asked": (3, 1, 5.0), "hidden": (2, 2, 30.0), "same pixel": (1, 1, 8.0)}
    xyz = np.array([[d, -d * (u - 2) / 10, -d * (v - 2) / 10] for u, v, d in on.values()])
    given, seen = np.array([1, 0, 0, 0], bool), np.array([1, 1, 0, 1], bool)
    sparse, truth = ring_maps(xyz, given, seen, camera, (4, 5))
    assert {(v, u): sparse[v, u] for v, u in np.argwhere(sparse)} == {(1, 1): pytest.approx(20)}
    assert {(v, u): truth[v, u] for v, u in np.argwhere(truth)} == {(1, 3): pytest.approx(5)}
    # A hidden return of a given ring is what a sensor of so few rings has; it is asked for nowhere.
    sparse, truth = ring_maps(xyz, ~given, seen, camera, (4, 5))
    assert sparse[2, 2] == pytest.approx(30)
    assert sparse[1, 1] == pytest.approx(8)
    assert not truth.any()


AHEAD = np.array([[0, -1.0, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize("first", [0, 1, 3])
def test_every_fourth_ring_is_given_and_the_seen_others_are_asked(first: int) -> None:
    frame = tiny_frame(3)
    drawn = HeldOutRings.of(frame, (4,)).every(4, first)
    ring = rings_of(frame, (4,))
    assert ring.max() == 16  # 16 rows, each of which passes the forward direction in its middle
    np.testing.assert_array_equal(drawn.sparse, project_points(frame.points[ring % 4 == first], CALIBRATION, SIZE))
    others = project_points(frame.points[ring % 4 != first], CALIBRATION, SIZE)
    assert drawn.target is not None
    asked = drawn.target > 0
    assert asked.sum() > 2 * (drawn.sparse > 0).sum()
    assert not (asked & (drawn.sparse > 0)).any()
    assert (drawn.target[asked] >= others[asked]).all()


def test_strides_first_rings_and_turns_are_drawn_by_the_given_generator() -> None:
    rings = HeldOutRings.of(tiny_frame(0), (2, 4), jitter=0.5)
    drawn = [rings(np.random.default_rng(seed)) for seed in (0, 0, 1, 2, 3, 4, 5, 6)]
    np.testing.assert_array_equal(drawn[0].sparse, drawn[1].sparse)
    counts = [int((each.sparse > 0).sum()) for each in drawn]
    assert max(counts) > 1.6 * min(counts)
    straight = replace(rings, jitter=0.0)(np.random.default_rng(0))
    assert (straight.sparse > 0).sum() == pytest.approx(counts[0], rel=0.1)
    assert (straight.sparse != drawn[0].sparse).any()


def test_a_crop_has_picture_input_and_target_of_one_place() -> None:
    marked = np.zeros((40, 64), np.float32)
    marked[5, 7], marked[6, 50] = 3.0, 4.0
    frame = DepthFrame(np.repeat(marked[..., None], 3, 2).astype(np.uint8), marked, marked)
    plain = Augmentation(crop=(32, 60), flip=1.0, jitter=0.0)
    crop = placed_crop(DrawnSample(lambda rng: frame), plain, np.random.default_rng(0))
    assert (crop.sparse > 0).any()
    np.testing.assert_array_equal(crop.sparse, crop.target)
    np.testing.assert_array_equal(crop.sparse, crop.image[..., 0])


def changed(frame: Frame, points: np.ndarray) -> Frame:
    return replace(frame, loaders={**frame.loaders, "points": lambda: points})


def test_clouds_whose_rings_cannot_be_told_are_refused() -> None:
    frame = tiny_frame(0)
    with pytest.raises(DataError, match=r"000000: expected at least 32 LiDAR rings.* every 8th leaves 4, got 17; give"):
        rings_of(frame, (2, 8))
    mixed = np.random.default_rng(0).permutation(frame.points)
    with pytest.raises(DataError, match=r"expected points ring after ring from the top.* in another order; sort"):
        rings_of(changed(frame, mixed), (2, 4))
    with pytest.raises(DataError, match=r"at least 8 LiDAR rings.* got 0"):
        rings_of(changed(frame, frame.points[:0]), (2,))


def test_the_network_comes_with_the_weights_it_begins_with() -> None:
    settings = completion_settings(load_config("self-supervised"))
    assert settings.model == load_checkpoint("selection_small")[1].model
    assert settings.loss.kind == "mixture"
    twise = completion_settings(load_config("self-supervised", ["train.model.architecture=twise"]))
    assert twise.model.architecture == "twise"
    with pytest.raises(UsageError, match="train: nowhere: no such weights"):
        completion_settings(load_config("self-supervised", ["train.warm_start=nowhere"]))


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames with points, calibration and pictures: no labels and no depth."""
    root = write_tiny_kitti(tmp_path_factory.mktemp("own"), 2)
    for file in (root / "training").glob("*/*"):
        if file.parent.name not in ("image_2", "velodyne", "calib"):
            file.unlink()
    return root


def adapt(data: Path, out: Path, *changes: str) -> int:
    few = ["beam_strides=[2, 4]", "augmentation.crop=[32, 64]", "steps=2", "save_every=1", *changes]
    options = [part for change in few for part in ("--set", f"train.{change}")]
    return main(["--stage", "train", "--config", "self-supervised", "--data", str(data), "--out", str(out), *options])


def test_two_steps_in_one_go_and_resumed_give_the_same_weights(recordings: Path, tmp_path: Path) -> None:
    assert adapt(recordings, tmp_path / "whole") == 0
    assert adapt(recordings, tmp_path / "parts", "max_steps=1") == 0
    assert adapt(recordings, tmp_path / "parts", "max_steps=null") == 0
    weights = [tmp_path / name / "weights" / "completion" / "last.safetensors" for name in ("whole", "parts")]
    assert weights[0].read_bytes() == weights[1].read_bytes()
    network, card = load_checkpoint(weights[0])
    assert card.training["step"] == 2
    start = load_checkpoint("selection_small")[0].state_dict()
    moved = [name for name, value in network.state_dict().items() if not value.equal(start[name])]
    assert len(moved) > len(start) / 2
    used = ["--set", f"completion.model={weights[0]}", "--data", str(recordings), "--out", str(tmp_path / "mine")]
    assert main(["--stage", "complete", "--config", "kitti", "--workers", "1", *used]) == 0
    assert len(list((tmp_path / "mine" / "depth").glob("*.png"))) == 2


def test_one_sample_in_three_is_rehearsed() -> None:
    for own, other in ((4, 3), (9, 2), (1, 1)):
        mixed: typing.Any = Rehearsal([f"own {i}" for i in range(own)], [f"other {i}" for i in range(other)])
        seen = collections.Counter(mixed[index] for index in range(len(mixed)))
        assert len(seen) == own + other
        count = sum(times for name, times in seen.items() if name.startswith("other"))
        assert 3 * count == len(mixed)


def test_rehearsed_frames_have_their_own_truth(recordings: Path, tmp_path: Path) -> None:
    streets = write_tiny_kitti(tmp_path, 1)
    config = load_config("self-supervised", [f"train.rehearse={streets}", "train.beam_strides=[2, 4]"])
    samples = completion_samples(open_dataset("kitti_object", recordings), config)
    rehearsed, *own = (samples[index] for index in range(len(samples)))
    assert isinstance(rehearsed, TrainingSample)
    np.testing.assert_array_equal(rehearsed.frame.target, open_dataset("kitti_object", streets)[0].target_depth)
    assert all(isinstance(each, DrawnSample) for each in own)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ("beam_strides=[8]", "000000: expected at least 32 LiDAR rings"),
        ("beam_strides=[1, 2]", "train.beam_strides: held_out_rings expects numbers from 2, as [2, 4, 8], got [1, 2]"),
        ("rehearse=RECORDINGS", "no true depth to train completion on (train.rehearse)"),
        ("beam_strides=[]", "train.beam_strides: held_out_rings expects numbers from 2"),
    ],
)
def test_what_cannot_be_learned_from_is_one_line(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: str, line: str
) -> None:
    assert adapt(recordings, tmp_path, change.replace("RECORDINGS", str(recordings))) == 2
    error = capsys.readouterr().err
    assert line in error.splitlines()[-1]
    assert "Traceback" not in error
