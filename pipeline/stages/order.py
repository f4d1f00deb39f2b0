"""The order of the work: which frame stages a request needs."""

from __future__ import annotations

from pipeline.base.errors import UsageError
from pipeline.run_folder.config import Config
from pipeline.run_folder.preset import uses_raw_lidar
from pipeline.stages.augment import AugmentStage
from pipeline.stages.complete import CompleteStage
from pipeline.stages.detect import DetectStage
from pipeline.stages.stage import FrameStage

# The order of the work; asking for a stage runs what it needs before it.
STAGES = ("synth", "train", "complete", "augment", "detect", "evaluate", "report")

FRAME_STAGES: dict[str, type[FrameStage]] = {"complete": CompleteStage, "augment": AugmentStage, "detect": DetectStage}


def frame_stages_for(stage: str, config: Config, has_points: bool = True) -> list[str]:
    """The frame stages that `stage` (one of STAGES) needs, in order, itself included when it is one.

    has_points  False for data sets without LiDAR (NYU, depth maps only): their depth is completed and nothing more
    """
    trains_on_clouds = config.train.network == "detection" and not config.train.beam_strides
    last = {"synth": None, "train": "augment" if trains_on_clouds else None}.get(stage, "detect")
    if stage in FRAME_STAGES:
        last = stage
    if last is None:
        return []
    order = list(FRAME_STAGES)
    wanted = order[: order.index(last) + 1]
    if not has_points:
        if stage in ("augment", "detect"):
            raise UsageError(
                f"--stage {stage} needs LiDAR points, and {config.data.name} has none; use --stage complete"
            )
        return ["complete"]
    if uses_raw_lidar(config) and stage not in ("complete", "augment"):
        wanted = [name for name in wanted if name == "detect"]
    if config.augment.depth_from is not None and stage != "complete":
        wanted = [name for name in wanted if name != "complete"]
    return wanted
