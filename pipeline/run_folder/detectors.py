"""What detects objects in a run: a class of one's own, or a network of `detection`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from detection.types import Detections, PointFrame
from pipeline.base.errors import DataError, UsageError
from pipeline.run_folder.own_methods import is_own, made


class ObjectDetector(Protocol):
    """Anything that detects objects."""

    def detect(self, frame: PointFrame) -> Detections:
        """Objects of one frame, boxes in the rectified camera frame."""
        ...


@dataclass(frozen=True)
class OwnDetector:
    """A user's detector; what it returns is checked."""

    name: str
    method: Any

    def detect(self, frame: PointFrame) -> Detections:
        """See `ObjectDetector`. DataError for a result that is not `Detections`."""
        found = self.method.detect(frame)
        if not isinstance(found, Detections):
            raise DataError(self.name, "detection.types.Detections", type(found).__name__)
        return found


def open_detector(
    name: str, device: str = "cpu", seed: int = 0, options: Mapping[str, Any] | None = None
) -> ObjectDetector:
    """The detector of a class of one's own, or what `detection.infer.load_detector` gives."""
    if is_own("detection", name):
        return OwnDetector(name, made("detection", name, options or {}))
    if options:
        raise UsageError(f"detection.options: only a class of one's own (module:Class) takes options, not {name}")
    from detection.infer import load_detector

    return load_detector(name, device, seed)
