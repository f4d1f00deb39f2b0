"""Forms that KITTI-like data comes in: the same frame written in another form is read as the same frame."""

from __future__ import annotations

import codecs
import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from detection.evaluation.reading import InputError, read_pair
from detection.kitti_format import format_line
from detection.text import decode_text
from pipeline.base.errors import DataError, UsageError
from pipeline.check.doctor import Report, check
from pipeline.data import open_dataset
from pipeline.data.cloud_columns import cloud_form, fitting_columns
from pipeline.data.images import check_complete, image_size, read_image
from pipeline.geometry.calibration import format_calibration, parse_calibration
from tests.pipeline.tiny_kitti import CALIBRATION, tiny_frame, write_tiny_kitti

KEYS = {"P2": CALIBRATION.P2, "R0_rect": CALIBRATION.R0_rect, "Tr_velo_to_cam": CALIBRATION.T_cam0_velo[:3]}
FRAMES = [tiny_frame(index) for index in range(3)]


def faults(report: Report) -> set[str]:
    """The faults found but for those of the tiny frames themselves: cars wider than long, no depth at the road."""
    return {finding.fault for finding in report.findings} - {"swapped_dimensions", "depth_disagrees_with_lidar"}


def with_columns(points: np.ndarray, columns: int) -> np.ndarray:
    """Ring, time and empty columns behind x y z intensity, as other data sets have them."""
    rings = np.repeat(np.arange(16), len(points) // 16)[: len(points)]
    more = [rings, np.linspace(0, 0.1, len(points)), -np.ones(len(points)), np.ones(len(points))]
    return np.column_stack([points, *more])[:, :columns].astype("<f4")


# ---- columns of clouds --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("columns", [3, 5, 6, 8])
@pytest.mark.parametrize("scale", [1, 255])
def test_clouds_of_other_columns_are_refused_with_their_number_and_read_when_it_is_given(
    tmp_path: Path, columns: int, scale: int
) -> None:
    root = write_tiny_kitti(tmp_path, 3)
    for frame in FRAMES:
        cloud = with_columns(frame.points * [1, 1, 1, scale], columns)
        (root / "training" / "velodyne" / f"{frame.id}.bin").write_bytes(cloud.tobytes())
    dataset = open_dataset("kitti_object", root)
    assert f"its clouds have {columns}; set data.columns={columns}" in dataset.refusal
    with pytest.raises(DataError, match=f"got {columns} float32 columns a point; set data.columns={columns}"):
        _ = dataset["000001"].points
    expected = FRAMES[1].points * [1, 1, 1, scale if columns > 3 else 0]
    read = open_dataset("kitti_object", root, columns)["000001"].points
    np.testing.assert_array_equal(read, expected.astype(np.float32))
    report = check(root, workers=1)
    assert faults(report) == {"wrong_columns"}
    assert all(f"{columns} float32 columns" in f.message for f in report.findings if f.fault == "wrong_columns")


def test_one_cloud_of_other_columns_among_others_is_named(tmp_path: Path) -> None:
    root = write_tiny_kitti(tmp_path, 3)
    (root / "training" / "velodyne" / "000001.bin").write_bytes(with_columns(FRAMES[1].points, 5).tobytes())
    dataset = open_dataset("kitti_object", root)
    assert dataset.refusal == ""
    assert len(dataset["000000"].points) == len(FRAMES[0].points)
    with pytest.raises(DataError, match=r"000001\.bin: expected 4 float32 columns .*, got 5 float32 columns"):
        _ = dataset["000001"].points


def test_a_cut_cloud_does_not_change_the_columns_of_the_others(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(FRAMES[0].points.tobytes()[:-7])
    assert cloud_form([path], None).fits == 4
    assert cloud_form([], None).fits == 4


@settings(max_examples=15, deadline=None)
@given(st.sampled_from([3, 4, 5, 6, 8]), st.sampled_from([1, 255]), st.integers(0, 2**31), st.booleans())
def test_the_columns_show_in_the_values(columns: int, scale: int, seed: int, shuffled: bool) -> None:
    rng = np.random.default_rng(seed)
    cloud = with_columns(FRAMES[seed % 3].points * [1, 1, 1, scale], columns)
    cloud = cloud[rng.permutation(len(cloud))] if shuffled else cloud
    assert fitting_columns(cloud.ravel()) == columns


@pytest.mark.real_data
def test_the_columns_of_real_clouds(kitti_object: Path) -> None:
    for path in sorted((kitti_object / "training" / "velodyne").glob("*.bin"))[:2]:
        points = np.fromfile(path, "<f4").reshape(-1, 4)
        for columns in (3, 4, 5, 6, 8):
            assert fitting_columns(with_columns(points[: len(points) // 16 * 16], columns).ravel()) == columns
        # A return that was not received is 0 0 0 0: every second one here.
        assert fitting_columns(np.column_stack([points, np.zeros_like(points)]).ravel()) == 4


def test_text_named_bin_is_called_text(tmp_path: Path) -> None:
    root = write_tiny_kitti(tmp_path, 2)
    (root / "training" / "velodyne" / "000001.bin").write_text("1.0 2.0 3.0 0.5\n" * 400)
    with pytest.raises(DataError, match="a text file that begins"):
        _ = open_dataset("kitti_object", root)["000001"].points


# ---- text ---------------------------------------------------------------------------------------------------------

ENCODINGS = {
    "utf-8": b"",
    "utf-8-sig": b"",
    "utf-16-le": codecs.BOM_UTF16_LE,
    "utf-16-be": codecs.BOM_UTF16_BE,
    "utf-32-le": codecs.BOM_UTF32_LE,
}


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(list(ENCODINGS)),
    st.sampled_from(["\n", "\r\n", "\r"]),
    st.sampled_from([" ", "\t", ", ", ",", "; ", " ; "]),
    st.sampled_from(["", "[]", "()", "[[]]"]),
    st.booleans(),
    st.booleans(),
    st.sampled_from([": ", " ", ":", " = "]),
)
def test_a_calibration_in_any_form_is_the_same(
    encoding: str, newline: str, separator: str, brackets: str, decimal_comma: bool, four_rows: bool, colon: str
) -> None:
    lines = ["calib_time: 09-Jan-2012 14:00:15", "corner: not-a-number"]
    for key, matrix in KEYS.items():
        rows = np.eye(4) if four_rows else matrix
        rows = rows.copy()
        rows[: matrix.shape[0], : matrix.shape[1]] = matrix
        numbers = [f"{value:.6e}" for value in rows.ravel()]
        if decimal_comma:
            numbers = [number.replace(".", ",") for number in numbers]
        mark = separator.replace(",", ";") if decimal_comma else separator
        half = len(brackets) // 2
        lines.append(key + colon + brackets[:half] + mark.join(numbers) + brackets[half:])
    data = ENCODINGS[encoding] + newline.join(lines).encode(encoding)
    read = parse_calibration(decode_text(data), "calib.txt")
    for name in ("P2", "R0_rect", "T_cam0_velo"):
        np.testing.assert_allclose(getattr(read, name), getattr(CALIBRATION, name), atol=1e-6)


def test_a_printed_matrix_goes_on_over_lines() -> None:
    text = "".join(f"{key}:\n{np.array2string(matrix, separator=', ')}\n" for key, matrix in KEYS.items())
    text = text.replace(":\n[[", ": [[")
    np.testing.assert_allclose(parse_calibration(text).P2, CALIBRATION.P2)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("P2: 1 2 three", r"calib\.txt:2 \(P2\): expected numbers, got 'three'"),
        ("P2: 1,0 0 0 0 0 1,0 0 0 0 0 1,0 0,0", r"expected 12 or 16 numbers, got '1,0 .* can be read in two ways"),
        ("P2: " + "1 " * 12 + "0 0 1 1", r"4 x 4 matrix that ends in 0 0 0 1"),
        ("P2: " + "0 " * 12, r"calib\.txt: expected positive focal lengths under P2"),
    ],
)
def test_a_calibration_that_can_not_be_used_is_named_with_file_and_line(line: str, words: str) -> None:
    lines = format_calibration(CALIBRATION).splitlines()
    text = "\n".join([lines[0], line, *(other for other in lines[1:] if not other.startswith("P2"))])
    with pytest.raises(DataError, match=words):
        parse_calibration(text, "calib.txt")


@pytest.mark.parametrize(("matrix", "key"), [(np.zeros(12), "Tr_velo_to_cam"), (np.zeros(9), "R0_rect")])
def test_a_matrix_of_zeros_is_named_with_its_file(matrix: np.ndarray, key: str) -> None:
    lines = [line for line in format_calibration(CALIBRATION).splitlines() if not line.startswith(key)]
    text = "\n".join([*lines, f"{key}: " + " ".join(map(str, matrix))])
    with pytest.raises(DataError, match=rf"calib/7\.txt: expected a rotation under {key}, got numbers that cannot"):
        parse_calibration(text, "calib/7.txt")


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sampled_from([name for name in ENCODINGS if name != "utf-8"]),
    st.sampled_from(["\n", "\r\n", "\r"]),
    st.sampled_from([" ", "  ", "\t", ",", ", ", ";"]),
    st.sampled_from(["{:06d}.txt", "{}.txt", "{:03d}.TXT"]),
    st.integers(0, 4),
)
def test_labels_in_any_form_score_the_same(
    tmp_path_factory: pytest.TempPathFactory, encoding: str, newline: str, separator: str, name: str, more: int
) -> None:
    root = tmp_path_factory.mktemp("forms")
    for part, score in (("l", ""), ("d", " 0.9")):
        (root / part).mkdir()
        for index, frame in enumerate(FRAMES):
            text = format_line(frame.labels[0]) + score + " 0" * more
            text = newline.join([separator.join(text.split()), ""])
            (root / part / (name.format(index) if part == "l" else f"{frame.id}.txt")).write_bytes(
                ENCODINGS[encoding] + text.encode(encoding)
            )
    (root / "l" / "._000000.txt").write_bytes(b"\0\5\26\7")
    pair = read_pair(root / "l", root / "d")
    expected = [[*frame.labels[0].bbox, *frame.labels[0].size, *frame.labels[0].location] for frame in FRAMES]
    for table in (pair.labels, pair.detections):
        assert table.types == ("Car",)
        np.testing.assert_allclose(table.values[:, 3:13], expected, atol=0.006)
    assert len(pair.frames) == 3


def test_decimal_commas_in_labels_and_bytes_that_are_no_text(tmp_path: Path) -> None:
    for part, score in (("l", ""), ("d", " 0,9")):
        (tmp_path / part).mkdir()
        (tmp_path / part / "000000.txt").write_text(format_line(FRAMES[0].labels[0]).replace(".", ",") + score)
    pair = read_pair(tmp_path / "l", tmp_path / "d")
    np.testing.assert_allclose(pair.labels.values[0, 10:13], FRAMES[0].labels[0].location)
    (tmp_path / "l" / "000000.txt").write_bytes(b"Car \xe4")
    with pytest.raises(InputError, match=r"000000\.txt: bytes that are not UTF-8 text \(byte 0xe4 at offset 4\)"):
        read_pair(tmp_path / "l", tmp_path / "d")


# ---- names --------------------------------------------------------------------------------------------------------


def renamed(root: Path, old: str, new: str) -> None:
    (root / "training" / old).rename(root / "training" / new)


def litter(root: Path) -> None:
    """What Windows, macOS, network disks and editors leave in folders."""
    for folder in (root / "training").iterdir():
        (folder / "Thumbs.db").write_bytes(b"x")
        (folder / f"._000000{next(folder.glob('0*')).suffix}").write_bytes(b"x")
        (folder / "@eaDir").mkdir()
        (folder / "notes.md").write_text("x")


def rewrite_text(root: Path, encoding: str, newline: str, separator: str) -> None:
    """Labels and calibrations in another encoding, with other line ends and marks between the numbers."""
    for path in (root / "training" / "label_2").iterdir():
        lines = [separator.join(line.split()) for line in path.read_text().splitlines()]
        path.write_bytes(ENCODINGS[encoding] + newline.join(lines).encode(encoding))
    for path in (root / "training" / "calib").iterdir():
        parts = [line.split(maxsplit=1) for line in path.read_text().splitlines() if line]
        lines = [f"{key} [{separator.join(numbers.split())}]" for key, numbers in parts]
        path.write_bytes(ENCODINGS[encoding] + newline.join(lines).encode(encoding))


def assert_same_frames(root: Path, name: str = "kitti_object", columns: int | None = None) -> None:
    dataset = open_dataset(name, root, columns)
    assert dataset.ids == tuple(frame.id for frame in FRAMES)
    for frame, expected in zip(dataset, FRAMES):
        assert frame.labels == expected.labels
        kept = [1, 1, 1, 0] if columns == 3 else [1, 1, 1, 1]
        np.testing.assert_array_equal(frame.points, expected.points * np.float32(kept))
        np.testing.assert_array_equal(frame.image, expected.image)
        assert frame.image_size == expected.image.shape[:2]
        np.testing.assert_allclose(frame.calibration.P2, CALIBRATION.P2)


@settings(max_examples=25, deadline=None)
@given(
    st.sampled_from(["{:06d}", "{:03d}", "{}"]),
    st.sampled_from([str.lower, str.upper, str.title]),
    st.sampled_from(["image_2", "image_02", "image_0"]),
    st.sampled_from(["label_2", "label_02", "label_0"]),
    st.booleans(),
    st.sampled_from([3, 4, 5, 6, 8]),
    st.tuples(
        st.sampled_from([*ENCODINGS]),
        st.sampled_from(["\n", "\r\n", "\r"]),
        st.sampled_from([" ", ",", ", ", ";", "\t"]),
    ),
)
def test_frames_written_in_any_form_are_the_same_frames(
    tmp_path_factory: pytest.TempPathFactory,
    pattern: str,
    case,
    image: str,
    label: str,
    dirty: bool,
    columns: int,
    text: tuple[str, str, str],
) -> None:
    root = write_tiny_kitti(tmp_path_factory.mktemp("names"), 3)
    for frame in FRAMES:
        cloud = with_columns(frame.points, columns)
        (root / "training" / "velodyne" / f"{frame.id}.bin").write_bytes(cloud.tobytes())
    for part in ("velodyne", "label_2", "calib"):
        for index, path in enumerate(sorted((root / "training" / part).iterdir())):
            path.rename(path.with_name(pattern.format(index) + case(path.suffix)))
    if image == "image_0":
        for path in (root / "training" / "calib").iterdir():
            lines = path.read_text().replace("P0:", "P9:").replace("P2:", "P0:")
            path.write_text(lines.replace("Tr_velo_to_cam:", "Tr_velo_to_cam_0:"))
    rewrite_text(root, *text)
    renamed(root, "image_2", image)
    renamed(root, "label_2", label)
    if dirty:
        litter(root)
    assert bool(open_dataset("kitti_object", root).refusal) == (columns != 4)
    assert_same_frames(root, columns=columns)
    assert faults(check(root, workers=1, columns=columns)) == set()


def test_files_of_no_frame_are_listed_by_the_doctor_and_make_no_frame(tmp_path: Path) -> None:
    root = write_tiny_kitti(tmp_path, 3)
    training = root / "training"
    (training / "label_2" / "000009.txt").write_text("")
    (training / "image_2" / "000001 (copy).png").write_bytes((training / "image_2" / "000001.png").read_bytes())
    (training / "velodyne" / "1.bin").write_bytes((training / "velodyne" / "000001.bin").read_bytes())
    assert_same_frames(root)
    dataset = open_dataset("kitti_object", root)
    assert {path.name for path in dataset.strays} == {"000009.txt", "000001 (copy).png", "1.bin"}
    report = check(root, workers=1)
    assert {Path(f.where).name for f in report.findings if f.fault == "extra_file"} == {p.name for p in dataset.strays}
    assert report.frames == 3


def test_a_split_in_another_form_selects_the_same_frames(tmp_path: Path) -> None:
    root = write_tiny_kitti(tmp_path, 3)
    (tmp_path / "val.txt").write_bytes("﻿1\r\n002\r\n".encode("utf-16"))
    assert open_dataset("kitti_object", root).select(tmp_path / "val.txt").ids == ("000001", "000002")
    (tmp_path / "val.txt").write_text("000007\n")
    with pytest.raises(UsageError, match="000007"):
        open_dataset("kitti_object", root).select(tmp_path / "val.txt")


def test_capital_suffixes_in_a_folder_of_ones_own(tmp_path: Path) -> None:
    root = write_tiny_kitti(tmp_path, 3)
    for old, new in (("image_2", "images"), ("velodyne", "points"), ("label_2", "labels")):
        (root / "training" / old).rename(root / new)
        for path in sorted((root / new).iterdir())[1:]:
            path.rename(path.with_suffix(path.suffix.upper()))
    (root / "calib.txt").write_text(format_calibration(CALIBRATION))
    assert_same_frames(root, "folder")
    assert check(root, "folder", workers=1).frames == 3


# ---- images -------------------------------------------------------------------------------------------------------


def jpeg(orientation: int, tail: bytes = b"") -> bytes:
    exif = Image.Exif()
    exif[0x0112] = orientation
    buffer = io.BytesIO()
    Image.fromarray(FRAMES[0].image).save(buffer, "JPEG", quality=95, exif=exif)
    return buffer.getvalue() + tail


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_stay_where_the_calibration_has_them(tmp_path: Path, orientation: int) -> None:
    (tmp_path / "a.jpg").write_bytes(jpeg(orientation))
    (tmp_path / "b.jpg").write_bytes(jpeg(1))
    np.testing.assert_array_equal(read_image(tmp_path / "a.jpg"), read_image(tmp_path / "b.jpg"))
    assert image_size(tmp_path / "a.jpg") == FRAMES[0].image.shape[:2]


def test_bytes_behind_the_end_of_a_jpeg_are_no_damage_and_a_cut_one_is() -> None:
    check_complete(jpeg(1, tail=b"\x00\x00MotionPhoto" + bytes(range(200))), Path("a.jpg"))
    whole = jpeg(1)
    for cut in (len(whole) - 1, len(whole) - 2, len(whole) // 2, 40):
        with pytest.raises(DataError):
            check_complete(whole[:cut], Path("a.jpg"))


@pytest.mark.parametrize("largest", [1023, 4095, 16383])
def test_sensor_bits_in_a_16_bit_file_are_named(tmp_path: Path, largest: int) -> None:
    pixels = np.full((20, 30), largest, np.uint16)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    with pytest.raises(DataError, match=rf"{largest.bit_length()}-bit data in a 16-bit file \(largest {largest}\)"):
        read_image(tmp_path / "a.png")
    Image.fromarray(pixels * np.uint16(65535 // largest)).save(tmp_path / "a.png")
    assert read_image(tmp_path / "a.png").min() >= 252
