"""One frame as viewers take it: coloured clouds, oriented boxes, images; the same for every format."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from detection.boxes import to_lidar
from detection.kitti_format import KittiObject, boxes_of
from pipeline.base.paths import RunFolder
from pipeline.data import Dataset, Frame
from pipeline.report import pictures
from pipeline.report.boxes import DRAWN
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.run_folder.thresholds import ScoreThresholds
from pipeline.stages.clouds import lidar_of

# Seconds between two frames in a recording: KITTI's 10 Hz.
PERIOD = 0.1
BOX_COLOURS = {"truth": (43, 212, 164), "found": (255, 122, 26)}


ALL_SCORES = ScoreThresholds()


@dataclass(frozen=True)
class SceneBox:
    """A box in the LiDAR frame.

    centre, size  metres, size along length, width, height
    heading       radians, counter-clockwise from +x
    """

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    heading: float
    text: str

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """x, y, z, w of the rotation about +z."""
        return (0.0, 0.0, float(np.sin(self.heading / 2)), float(np.cos(self.heading / 2)))


@dataclass(frozen=True)
class Scene:
    """Everything of one frame.

    cloud    (N, 5) float32 x y z intensity source, LiDAR frame
    colours  (N, 3) uint8, by source
    images   name -> (H, W, 3) uint8 RGB
    boxes    "truth" and "found" -> boxes
    """

    id: str
    time: float
    cloud: NDArray[np.float32]
    colours: NDArray[np.uint8]
    images: dict[str, NDArray[np.uint8]] = field(default_factory=dict)
    boxes: dict[str, list[SceneBox]] = field(default_factory=dict)


def scenes(
    run: RunFolder, dataset: Dataset, frames: Sequence[str], least: ScoreThresholds = ALL_SCORES
) -> Iterator[Scene]:
    """The frames of a run, one at a time; what a frame does not have is empty. Raises DataError for damaged files.

    least  scores from which predicted boxes are recorded
    """
    for index, frame_id in enumerate(frames):
        yield scene_of(run, dataset[frame_id], index * PERIOD, least)


def scene_of(run: RunFolder, frame: Frame, time: float, least: ScoreThresholds = ALL_SCORES) -> Scene:
    """One frame at `time` seconds from the start of the recording."""
    files = FrameOutputs(run, frame.id)
    if run.cloud(frame.id).is_file():
        cloud = files.read_cloud()[:, :5]
    elif frame.has("points") or frame.has("sparse_depth"):
        points = lidar_of(frame)
        cloud = np.column_stack([points, np.zeros(len(points))]).astype(np.float32)
    else:
        cloud = np.zeros((0, 5), np.float32)
    colours = np.array([pictures.MEASURED_COLOUR, pictures.COMPLETED_COLOUR], np.uint8)
    images = {"image": frame.image}
    if run.depth(frame.id).is_file():
        completed = files.read_completed()
        images["depth"] = pictures.colour_depth(completed.depth)
        if completed.sigma is not None:
            images["sigma"] = pictures.colour_sigma(completed.sigma, completed.depth > 0)
    boxes = {"truth": scene_boxes(frame, frame.labels if frame.has("labels") else [])}
    if run.detections(frame.id).is_file():
        boxes["found"] = scene_boxes(frame, [item for item in files.read_detections() if least.shows(item)])
    return Scene(frame.id, time, cloud, colours[(cloud[:, 4] > 0).astype(int)], images, boxes)


def scene_boxes(frame: Frame, objects: Sequence[KittiObject]) -> list[SceneBox]:
    """Objects with a 3D box, in the LiDAR frame."""
    solid = [item for item in objects if item.type in DRAWN and min(item.size) > 0]
    rows = to_lidar(boxes_of(solid), frame.calibration.T_velo_cam).tolist()
    return [
        SceneBox((x, y, z), (l, w, h), heading, item.type if item.score is None else f"{item.type} {item.score:.2f}")
        for item, (x, y, z, l, w, h, heading) in zip(solid, rows)
    ]
