"""JSON schemas of the Foxglove messages we write, after its schema reference: they tell the viewer what is base64."""

from __future__ import annotations

from typing import Any

NUMBER, INTEGER, TEXT, FLAG = {"type": "number"}, {"type": "integer"}, {"type": "string"}, {"type": "boolean"}
BYTES = {"type": "string", "contentEncoding": "base64"}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


def _list(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


TIME = _object(sec=INTEGER, nsec=INTEGER)
XYZ = _object(x=NUMBER, y=NUMBER, z=NUMBER)
POSE = _object(position=XYZ, orientation=_object(x=NUMBER, y=NUMBER, z=NUMBER, w=NUMBER))
COLOUR = _object(r=NUMBER, g=NUMBER, b=NUMBER, a=NUMBER)
CUBE = _object(pose=POSE, size=XYZ, color=COLOUR)
LETTERING = _object(pose=POSE, billboard=FLAG, font_size=NUMBER, scale_invariant=FLAG, color=COLOUR, text=TEXT)

SCHEMAS: dict[str, dict[str, Any]] = {
    "foxglove.PointCloud": _object(
        timestamp=TIME,
        frame_id=TEXT,
        pose=POSE,
        point_stride=INTEGER,
        fields=_list(_object(name=TEXT, offset=INTEGER, type=INTEGER)),
        data=BYTES,
    ),
    "foxglove.SceneUpdate": _object(
        deletions=_list(_object(timestamp=TIME, type=INTEGER, id=TEXT)),
        entities=_list(
            _object(
                timestamp=TIME,
                frame_id=TEXT,
                id=TEXT,
                lifetime=TIME,
                frame_locked=FLAG,
                metadata=_list(_object(key=TEXT, value=TEXT)),
                cubes=_list(CUBE),
                texts=_list(LETTERING),
            )
        ),
    ),
    "foxglove.CompressedImage": _object(timestamp=TIME, frame_id=TEXT, data=BYTES, format=TEXT),
}
