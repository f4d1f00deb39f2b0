"""Data sets: determinism, files that our own readers read back, sequences and pseudo ground truth."""

from __future__ import annotations

import filecmp
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from pipeline.data import open_dataset
from pipeline.data.depth_png import read_depth_png
from pipeline.simulation.semi_dense import PoseNoise, accumulate, consistent, stereo_depth
from pipeline.simulation.sequence import simulate_sequence
from pipeline.simulation.statistics import describe, describe_folder, plot, table
from pipeline.simulation.synth import SyntheticFrame, SynthSettings, simulate_frame
from pipeline.simulation.writers import write_dataset
from pipeline.simulation.writers.kitti_depth import drives, pseudo_ground_truth
from pipeline.simulation.writers.vkitti2 import scene_lengths


def _files(root: Path) -> list[str]:
    return sorted(str(path.relative_to(root)) for path in root.rglob("*") if path.is_file())


def test_same_seed_same_frame_other_seed_other_frame(small_settings: SynthSettings) -> None:
    small = replace(small_settings, size=(60, 200), stereo=False)
    one, two, other = (simulate_frame(settings, 1) for settings in (small, small, replace(small, seed=6)))
    np.testing.assert_array_equal(one.image, two.image)
    np.testing.assert_array_equal(one.points, two.points)
    assert one.labels == two.labels
    assert not np.array_equal(one.depth, other.depth)


def test_any_number_of_workers_writes_the_same_bytes(tmp_path: Path) -> None:
    settings = SynthSettings(frames=3, seed=2, size=(60, 200))
    done: list[tuple[int, int]] = []
    write_dataset(tmp_path / "one", settings, workers=1, progress=lambda n, total: done.append((n, total)))
    write_dataset(tmp_path / "two", settings, workers=2)
    assert done == [(1, 3), (2, 3), (3, 3)]
    names = _files(tmp_path / "one")
    assert names == _files(tmp_path / "two")
    same, different, errors = filecmp.cmpfiles(tmp_path / "one", tmp_path / "two", names, shallow=False)
    assert (different, errors) == ([], [])
    assert len(same) == 3 * 7 + 4


def test_kitti_layout_reads_back(tmp_path: Path) -> None:
    settings = SynthSettings(frames=4, seed=5, size=(96, 320), stereo=True)
    write_dataset(tmp_path, settings)
    dataset = open_dataset("kitti_object", tmp_path)
    assert len(dataset) == 4
    frame, made = dataset["000002"], simulate_frame(settings, 2)
    np.testing.assert_array_equal(frame.image, made.image)
    np.testing.assert_array_equal(frame.points, made.points)
    np.testing.assert_allclose(frame.calibration.P2, made.calibration.P2, rtol=1e-11)
    np.testing.assert_allclose(frame.calibration.T_cam_velo, made.calibration.T_cam_velo, atol=1e-11)
    assert [item.type for item in frame.labels] == [item.type for item in made.labels]
    folder = tmp_path / "training"
    dense = read_depth_png(folder / "depth_2" / "000002.png")
    np.testing.assert_allclose(dense, np.minimum(made.depth, 255), atol=1 / 512 + 1e-5)
    assert (folder / "image_3" / "000002.png").is_file()
    assert (tmp_path / "ImageSets" / "val.txt").read_text() == "000003\n"
    assert (tmp_path / "ImageSets" / "train.txt").read_text() == "000000\n000001\n000002\n"


def test_fewer_rows_make_a_thinner_scan(small_settings: SynthSettings) -> None:
    small = replace(small_settings, size=(60, 200), stereo=False)
    counts = [len(simulate_frame(replace(small, rows=rows), 0).points) for rows in (64, 16)]
    assert 3 < counts[0] / counts[1] < 8


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": 0}, "frames: expected at least 1"),
        ({"layout": "kiti"}, "layout: expected one of kitti, kitti_depth, vkitti2"),
        ({"streets": ("moon",)}, "streets: expected names among"),
        ({"size": (8, 100)}, "size: expected"),
        ({"rows": 7}, "rows: expected one of"),
    ],
)
def test_impossible_settings_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SynthSettings(**change)  # type: ignore[arg-type]


