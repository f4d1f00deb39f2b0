"""What the stages write for one frame and read back: the formats of a run folder."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from auglidar_base.array_files import ArrayFileError, npz_arrays
from auglidar_base.atomic import write_bytes
from completion.types import CompletedDepth
from detection.kitti_format import KittiObject, format_line
from pipeline.base.errors import DataError
from pipeline.base.files import read_file
from pipeline.base.paths import RunFolder
from pipeline.data.depth_png import decode_depth, depth_png_bytes, encode_depth, read_depth_png
from pipeline.data.kitti_object import read_labels

if TYPE_CHECKING:
    from pipeline.pointcloud.augment import AugmentedCloud


@dataclass(frozen=True)
class Written:
    """A file of the run as it was written."""

    size: int
    hash: str


@dataclass(frozen=True)
class FrameOutputs:
    """One frame's files in a run folder; every write is atomic and noted in `written` (path below the run -> hash)."""

    run: RunFolder
    id: str
    written: dict[str, Written] = field(default_factory=dict)

    def to_read(self, name: str) -> Path:
        """The file to read an output from, by its name in `RunFolder`."""
        return self.run.output(name, self.id)

    def to_write(self, name: str) -> Path:
        """The file to write an output to, or to remove."""
        return self.run.output(name, self.id)

    def _write(self, output: str, data: bytes) -> None:
        path = self.to_write(output)
        write_bytes(path, data)
        name = path.relative_to(self.run.root).as_posix()
        self.written[name] = Written(len(data), content_hash(data))

    def write_completed(self, completed: CompletedDepth) -> None:
        """depth/ID.png, and twin/ID.npz when there are two surfaces (an older one is removed when there are not)."""
        self._write("depth", depth_png_bytes(completed.depth))
        if completed.foreground is None or completed.background is None or completed.sigma is None:
            self.to_write("twin").unlink(missing_ok=True)
            return
        sigma = np.rint(completed.sigma * 255).astype(np.uint8)
        surfaces: dict[str, NDArray[Any]] = {
            "foreground": encode_depth(completed.foreground),
            "background": encode_depth(completed.background),
            "sigma": sigma,
        }
        self._write("twin", npz_bytes(surfaces))

    def read_completed(self) -> CompletedDepth:
        """Completed depth of an earlier stage, quantised as it lies on disk."""
        depth = read_depth_png(self.to_read("depth"))
        path = self.to_read("twin")
        if not path.is_file():
            return CompletedDepth(depth)
        surfaces = read_npz(path, ("foreground", "background", "sigma"))
        foreground, background, sigma = (surfaces[name] for name in ("foreground", "background", "sigma"))
        wrong = [name for name, value in surfaces.items() if value.shape != depth.shape]
        if wrong or foreground.dtype != np.uint16 or background.dtype != np.uint16 or sigma.dtype != np.uint8:
            kinds = ", ".join(f"{name} {value.dtype} {value.shape}" for name, value in surfaces.items())
            raise DataError(path, f"uint16 surfaces and uint8 sigma of shape {depth.shape}", kinds)
        sigma = sigma.astype(np.float32) / np.float32(255)
        return CompletedDepth(depth, decode_depth(foreground), decode_depth(background), sigma)

    def write_cloud(self, cloud: AugmentedCloud) -> None:
        """cloud/ID.bin (N x 5), cloud/ID.json (point counts), cloud/ID.columns.npz when there are further columns."""
        base = np.ascontiguousarray(cloud.points[:, :5], dtype="<f4")
        self._write("cloud", base.tobytes())
        counts = [{"step": step, "in": before, "out": after} for step, before, after in cloud.counts]
        record = {"columns": list(cloud.columns), "points": len(cloud.points), "steps": counts}
        self._write("counts", (json.dumps(record, indent=1) + "\n").encode())
        extra = {name: cloud.points[:, 5 + i] for i, name in enumerate(cloud.columns[5:])}
        if extra:
            self._write("cloud_columns", npz_bytes(extra))
        else:
            self.to_write("cloud_columns").unlink(missing_ok=True)

    def read_cloud(self) -> NDArray[np.float32]:
        """(N, 5 + C) float32: x y z intensity source and the further columns, LiDAR frame."""
        path = self.to_read("cloud")
        data = read_run_file(path)
        if len(data) % 20:
            raise DataError(path, "float32 rows of x y z intensity source (20 bytes each)", f"{len(data)} bytes")
        points = np.frombuffer(data, dtype="<f4").reshape(-1, 5).astype(np.float32)
        columns = self.read_counts()["columns"][5:]
        if not columns:
            return points
        extra = read_npz(self.to_read("cloud_columns"), tuple(columns))
        return np.column_stack([points, *(extra[name] for name in columns)]).astype(np.float32)

    def read_counts(self) -> dict[str, Any]:
        """{"columns": [...], "points": N, "steps": [{"step", "in", "out"}, ...]} of the augmentation."""
        path = self.to_read("counts")
        try:
            record: Any = json.loads(read_run_file(path))
        except (ValueError, RecursionError) as error:
            if isinstance(error, DataError):
                raise
            record = None
        columns = record.get("columns") if isinstance(record, dict) else None
        if not (isinstance(columns, list) and all(isinstance(name, str) for name in columns)):
            raise DataError(path, "JSON written by the augment stage", "something else", _REDO)
        return dict(record)

    def remove_other_presets_cloud(self) -> None:
        """Removes an augmented cloud that lies here from before the run went back to raw LiDAR (preset L).

        Report and exports would take it for what the detector saw; a cloud without completed points stays.
        """
        if self.to_read("cloud").is_file() and self.read_cloud()[:, 4].any():
            for name in ("cloud", "counts", "cloud_columns"):
                self.to_write(name).unlink(missing_ok=True)

    def write_detections(self, objects: list[KittiObject]) -> None:
        """detections/ID.txt, empty when nothing is found."""
        self._write("detections", "".join(format_line(item) + "\n" for item in objects).encode())

    def read_detections(self) -> list[KittiObject]:
        """The result lines of detections/ID.txt."""
        return read_labels(self.to_read("detections"), scored=True)


_REDO = "remove it and run the stage again"


def read_run_file(path: Path) -> bytes:
    """The bytes of a file that an earlier stage wrote."""
    return read_file(path, "a file of an earlier stage")


def content_hash(data: bytes) -> str:
    """Hash of contents as it stands in the ledger (BLAKE2b, 128 bits)."""
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def file_content_hash(path: Path) -> str:
    """`content_hash` of a file, read in pieces. Raises OSError when it cannot be read."""
    digest = hashlib.blake2b(digest_size=16)
    with open(path, "rb") as file:
        while piece := file.read(1 << 20):
            digest.update(piece)
    return digest.hexdigest()


def npz_bytes(arrays: dict[str, NDArray[Any]]) -> bytes:
    """A compressed .npz whose bytes depend on the arrays alone (no time stamps), readable by `numpy.load`."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            inner = io.BytesIO()
            np.lib.format.write_array(inner, np.ascontiguousarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), inner.getvalue(), zipfile.ZIP_DEFLATED, 1)
    return buffer.getvalue()


def read_npz(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """The named arrays of an .npz. Raises DataError when it is damaged or one is missing; pickles are refused."""
    try:
        return npz_arrays(read_run_file(path), names)
    except ArrayFileError as error:
        raise DataError(path, f"an .npz with {', '.join(names)}", str(error), _REDO) from None
