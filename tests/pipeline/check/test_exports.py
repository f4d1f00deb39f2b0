"""Planted faults in exported folders of real frames: SFD, VirConv, info pickles, runs and result folders."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from completion.types import CompletedDepth
from pipeline.base.errors import DataError, UsageError
from pipeline.base.paths import RunFolder
from pipeline.check.doctor import check
from pipeline.check.safe_pickle import load_infos
from pipeline.data import open_dataset
from pipeline.data.dataset import Dataset
from pipeline.export.export import export
from pipeline.export.record import Options
from pipeline.run_folder.frame_outputs import FrameOutputs

FRAMES = ("000003", "000004", "000007")
VICTIM = "000004"


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, Path]:
    """Three real frames and a run with depth (the LiDAR, grown) and detections (the labels, scored)."""
    from tests.conftest import sample_folder

    dataset = open_dataset("kitti_object", sample_folder("kitti_object")).select(FRAMES)
    run = tmp_path_factory.mktemp("run")
    for frame in dataset:
        sparse = frame.sparse_depth
        near = cv2.dilate(np.divide(1, sparse, out=np.zeros_like(sparse), where=sparse > 0), np.ones((9, 9)))
        depth = np.where(sparse > 0, sparse, np.divide(1, near, out=np.zeros_like(near), where=near > 0))
        files = FrameOutputs(RunFolder(run), frame.id)
        files.write_completed(CompletedDepth(depth.astype(np.float32)))
        files.write_detections([replace(o, score=0.5) for o in frame.labels if o.type != "DontCare"])
        path = RunFolder(run).cloud(frame.id)
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(np.column_stack([frame.points, np.zeros(len(frame.points))]).astype("<f4").tobytes())
    return dataset, run


def exported(source: tuple[Dataset, Path], out: Path, name: str) -> Path:
    dataset, run = source
    assert not export(dataset, run, out, name, Options(images=True)).failures
    return out


def names(path: Path, reference: Dataset | None = None, format_name: str | None = None) -> set[str]:
    return {finding.fault for finding in check(path, format_name, reference, workers=1).findings}


@pytest.mark.parametrize("name", ["sfd", "virconv", "openpcdet", "mmdet3d"])
def test_it_is_silent_on_clean_exports(source: tuple[Dataset, Path], tmp_path: Path, name: str) -> None:
    out = exported(source, tmp_path, name)
    report = check(out, workers=1)
    assert (report.format, report.frames, report.findings) == (name, 3, ())
    if name in ("sfd", "virconv"):
        assert names(out, source[0]) == set()


def test_it_is_silent_on_a_clean_run(source: tuple[Dataset, Path]) -> None:
    assert names(source[1], source[0]) == set()
    assert names(source[1] / "detections", source[0], "results") == set()
    assert names(source[1] / "depth", source[0], "depth") == set()
    with pytest.raises(UsageError, match="--data"):
        check(source[1])


# ---- SFD ----------------------------------------------------------------------------------------------------------


def columns(change: Callable[[np.ndarray], None]) -> Callable[[np.ndarray], np.ndarray]:
    def changed(rows: np.ndarray) -> np.ndarray:
        rows = rows.copy()
        change(rows)
        return rows

    return changed


def shift_pixels(rows: np.ndarray) -> None:
    rows[:, 7] -= 13
    rows[:, 8] -= 23


def bgr(rows: np.ndarray) -> None:
    rows[:, 3:6] = rows[:, 5:2:-1]


def unit_colours(rows: np.ndarray) -> None:
    rows[:, 3:6] /= 255


def lose_calibration(rows: np.ndarray) -> None:
    rows[:, 1] *= 1.3


def not_a_number(rows: np.ndarray) -> None:
    rows[5, 2] = np.nan


SFD_FAULTS = {
    "wrong_crop": columns(shift_pixels),
    "rgb_bgr_swap": columns(bgr),
    "colour_scale": columns(unit_colours),
    "points_disagree_with_pixels": columns(lose_calibration),
    "non_finite_points": columns(not_a_number),
    "wrong_columns": lambda rows: rows[:, :8][: len(rows) // 9 * 9 - 1],
    "empty_file": lambda rows: rows[:0],
}


@pytest.mark.parametrize("fault", SFD_FAULTS)
def test_sfd_faults(source: tuple[Dataset, Path], tmp_path: Path, fault: str) -> None:
    out = exported(source, tmp_path, "sfd")
    path = out / "training" / "depth_pseudo_rgbseguv_twise" / f"{VICTIM}.bin"
    rows = np.fromfile(path, "<f4").reshape(-1, 9)
    path.write_bytes(np.ascontiguousarray(SFD_FAULTS[fault](rows), "<f4").tobytes())
    assert names(out) == {fault}


def test_sfd_files_named_by_running_index(source: tuple[Dataset, Path], tmp_path: Path) -> None:
    folder = exported(source, tmp_path, "sfd") / "training" / "depth_dense_twise"
    maps = [(folder / f"{frame}.png").read_bytes() for frame in FRAMES]
    for frame, data in zip(FRAMES, maps[1:] + maps[:1]):
        (folder / f"{frame}.png").write_bytes(data)
    assert names(tmp_path) == {"index_offset"}


def test_sfd_missing_and_extra_files(source: tuple[Dataset, Path], tmp_path: Path) -> None:
    folder = exported(source, tmp_path, "sfd") / "training" / "depth_pseudo_rgbseguv_twise"
    (folder / f"{VICTIM}.bin").rename(folder / "000555.bin")
    assert names(tmp_path) == {"missing_file", "extra_file"}


# ---- VirConv ------------------------------------------------------------------------------------------------------


def swap_flags(rows: np.ndarray) -> None:
    rows[:, 7] = 3 - rows[:, 7]


def plain_intensity(rows: np.ndarray) -> None:
    rows[rows[:, 7] == 2, 3] /= 10


def full_colours(rows: np.ndarray) -> None:
    rows[:, 4:7] *= 3


def virtual_bgr(rows: np.ndarray) -> None:
    rows[:, 4:7] = rows[:, 6:3:-1]


def random_depth(rows: np.ndarray) -> None:
    virtual = rows[:, 7] == 1
    factor = np.random.default_rng(0).uniform(0.3, 3, int(virtual.sum()))
    rows[virtual, :3] *= factor[:, None].astype(np.float32)


VIRCONV_FAULTS = {
    "source_flag_swapped": columns(swap_flags),
    "intensity_scale": columns(plain_intensity),
    "colour_scale": columns(full_colours),
    "rgb_bgr_swap": columns(virtual_bgr),
    "depth_disagrees_with_lidar": columns(random_depth),
    "wrong_columns": lambda rows: rows[:, :7],
}


@pytest.mark.parametrize("fault", VIRCONV_FAULTS)
def test_virconv_faults(source: tuple[Dataset, Path], tmp_path: Path, fault: str) -> None:
    out = exported(source, tmp_path, "virconv")
    path = out / "training" / "velodyne_depth" / f"{VICTIM}.npy"
    np.save(path, VIRCONV_FAULTS[fault](np.load(path).astype(np.float32)).astype(np.float16))
    assert names(out) == {fault}


def test_virconv_of_another_frame(source: tuple[Dataset, Path], tmp_path: Path) -> None:
    folder = exported(source, tmp_path, "virconv") / "training" / "velodyne_depth"
    (folder / f"{VICTIM}.npy").write_bytes((folder / "000003.npy").read_bytes())
    assert names(tmp_path) == {"index_offset"}


def test_virconv_from_the_top_left_crop_with_centre_offsets(source: tuple[Dataset, Path], tmp_path: Path) -> None:
    """The original generator's slip: the top-left window, lifted with a camera matrix moved by (13, 11.5) px."""
    from pipeline.data.lidar_like import pixels_to_velo

    out = exported(source, tmp_path, "virconv")
    calibration = source[0][VICTIM].calibration
    path = out / "training" / "velodyne_depth" / f"{VICTIM}.npy"
    rows = np.load(path).astype(np.float32)
    virtual = rows[:, 7] == 1
    pixels, depth = calibration.cam_to_image(calibration.velo_to_cam(rows[virtual]))
    rows[virtual, :3] = pixels_to_velo(pixels[:, 0] + 13, pixels[:, 1] + 11.5, depth, calibration)
    np.save(path, rows.astype(np.float16))
    assert names(out) == {"wrong_crop"}


