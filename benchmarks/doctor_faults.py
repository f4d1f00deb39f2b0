"""Planted faults against what the doctor calls them: the confusion table of docs/doctor.md.

    python -m benchmarks.doctor_faults --data KITTI/object --into docs/doctor.md

Six real frames are laid out as links; each fault is planted into frame 000003 (or into all), and the doctor examines
the six. Right is the fault's own name and no other one.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from auglidar_base.atomic import write_text
from pipeline.check.doctor import check
from pipeline.data import open_dataset
from pipeline.data.depth_png import decode_depth, encode_depth, png_bytes

FRAMES = ("000001", "000002", "000003", "000004", "000007", "000008")
VICTIM, NEXT = "000003", "000004"
SUFFIX = {"image_2": "png", "velodyne": "bin", "calib": "txt", "label_2": "txt", "depth_2": "png"}
BEGIN, END = "<!-- planted faults: begin -->", "<!-- planted faults: end -->"

Plant = Callable[["Desk"], None]
Points = NDArray[np.float32]


@dataclass(frozen=True)
class Desk:
    """A KITTI folder of six frames whose files are links until a fault replaces one."""

    root: Path

    def path(self, part: str, frame: str = VICTIM) -> Path:
        """The file of a frame."""
        return self.root / "training" / part / f"{frame}.{SUFFIX[part]}"

    def replace(self, part: str, data: bytes | str, frame: str = VICTIM) -> None:
        """Another content for a file."""
        path = self.path(part, frame)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.write_bytes(data.encode() if isinstance(data, str) else data)

    def cloud(self, frame: str = VICTIM) -> Points:
        """(N, 4) the cloud as stored."""
        return np.fromfile(self.path("velodyne", frame), "<f4").reshape(-1, 4)

    def image(self, frame: str = VICTIM) -> NDArray[np.uint8]:
        """(H, W, 3) RGB."""
        return np.ascontiguousarray(cv2.imread(str(self.path("image_2", frame)))[:, :, ::-1])


def desk(data: Path, folder: Path) -> Desk:
    """Six frames of `data` as links below `folder`."""
    made = Desk(folder)
    for part in ("image_2", "velodyne", "calib", "label_2"):
        (folder / "training" / part).mkdir(parents=True)
        for frame in FRAMES:
            name = f"{frame}.{SUFFIX[part]}"
            (folder / "training" / part / name).symlink_to((data / "training" / part / name).resolve())
    return made


# ---- ways to plant ------------------------------------------------------------------------------------------------


def cloud(change: Callable[[Points], NDArray[np.floating]], everywhere: bool = False) -> Plant:
    """Other points."""

    def plant(d: Desk) -> None:
        for frame in FRAMES if everywhere else (VICTIM,):
            d.replace("velodyne", np.ascontiguousarray(change(d.cloud(frame)), "<f4").tobytes(), frame)

    return plant


def labels(change: Callable[[list[str]], list[str]], everywhere: bool = False, all_lines: bool = False) -> Plant:
    """Other fields of the labels (of DontCare too with all_lines)."""

    def plant(d: Desk) -> None:
        for frame in FRAMES if everywhere else (VICTIM,):
            lines = [line.split() for line in d.path("label_2", frame).read_text().splitlines()]
            changed = [change(line) if all_lines or line[0] != "DontCare" else line for line in lines]
            d.replace("label_2", "".join(" ".join(line) + "\n" for line in changed), frame)

    return plant


def numbers(**changes: Callable[[float], float]) -> Callable[[list[str]], list[str]]:
    """Changes of columns by their names."""
    names = ["type", "truncated", "occluded", "alpha", "x1", "y1", "x2", "y2", "h", "w", "l", "x", "y", "z", "ry"]

    def change(line: list[str]) -> list[str]:
        line = list(line)
        for name, function in changes.items():
            line[names.index(name)] = f"{function(float(line[names.index(name)])):.2f}"
        return line

    return change


def columns(order: str) -> Callable[[list[str]], list[str]]:
    """h w l in another order."""
    return lambda line: [*line[:8], *(line[8 + "hwl".index(name)] for name in order), *line[11:]]


def calib(key: str, change: Callable[[NDArray[np.float64]], NDArray[np.float64]], everywhere: bool = False) -> Plant:
    """Another matrix, given as 3 x 4 or 3 x 3."""

    def plant(d: Desk) -> None:
        for frame in FRAMES if everywhere else (VICTIM,):
            lines = d.path("calib", frame).read_text().splitlines()
            for index, line in enumerate(lines):
                if line.startswith(f"{key}:"):
                    matrix = change(np.array(line.split()[1:], float).reshape(3, -1))
                    lines[index] = f"{key}: " + " ".join(f"{value:.12e}" for value in matrix.ravel())
            d.replace("calib", "\n".join(lines) + "\n", frame)

    return plant


def image(change: Callable[[NDArray[np.uint8]], NDArray[np.integer]], everywhere: bool = False) -> Plant:
    """Other pixels."""

    def plant(d: Desk) -> None:
        for frame in FRAMES if everywhere else (VICTIM,):
            d.replace("image_2", png_bytes(np.ascontiguousarray(change(d.image(frame)))), frame)

    return plant


def raw(part: str, change: Callable[[bytes], bytes]) -> Plant:
    """Other bytes."""
    return lambda d: d.replace(part, change(d.path(part).read_bytes()))


def depth(change: Callable[[NDArray[np.uint16], NDArray[np.uint16]], NDArray[np.integer]]) -> Plant:
    """Dense maps of every frame, the victim's changed: change(map, the next frame's map)."""

    def plant(d: Desk) -> None:
        codes = {frame: encode_depth(dense(d, frame)) for frame in FRAMES}
        codes[VICTIM] = change(codes[VICTIM], codes[NEXT])  # type: ignore[assignment]
        for frame, code in codes.items():
            d.replace("depth_2", png_bytes(np.ascontiguousarray(code)), frame)

    return plant


def dense(d: Desk, frame: str) -> NDArray[np.float32]:
    """A depth map as a good network would give: the LiDAR, grown by its neighbours."""
    sparse = open_dataset("kitti_object", d.root)[frame].sparse_depth
    grown = cv2.dilate(np.divide(1, sparse, out=np.zeros_like(sparse), where=sparse > 0), np.ones((9, 9)))
    return np.where(sparse > 0, sparse, np.divide(1, grown, out=np.zeros_like(grown), where=grown > 0))


def moved(pixels: NDArray[np.integer], rows: int, columns: int) -> NDArray[np.integer]:
    """Moved down and right, zeros where nothing is."""
    result = np.zeros_like(pixels)
    result[rows:, columns:] = pixels[: len(pixels) - rows, : pixels.shape[1] - columns]
    return result


# ---- single plants ------------------------------------------------------------------------------------------------


def interleaved_zeros(points: Points) -> Points:
    """Every second return did not come back."""
    mixed = np.zeros((2 * len(points), 4), np.float32)
    mixed[::2] = points
    return mixed


def with_ring(points: Points) -> NDArray[np.float32]:
    """A fifth column with the number of the ring."""
    return np.column_stack([points, np.repeat(np.arange(64), len(points) // 64 + 1)[: len(points)]])


def lidar_frame(d: Desk) -> None:
    """Locations in the LiDAR frame."""
    calibration = open_dataset("kitti_object", d.root)[VICTIM].calibration
    lines = [line.split() for line in d.path("label_2").read_text().splitlines()]
    for line in lines:
        if line[0] != "DontCare":
            place = calibration.cam_to_velo(np.array([line[11:14]], float))[0]
            line[11:14] = [f"{value:.2f}" for value in place]
    d.replace("label_2", "".join(" ".join(line) + "\n" for line in lines))


def mirrored_yaw(d: Desk) -> None:
    """Turned cars whose ry has the other sign (KITTI's cars drive along the road, where both signs are alike)."""
    labels(numbers(ry=lambda v: v + 0.5, alpha=lambda v: v + 0.5))(d)
    labels(numbers(ry=lambda v: -v))(d)


def odometry(d: Desk) -> None:
    """The keys of the odometry benchmark."""
    kept = [line for line in d.path("calib").read_text().splitlines() if not line.startswith(("R0_rect", "Tr_imu"))]
    d.replace("calib", "\n".join(kept).replace("Tr_velo_to_cam:", "Tr:") + "\n")


def inverse(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The other direction of a 3 x 4 transform."""
    return np.asarray(np.linalg.inv(np.vstack([matrix, [0, 0, 0, 1]]))[:3])


def rotated(part: str) -> Plant:
    """Every frame's file under the name of the frame before it."""

    def plant(d: Desk) -> None:
        data = [d.path(part, frame).read_bytes() for frame in FRAMES]
        for frame, content in zip(FRAMES, [*data[1:], data[0]]):
            d.replace(part, content, frame)

    return plant


def exchanged(d: Desk) -> None:
    """Images of two frames exchanged."""
    one, two = (d.path("image_2", frame).read_bytes() for frame in FRAMES[-2:])
    d.replace("image_2", two, FRAMES[-2])
    d.replace("image_2", one, FRAMES[-1])


def twice(d: Desk) -> None:
    """A whole frame under a second name."""
    for part in ("image_2", "velodyne", "label_2"):
        d.replace(part, d.path(part).read_bytes(), NEXT)


def overlapping_splits(d: Desk) -> None:
    """A frame in train and val."""
    (d.root / "ImageSets").mkdir()
    (d.root / "ImageSets" / "train.txt").write_text("000001\n000002\n")
    (d.root / "ImageSets" / "val.txt").write_text("000002\n000003\n")


def text_cloud(d: Desk) -> None:
    """Numbers as text under the name of a cloud."""
    d.replace("velodyne", "\n".join(" ".join(f"{v:.3f}" for v in row) for row in d.cloud()[:3000]))


def as_range(code: NDArray[np.uint16], _: object) -> NDArray[np.uint16]:
    """Distance to the camera instead of z."""
    v, u = np.indices(code.shape)
    return encode_depth(decode_depth(code) * np.sqrt(1 + ((u - 609.56) / 721.54) ** 2 + ((v - 172.85) / 721.54) ** 2))


def noise(code: NDArray[np.uint16], _: object) -> NDArray[np.uint16]:
    """What a network without its weights gives."""
    smooth = cv2.GaussianBlur(np.random.default_rng(3).normal(size=code.shape), (0, 0), 8)
    return encode_depth((30 + 20 * smooth / np.abs(smooth).max()).astype(np.float32))


def sky(code: NDArray[np.uint16], _: object) -> NDArray[np.uint16]:
    """The far plane of a renderer."""
    return np.where(np.arange(len(code))[:, None] < 50, 65535, code).astype(np.uint16)


def millimetres(code: NDArray[np.uint16], _: object) -> NDArray[np.uint16]:
    """NYU's unit."""
    return (decode_depth(code) * 1000).clip(0, 65534).astype(np.uint16)


def lower_case(line: list[str]) -> list[str]:
    """dontcare."""
    return [line[0].replace("DontCare", "dontcare"), *line[1:]]


def stray(part: str, name: str) -> Plant:
    """A copy of a file under a name of no frame."""
    return lambda d: d.path(part).with_name(name).write_bytes(d.path(part).read_bytes()[::-1]) and None


def removed(part: str) -> Plant:
    """No file."""
    return lambda d: d.path(part).unlink()


YAW = np.diag([-1.0, 1, -1])
ROLL = np.diag([-1.0, -1, 1])
# The principal point of an image whose first 23 rows are cut away.
CROPPED_ROWS = np.array([[0.0, 0, 0, 0], [0, 0, 23, 0], [0, 0, 0, 0]])

# (what is planted, the fault's name, how)
PLANTED: tuple[tuple[str, str, Plant], ...] = (
    ("image missing", "missing_file", removed("image_2")),
    ("cloud missing", "missing_file", removed("velodyne")),
    ("calibration missing", "missing_file", removed("calib")),
    ("labels missing", "missing_file", removed("label_2")),
    ("labels of no frame", "extra_file", stray("label_2", "000099.txt")),
    ("image of no frame", "extra_file", stray("image_2", "000003 (copy).png")),
    ("cloud of no frame", "extra_file", stray("velodyne", "000099.bin")),
    ("image of 0 bytes", "empty_file", raw("image_2", lambda data: b"")),
    ("cloud of 0 bytes", "empty_file", raw("velodyne", lambda data: b"")),
    ("calibration of 0 bytes", "empty_file", raw("calib", lambda data: b"")),
    ("image cut", "truncated_file", raw("image_2", lambda data: data[:50_000])),
    ("image with a flipped byte", "truncated_file", raw("image_2", lambda data: data[:9000] + b"\x55" + data[9001:])),
    ("web page named .png", "unreadable_file", raw("image_2", lambda data: b"<!DOCTYPE html><html></html>")),
    ("12-bit pixels in a 16-bit image", "unreadable_file", image(lambda i: i[..., 0].astype(np.uint16) * 16)),
    ("text named .bin", "unreadable_file", text_cloud),
    ("calibration without P2", "unreadable_file", raw("calib", lambda data: data.replace(b"P2:", b"Q2:"))),
    ("P2 of zeros", "unreadable_file", calib("P2", lambda m: m * 0)),
    ("Tr_velo_to_cam of zeros", "unreadable_file", calib("Tr_velo_to_cam", lambda m: m * 0)),
    ("a word in R0_rect", "unreadable_file", raw("calib", lambda data: data.replace(b"R0_rect: ", b"R0_rect: x"))),
    ("cloud cut inside a row", "truncated_cloud", raw("velodyne", lambda data: data[:100_001])),
    ("half of a cloud", "truncated_cloud", cloud(lambda p: p[: len(p) // 2])),
    ("cloud of one point", "truncated_cloud", cloud(lambda p: p[:1])),
    ("second half of a cloud 0", "truncated_cloud", cloud(lambda p: p * (np.arange(len(p)) < len(p) / 2)[:, None])),
    ("zero returns between the others", "zero_returns", cloud(interleaved_zeros)),
    ("cloud of 3 columns", "wrong_columns", cloud(lambda p: p[:, :3])),
    ("cloud of 5 columns", "wrong_columns", cloud(with_ring)),
    ("clouds of 5 columns everywhere", "wrong_columns", cloud(with_ring, everywhere=True)),
    ("clouds of 5 columns, intensity 0..255", "wrong_columns", cloud(lambda p: with_ring(p * [1, 1, 1, 255]), True)),
    ("clouds of 6 columns", "wrong_columns", cloud(lambda p: np.column_stack([with_ring(p), 0 * p[:, 0] - 1]), True)),
    ("NaN in a point", "non_finite_points", cloud(lambda p: np.where(np.arange(len(p))[:, None] == 77, np.nan, p))),
    ("a point at 1e9 m", "non_finite_points", cloud(lambda p: np.where(np.arange(len(p))[:, None] == 77, 1e9, p))),
    ("cloud in millimetres", "cloud_in_millimetres", cloud(lambda p: p * [1000, 1000, 1000, 1])),
    ("y and z exchanged", "axis_order", cloud(lambda p: p[:, [0, 2, 1, 3]])),
    ("x and y exchanged", "axis_order", cloud(lambda p: p[:, [1, 0, 2, 3]])),
    ("y to the right", "axis_order", cloud(lambda p: p * [1, -1, 1, 1])),
    ("cloud with its origin on the ground", "shifted_cloud", cloud(lambda p: p - [0, 0, -1.73, 0])),
    ("cloud lowered twice", "shifted_cloud", cloud(lambda p: p - [0, 0, 1.73, 0])),
    ("float16 coordinates", "float16_loss", cloud(lambda p: p.astype(np.float16))),
    ("intensity 0..255", "intensity_scale", cloud(lambda p: p * [1, 1, 1, 255])),
    ("red and blue exchanged", "rgb_bgr_swap", image(lambda i: i[..., ::-1])),
    ("image of half the size", "resized_image", image(lambda i: cv2.resize(i, None, fx=0.5, fy=0.5))),
    ("image of twice the size", "resized_image", image(lambda i: cv2.resize(i, None, fx=2, fy=2))),
    ("image cropped, P2 of the whole", "wrong_crop", image(lambda i: i[23:, 13:1229])),
    ("images moved by a crop", "wrong_crop", image(lambda i: moved(i, 23, 13), everywhere=True)),
    ("P2 of the crop, whole image", "wrong_crop", calib("P2", lambda m: m - CROPPED_ROWS)),
    ("image of another frame", "index_offset", lambda d: d.replace("image_2", d.path("image_2", NEXT).read_bytes())),
    ("images of two frames exchanged", "index_offset", exchanged),
    ("images one frame late", "index_offset", rotated("image_2")),
    ("a frame twice", "duplicated_frame", twice),
    ("a frame in train and val", "split_overlap", overlapping_splits),
    ("odometry keys", "wrong_calibration_family", odometry),
    ("R0_rect that is no rotation", "calibration_not_rigid", calib("R0_rect", lambda m: m * [0.9, 1, 1])),
    ("Tr_velo_to_cam mirrored", "calibration_not_rigid", calib("Tr_velo_to_cam", lambda m: np.diag([-1.0, 1, 1]) @ m)),
    ("focal length of another day", "other_rigs_calibration", calib("P2", lambda m: np.array(
        [[707.0493, 0, 604.0814, 45.75831], [0, 707.0493, 180.5066, -0.3454157], [0, 0, 1, 0.004981016]]))),
    ("Tr_velo_to_cam inverted", "wrong_extrinsics", calib("Tr_velo_to_cam", inverse)),
    ("camera turned by 180 degrees", "wrong_extrinsics", calib("Tr_velo_to_cam", lambda m: YAW @ m)),
    ("camera upside down", "wrong_extrinsics", calib("Tr_velo_to_cam", lambda m: ROLL @ m)),
    ("scores among labels", "label_result_mixup", labels(lambda line: [*line, "0.87"])),
    ("labels of 12 columns", "malformed_labels", labels(lambda line: line[:12])),
    ("labels with words", "malformed_labels", labels(lambda line: [*line[:4], "left", *line[5:]])),
    ("angles in degrees", "degrees_not_radians", labels(numbers(ry=np.degrees, alpha=np.degrees))),
    ("yaw alone in degrees", "degrees_not_radians", labels(numbers(ry=lambda v: np.degrees(v) + 200))),
    ("ry with the other sign", "yaw_sign", mirrored_yaw),
    ("labels in millimetres", "label_unit", labels(numbers(**{k: lambda v: 1000 * v for k in "hwlxyz"}))),
    ("h l w", "swapped_dimensions", labels(columns("hlw"), everywhere=True)),
    ("l w h", "swapped_dimensions", labels(columns("lwh"), everywhere=True)),
    ("locations in the LiDAR frame", "labels_in_lidar_frame", lidar_frame),
    ("class 'automobile'", "unknown_class", labels(lambda line: ["automobile", *line[1:]])),
    ("class 'dontcare'", "unknown_class", labels(lower_case, True, True)),
    ("rectangles beyond the image", "label_outside_image", labels(numbers(x2=lambda v: v + 1000))),
    ("labels 9 m too far", "labels_disagree_with_cloud", labels(numbers(z=lambda v: v + 9))),
    ("labels of the next frame", "index_offset", rotated("label_2")),
    ("8-bit depth", "eight_bit_depth", depth(lambda code, _: (code >> 8).astype(np.uint8))),
    ("sky as 65535", "far_plane_as_depth", depth(sky)),
    ("depth in millimetres", "depth_unit", depth(millimetres)),
    ("distance instead of depth", "depth_is_range", depth(as_range)),
    ("depth of the next frame", "index_offset", depth(lambda _, other: other)),
    ("depth moved by a crop", "wrong_crop", depth(lambda code, _: moved(code, 23, 13))),
    ("depth cropped at the top left", "wrong_crop", depth(lambda code, _: code[:352, :1216])),
    ("depth without weights", "depth_disagrees_with_lidar", depth(noise)),
)  # fmt: skip


def examine(data: Path, plant: Plant | None) -> tuple[str, ...]:
    """The names that the doctor gives to a planted fault (None: nothing is planted)."""
    with tempfile.TemporaryDirectory() as folder:
        made = desk(data, Path(folder))
        if plant is not None:
            plant(made)
        return tuple(sorted({finding.fault for finding in check(made.root, workers=1).findings}))


def table(rows: list[tuple[str, str, tuple[str, ...]]]) -> str:
    """The table as Markdown, with how many were named."""
    right = sum(found == (name,) for _, name, found in rows)
    lines = [f"{right} of {len(rows)} planted faults get their own name and no other.", ""]
    lines += ["| planted | named | |", "|---|---|---|"]
    for what, name, found in rows:
        named = ", ".join(f"`{fault}`" for fault in found) or "nothing"
        lines.append(f"| {what} | {named} | {'' if found == (name,) else f'should be `{name}`'} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Plants every fault; 1 when one gets another's name."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="KITTI object folder with frames 000001-000008")
    parser.add_argument("--into", type=Path, help="page whose table is written again")
    parser.add_argument("--only", default="", help="plants whose description holds this text")
    options = parser.parse_args(arguments)
    rows = []
    for what, name, plant in PLANTED:
        if options.only in what:
            rows.append((what, name, examine(options.data, plant)))
            print(
                f"{what}: {', '.join(rows[-1][2]) or 'nothing'}" + ("" if rows[-1][2] == (name,) else f"   NOT {name}"),
                flush=True,
            )
    if options.into is not None:
        page = options.into.read_text(encoding="utf-8")
        head, _, rest = page.partition(BEGIN)
        write_text(options.into, f"{head}{BEGIN}\n{table(rows)}\n{END}{rest.partition(END)[2]}")
    return 0 if all(found == (name,) for _, name, found in rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
