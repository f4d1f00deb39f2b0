"""The completed depth of a frame, as the augment stage reads it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.data.depth_folder import read_depth_folder
from pipeline.data.frame import Frame
from pipeline.run_folder.frame_outputs import FrameOutputs

if TYPE_CHECKING:
    from completion.types import CompletedDepth
    from pipeline.pointcloud.presets import AugmentSettings


def completed_depth(depth_from: str | None, compare: bool, frame: Frame, files: FrameOutputs) -> CompletedDepth:
    """Completed depth of this run, or of the folder `depth_from`. Raises DataError for an unusable file.

    compare  refuse a map of the folder that does not fit the frame's LiDAR
    """
    if depth_from is None:
        return files.read_completed()
    return read_depth_folder(depth_from, frame.id, frame.image_size, frame.sparse_depth if compare else None)


def with_sigma(completed: CompletedDepth, settings: AugmentSettings) -> CompletedDepth:
    """The completed depth, with surfaces estimated from its local spread when the settings need some it has not."""
    if completed.has_surfaces or not settings.needs_surfaces:
        return completed
    from pipeline.pointcloud.pseudo_sigma import pseudo_sigma

    return pseudo_sigma(completed.depth)
