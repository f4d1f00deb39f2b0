"""Every format is read back by a reader written here from the format's description, and compared with the data."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pipeline.base.errors import UsageError
from pipeline.check.safe_pickle import load_infos
from pipeline.export.export import Summary, export
from pipeline.export.formats import FORMATS
from pipeline.export.record import Options
from pipeline.geometry.reference_in_view import in_view_openpcdet
from tests.pipeline.export.conftest import TinyRun
from tests.pipeline.tiny_kitti import CALIBRATION, HEIGHT, P2, T_CAM0_VELO, WIDTH, tiny_frame

GOLDEN = Path(__file__).parents[2] / "golden" / "exports.json"


def exported(tiny_run: TinyRun, out: Path, name: str, workers: int = 1, **options: Any) -> Summary:
    if "compat" in options:
        options["compat"] = frozenset(options["compat"])
    return export(tiny_run.dataset, tiny_run.run, out, name, Options(**options), workers)


def project(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """u, v by the devkit's formula P2 * Tr * x, written out."""
    homogeneous = np.column_stack([xyz, np.ones(len(xyz))]) @ T_CAM0_VELO.T @ np.vstack([P2, [0, 0, 0, 1]]).T
    return homogeneous[:, 0] / homogeneous[:, 2], homogeneous[:, 1] / homogeneous[:, 2]


# ---- SFD ----------------------------------------------------------------------------------------------------------


def test_sfd_pseudo_points(tiny_run: TinyRun, tmp_path: Path) -> None:
    exported(tiny_run, tmp_path, "sfd")
    path = tmp_path / "training" / "depth_pseudo_rgbseguv_twise" / "000001.bin"
    rows = np.fromfile(path, dtype=np.float32).reshape(-1, 9)
    depth = tiny_run.depth("000001")
    assert len(rows) == (depth > 0).sum()
    u, v = rows[:, 7].astype(int), rows[:, 8].astype(int)
    np.testing.assert_array_equal(rows[:, 3:6], tiny_frame(1).image[v, u])
    assert (rows[:, 6] == 1).all()
    projected_u, projected_v = project(rows[:, :3].astype(np.float64))
    np.testing.assert_allclose(projected_u, rows[:, 7], atol=1e-3)
    np.testing.assert_allclose(projected_v, rows[:, 8], atol=1e-3)
    forward = rows[:, 0] - 0.27
    np.testing.assert_allclose(forward, depth[v, u], atol=1e-5)


def test_sfd_depth_has_full_height_unless_asked_otherwise(tiny_run: TinyRun, tmp_path: Path) -> None:
    exported(tiny_run, tmp_path, "sfd")
    code = cv2.imread(str(tmp_path / "training" / "depth_dense_twise" / "000001.png"), cv2.IMREAD_UNCHANGED)
    assert code.dtype == np.uint16
    np.testing.assert_array_equal(code, np.rint(tiny_run.depth("000001") * 256))


def test_sfd_quirks_on_a_kitti_sized_map() -> None:
    from pipeline.export.sfd import quirky_depth

    depth = np.arange(1, 375 * 1242 + 1, dtype=np.float32).reshape(375, 1242)
    same, top, left = quirky_depth(depth, frozenset({"crop"}))
    assert (same.shape, top, left) == ((352, 1216), 23, 13)
    np.testing.assert_array_equal(same, depth[23:, 13:1229])
    published, _, _ = quirky_depth(depth, frozenset({"crop", "top96"}))
    assert not published[:96].any()
    np.testing.assert_array_equal(published[96:], depth[23 + 96 :, 13:1229])
    narrow, top, left = quirky_depth(depth[:300, :1000], frozenset({"crop"}))
    assert (top, left) == (-52, -108)
    np.testing.assert_array_equal(narrow[52:, 108:1108], depth[:300, :1000])


