"""Clouds of fewer LiDAR rows for detector training: every frame once per entry of `train.beam_strides`."""

from __future__ import annotations

import hashlib
import io
import json
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from auglidar_base.array_files import ArrayFileError, npy_array
from auglidar_base.atomic import write_bytes
from pipeline.base.errors import UsageError
from pipeline.base.paths import RunFolder
from pipeline.base.seeds import derive_seed
from pipeline.base.settings import plain
from pipeline.data import Dataset, Frame
from pipeline.geometry.project import project_points
from pipeline.geometry.rings import subsample_rows
from pipeline.run_folder.completers import open_completer
from pipeline.run_folder.config import Config
from pipeline.run_folder.preset import augment_settings, uses_raw_lidar
from pipeline.run_folder.weights import completion_weights
from pipeline.stages.completed import with_sigma

if TYPE_CHECKING:
    from completion.infer import Completer
    from detection.kitti_format import KittiObject
    from detection.types import PointFrame
    from pipeline.pointcloud.presets import AugmentSettings


def thinned_cloud(
    frame: Frame, step: int, settings: AugmentSettings | None, completer: Completer | None, seed: int
) -> NDArray[np.float32]:
    """The cloud of a frame whose scan keeps every `step`-th ring, (N, 4 or 5 + C) float32, LiDAR frame.

    settings, completer  None for raw LiDAR; else depth is completed from the thinned scan and augments it
    """
    points = frame.points if step == 1 else subsample_rows(frame.points, step)
    if settings is None or completer is None:
        return points
    from pipeline.pointcloud.augment import augment_frame

    completed = completer.complete(
        project_points(points, frame.calibration, frame.image_size), frame.image, frame.calibration.K
    )
    completed = with_sigma(completed, settings)
    augment_seed = derive_seed(seed, frame.id, "augment")
    return augment_frame(completed, points, frame.calibration, settings, None, augment_seed).points


@dataclass(frozen=True)
class ThinnedClouds:
    """Labelled clouds with 64, 32, 16 ... rows, as `detection.train` reads them.

    What the detectors' border lets through is kept in OUT/training_clouds, so a frame is thinned, completed and
    augmented once.
    """

    dataset: Dataset
    config: Config
    run: RunFolder

    def __post_init__(self) -> None:
        if any(step < 1 for step in self.config.train.beam_strides):
            raise UsageError(f"train.beam_strides: expected numbers from 1, got {list(self.config.train.beam_strides)}")
        if not uses_raw_lidar(self.config) and augment_settings(self.config).needs_semantics:
            raise UsageError("train.beam_strides: clouds with object masks cannot be thinned; leave it out")

    def __len__(self) -> int:
        return len(self.dataset) * len(self.config.train.beam_strides)

    def __getitem__(self, index: int, /) -> tuple[PointFrame, list[KittiObject]]:
        from detection.types import PointFrame

        frame = self.dataset[index % len(self.dataset)]
        points = self._points(frame, self.config.train.beam_strides[index // len(self.dataset)])
        camera = frame.calibration
        return PointFrame(points, camera.T_cam_velo, camera.P2, frame.image_size, frame.id), frame.labels

    def _points(self, frame: Frame, step: int) -> NDArray[np.float32]:
        path = self._path(frame.id, step)
        if path.is_file():
            with suppress(ArrayFileError):  # damaged: it is made again
                return npy_array(path.read_bytes()).copy()
        from detection.inputs import in_view_openpcdet
        from detection.types import PointFrame

        settings, completer = self._tools()
        points = thinned_cloud(frame, step, settings, completer, self.config.seed)
        camera = frame.calibration
        seen = PointFrame(points, camera.T_cam_velo, camera.P2, frame.image_size, frame.id)
        points = points[in_view_openpcdet(seen)]
        content = io.BytesIO()
        np.save(content, points, allow_pickle=False)
        write_bytes(path, content.getvalue())
        return points

    def _path(self, frame_id: str, step: int) -> Path:
        return self.run.root / "training_clouds" / self._made_by / f"{frame_id}-{step}.npy"

    @cached_property
    def _made_by(self) -> str:
        """A folder name for everything but frame and rows that a cloud depends on."""
        if uses_raw_lidar(self.config):
            return "L"
        section = self.config.completion
        own = [section.options] if section.options else []
        facts = json.dumps([plain(augment_settings(self.config)), section.model, self.config.seed, *own])
        weights = [path.read_bytes() for path in completion_weights(section.model, section.options)]
        return f"{self.config.augment.preset}-{hashlib.sha256(facts.encode() + b''.join(weights)).hexdigest()[:12]}"

    def _tools(self) -> tuple[AugmentSettings | None, Completer | None]:
        if uses_raw_lidar(self.config):
            return None, None
        completion = self.config.completion
        options = json.dumps(completion.options, sort_keys=True)
        return augment_settings(self.config), _completer(
            completion.model, completion.device, completion.backend, options
        )


@lru_cache(maxsize=1)
def _completer(name: str, device: str, backend: str, options: str) -> Completer:
    return open_completer(name, device, backend, json.loads(options))
