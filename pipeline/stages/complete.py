"""complete: sparse depth + image -> dense depth with two surfaces."""

from __future__ import annotations

from pipeline.base.errors import DataError
from pipeline.data import Frame
from pipeline.run_folder.config import Config
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.run_folder.weights import completion_weights
from pipeline.stages.stage import FrameFunction, FrameStage


def prepare_complete(config: Config) -> FrameFunction:
    """Sparse depth and image in, depth/ID.png and twin/ID.npz out."""
    from completion.infer import load_completer

    completer = load_completer(config.completion.model, config.completion.device, config.completion.backend)

    def complete(frame: Frame, files: FrameOutputs) -> None:
        camera = frame.calibration.K if frame.has("calibration") else None
        if frame.has("points") and not frame.sparse_depth.any():
            where = next(iter(frame.files("points")), frame.where)
            raise DataError(where, "points in the image", "no pixel has a value", "does the calibration fit?")
        files.write_completed(completer.complete(frame.sparse_depth, frame.image, camera))

    return complete


def _complete_parts(config: Config, frame: Frame) -> tuple[str, ...]:
    sparse = ("sparse_depth",) if frame.has("sparse_depth") else ("points",)
    return ("image", "calibration", *sparse)


COMPLETE = FrameStage(
    prepare_complete,
    lambda config: config.completion.model_dump(),
    _complete_parts,
    lambda config, run, frame_id: (),
    completion_weights,
    ("completion", "pipeline/geometry", "pipeline/data"),
    seconds=3.0,
    megabytes=1.2,
)