# ---- info pickles -------------------------------------------------------------------------------------------------


def rewrite(path: Path, change: Callable[[object], object]) -> None:
    path.write_bytes(pickle.dumps(change(load_infos(path))))


def openpcdet_change(key: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[list], list]:
    def changed(infos: list) -> list:
        for info in infos:
            info["annos"][key] = change(info["annos"][key])
        return infos

    return changed


@pytest.mark.parametrize(
    ("fault", "change"),
    [
        ("swapped_dimensions", openpcdet_change("dimensions", lambda d: d[:, [1, 2, 0]])),
        ("swapped_dimensions", openpcdet_change("gt_boxes_lidar", lambda b: b[:, [0, 1, 2, 4, 3, 5, 6]])),
        ("yaw_sign", openpcdet_change("gt_boxes_lidar", lambda b: b * [1, 1, 1, 1, 1, 1, -1])),
        ("infos_disagree", openpcdet_change("name", lambda n: np.full_like(n, "Tram"))),
        ("infos_disagree", lambda infos: {"data_list": infos}),
    ],
)
def test_openpcdet_info_faults(source: tuple[Dataset, Path], tmp_path: Path, fault: str, change: Callable) -> None:
    out = exported(source, tmp_path, "openpcdet")
    rewrite(out / "kitti_infos_trainval.pkl", change)
    assert names(out) == {fault}


