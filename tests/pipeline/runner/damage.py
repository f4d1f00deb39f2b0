"""Kinds of damage done to the frames of a tiny KITTI folder, each with the words its report must contain.

A kind is a function that damages one frame of `training`, and a piece of the message that names the cause.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pipeline.data.depth_png import png_bytes

Damage = Callable[[Path, str], None]


def _velodyne(change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    """Points of a frame changed; whatever dtype comes back is written as it is."""

    def damage(training: Path, name: str) -> None:
        path = training / "velodyne" / f"{name}.bin"
        path.write_bytes(change(np.fromfile(path, "<f4").reshape(-1, 4)).tobytes())

    return damage


def _with(points: np.ndarray, value: float) -> np.ndarray:
    points[7, 1] = value
    return points


def _bytes(part: str, suffix: str, change: Callable[[bytes], bytes]) -> Damage:
    def damage(training: Path, name: str) -> None:
        path = training / part / f"{name}{suffix}"
        path.write_bytes(change(path.read_bytes()))

    return damage


def _removed(part: str, suffix: str) -> Damage:
    return lambda training, name: (training / part / f"{name}{suffix}").unlink()


def _folder(part: str, suffix: str) -> Damage:
    def damage(training: Path, name: str) -> None:
        path = training / part / f"{name}{suffix}"
        path.unlink()
        path.mkdir()

    return damage


def _link(part: str, suffix: str, target: Callable[[Path], Path]) -> Damage:
    def damage(training: Path, name: str) -> None:
        path = training / part / f"{name}{suffix}"
        goal = target(path)
        if goal != path:
            goal.write_bytes(path.read_bytes())
        path.unlink()
        path.symlink_to(goal)

    return damage


def _out_of_root(path: Path) -> Path:
    return path.parents[3] / f"secret-{path.name}"


def _line(key: str, text: str | None) -> Damage:
    """One calibration line replaced, or left out."""

    def damage(training: Path, name: str) -> None:
        path = training / "calib" / f"{name}.txt"
        lines = path.read_text().splitlines()
        changed = [text if line.startswith(f"{key}:") else line for line in lines]
        path.write_text("\n".join(line for line in changed if line is not None) + "\n")

    return damage


def _swapped(training: Path, name: str) -> None:
    image, cloud = training / "image_2" / f"{name}.png", training / "velodyne" / f"{name}.bin"
    pixels, points = image.read_bytes(), cloud.read_bytes()
    image.write_bytes(points)
    cloud.write_bytes(pixels[: len(pixels) // 16 * 16])


def png_header(width: int, height: int) -> bytes:
    """A small, well-formed 16-bit PNG whose header claims `width` x `height` pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 64)) + chunk(b"IEND", b"")
    )


def _flipped(data: bytes) -> bytes:
    return data[:200] + bytes([data[200] ^ 0xFF]) + data[201:]


def _pipe(training: Path, name: str) -> None:
    path = training / "velodyne" / f"{name}.bin"
    path.unlink()
    os.mkfifo(path)


def _sparse(training: Path, name: str) -> None:
    """A file of 100 GB that takes no room: only its size is absurd."""
    with open(training / "velodyne" / f"{name}.bin", "r+b") as file:
        file.truncate(100 * 10**9)


_ZEROS = " ".join(["0"] * 12)