def test_sfd_keeps_u_and_v_in_the_full_image_when_cropped(tiny_run: TinyRun, tmp_path: Path) -> None:
    exported(tiny_run, tmp_path / "plain", "sfd")
    exported(tiny_run, tmp_path / "crop", "sfd", compat=["crop"])
    name = "training/depth_pseudo_rgbseguv_twise/000000.bin"
    assert (tmp_path / "plain" / name).read_bytes() == (tmp_path / "crop" / name).read_bytes()


def test_sfd_filtered_points_are_those_of_the_cloud(tiny_run: TinyRun, tmp_path: Path) -> None:
    exported(tiny_run, tmp_path, "sfd", virtual="filtered")
    rows = np.fromfile(tmp_path / "training/depth_pseudo_rgbseguv_twise/000000.bin", np.float32).reshape(-1, 9)
    cloud = tiny_run.cloud("000000")
    np.testing.assert_array_equal(rows[:, :3], cloud[cloud[:, 4] == 1, :3])
    measured = np.fromfile(tmp_path / "training/velodyne/000000.bin", np.float32).reshape(-1, 4)
    np.testing.assert_array_equal(measured, tiny_frame(0).points)


# ---- VirConv ------------------------------------------------------------------------------------------------------


def test_virconv_rows(tiny_run: TinyRun, tmp_path: Path) -> None:
    summary = exported(tiny_run, tmp_path, "virconv")
    rows = np.load(tmp_path / "training" / "velodyne_depth" / "000002.npy")
    assert rows.dtype == np.float16
    assert rows.shape[1] == 8
    measured, virtual = rows[rows[:, 7] == 2], rows[rows[:, 7] == 1]
    assert len(measured) + len(virtual) == len(rows)
    assert (rows[: len(measured), 7] == 2).all()
    points = tiny_frame(2).points
    # OpenPCDet's rule, which VirConv keeps; dividing by P2's third coordinate would keep 1416 points instead of 1414.
    inside = points[in_view_openpcdet(points, tiny_frame(2).calibration, (HEIGHT, WIDTH))]
    np.testing.assert_array_equal(measured[:, :3], inside[:, :3].astype(np.float16))
    np.testing.assert_allclose(measured[:, 3], inside[:, 3] * 10, rtol=1e-3)
    assert not measured[:, 4:7].any()
    assert not virtual[:, 3].any()
    pixels = [np.rint(c).astype(int) for c in project(virtual[:, :3].astype(np.float64))]
    colour = tiny_frame(2).image[pixels[1].clip(0, HEIGHT - 1), pixels[0].clip(0, WIDTH - 1)]
    assert np.median(np.abs(virtual[:, 4:7] * 3.0 - colour)) < 0.5
    assert 0 < summary.largest["rounding of coordinates (m)"] < 0.04


def test_virconv_sampling_by_hand() -> None:
    from pipeline.export.virconv import one_per_cell

    near, far, lower = [10.0, 0.0, -1.0], [20.0, 0.0, -2.0], [10.0, 0.0, -1.0005]
    other, high, above = [10.0, 5.0, -1.0], [3.0, 0.0, 1.5], [10.0, 0.0, 0.9]
    xyz = np.array([far, near, other, high, above])
    # near and far share a cell; `high` is above 1 m; `above` is 1.48 rad from the vertical.
    assert one_per_cell(xyz, lowest_z=False).tolist() == [1, 2]
    assert one_per_cell(xyz, lowest_z=True).tolist() == [0, 2]
    assert one_per_cell(np.array([near, lower]), lowest_z=True).tolist() == [1]
    assert one_per_cell(np.zeros((0, 3)), lowest_z=False).tolist() == []


def test_virconv_full_precision(tiny_run: TinyRun, tmp_path: Path) -> None:
    summary = exported(tiny_run, tmp_path, "virconv", compat=["float32"])
    assert np.load(tmp_path / "training/velodyne_depth/000002.npy").dtype == np.float32
    assert summary.largest["rounding of coordinates (m)"] == 0