def test_drives_and_scenes_share_the_frames() -> None:
    assert drives(45) == [20, 20, 5]
    assert drives(20) == [20]
    assert scene_lengths(12) == [3, 3, 2, 2, 2]
    assert scene_lengths(2) == [1, 1]


def test_vkitti2_layout_reads_back(tmp_path: Path) -> None:
    settings = SynthSettings(frames=2, seed=3, layout="vkitti2", size=(96, 320))
    write_dataset(tmp_path, settings)
    dataset = open_dataset("vkitti2", tmp_path)
    assert len(dataset) == 4
    assert {name for name in _files(tmp_path) if name.endswith(".txt")} == {
        f"Scene0{scene}/clone/{name}.txt"
        for scene in (1, 2)
        for name in ("bbox", "pose", "info", "colors", "intrinsic", "extrinsic")
    }
    for frame in dataset:
        assert frame.target_depth.max() > 20
        assert set(np.unique(frame.semantics)) <= {0, 2, 5, 6, 7, 8, 9, 10, 13, 14, 255}
        for item in frame.labels:
            assert item.type in ("Car", "Van", "Truck")
            left, top, right, bottom = (int(value) for value in item.bbox)
            inside = frame.semantics[top : bottom + 1, left : right + 1]
            assert np.isin(inside, (13, 14)).any()
    lines = (tmp_path / "Scene01" / "clone" / "bbox.txt").read_text().splitlines()
    _, camera, track, left, right, top, bottom, pixels, _, fill, moving = lines[1].split()
    assert float(fill) == pytest.approx(
        min(1, int(pixels) / ((int(right) - int(left)) * (int(bottom) - int(top)))), rel=1e-5
    )
    assert moving in ("True", "False")
    instances = dataset["Scene01/clone/Camera_0/00000"].instances
    assert (instances == int(track) + 1).sum() == int(pixels)
    assert camera == "0"


def test_vkitti2_points_of_an_object_lie_in_its_camera_box(tmp_path: Path) -> None:
    write_dataset(tmp_path, SynthSettings(frames=1, seed=3, layout="vkitti2", size=(96, 320)))
    frame = open_dataset("vkitti2", tmp_path)["Scene01/clone/Camera_1/00000"]
    K = frame.calibration.K
    label = max(frame.labels, key=lambda item: (item.bbox[2] - item.bbox[0]) * (item.truncated < 0.05))
    u = int((label.bbox[0] + label.bbox[2]) / 2)
    v = int((label.bbox[1] + label.bbox[3]) / 2)
    z = float(frame.target_depth[v, u])
    point = np.array([(u - K[0, 2]) * z / K[0, 0], (v - K[1, 2]) * z / K[1, 1], z])
    middle = np.array(label.location) - (0, label.size[0] / 2, 0)
    assert np.linalg.norm(point - middle) < 0.75 * np.hypot(label.size[1], label.size[2])


@pytest.fixture(scope="module")
def drive() -> list[SyntheticFrame]:
    settings = SynthSettings(frames=1, seed=3, layout="kitti_depth", size=(188, 620))
    return list(simulate_sequence(settings, 0, 11))


def test_kitti_depth_layout_reads_back(tmp_path: Path) -> None:
    write_dataset(tmp_path, SynthSettings(frames=1, seed=3, layout="kitti_depth", size=(60, 200)))
    dataset = open_dataset("kitti_depth", tmp_path)
    assert dataset.ids == ("train/2000_01_01_drive_0000_sync/image_02/0000000005",)
    frame = dataset[dataset.ids[0]]
    assert frame.image.shape == (60, 200, 3)
    assert frame.target_depth.shape == frame.sparse_depth.shape == (60, 200)
    assert 0 < (frame.target_depth > 0).mean() < 1
    assert frame.calibration.P2[0, 0] == pytest.approx(721.5377 * 200 / 1242, rel=0.02)
    raw = tmp_path / "2000_01_01" / "2000_01_01_drive_0000_sync"
    assert len(list((raw / "velodyne_points" / "data").glob("*.bin"))) == 11


