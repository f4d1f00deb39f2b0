"""What an exporter reads: a frame of the data set and what a run made of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from completion.types import CompletedDepth
from detection.evaluation.reading import renamed_like
from detection.kitti_format import KittiObject
from pipeline.base.errors import DataError, MissingPart
from pipeline.base.paths import RunFolder
from pipeline.data.cloud_files import Cloud
from pipeline.data.dataset import read_split
from pipeline.data.frame import Frame
from pipeline.data.kitti_object import read_labels
from pipeline.geometry.in_view import lidar_pixels, value_at
from pipeline.run_folder.frame_outputs import FrameOutputs, read_npz, read_run_file

BASE_COLUMNS = ("x", "y", "z", "intensity", "source")
RAW_COLUMNS = BASE_COLUMNS[:4]


@dataclass(frozen=True, eq=False)
class ExportFrame:
    """A frame with a run's outputs.

    frame  the frame of the data set
    run    run folder, or None: then the cloud is the data set's own, and there is no completed depth
    name   file name without suffix in the consumer's layout ("000123")
    train  True for frames of the training split, of which ground truth databases are made
    """

    frame: Frame
    run: RunFolder | None
    name: str
    train: bool = True

    @property
    def without_run(self) -> ExportFrame:
        """The same frame with the data set's own cloud."""
        return ExportFrame(self.frame, None, self.name, self.train)

    def _run(self, part: str) -> RunFolder:
        if self.run is None:
            raise MissingPart(f"frame {self.frame.id}", part, "no run", "give the run folder with --run")
        return self.run

    @cached_property
    def completed(self) -> CompletedDepth:
        """Completed depth of the run."""
        completed = FrameOutputs(self._run("completed depth"), self.frame.id).read_completed()
        if completed.size != self.frame.image_size:
            where = self._run("completed depth").depth(self.frame.id)
            raise DataError(where, f"depth of the image's size {self.frame.image_size}", f"{completed.size}")
        return completed

    @cached_property
    def cloud(self) -> Cloud:
        """The run's augmented cloud (x y z intensity source ...), or the measured one without a run."""
        if self.run is None:
            return Cloud(self.frame.points, RAW_COLUMNS)
        return read_augmented(self.run, self.frame.id)

    @cached_property
    def columns(self) -> Cloud:
        """The cloud with the run's surfaces at each point's pixel behind it: sigma, foreground, background.

        Points outside the image, and runs with one surface only, have 0 (no value) there.
        """
        cloud = self.cloud
        names = tuple(name for name in ("sigma", "foreground", "background") if name not in cloud.columns)
        if self.run is None or not self.run.twin(self.frame.id).is_file() or not names:
            return cloud
        pixels = lidar_pixels(cloud.values, self.frame.calibration, self.completed.size)
        added = [value_at(pixels, getattr(self.completed, name)) for name in names]
        return Cloud(np.column_stack([cloud.values, *added]), cloud.columns + names)

    @property
    def points(self) -> NDArray[np.float32]:
        """(N, 4) x y z intensity of the cloud."""
        return np.ascontiguousarray(self.cloud.values[:, :4])

    @property
    def measured(self) -> NDArray[np.float32]:
        """(N, 4) the LiDAR points of the cloud (source 0)."""
        cloud = self.cloud
        return self.points if "source" not in cloud.columns else self.points[cloud.column("source") == 0]

    @property
    def virtual(self) -> NDArray[np.float32]:
        """(N, 4) the completed points of the cloud (source 1)."""
        return self.points[self.cloud.column("source") == 1] if "source" in self.cloud.columns else self.points[:0]

    @property
    def detections(self) -> list[KittiObject]:
        """Result lines of the run."""
        return read_labels(self._run("detections").detections(self.frame.id), scored=True)


def read_augmented(run: RunFolder, frame_id: str) -> Cloud:
    """cloud/ID.bin with the further columns that lie beside it. Raises DataError when it is missing or damaged."""
    path = run.cloud(frame_id)
    data = read_run_file(path)
    if len(data) % 20:
        raise DataError(path, "float32 rows of x y z intensity source (20 bytes each)", f"{len(data)} bytes")
    points = np.frombuffer(data, dtype="<f4").reshape(-1, 5).astype(np.float32)
    record = run.counts(frame_id)
    names = tuple(json.loads(read_run_file(record))["columns"][5:]) if record.is_file() else ()
    if names:
        extra = read_npz(run.cloud_columns(frame_id), names)
        points = np.column_stack([points, *(extra[name] for name in names)]).astype(np.float32)
    return Cloud(points, BASE_COLUMNS + names)


def in_run(root: Path, frame_id: str) -> bool:
    """True when a run folder holds something of a frame."""
    run = RunFolder(root)
    return any(path.is_file() for path in (run.depth(frame_id), run.cloud(frame_id), run.detections(frame_id)))


def consumer_names(frame_ids: Sequence[str]) -> dict[str, str]:
    """Frame id -> file name of the consumer's layouts, which know six-digit numbers only.

    KITTI ids stay as they are; others (Virtual KITTI 2, raw drives) are numbered in the order given, and the exporter
    writes the table beside the data.
    """
    if all(len(name) == 6 and name.isdigit() for name in frame_ids):
        return {name: name for name in frame_ids}
    return {name: f"{index:06d}" for index, name in enumerate(frame_ids)}


def read_splits(root: Path, frame_ids: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Split name -> the exported frames of ROOT/ImageSets/NAME.txt; all of them as train and trainval without one."""
    found: dict[str, tuple[str, ...]] = {}
    # KITTI numbers its training and testing frames from 0 alike: test.txt is about testing/ only.
    lists = {"training": ("train", "val", "trainval"), "testing": ("test",)}
    for folder in (root, root.parent):
        for name in lists.get(root.name, ("train", "val", "trainval", "test")):
            path = folder / "ImageSets" / f"{name}.txt"
            if path.is_file():
                listed = set(renamed_like(read_split(path), frame_ids).values())
                found[name] = tuple(frame_id for frame_id in frame_ids if frame_id in listed)
        if found:
            break
    found = {name: ids for name, ids in found.items() if ids}
    return found or {"train": tuple(frame_ids), "trainval": tuple(frame_ids)}
