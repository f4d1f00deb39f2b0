"""A run over three tiny frames, written without networks, and its report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from completion.types import CompletedDepth
from pipeline.base.paths import RunFolder
from pipeline.data import open_dataset
from pipeline.pointcloud.augment import AugmentedCloud
from pipeline.report.page import write_report
from pipeline.run_folder.config import load_config
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.scoring.scores import evaluate_run
from tests.pipeline.tiny_kitti import write_tiny_kitti


def write_run(folder: Path, name: str, error: float) -> RunFolder:
    """FOLDER/NAME: every depth `error` metres too large, half of the points called completed, detections = labels."""
    data = folder / "kitti"
    if not data.is_dir():
        write_tiny_kitti(data, 3)
    run = RunFolder(folder / name)
    for frame in open_dataset("kitti_object", data):
        files = FrameOutputs(run, frame.id)
        depth = frame.target_depth
        files.write_completed(CompletedDepth(depth + error, depth, depth + 2, np.full_like(depth, 0.5)))
        source = np.arange(len(frame.points)) % 2
        cloud = np.column_stack([frame.points, source]).astype(np.float32)
        names = ("x", "y", "z", "intensity", "source")
        files.write_cloud(AugmentedCloud(cloud, names, (("grid_sampling", 100, 40), ("join", 40, 40))))
        files.write_detections([replace(item, score=1.0) for item in frame.labels])
    (run.root / "config.yaml").write_text(f"data: {{name: kitti_object, root: {data}}}\n")
    return run


def score_and_report(run: RunFolder, *overrides: str) -> str:
    """The text of the report, with `--set` overrides."""
    config = load_config(run.config, overrides)
    dataset = open_dataset("kitti_object", str(config.data.root))
    evaluate_run(config, run, dataset, dataset.ids)
    return write_report(config, run, dataset, dataset.ids).read_text(encoding="utf-8")
