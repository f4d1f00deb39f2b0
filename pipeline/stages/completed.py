"""The completed depth of a frame, as the augment stage reads it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.base.errors import DataError
from pipeline.data.depth_png import read_depth_png
from pipeline.data.frame import Frame
from pipeline.run_folder.frame_outputs import FrameOutputs

if TYPE_CHECKING:
    from completion.types import CompletedDepth
    from pipeline.pointcloud.presets import AugmentSettings


def completed_depth(depth_from: str | None, frame: Frame, files: FrameOutputs) -> CompletedDepth:
    """Completed depth of this run, or of the folder `depth_from`."""
    from completion.types import CompletedDepth

    if depth_from is None:
        return files.read_completed()
    from pipeline.pointcloud.depth_source import placed_bottom_centre

    path = Path(depth_from) / f"{frame.id}.png"
    depth = read_depth_png(path)
    if not depth.any():
        raise DataError(path, "a depth map with values", "no pixel has a value")
    if depth.shape != tuple(frame.image_size):
        depth = placed_bottom_centre(depth, frame.image_size, path)
    return CompletedDepth(depth)


def with_sigma(completed: CompletedDepth, settings: AugmentSettings) -> CompletedDepth:
    """The completed depth, with surfaces estimated from its local spread when the settings need some it has not."""
    if completed.has_surfaces or not settings.needs_surfaces:
        return completed
    from pipeline.pointcloud.pseudo_sigma import pseudo_sigma

    return pseudo_sigma(completed.depth)