DAMAGE: dict[str, tuple[Damage, str]] = {
    "cloud: empty": (_bytes("velodyne", ".bin", lambda data: b""), "an empty file"),
    "cloud: truncated": (_bytes("velodyne", ".bin", lambda data: data[:-5]), "a multiple of 16 bytes"),
    "cloud: NaN": (_velodyne(lambda points: _with(points, np.nan)), "1 of 1440 points with NaN or infinite values"),
    "cloud: infinite": (_velodyne(lambda points: _with(points, np.inf)), "1 of 1440 points with NaN or infinite"),
    "cloud: huge coordinates": (_velodyne(lambda points: _with(points, 3e7)), "coordinates within 10000 m, got 3e+07"),
    "cloud: nothing in the image": (
        _velodyne(lambda points: points * np.float32([-1, 1, 1, 1])),
        "no pixel has a value",
    ),
    "cloud: float64": (_velodyne(lambda points: points.astype("<f8")), "velodyne/"),
    "cloud: missing": (_removed("velodyne", ".bin"), "no such file"),
    "cloud: a folder": (_folder("velodyne", ".bin"), "a folder"),
    "cloud: a link to itself": (_link("velodyne", ".bin", lambda path: path), "symbolic link"),
    "cloud: link out of the data": (_link("velodyne", ".bin", _out_of_root), "a link out of it"),
    "cloud: a pipe": (_pipe, "a device or pipe"),
    "cloud: absurd size": (_sparse, "got 100,000.0 MB"),
    "cloud and image: swapped": (_swapped, "points with NaN or infinite values"),
    "image: empty": (_bytes("image_2", ".png", lambda data: b""), "an empty file"),
    "image: truncated": (_bytes("image_2", ".png", lambda data: data[:3000]), "a file that ends after 3000 bytes"),
    "image: bit flip": (_bytes("image_2", ".png", _flipped), "checksums agree"),
    "image: absurd header": (_bytes("image_2", ".png", lambda _: png_header(10**6, 10**6)), "1000000 x 1000000"),
    "image: web page": (_bytes("image_2", ".png", lambda data: b"<!DOCTYPE html>..."), "a file starting with b'<!DO'"),
    "image: missing": (_removed("image_2", ".png"), "no such file"),
    "calibration: missing": (_removed("calib", ".txt"), "no such file"),
    "calibration: empty": (_bytes("calib", ".txt", lambda data: b""), "no key at all"),
    "calibration: missing key": (_line("P2", None), "a line 'P2:'"),
    "calibration: NaN": (_line("Tr_velo_to_cam", "Tr_velo_to_cam: nan" + " 0" * 11), "NaN or infinity"),
    "calibration: too few numbers": (_line("P2", "P2: 1 2 3"), "12 or 16 numbers, got 3"),
    "calibration: no focal length": (_line("P2", f"P2: {_ZEROS}"), "positive focal lengths"),
    "calibration: singular": (_line("Tr_velo_to_cam", f"Tr_velo_to_cam: {_ZEROS}"), "a rotation"),
    "calibration: a folder": (_folder("calib", ".txt"), "a folder"),
    "calibration: not UTF-8": (_bytes("calib", ".txt", lambda data: b"\xe4\xf6" + data), "not UTF-8"),
    "label: not UTF-8": (_bytes("label_2", ".txt", lambda data: b"\xe4\xf6" + data), "not UTF-8"),
    "label: a word for a number": (_bytes("label_2", ".txt", lambda d: d.replace(b"36.00", b"left")), "'left'"),
    "label: columns missing": (_bytes("label_2", ".txt", lambda data: b"Car 0 0 1\n"), "expected 15 columns, got 4"),
    "label: infinite": (_bytes("label_2", ".txt", lambda d: d.replace(b"36.00", b"inf")), "expected a finite number"),
}


def write_depth_folder(folder: Path, depth: np.ndarray, names: list[str]) -> None:
    """The same depth map for each frame, as another method's results would lie there."""
    folder.mkdir()
    for name in names:
        (folder / f"{name}.png").write_bytes(png_bytes(depth))


DEPTH_DAMAGE: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "empty": (lambda data: b"", "an empty file"),
    "truncated": (lambda data: data[: len(data) // 2], "a file that ends after"),
    "8 bits": (lambda data: png_bytes(np.full((48, 96), 7, np.uint8)), "uint8"),
    "three channels": (lambda data: png_bytes(np.full((48, 96, 3), 7, np.uint8)), "uint8"),
    "no value at all": (lambda data: png_bytes(np.zeros((48, 96), np.uint16)), "no pixel has a value"),
    "larger than the image": (
        lambda data: png_bytes(np.full((50, 96), 900, np.uint16)),
        "at most 48 x 96, got 50 x 96",
    ),
    "absurd header": (lambda data: png_header(2**31 - 1, 2**31 - 1), "2147483647 x 2147483647"),
    "a NumPy file": (lambda data: b"\x93NUMPY\x01\x00", "a file starting with"),
    "too few pixels in the stream": (lambda data: png_header(96, 48), "cannot be decoded"),
}
