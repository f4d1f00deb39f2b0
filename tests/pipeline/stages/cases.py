"""Frames and configurations which together use everything that the stages declare."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from completion.models.rings import interpolate_rings
from completion.types import CompletedDepth
from pipeline.base.paths import RunFolder
from pipeline.data.depth_png import write_depth_png
from pipeline.data.folder import open_folder
from pipeline.data.frame import Frame
from pipeline.data.kitti_object import open_kitti_object
from pipeline.pointcloud.augment import AugmentedCloud
from pipeline.run_folder.config import Config
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.stages.order import FRAME_STAGES
from pipeline.stages.stage import FrameStage
from tests.pipeline.tiny_kitti import HEIGHT, WIDTH, write_tiny_kitti

ID = "000000"
# Weights of a segmentation network, and masks in files.
NETWORK = "{root}/weights/masks.safetensors"
MASKS = {"semantics": "files:{root}/masks"}
# Name -> stage, settings beside the defaults. {root} is the folder of `write_inputs`.
CASES: Mapping[str, tuple[str, dict[str, Any]]] = {
    "complete, no weights": ("complete", {}),
    "complete, network": ("complete", {"completion": {"model": "{root}/weights/depth.safetensors"}}),
    "complete, stored sparse depth": ("complete", {"data": {"name": "folder"}}),
    "augment, L_D_F": ("augment", {"augment": {"preset": "L_D_F"}}),
    "augment, masks in files": ("augment", {"augment": {"preset": "L_D_SF", **MASKS}}),
    "augment, true masks": ("augment", {"augment": {"preset": "L_D_SF_mask", "semantics": "truth"}}),
    "augment, boxes": ("augment", {"augment": {"preset": "L_D_SF", "semantics": "boxes"}}),
    "augment, network": ("augment", {"augment": {"preset": "L_D_SF", "semantics": f"network:{NETWORK}"}}),
    "augment, soft masks": (
        "augment",
        {"augment": {"preset": "L_D_SF_mask", "semantics": f"soft:{NETWORK}"}},
    ),
    "augment, depth from a folder": ("augment", {"augment": {"preset": "D", "depth_from": "{root}/depth"}}),
    "augment, sparse depth as LiDAR": ("augment", {"data": {"name": "folder"}, "augment": {"preset": "L_D_F"}}),
    "detect, raw LiDAR": ("detect", {"augment": {"preset": "L"}}),
    "detect, augmented": ("detect", {"augment": {"preset": "L_D_SF_mask", "semantics": "truth"}}),
}


@dataclass(frozen=True)
class Case:
    """A stage with settings, a frame, and a run in which the stages before it have been."""

    stage: FrameStage
    frame: Frame
    run: RunFolder


def open_case(name: str, root: Path) -> Case:
    """The case over inputs that `write_inputs` wrote; its run is made anew."""
    stage, settings = CASES[name]
    config = config_of(settings, root)
    run = RunFolder(root / "run")
    shutil.rmtree(run.root, ignore_errors=True)
    write_earlier_outputs(run)
    frame = open_folder(root / "folder")[ID] if config.data.name == "folder" else open_kitti_object(root / "kitti")[ID]
    return Case(FRAME_STAGES[stage].of(config), frame, run)


def config_of(settings: Mapping[str, Any], root: Path) -> Config:
    """The configuration with the tiny detector, and {root} put in."""
    sections = {"detection": {"model": "{root}/weights/detector.safetensors"}, **settings}
    return Config.model_validate(
        {
            section: {key: value.format(root=root) if isinstance(value, str) else value for key, value in of.items()}
            for section, of in sections.items()
        }
    )


def write_earlier_outputs(run: RunFolder) -> None:
    """Depth with two surfaces and a cloud with a further column, as stages before would have left them."""
    files = FrameOutputs(run, ID)
    ramp = np.linspace(5, 20, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
    files.write_completed(CompletedDepth(ramp, ramp, ramp + 4, np.full_like(ramp, 0.9)))
    rng = np.random.default_rng(0)
    points = rng.uniform([6, -3, -1.6, 0, 0, 0], [14, 3, 0.5, 1, 1, 1], (400, 6)).astype(np.float32)
    files.write_cloud(AugmentedCloud(points, ("x", "y", "z", "intensity", "source", "semantic"), (("join", 400, 400),)))


def write_inputs(root: Path) -> Path:
    """A KITTI folder, a folder with stored sparse depth, depth maps, masks and weights under `root`."""
    write_tiny_kitti(root / "kitti", 1)
    training, folder = root / "kitti" / "training", root / "folder"
    frame = open_kitti_object(root / "kitti")[ID]
    for part, kitti in (("images", "image_2/{}.png"), ("calib", "calib/{}.txt")):
        (folder / part).mkdir(parents=True)
        shutil.copy(training / kitti.format(ID), folder / part)
    write_depth_png(folder / "sparse_depth" / f"{ID}.png", frame.sparse_depth)
    write_depth_png(root / "depth" / f"{ID}.png", interpolate_rings(frame.sparse_depth)[8:])
    (root / "masks").mkdir()
    cv2.imwrite(str(root / "masks" / f"{ID}.png"), frame.semantics)
    (root / "masks" / "mask.json").write_text('{"convention": "cityscapes_trainIds"}')
    write_weights(root / "weights")
    return root


def write_weights(folder: Path) -> None:
    """A small network of each kind with its card."""
    import torch

    from detection.checkpoints import save_checkpoint
    from detection.models.presets import small
    from pipeline.run_folder.weights import ROOT

    folder.mkdir()
    bundled = {"depth": "completion/weights/selection_small", "masks": "pipeline/semantics/weights/street-small"}
    for name, source in bundled.items():
        for suffix in (".safetensors", ".json"):
            shutil.copy(ROOT / f"{source}{suffix}", folder / f"{name}{suffix}")
    preset = small(points=512, width=0.25)
    torch.manual_seed(0)
    save_checkpoint(preset.build(), preset, folder / "detector.safetensors", {"data": "none: untrained, for tests"})
