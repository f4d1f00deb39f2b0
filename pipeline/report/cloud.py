"""The 3D cloud of a frame, packed for the page: quantised places and one byte per point and colouring."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import DataError
from pipeline.data import Frame
from pipeline.geometry.in_view import lidar_pixels
from pipeline.report import pictures
from pipeline.run_folder.frame_outputs import FrameOutputs

# All frames of a page share this many points, so that 20 frames stay under 15 MB; one frame takes no more than MOST.
POINTS_OF_A_PAGE, MOST_POINTS = 300_000, 24_000
# Byte values of the colourings that mean "no value".
NO_BYTE = 255
MEASURED_SIGMA = 254
MEASURED_NOISE = 5
STEPS = 65535


@dataclass(frozen=True)
class FrameCloud:
    """A cloud and what its points are coloured by.

    points  (N, 3) float32 metres, LiDAR frame
    bytes   colouring ("source", "sigma", "class", "noise") -> (N,) uint8
    total   points before thinning
    """

    points: NDArray[np.float32]
    bytes: dict[str, NDArray[np.uint8]] = field(default_factory=dict)
    total: int = 0

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(N,) True for the sensor's own points."""
        return np.asarray(self.bytes["source"] == 0)

    def thinned(self, budget: int, seed: int) -> FrameCloud:
        """At most `budget` points, drawn without replacement; measured ones take up to half when both are many."""
        if len(self.points) <= budget:
            return self
        rng = np.random.default_rng(seed)
        measured, completed = np.flatnonzero(self.measured), np.flatnonzero(~self.measured)
        n_measured = min(len(measured), max(budget // 2, budget - len(completed)))
        chosen = [
            rng.choice(measured, n_measured, replace=False),
            rng.choice(completed, min(len(completed), budget - n_measured), replace=False),
        ]
        rows = np.sort(np.concatenate(chosen))
        return FrameCloud(self.points[rows], {name: values[rows] for name, values in self.bytes.items()}, self.total)

    def packed(self) -> dict[str, Any]:
        """What script and page exchange: JSON with one base64 text of x, y, z (uint16 each), then the colourings."""
        low = self.points.min(axis=0) if len(self.points) else np.zeros(3, np.float32)
        span = np.maximum(self.points.max(axis=0) - low if len(self.points) else np.ones(3), 1e-3)
        places = np.rint((self.points - low) / span * STEPS).astype("<u2")
        data = b"".join(np.ascontiguousarray(column).tobytes() for column in (*places.T, *self.bytes.values()))
        return {
            "count": len(self.points),
            "total": self.total,
            "low": [round(float(value), 4) for value in low],
            "span": [round(float(value), 4) for value in span],
            "colourings": list(self.bytes),
            "data": base64.b64encode(data).decode("ascii"),
        }


def point_budget(frames: int) -> int:
    """Points drawn per frame when the page shows `frames` of them."""
    return min(MOST_POINTS, POINTS_OF_A_PAGE // max(frames, 1))


def frame_cloud(frame: Frame, files: FrameOutputs) -> FrameCloud | None:
    """The augmented cloud, else the raw LiDAR, with every colouring the frame has data for; None without points."""
    if files.run.cloud(frame.id).is_file():
        cloud = files.read_cloud()
        points, source = cloud[:, :3], cloud[:, 4].astype(np.uint8)
    elif frame.has("points"):
        points = frame.points[:, :3]
        source = np.zeros(len(points), np.uint8)
    else:
        return None
    colours = {"source": source}
    pixels = lidar_pixels(np.ascontiguousarray(points, np.float32), frame.calibration, frame.image_size)
    for name, values in (
        ("sigma", _sigma_map(files)),
        ("class", _class_map(frame)),
        ("noise", _noise_map(frame, files)),
    ):
        if values is not None and values.shape == tuple(frame.image_size):
            colours[name] = _bytes_at(pixels, values)
    if "sigma" in colours:
        colours["sigma"][source == 0] = MEASURED_SIGMA
    if "noise" in colours:
        colours["noise"][source == 0] = MEASURED_NOISE
    return FrameCloud(points, colours, len(points))


def _bytes_at(pixels: NDArray[np.int64], values: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.where(pixels >= 0, values.reshape(-1)[pixels.clip(0)], NO_BYTE).astype(np.uint8)


def _sigma_map(files: FrameOutputs) -> NDArray[np.uint8] | None:
    """(H, W) sigma x 250, of frames with two surfaces."""
    if not files.run.twin(files.id).is_file():
        return None
    sigma = files.read_completed().sigma
    return None if sigma is None else np.rint(sigma * 250).astype(np.uint8)


def _class_map(frame: Frame) -> NDArray[np.uint8] | None:
    return frame.semantics if frame.has("semantics") else None


def _noise_map(frame: Frame, files: FrameOutputs) -> NDArray[np.uint8] | None:
    """(H, W) noise kinds, of frames with completed depth and true depth of every pixel (thesis 5.3.2)."""
    if not frame.has("target_depth") or not files.run.depth(frame.id).is_file():
        return None
    from pipeline.pointcloud.taxonomy import Taxonomy, label_noise

    depth, truth = files.read_completed().depth, frame.target_depth
    if depth.shape != truth.shape:
        return None
    return label_noise(depth, truth, object_pixels(frame), Taxonomy())


def object_pixels(frame: Frame) -> NDArray[np.bool_]:
    """(H, W) pixels of relevant objects: by the semantics when there are some, else inside the labels' rectangles."""
    from pipeline.pointcloud.semantic_mask import OBJECTS

    if frame.has("semantics"):
        return np.asarray(np.isin(frame.semantics, OBJECTS))
    mask = np.zeros(frame.image_size, np.bool_)
    for item in frame.labels if frame.has("labels") else []:
        if item.type != "DontCare":
            left, top, right, bottom = (max(0, round(value)) for value in item.bbox)
            mask[top : bottom + 1, left : right + 1] = True
    return mask


# --- the picture shown where no canvas works, and on paper


STILL_WIDTH, STILL_HEIGHT = 760, 420
# Where the page's camera stands at first: looking at this point (metres, LiDAR frame) from behind and above.
TARGET, DISTANCE, PITCH, FOCAL = (17.0, 0.0, -1.2), 30.0, np.deg2rad(24.0), 0.85


def still_picture(cloud: FrameCloud, boxes: list[tuple[str, NDArray[np.float64]]]) -> pictures.RGB:
    """(H, W, 4) RGBA of the cloud from the page's first point of view.

    boxes  ("truth" or "found", (8, 3) corners in the LiDAR frame)
    """
    import cv2

    from pipeline.report.boxes import EDGES

    picture = np.zeros((STILL_HEIGHT, STILL_WIDTH, 4), np.uint8)
    for chosen, colour in (
        (~cloud.measured, pictures.COMPLETED_COLOUR),
        (cloud.measured, pictures.MEASURED_COLOUR),
    ):
        place, depth = still_pixels(cloud.points[chosen])
        seen = (depth > 1) & (place >= 0).all(axis=1) & (place < (STILL_WIDTH - 1, STILL_HEIGHT - 1)).all(axis=1)
        column, row = place[seen].astype(int).T
        for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
            picture[row + down, column + right] = (*colour, 255)
    colours = {"truth": (0, 158, 115, 255), "found": (213, 94, 0, 255)}
    for kind, corners in boxes:
        place, depth = still_pixels(corners)
        if (depth > 1).all():
            for first, second in EDGES:
                ends = [tuple(int(v) for v in place[i].clip(-4000, 4000)) for i in (first, second)]
                cv2.line(picture, ends[0], ends[1], colours[kind], 1, cv2.LINE_AA)
    return picture


def still_pixels(points: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """((N, 2) column row, (N,) depth) of (N, 3) points in `still_picture`."""
    cos, sin = np.cos(PITCH), np.sin(PITCH)
    forward, right, up = np.array([cos, 0, -sin]), np.array([0.0, -1, 0]), np.array([sin, 0, cos])
    relative = np.asarray(points[:, :3], np.float64) - (np.array(TARGET) - DISTANCE * forward)
    depth = relative @ forward
    scale = FOCAL * STILL_WIDTH / np.maximum(depth, 1e-3)
    column = STILL_WIDTH / 2 + scale * (relative @ right)
    return np.column_stack([column, STILL_HEIGHT / 2 - scale * (relative @ up)]), depth


# --- palettes, shared by the legends and the script


CLASS_COLOURS = {  # Cityscapes trainIds with their published colours
    0: ("road", (128, 64, 128)),
    1: ("sidewalk", (244, 35, 232)),
    2: ("building", (120, 120, 120)),
    3: ("wall", (102, 102, 156)),
    4: ("fence", (190, 153, 153)),
    5: ("pole", (200, 200, 200)),
    6: ("traffic light", (250, 170, 30)),
    7: ("traffic sign", (220, 220, 0)),
    8: ("vegetation", (107, 142, 35)),
    9: ("terrain", (152, 251, 152)),
    10: ("sky", (70, 130, 180)),
    11: ("person", (220, 20, 60)),
    12: ("rider", (255, 60, 60)),
    13: ("car", (64, 120, 255)),
    14: ("truck", (60, 90, 190)),
    15: ("bus", (0, 150, 180)),
    16: ("train", (0, 130, 150)),
    17: ("motorcycle", (90, 90, 255)),
    18: ("bicycle", (190, 60, 90)),
    NO_BYTE: ("none", (110, 110, 110)),
}


def palettes() -> dict[str, Any]:
    """Colouring -> title and named byte values or a ramp; the script itself works out "distance" and "height"."""
    from pipeline.pointcloud.taxonomy import COLOURS, LABELS

    noise = {str(i): [name, list(colour)] for i, (name, colour) in enumerate(zip(LABELS, COLOURS))}
    noise |= {str(MEASURED_NOISE): ["measured", [150, 160, 172]], str(NO_BYTE): ["unknown", list(COLOURS[0])]}
    depth = [[int(v) for v in row] for row in pictures.depth_colours()[::15]]
    return {
        "source": {
            "title": "source",
            "names": {"0": ["measured", pictures.MEASURED_COLOUR], "1": ["completed", pictures.COMPLETED_COLOUR]},
        },
        "sigma": {
            "title": "sigma",
            "ramp": [[int(v) for v in row] for row in pictures.sigma_colours()[::15]],
            "last": 250,
            "low": "0 background",
            "high": "1 foreground",
            "names": {str(MEASURED_SIGMA): ["measured", [120, 130, 142]], str(NO_BYTE): ["none", [80, 80, 80]]},
        },
        "class": {"title": "class", "names": {str(k): [name, list(rgb)] for k, (name, rgb) in CLASS_COLOURS.items()}},
        "noise": {"title": "noise", "names": noise},
        "distance": {"title": "distance", "ramp": depth, "low": "2 m", "high": "80 m"},
        "height": {"title": "height", "ramp": depth[::-1], "low": "−2.5 m", "high": "2.5 m"},
    }


def cloud_of_frame(frame: Frame, files: FrameOutputs) -> FrameCloud | None:
    """As `frame_cloud`, without the colourings whose files are damaged (the page names those elsewhere)."""
    try:
        return frame_cloud(frame, files)
    except DataError:
        if not frame.has("points"):
            raise
        points = frame.points[:, :3]
        return FrameCloud(points, {"source": np.zeros(len(points), np.uint8)}, len(points))