# ---- OpenPCDet ----------------------------------------------------------------------------------------------------


def test_openpcdet_infos(tiny_run: TinyRun, tmp_path: Path) -> None:
    exported(tiny_run, tmp_path, "openpcdet")
    train, val = (load_infos(tmp_path / f"kitti_infos_{split}.pkl") for split in ("train", "val"))
    assert [info["point_cloud"]["lidar_idx"] for info in train] == ["000000", "000002"]
    assert [info["image"]["image_idx"] for info in val] == ["000001", "000003"]
    info = val[0]
    assert info["point_cloud"]["num_features"] == 4
    assert info["image"]["image_shape"].tolist() == [HEIGHT, WIDTH]
    assert info["image"]["image_shape"].dtype == np.int32
    np.testing.assert_allclose(info["calib"]["P2"], np.vstack([P2, [0, 0, 0, 1]]))
    np.testing.assert_allclose(info["calib"]["R0_rect"], np.eye(4))
    np.testing.assert_allclose(info["calib"]["Tr_velo_to_cam"], T_CAM0_VELO)
    annos = info["annos"]
    assert annos["name"].tolist() == ["Car"]
    # The label is h 1.5, w 4.0, l 1.6 at (0, 1.62, 9.5), ry 0; the LiDAR is 0.27 m behind and 0.08 m above.
    np.testing.assert_allclose(annos["dimensions"], [[1.6, 1.5, 4.0]])
    np.testing.assert_allclose(annos["location"], [[0, 1.62, 9.5]], rtol=1e-6)
    expected = [9.5 + 0.27, 0, -(1.62 - 0.75) - 0.08, 1.6, 4.0, 1.5, -np.pi / 2]
    np.testing.assert_allclose(annos["gt_boxes_lidar"], [expected], atol=1e-9)
    assert annos["difficulty"].tolist() == [-1]
    assert annos["index"].tolist() == [0]
    points = np.fromfile(tmp_path / "training/velodyne/000001.bin", np.float32).reshape(-1, 4)
    np.testing.assert_array_equal(points, tiny_run.cloud("000001")[:, :4])
    # The box lies across the view: turned by -90 degrees, its length 1.6 runs along y and its width 4.0 along x.
    half = np.array([2.0, 0.8, 0.75])
    inside = (np.abs(points[:, :3] - expected[:3]) <= half).all(1)
    assert annos["num_points_in_gt"].tolist() == [inside.sum()]
    assert inside.sum() > 0


def test_openpcdet_ground_truth_database(tiny_run: TinyRun, tmp_path: Path) -> None:
    exported(tiny_run, tmp_path, "openpcdet")
    database = load_infos(tmp_path / "kitti_dbinfos_train.pkl")
    assert [entry["image_idx"] for entry in database["Car"]] == ["000000", "000002"]
    for entry in database["Car"]:
        points = np.fromfile(tmp_path / entry["path"], np.float32).reshape(-1, 4)
        assert len(points) == entry["num_points_in_gt"]
        assert np.abs(points[:, :3]).max(initial=0) <= 2.1
        assert entry["box3d_lidar"].shape == (7,)
    assert {path.name for path in (tmp_path / "gt_database").iterdir()} == {"000000_Car_0.bin", "000002_Car_0.bin"}
    assert (tmp_path / "ImageSets" / "train.txt").read_text() == "000000\n000002\n"


def test_info_pickles_name_no_module_that_numpy_1_lacks(tiny_run: TinyRun, tmp_path: Path) -> None:
    exported(tiny_run, tmp_path, "openpcdet")
    data = (tmp_path / "kitti_infos_train.pkl").read_bytes()
    assert b"numpy.core.multiarray" in data
    assert b"numpy._core" not in data