def old_list(infos: dict) -> list:
    return infos["data_list"]


def label_order(infos: dict) -> dict:
    for info in infos["data_list"]:
        for item in info["instances"]:
            x, y, z, l, h, w, ry = item["bbox_3d"]
            item["bbox_3d"] = [x, y, z, h, w, l, ry]
    return infos


@pytest.mark.parametrize(("fault", "change"), [("old_info_format", old_list), ("swapped_dimensions", label_order)])
def test_mmdet3d_info_faults(source: tuple[Dataset, Path], tmp_path: Path, fault: str, change: Callable) -> None:
    out = exported(source, tmp_path, "mmdet3d")
    rewrite(out / "kitti_infos_trainval.pkl", change)
    assert names(out) == {fault}


def test_a_pickle_that_runs_code_is_refused(tmp_path: Path) -> None:
    class Attack:
        def __reduce__(self) -> tuple:
            return print, ("never",)

    path = tmp_path / "kitti_infos_train.pkl"
    path.write_bytes(pickle.dumps([Attack()]))
    with pytest.raises(DataError, match=r"builtins\.print"):
        load_infos(path)
    path.write_bytes(pickle.dumps([{"a": np.arange(3.0)}])[:-7])
    with pytest.raises(DataError, match="expected a pickle"):
        load_infos(path)
    path.write_bytes(pickle.dumps([{"a": np.float32(2), "b": np.array(["Car"])}]))
    assert load_infos(path)[0]["a"] == 2


# ---- runs and results ---------------------------------------------------------------------------------------------


def test_labels_in_place_of_results(source: tuple[Dataset, Path], tmp_path: Path) -> None:
    dataset, _ = source
    for frame in FRAMES:
        text = (Path(dataset.root) / "label_2" / f"{frame}.txt").read_text()
        (tmp_path / f"{frame}.txt").write_text(text)
    assert names(tmp_path, dataset, "results") == {"label_result_mixup"}
    assert names(tmp_path, dataset, "labels") == set()


def test_a_missing_result_file(source: tuple[Dataset, Path], tmp_path: Path) -> None:
    (tmp_path / "000003.txt").write_text("")
    (tmp_path / "000007.txt").write_text("")
    report = check(tmp_path, "results", source[0], workers=1)
    assert [(f.fault, f.frame) for f in report.findings] == [("missing_file", VICTIM)]


def test_a_cut_cloud_in_a_run(source: tuple[Dataset, Path], tmp_path: Path) -> None:
    dataset, run = source
    cloud = tmp_path / "cloud"
    cloud.mkdir()
    for frame in FRAMES:
        data = (run / "cloud" / f"{frame}.bin").read_bytes()
        (cloud / f"{frame}.bin").write_bytes(data[:-3] if frame == VICTIM else data)
    assert names(tmp_path, dataset, "run") == {"truncated_cloud"}
