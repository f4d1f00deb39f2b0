"""A run over a tiny data set with odd numbers in it, as the stages would leave it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from completion.types import CompletedDepth
from pipeline.base.paths import RunFolder
from pipeline.data import open_dataset
from pipeline.data.dataset import Dataset
from pipeline.run_folder.frame_outputs import FrameOutputs
from tests.pipeline.tiny_kitti import write_tiny_kitti


@dataclass(frozen=True)
class TinyRun:
    data: Path
    run: Path

    @property
    def dataset(self) -> Dataset:
        return open_dataset("kitti_object", self.data)

    def depth(self, name: str) -> np.ndarray:
        """(H, W) metres as the run's PNG holds it."""
        return FrameOutputs(RunFolder(self.run), name).read_completed().depth

    def cloud(self, name: str) -> np.ndarray:
        """(N, 5) x y z intensity source."""
        return np.fromfile(self.run / "cloud" / f"{name}.bin", "<f4").reshape(-1, 5)


def make_run(data: Path, run: Path) -> TinyRun:
    """depth/, twin/, cloud/ and detections/ of every frame of a data set."""
    for frame in open_dataset("kitti_object", data):
        files = FrameOutputs(RunFolder(run), frame.id)
        depth = frame.target_depth.copy()
        depth[:6] = 0
        far = np.where(depth > 0, depth + 2, 0).astype(np.float32)
        files.write_completed(CompletedDepth(depth, depth, far, np.full_like(depth, 0.8)))
        virtual = np.random.default_rng(int(frame.id)).uniform(1, 9, (40, 3))
        virtual[:, 1:] *= 0.1
        rows = [np.column_stack([frame.points, np.zeros(len(frame.points))])]
        rows.append(np.column_stack([virtual, np.zeros(len(virtual)), np.ones(len(virtual))]))
        path = RunFolder(run).cloud(frame.id)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(np.concatenate(rows).astype("<f4").tobytes())
        files.write_detections([replace(item, score=0.75, truncated=-1, occluded=-1) for item in frame.labels])
    return TinyRun(data, run)


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> TinyRun:
    root = tmp_path_factory.mktemp("export")
    write_tiny_kitti(root / "data", 4)
    lists = root / "data" / "ImageSets"
    lists.mkdir()
    (lists / "train.txt").write_text("000000\n000002\n009999\n")
    (lists / "val.txt").write_text("000001\n000003\n")
    return make_run(root / "data", root / "run")