def test_openpcdet_custom(tiny_run: TinyRun, tmp_path: Path) -> None:
    exported(tiny_run, tmp_path, "openpcdet_custom")
    points = np.load(tmp_path / "points" / "000003.npy")
    assert points.dtype == np.float32
    np.testing.assert_array_equal(points, tiny_run.cloud("000003")[:, :4])
    *box, name = (tmp_path / "labels" / "000003.txt").read_text().split()
    assert name == "Car"
    np.testing.assert_allclose([float(v) for v in box], [11.77, 0, -0.95, 1.6, 4.0, 1.5, -1.5708], atol=1e-4)
    exported(tiny_run, tmp_path / "all", "openpcdet_custom", compat=["all_columns"])
    assert np.load(tmp_path / "all" / "points" / "000003.npy").shape[1] == 8


# ---- mmdetection3d ------------------------------------------------------------------------------------------------


def test_mmdet3d_infos(tiny_run: TinyRun, tmp_path: Path) -> None:
    exported(tiny_run, tmp_path, "mmdet3d")
    infos = load_infos(tmp_path / "kitti_infos_val.pkl")
    assert infos["metainfo"]["info_version"] == "1.1"
    assert infos["metainfo"]["categories"]["Car"] == 2
    assert [info["sample_idx"] for info in infos["data_list"]] == [1, 3]
    info = infos["data_list"][0]
    camera = info["images"]["CAM2"]
    assert (camera["img_path"], camera["height"], camera["width"]) == ("000001.png", HEIGHT, WIDTH)
    np.testing.assert_allclose(np.array(camera["cam2img"]) @ camera["lidar2cam"], camera["lidar2img"])
    np.testing.assert_allclose(camera["lidar2cam"], T_CAM0_VELO)
    assert info["lidar_points"]["lidar_path"] == "000001.bin"
    (instance,) = info["instances"]
    np.testing.assert_allclose(instance["bbox_3d"], [0, 1.62, 9.5, 1.6, 1.5, 4.0, 0])
    assert (instance["bbox_label"], instance["bbox_label_3d"], instance["index"]) == (2, 2, 0)
    # Centre (0, 0.87, 9.5): u = (48 * 9.5 + 3) / 9.503, v = (70 * 0.87 + 20 * 9.5 + 0.5) / 9.503
    np.testing.assert_allclose(instance["center_2d"], [(48 * 9.5 + 3) / 9.503, (70 * 0.87 + 190.5) / 9.503])
    assert instance["depth"] == pytest.approx(9.5)
    reduced = np.fromfile(tmp_path / "training/velodyne_reduced/000001.bin", np.float32).reshape(-1, 4)
    u, v = project(reduced[:, :3].astype(np.float64))
    assert ((u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)).all()
    assert info["cam_instances"]["CAM2"][0]["bbox_3d_isvalid"]


# ---- plain files --------------------------------------------------------------------------------------------------


def test_bin_ply_and_pcd(tiny_run: TinyRun, tmp_path: Path) -> None:
    exported(tiny_run, tmp_path, "kitti_bin")
    exported(tiny_run, tmp_path, "ply")
    exported(tiny_run, tmp_path, "pcd")
    cloud = tiny_run.cloud("000000")
    flat = np.fromfile(tmp_path / "velodyne" / "000000.bin", np.float32).reshape(-1, 4)
    np.testing.assert_array_equal(flat, cloud[:, :4])
    for suffix, last in ((".ply", b"end_header\n"), (".pcd", b"DATA binary\n")):
        body = (tmp_path / f"000000{suffix}").read_bytes().partition(last)[2]
        rows = np.frombuffer(body, "<f4").reshape(len(cloud), 8)
        np.testing.assert_array_equal(rows[:, :5], cloud)
        u, v = (np.rint(c).astype(int) for c in project(cloud[:, :3].astype(np.float64)))
        inside = (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT) & (cloud[:, 0] > 0.3)
        np.testing.assert_allclose(rows[inside, 5], round(0.8 * 255) / 255, rtol=1e-6)
        np.testing.assert_array_equal(rows[inside, 6], tiny_run.depth("000000")[v[inside], u[inside]])
        assert not rows[~inside, 5:].any()


