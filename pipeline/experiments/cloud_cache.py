"""Completed depth and input clouds on disk: made once per experiment folder, shared by every run that needs them."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from auglidar_base.atomic import write_bytes, write_text
from pipeline.base.errors import DataError, UsageError
from pipeline.base.paths import RunFolder, safe_id
from pipeline.data import Dataset, Frame
from pipeline.experiments.inputs import InputCloud, InputRecipe, lidar_points, make_input
from pipeline.run_folder.completers import open_completer
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.run_folder.own_methods import is_own, own_version

if TYPE_CHECKING:
    from completion.infer import Completer
    from completion.types import CompletedDepth
    from detection.kitti_format import KittiObject
    from detection.types import PointFrame
    from pipeline.semantics.sources import SemanticsSource


def short_hash(values: object) -> str:
    """Twelve hex digits of plain values."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]


@lru_cache(maxsize=2)
def _completer(network: str) -> Completer:
    return open_completer(network)


@dataclass(frozen=True)
class DepthCache:
    """Depth of frames, `root`/depth-NAME/ in the layout of a run.

    root     one folder per data set, because ids may repeat between them
    network  of depth "completed": a bundled name or a path of weights
    """

    root: Path
    network: str

    def name(self, depth: str, rows: int) -> str:
        """Folder of a kind of depth at a number of LiDAR rows."""
        network = self.network if depth == "completed" else depth
        if is_own("completion", network):
            return f"depth-own-{own_version('completion', network, {})}-{rows}"
        return f"depth-{Path(network).stem if depth == 'completed' else depth}-{rows}"

    def of(self, frame: Frame, depth: str, rows: int) -> CompletedDepth:
        """The depth of a frame, completed now if it is not there. UsageError when the data set has no dense truth."""
        from completion.types import CompletedDepth

        if depth == "truth":
            if not frame.has("target_depth"):
                raise UsageError(f"{frame.where} frame {frame.id}: no dense true depth (Virtual KITTI 2 has it)")
            return CompletedDepth(frame.target_depth)
        files = FrameOutputs(RunFolder(self.root / self.name(depth, rows)), frame.id)
        if not files.run.depth(frame.id).is_file():
            files.write_completed(self._made(frame, depth, rows))
        return files.read_completed()

    def _made(self, frame: Frame, depth: str, rows: int) -> CompletedDepth:
        from pipeline.geometry.project import project_points

        if depth == "semi_dense":
            from completion.types import CompletedDepth
            from pipeline.experiments.semi_dense_model import semi_dense_of

            return CompletedDepth(semi_dense_of(frame))
        completer = _completer(self.network if depth == "completed" else depth)
        sparse = project_points(lidar_points(frame, rows), frame.calibration, frame.image_size)
        return completer.complete(sparse, frame.image, frame.calibration.K)


@dataclass(frozen=True)
class CloudCache:
    """Input clouds of one recipe for one data set: samples for `detection.train`, frames for detection.

    limit  most points of a cloud
    """

    dataset: Dataset
    recipe: InputRecipe
    depth: DepthCache
    masks: SemanticsSource | None
    masks_name: str
    limit: int

    @property
    def folder(self) -> Path:
        """ROOT/clouds-HASH of everything that decides the points."""
        source = self.depth.name(self.recipe.depth_name, self.recipe.rows) if self.recipe.depth_name else ""
        record = [self.recipe.record(), self.limit, source, self.masks_name, self.dataset.name, str(self.dataset.root)]
        return self.depth.root / f"clouds-{short_hash(record)}"

    def prepare(self, say: Callable[[str], None] = print) -> None:
        """Makes every cloud that is missing; a killed run goes on where it stopped."""
        missing = [frame_id for frame_id in self.dataset.ids if not self._path(frame_id).is_file()]
        if not missing:
            return
        say(f"making {len(missing)} clouds in {self.folder}")
        write_text(self.folder / "recipe.json", json.dumps(self.recipe.record(), indent=1, sort_keys=True) + "\n")
        for frame_id in missing:
            frame = self.dataset[frame_id]
            name = self.recipe.depth_name
            depth = self.depth.of(frame, name, self.recipe.rows) if name else None
            self._write(frame_id, make_input(frame, self.recipe, depth, self.masks, self.limit))

    def _path(self, frame_id: str) -> Path:
        return self.folder / f"{safe_id(frame_id)}.npz"

    def _write(self, frame_id: str, cloud: InputCloud) -> None:
        buffer = io.BytesIO()
        counts = np.frombuffer(json.dumps(cloud.counts).encode(), np.uint8)
        np.savez(buffer, points=cloud.points, kind=cloud.kind, objects=cloud.objects, counts=counts)
        write_bytes(self._path(frame_id), buffer.getvalue())

    def read(self, frame_id: str) -> InputCloud:
        """A cloud that `prepare` made. DataError when its file is damaged."""
        path = self._path(frame_id)
        try:
            with np.load(path, allow_pickle=False) as parts:
                counts = json.loads(parts["counts"].tobytes())
                return InputCloud(parts["points"], parts["kind"], parts["objects"], tuple(map(tuple, counts)))
        except (OSError, ValueError, KeyError, EOFError) as error:
            raise DataError(path, "a cloud of this experiment", str(error), "remove it and run again") from None

    def point_frame(self, frame: Frame) -> PointFrame:
        """The cloud as detectors take it."""
        from detection.types import PointFrame

        camera = frame.calibration
        points = self.read(frame.id).points
        return PointFrame(points, camera.T_cam_velo, camera.P2, frame.image_size, frame.id)

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int, /) -> tuple[PointFrame, list[KittiObject]]:
        frame = self.dataset[index]
        return self.point_frame(frame), frame.labels
