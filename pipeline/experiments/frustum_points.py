"""The points that an experiment with Frustum PointNet cuts frustums from: raw LiDAR, or completed depth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.base.paths import RunFolder
from pipeline.base.settings import plain
from pipeline.data import Dataset, Frame
from pipeline.experiments.cloud_cache import short_hash
from pipeline.experiments.completion_inputs import default_decoding, load_weights
from pipeline.experiments.completion_runs import train_settings
from pipeline.experiments.inputs import lidar_points
from pipeline.experiments.runs import Context, budget_of
from pipeline.experiments.tables import Recipe
from pipeline.experiments.worlds import TRAIN_SEED, synthetic_frames
from pipeline.run_folder.frame_outputs import FrameOutputs

if TYPE_CHECKING:
    from completion.infer import Completer
    from completion.types import DepthFrame
    from detection.kitti_format import KittiObject
    from detection.types import PointFrame

# Rows of Table 3.4 that complete the depth -> network and loss of the completion experiments.
COMPLETED: Mapping[str, tuple[str, str]] = {"ma": ("resnet18", "l2"), "dc": ("resnet18", "dc")}


@dataclass(frozen=True)
class Completion:
    """A completer, and the name that says which one it is."""

    completer: Completer
    name: str


def sparse_depth(frame: Frame, rows: int) -> Any:
    """(H, W) metres of the chosen LiDAR rows, 0 where there is none."""
    from pipeline.geometry.project import project_points

    return project_points(lidar_points(frame, rows), frame.calibration, frame.image_size)


@dataclass(frozen=True)
class _Frames:
    """Frames with true depth as the completion is trained on them."""

    dataset: Dataset
    rows: int

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int, /) -> DepthFrame:
        from completion.types import DepthFrame

        frame = self.dataset[index]
        return DepthFrame(frame.image, sparse_depth(frame, self.rows), frame.target_depth)


def completion_of(which: str, rows: int, frames: Dataset, context: Context) -> Completion:
    """The completion of a row: the budget's own weights, or a network trained now on frames with true depth."""
    from completion.infer import load_completer, network_completer
    from completion.train import train

    given = context.budget.completers.get(which)
    if given is not None:
        return Completion(load_completer(given), f"{Path(given).stem}-{short_hash(str(given))}")
    budget = budget_of("completion", context.budget.completion)
    network, loss = COMPLETED[which]
    base = {"network": network, "loss": loss, "rows": rows, "colour": True, "target": "clean", "scene": "street"}
    source = frames if frames[0].has("target_depth") else _synthetic(len(frames), context)
    settings = train_settings(Recipe("completion", base), budget, context.seed)
    size = source[0].image_size
    crop = (min(budget.crop[0], size[0]), min(budget.crop[1], size[1]))
    settings = replace(settings, augmentation=replace(settings.augmentation, crop=crop))
    name = f"completion-{short_hash([plain(settings), rows, str(source.root), list(source.ids)])}"
    folder = context.out / "data" / name
    if not (folder / "last.safetensors").is_file():
        context.say(f"  training the completion {which!r} on {len(source)} frames")
    train(settings, _Frames(source, rows), folder, facts={"experiment": name})
    spec = settings.model
    model = load_weights(spec, folder / "last.safetensors")
    return Completion(network_completer(model, spec, decoding=default_decoding(spec)), name)


def _synthetic(count: int, context: Context) -> Dataset:
    return synthetic_frames(context.out / "data", count, TRAIN_SEED, context.budget.size, context.say)


@dataclass(frozen=True)
class FrustumFrames:
    """Frames of a data set whose points are those of a row: x y z, no intensity, which completed depth has not."""

    dataset: Dataset
    rows: int
    completion: Completion | None
    root: Path

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int, /) -> tuple[PointFrame, list[KittiObject]]:
        frame = self.dataset[index]
        return self.point_frame(frame), frame.labels

    def point_frame(self, frame: Frame) -> PointFrame:
        """The raw points of the chosen rows, or every pixel of the completed depth in space (LiDAR frame)."""
        from detection.types import PointFrame
        from pipeline.geometry.back_project import depth_pixels, pixels_to_velo

        camera = frame.calibration
        if self.completion is None:
            points = lidar_points(frame, self.rows)[:, :3]
        else:
            u, v, depth = depth_pixels(self._depth(frame))
            points = pixels_to_velo(u, v, depth, camera)[:, :3].astype(np.float32)
        return PointFrame(points, camera.T_cam_velo, camera.P2, frame.image_size, frame.id)

    def _depth(self, frame: Frame) -> Any:
        """The completed depth, made once per experiment folder."""
        assert self.completion is not None
        files = FrameOutputs(RunFolder(self.root / f"depth-{self.completion.name}-{self.rows}"), frame.id)
        if not files.run.depth(frame.id).is_file():
            sparse = sparse_depth(frame, self.rows)
            completed = self.completion.completer.complete(sparse, frame.image, frame.calibration.K)
            files.write_completed(completed)
        return files.read_completed().depth