def test_parquet(tiny_run: TinyRun, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    exported(tiny_run, tmp_path, "parquet")
    rows = parquet.read_table(tmp_path / "detections.parquet").to_pylist()
    assert [row["frame"] for row in rows] == ["000000", "000001", "000002", "000003"]
    assert (rows[1]["class"], rows[1]["score"], rows[1]["z"], rows[1]["w"]) == ("Car", 0.75, 9.5, 4.0)


# ---- all of them --------------------------------------------------------------------------------------------------


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()[:16] for path in files}


@pytest.mark.parametrize("name", [name for name in FORMATS if name != "parquet"])
def test_golden_bytes(tiny_run: TinyRun, tmp_path: Path, name: str) -> None:
    """Frame 000000 in every format; PNGs are compared by pixels, since their compression may change."""
    dataset = tiny_run.dataset.select("000000")
    export(dataset, tiny_run.run, tmp_path, name, Options())
    for path in tmp_path.rglob("*.png"):
        path.write_bytes(cv2.imread(str(path), cv2.IMREAD_UNCHANGED).tobytes())
    assert digests(tmp_path) == json.loads(GOLDEN.read_text())[name]


def test_the_files_do_not_depend_on_the_number_of_workers(tiny_run: TinyRun, tmp_path: Path) -> None:
    exported(tiny_run, tmp_path / "one", "openpcdet", workers=1)
    exported(tiny_run, tmp_path / "two", "openpcdet", workers=2)
    assert digests(tmp_path / "one") == digests(tmp_path / "two")


def test_a_frame_that_fails_does_not_stop_the_others(tiny_run: TinyRun, tmp_path: Path) -> None:
    from tests.pipeline.export.conftest import make_run
    from tests.pipeline.tiny_kitti import write_tiny_kitti

    broken = make_run(write_tiny_kitti(tmp_path / "data", 3), tmp_path / "run")
    (tmp_path / "run" / "depth" / "000001.png").write_bytes(b"")
    summary = exported(broken, tmp_path / "out", "sfd")
    assert summary.frames == 2
    assert list(summary.failures) == ["000001"]
    assert "empty file" in json.loads((tmp_path / "out" / "failures.json").read_text())["000001"]
    assert not (tmp_path / "out" / "training" / "depth_dense_twise" / "000001.png").exists()


def test_requests_that_cannot_be_carried_out(tiny_run: TinyRun, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="needs the depth of a run"):
        export(tiny_run.dataset, None, tmp_path, "sfd", Options())
    with pytest.raises(UsageError, match="no compat option 'upside_down'; known: crop, top96"):
        exported(tiny_run, tmp_path, "sfd", compat=["upside_down"])
    with pytest.raises(UsageError, match="unknown export format"):
        exported(tiny_run, tmp_path, "kitty")


def test_the_verb(tiny_run: TinyRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from pipeline.cli import main

    arguments = ["--stage", "export", "--format", "sfd", "--data", str(tiny_run.data), "--run", str(tiny_run.run)]
    assert main([*arguments, "--out", str(tmp_path), "--frames", "0:2", "--workers", "1", "--compat", "top96"]) == 0
    assert "2 frames" in capsys.readouterr().out
    assert main([*arguments, "--out", str(tmp_path), "--compat", "nonsense"]) == 2


def test_calibration_survives_the_text_file(tiny_run: TinyRun, tmp_path: Path) -> None:
    from pipeline.geometry.calibration import read_calibration

    exported(tiny_run, tmp_path, "openpcdet")
    read = read_calibration(tmp_path / "training" / "calib" / "000000.txt")
    np.testing.assert_array_equal(read.P2, CALIBRATION.P2)
    np.testing.assert_array_equal(read.T_cam0_velo, CALIBRATION.T_cam0_velo)
