"""KITTI object layout, with dense depth, classes and instances beside it.

training/{image_2, image_3, velodyne, calib, label_2} as in KITTI; our own additions depth_2 (uint16, metres x 256),
semantic_2 (uint8 trainIds), instance_2 (uint16, object number + 1); ImageSets/{train,val,trainval,test}.txt.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from auglidar_base.atomic import write_bytes, write_text
from detection.kitti_format import format_line
from pipeline.data.depth_png import depth_png_bytes, png_bytes
from pipeline.geometry.calibration import format_calibration

if TYPE_CHECKING:
    from pipeline.simulation.synth import SyntheticFrame


def write_kitti_frame(root: Path, frame: SyntheticFrame, part: str = "training") -> None:
    """All files of one frame below root/part."""
    folder = root / part
    write_bytes(folder / "image_2" / f"{frame.id}.png", png_bytes(frame.image))
    if frame.right is not None:
        write_bytes(folder / "image_3" / f"{frame.id}.png", png_bytes(frame.right.image))
    write_bytes(folder / "velodyne" / f"{frame.id}.bin", frame.points.astype("<f4").tobytes())
    write_text(folder / "calib" / f"{frame.id}.txt", format_calibration(frame.calibration))
    write_text(folder / "label_2" / f"{frame.id}.txt", "".join(format_line(item) + "\n" for item in frame.labels))
    write_bytes(folder / "depth_2" / f"{frame.id}.png", depth_png_bytes(np.minimum(frame.depth, 255.0)))
    write_bytes(folder / "semantic_2" / f"{frame.id}.png", png_bytes(frame.semantics))
    write_bytes(folder / "instance_2" / f"{frame.id}.png", png_bytes(frame.instances.astype(np.uint16)))


def write_splits(root: Path, ids: list[str]) -> None:
    """ImageSets: every fourth frame validates, all are trainval; test is empty (there is no testing folder)."""
    val = ids[3::4]
    train = [name for name in ids if name not in set(val)]
    for name, members in (("train", train), ("val", val), ("trainval", ids), ("test", [])):
        write_text(root / "ImageSets" / f"{name}.txt", "".join(f"{member}\n" for member in members))
