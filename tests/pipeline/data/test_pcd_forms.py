"""PCD and PLY files in the forms of other programs: the same points are read from all of them."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.base.errors import DataError
from pipeline.check.doctor import check
from pipeline.data import open_dataset
from pipeline.data.cloud_columns import CloudForm
from pipeline.data.cloud_files import INTENSITY_NAMES, read_measured, read_points
from pipeline.data.kitti_object import write_calibration
from tests.pipeline.tiny_kitti import CALIBRATION, tiny_frame, write_tiny_kitti

POINTS = tiny_frame(0).points[:60]
Field = tuple[str, str, int, np.ndarray | None]


def lzf(data: bytes) -> bytes:
    """LZF as a packer may write it: literals, and a copy wherever eight bytes stood before."""
    out, literals, i = bytearray(), bytearray(), 0

    def flush() -> None:
        for start in range(0, len(literals), 32):
            part = literals[start : start + 32]
            out.append(len(part) - 1)
            out.extend(part)
        literals.clear()

    while i < len(data):
        start = data.rfind(data[i : i + 8], max(0, i - 8000), i) if i + 8 <= len(data) else -1
        if start < 0:
            literals.append(data[i])
            i += 1
            continue
        length = 8
        while length < 264 and i + length < len(data) and data[start + length] == data[i + length]:
            length += 1
        flush()
        distance = i - start - 1
        out.extend([(7 << 5) | (distance >> 8), length - 2 - 7] if length > 8 else [(6 << 5) | (distance >> 8)])
        out.append(distance & 255)
        i += length
    flush()
    return bytes(out)


def pcd(fields: list[Field], kind: str, points_line: bool = True, count_line: bool = True) -> bytes:
    """A PCD file of fields (name, NumPy type, count, (N, count) values or None for padding)."""
    rows = len(POINTS)
    blocks = [
        (np.full((rows, count), 7) if values is None else values.reshape(rows, count)).astype("<" + dtype)
        for _, dtype, count, values in fields
    ]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(name for name, *_ in fields),
        "SIZE " + " ".join(dtype[1] for _, dtype, *_ in fields),
        "TYPE " + " ".join(dtype[0].upper() for _, dtype, *_ in fields),
        *(["COUNT " + " ".join(str(count) for _, _, count, _ in fields)] if count_line else []),
        f"WIDTH {rows // 2}",
        "HEIGHT 2",
        "VIEWPOINT 0 0 0 1 0 0 0",
        *([f"POINTS {rows}"] if points_line else []),
        f"DATA {kind}",
        "",
    ]
    if kind == "ascii":
        lines = (" ".join(repr(v.item()) for block in blocks for v in block[i]) for i in range(rows))
        body = "\n".join(lines).encode()
    elif kind == "binary":
        body = b"".join(block[i].tobytes() for i in range(rows) for block in blocks)
    else:
        plain = b"".join(block.tobytes() for block, (name, *_) in zip(blocks, fields) if name != "_")
        packed = lzf(plain)
        body = struct.pack("<II", len(packed), len(plain)) + packed
    return "\n".join(header).encode() + body


@settings(max_examples=30, deadline=None)
@given(
    st.sampled_from(["ascii", "binary", "binary_compressed"]),
    st.sampled_from([*INTENSITY_NAMES, "Intensity", "scalar_Intensity", "REFLECTIVITY"]),
    st.sampled_from([str.lower, str.upper]),
    st.lists(st.tuples(st.integers(0, 4), st.sampled_from(["u1", "u2", "f4"]), st.integers(0, 12)), max_size=3),
    st.sampled_from(["f4", "f8"]),
    st.booleans(),
)
def test_a_pcd_in_any_form_is_the_same_cloud(
    tmp_path_factory: pytest.TempPathFactory, kind: str, name: str, case, padding, dtype: str, points_line: bool
) -> None:
    fields: list[Field] = [(case(axis), dtype, 1, POINTS[:, i]) for i, axis in enumerate("xyz")]
    fields.append((name, "f4", 1, POINTS[:, 3]))
    fields.append(("ring", "u2", 1, np.arange(len(POINTS))))
    for place, type_, count in padding:
        fields.insert(place, ("_", type_, count, None))
    path = tmp_path_factory.mktemp("pcd") / "a.PCD"
    counted = bool(padding) or not points_line
    path.write_bytes(pcd(fields, kind, points_line, counted))
    np.testing.assert_allclose(read_points(path), POINTS, rtol=1e-6)


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_pixels_without_a_return_are_left_out_with_their_count(tmp_path: Path, kind: str) -> None:
    cloud = POINTS.copy()
    cloud[3:9, :3] = np.nan
    cloud[20] = 0
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd([(name, "f4", 1, cloud[:, i]) for i, name in enumerate(("x", "y", "z", "intensity"))], kind))
    points, empty = read_measured(path)
    assert empty == 7
    np.testing.assert_allclose(points, np.delete(POINTS, [3, 4, 5, 6, 7, 8, 20], axis=0), rtol=1e-6)
    with pytest.raises(DataError, match="6 of 60 points with NaN"):
        read_points(path, CloudForm(keep_empty=True))


def test_the_doctor_counts_pixels_without_a_return(tmp_path: Path) -> None:
    root = write_tiny_kitti(tmp_path, 1)
    (root / "training" / "image_2").rename(root / "images")
    (root / "points").mkdir()
    write_calibration(root / "calib.txt", CALIBRATION)
    cloud = POINTS.copy()
    cloud[:5, :3] = np.nan
    fields: list[Field] = [(name, "f4", 1, cloud[:, i]) for i, name in enumerate(("x", "y", "z", "Intensity"))]
    (root / "points" / "000000.pcd").write_bytes(pcd(fields, "binary"))
    report = check(root, "folder", workers=1)
    assert any("5 points without a return (NaN or 0 0 0) are left out of 1 clouds" in note for note in report.notes)
    assert len(open_dataset("folder", root)["000000"].points) == 55
    with pytest.raises(DataError, match="NaN"):
        _ = open_dataset("folder", root, keep_empty=True)["000000"].points


@pytest.mark.parametrize("cut", [1, 30, 200])
def test_a_cut_file_is_damage_in_every_kind(tmp_path: Path, cut: int) -> None:
    fields: list[Field] = [(name, "f4", 1, POINTS[:, i]) for i, name in enumerate(("x", "y", "z", "intensity"))]
    for kind in ("binary", "binary_compressed"):
        (tmp_path / "a.pcd").write_bytes(pcd(fields, kind)[:-cut])
        with pytest.raises(DataError, match=r"a\.pcd: expected"):
            read_points(tmp_path / "a.pcd")


def test_a_ply_with_other_names_and_with_faces_first(tmp_path: Path) -> None:
    path = tmp_path / "a.PLY"
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty Float X\nproperty float Y\nproperty float Z\n"
    path.write_text(head + "property float scalar_Intensity\nend_header\n1 2 3 .5\n4 5 6 .25\n")
    np.testing.assert_array_equal(read_points(path), [[1, 2, 3, 0.5], [4, 5, 6, 0.25]])
    path.write_text(
        "ply\nformat ascii 1.0\nelement camera 1\nproperty float f\n" + head[21:] + "end_header\n7\n1 2 3\n4 5 6\n"
    )
    with pytest.raises(DataError, match="the vertices first"):
        read_points(path)
