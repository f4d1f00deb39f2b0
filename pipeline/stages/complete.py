"""complete: sparse depth + image -> dense depth with two surfaces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from pipeline.base.errors import DataError
from pipeline.data.frame import Frame
from pipeline.run_folder.completers import open_completer
from pipeline.run_folder.config import Config
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.run_folder.weights import completion_weights
from pipeline.stages.stage import FRAME_CODE, FrameStage, Work


@dataclass(frozen=True)
class CompleteStage(FrameStage):
    """Sparse depth and image in, depth/ID.png and twin/ID.npz out.

    model, device, backend, options  as `pipeline.run_folder.completers.open_completer` takes them
    """

    model: str
    device: str
    backend: str
    options: Mapping[str, Any] = field(default_factory=dict)

    code: ClassVar = (
        "completion",
        "auglidar_base/torch_pickle.py",
        "pipeline/run_folder/completers.py",
        "pipeline/run_folder/own_methods.py",
        *FRAME_CODE,
    )
    seconds: ClassVar = 3.0
    megabytes: ClassVar = 1.2

    @classmethod
    def of(cls, config: Config) -> CompleteStage:
        """The completion section."""
        section = config.completion
        return cls(section.model, section.device, section.backend, section.options)

    def parts(self, frame: Frame) -> tuple[str, ...]:
        """Stored sparse depth, or the points it is projected from."""
        return "image", "calibration", "sparse_depth", *frame.sources("sparse_depth")

    def weights(self) -> tuple[Path, ...]:
        """Network and card; nothing for the classical method; the source of a class of one's own."""
        return completion_weights(self.model, self.options)

    def writes(self) -> tuple[str, ...]:
        """The second for networks with two surfaces."""
        return "depth", "twin"

    def open(self) -> Work:
        """Loads the completer."""
        completer = open_completer(self.model, self.device, self.backend, self.options)

        def complete(frame: Frame, files: FrameOutputs) -> None:
            camera = frame.calibration.K if frame.has("calibration") else None
            if not frame.has("sparse_depth") and not frame.sparse_depth.any():
                where = next(iter(frame.files("points")), frame.where)
                raise DataError(where, "points in the image", "no pixel has a value", "does the calibration fit?")
            files.write_completed(completer.complete(frame.sparse_depth, frame.image, camera))

        return complete