def test_drives_move_and_keep_their_rig(drive: list[SyntheticFrame]) -> None:
    step = [np.linalg.norm(b.T_world_cam[:3, 3] - a.T_world_cam[:3, 3]) for a, b in pairwise(drive)]
    assert min(step) > 0.05
    assert max(step) < 1.3
    assert all(frame.calibration is drive[0].calibration for frame in drive)
    assert [frame.id for frame in drive[:2]] == ["0000000000", "0000000001"]


def test_pseudo_ground_truth_is_semi_dense_and_wrong_at_edges(drive: list[SyntheticFrame]) -> None:
    target, truth = pseudo_ground_truth(drive, [3, 0, 5]), drive[5].depth
    valid = (target > 0) & (truth > 0)
    error = np.abs(target - truth)
    # Half the resolution has four times fewer pixels for the same rays: denser than KITTI's 14-20 %.
    assert 0.1 < (target > 0).mean() < 0.7
    mae, rmse = error[valid].mean(), np.sqrt((error[valid] ** 2).mean())
    assert mae < 0.5
    assert rmse > 2 * mae
    padded = np.pad(drive[5].semantics, 3, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (7, 7))
    near = windows.max(axis=(2, 3)) != windows.min(axis=(2, 3))
    share_of_error = error[valid & near].sum() / error[valid].sum()
    assert share_of_error > 2 * near[valid].mean()


def test_accumulation_without_noise_and_motion_repeats_the_scan() -> None:
    points = np.array([[5.0, 1.0, -1.0, 0.3], [9.0, 0.0, 0.0, 0.1]], dtype=np.float32)
    ahead = np.eye(4)
    ahead[0, 3] = 2.0
    cloud = accumulate([points, points], [np.eye(4), ahead], 0, PoseNoise(0, 0), np.random.default_rng(0))
    np.testing.assert_allclose(cloud, np.concatenate([points[:, :3], points[:, :3] + (2, 0, 0)]), atol=1e-9)


def test_consistency_keeps_what_stereo_confirms() -> None:
    accumulated = np.array([[10.0, 10.0, 10.0, 0.0, 90.0]], dtype=np.float32)
    current = np.array([[0.0, 10.0, 0.0, 0.0, 0.0]], dtype=np.float32)
    stereo = np.array([[10.3, 0.0, 0.0, 10.0, 90.0]], dtype=np.float32)
    # Confirmed; no match but measured now; no match; nothing accumulated; beyond 80 m.
    np.testing.assert_array_equal(consistent(accumulated, current, stereo), [[10, 10, 0, 0, 0]])
    np.testing.assert_array_equal(consistent(accumulated, current, stereo * 1.2), [[0, 10, 0, 0, 0]])


def test_stereo_depth_of_a_shifted_texture() -> None:
    rng = np.random.default_rng(0)
    texture = rng.integers(0, 255, (80, 300, 3), dtype=np.uint8)
    left, right = texture[:, :260], texture[:, 20:280]
    # A disparity of 20 px at f = 400: 400 * 0.532725 / 20 = 10.65 m.
    depth = stereo_depth(left, right, 400.0)
    assert np.median(depth[20:60, 60:240]) == pytest.approx(10.65, rel=0.01)


def test_statistics_of_a_written_data_set_are_those_of_its_frames(tmp_path: Path) -> None:
    settings = SynthSettings(frames=2, seed=5, size=(96, 320))
    write_dataset(tmp_path, settings)
    (written,) = describe_folder(tmp_path, 1)
    made = simulate_frame(settings, 0)
    direct = describe(made.points, made.calibration, made.labels, made.image)
    assert (written.in_view, written.in_scan, written.row_shares) == (direct.in_view, direct.in_scan, direct.row_shares)
    assert max(abs(share) for share in written.row_shares) < 8


def test_statistics_compare_two_sets(frames: list[SyntheticFrame], tmp_path: Path) -> None:
    sets = [describe(f.points, f.calibration, f.labels, f.image) for f in frames]
    assert sets[0].depth_shares.sum() == pytest.approx(1, abs=0.02)
    assert sets[0].in_view < sets[0].in_scan
    text = table(sets, sets)
    rows = [line.split("|") for line in text.splitlines()[2:]]
    assert all(row[2] == row[3] for row in rows)
    assert len(rows) > 20
    plot(sets, sets, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 10_000
