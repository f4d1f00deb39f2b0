"""A run as an MCAP file for Foxglove (extra `viewer`), with Foxglove's own message kinds written as JSON.

Fields and numbers of the messages: Foxglove's schema reference; the container: the MCAP specification (mcap.dev).
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from auglidar_base.atomic import replacing
from pipeline.base.errors import UsageError
from pipeline.report.recordings.scene import BOX_COLOURS, PERIOD, Scene, SceneBox
from pipeline.report.recordings.schemas import SCHEMAS

LIDAR = "velodyne"
UINT8, FLOAT32 = 1, 7
TOPICS = {
    "/cloud": "foxglove.PointCloud",
    "/boxes/truth": "foxglove.SceneUpdate",
    "/boxes/found": "foxglove.SceneUpdate",
    "/camera/image": "foxglove.CompressedImage",
    "/camera/depth": "foxglove.CompressedImage",
    "/camera/sigma": "foxglove.CompressedImage",
}


def write_mcap(path: Path, scenes: Iterable[Scene], name: str) -> Path:
    """Writes the recording, one message per topic and frame. Raises UsageError when mcap is not installed.

    name  kept in the file's metadata
    """
    try:
        from mcap.writer import CompressionType, Writer
    except ImportError:
        raise UsageError("report.format mcap needs mcap: pip install 'auglidar[viewer]'") from None
    with replacing(path) as temporary, open(temporary, "wb") as file:
        # Clouds and JPEGs hardly compress, and without compression no further package is needed to read the file.
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start(profile="", library="auglidar")
        writer.add_metadata("run", {"name": name})
        channels = _channels(writer)
        for index, scene in enumerate(scenes):
            for topic, message in messages(scene):
                nanoseconds = round(scene.time * 1e9)
                data = json.dumps(message, separators=(",", ":")).encode()
                writer.add_message(channels[topic], nanoseconds, data, nanoseconds, sequence=index)
        writer.finish()
    return path


def _channels(writer: Any) -> dict[str, int]:
    """Topic -> channel number; every topic is there even when no frame has it."""
    schemas: dict[str, int] = {}
    for kind in dict.fromkeys(TOPICS.values()):
        text = json.dumps({"title": kind} | SCHEMAS[kind]).encode()
        schemas[kind] = writer.register_schema(kind, "jsonschema", text)
    return {topic: writer.register_channel(topic, "json", schemas[kind]) for topic, kind in TOPICS.items()}


def messages(scene: Scene) -> list[tuple[str, dict[str, Any]]]:
    """(topic, message) of one frame."""
    stamp = {"sec": int(scene.time), "nsec": round((scene.time % 1) * 1e9)}
    found: list[tuple[str, dict[str, Any]]] = [("/cloud", cloud_message(scene, stamp))]
    found += [(f"/boxes/{kind}", boxes_message(kind, boxes, stamp)) for kind, boxes in scene.boxes.items()]
    found += [(f"/camera/{name}", image_message(image, stamp)) for name, image in scene.images.items()]
    return found


def cloud_message(scene: Scene, stamp: dict[str, int]) -> dict[str, Any]:
    """foxglove.PointCloud: x y z intensity as float32, then red green blue alpha as bytes; 20 bytes a point."""
    fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")]
    fields += [("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1")]
    table = np.zeros(len(scene.cloud), dtype=fields)
    for column, (name, _) in enumerate(fields[:4]):
        table[name] = scene.cloud[:, column]
    for column, (name, _) in enumerate(fields[4:7]):
        table[name] = scene.colours[:, column]
    table["alpha"] = 255
    offsets = [table.dtype.fields[name][1] for name, _ in fields]  # type: ignore[index]
    return {
        "timestamp": stamp,
        "frame_id": LIDAR,
        "pose": {"position": _xyz((0, 0, 0)), "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}},
        "point_stride": table.dtype.itemsize,
        "fields": [
            {"name": name, "offset": offset, "type": FLOAT32 if kind == "<f4" else UINT8}
            for (name, kind), offset in zip(fields, offsets)
        ],
        "data": base64.b64encode(table.tobytes()).decode("ascii"),
    }


def boxes_message(kind: str, boxes: list[SceneBox], stamp: dict[str, int]) -> dict[str, Any]:
    """foxglove.SceneUpdate: see-through cubes with their names; they vanish with the next frame."""
    red, green, blue = (value / 255 for value in BOX_COLOURS[kind])
    cubes = [
        {
            "pose": {"position": _xyz(box.centre), "orientation": dict(zip("xyzw", box.quaternion))},
            "size": _xyz(box.size),
            "color": {"r": red, "g": green, "b": blue, "a": 0.3},
        }
        for box in boxes
    ]
    texts = [
        {
            "pose": {
                "position": _xyz((box.centre[0], box.centre[1], box.centre[2] + box.size[2] / 2 + 0.4)),
                "orientation": {"x": 0, "y": 0, "z": 0, "w": 1},
            },
            "billboard": True,
            "font_size": 14,
            "scale_invariant": True,
            "color": {"r": red, "g": green, "b": blue, "a": 1},
            "text": box.text,
        }
        for box in boxes
    ]
    entity = {
        "timestamp": stamp,
        "frame_id": LIDAR,
        "id": kind,
        "lifetime": {"sec": 0, "nsec": round(PERIOD * 1e9)},
        "frame_locked": True,
        "metadata": [],
        "cubes": cubes,
        "texts": texts,
    }
    return {"deletions": [], "entities": [entity]}


def image_message(image: Any, stamp: dict[str, int]) -> dict[str, Any]:
    """foxglove.CompressedImage: JPEG."""
    import cv2

    done, data = cv2.imencode(".jpg", np.ascontiguousarray(image[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 85])
    if not done:
        raise ValueError(f"cannot encode a picture of shape {image.shape}")
    text = base64.b64encode(data.tobytes()).decode("ascii")
    return {"timestamp": stamp, "frame_id": "camera", "data": text, "format": "jpeg"}


def _xyz(values: tuple[float, float, float]) -> dict[str, float]:
    return dict(zip("xyz", values))
