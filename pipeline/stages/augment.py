"""augment: dense depth -> augmented LiDAR."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.base.paths import RunFolder
from pipeline.base.seeds import derive_seed
from pipeline.base.settings import plain
from pipeline.data import Frame
from pipeline.run_folder.config import Config
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.run_folder.preset import augment_settings
from pipeline.run_folder.weights import mask_weights
from pipeline.stages.clouds import completed_depth, lidar_of, lidar_parts, with_sigma
from pipeline.stages.stage import FrameFunction, FrameStage

if TYPE_CHECKING:
    from pipeline.pointcloud.presets import AugmentSettings
    from pipeline.semantics.sources import SemanticsSource


def prepare_augment(config: Config) -> FrameFunction:
    """Completed depth, raw LiDAR and masks in, cloud/ID.bin out."""
    from pipeline.pointcloud.augment import augment_frame

    settings = augment_settings(config)
    masks = open_masks(config, settings)

    def augment(frame: Frame, files: FrameOutputs) -> None:
        completed = with_sigma(completed_depth(config, frame, files), settings)
        semantics = masks.semantics(frame) if masks is not None else None
        seed = derive_seed(config.seed, frame.id, "augment")
        files.write_cloud(augment_frame(completed, lidar_of(frame), frame.calibration, settings, semantics, seed))

    return augment


def open_masks(config: Config, settings: AugmentSettings) -> SemanticsSource | None:
    """Where the object masks come from, or None when the settings use none."""
    if not settings.needs_semantics or config.augment.semantics is None:
        return None
    from pipeline.semantics.sources import open_semantics

    return open_semantics(config.augment.semantics, config.augment.convention)


def _augment_record(config: Config) -> Any:
    section = config.augment
    masks = (section.semantics, section.convention) if augment_settings(config).needs_semantics else None
    return {"settings": plain(augment_settings(config)), "masks": masks, "seed": config.seed}


def _augment_parts(config: Config, frame: Frame) -> tuple[str, ...]:
    parts = (*lidar_parts(frame), "image_size")
    kind = mask_kind(config)
    return parts if kind is None else (*parts, *{"truth": ("semantics",), "boxes": ("labels",)}.get(kind, ("image",)))


def mask_kind(config: Config) -> str | None:
    """The kind of mask source (truth, boxes, files, network, onnx, hf) when the settings use masks."""
    used = augment_settings(config).needs_semantics and config.augment.semantics is not None
    return str(config.augment.semantics).partition(":")[0] if used else None


def _augment_files(config: Config, run: RunFolder, frame_id: str) -> tuple[Path, ...]:
    files: tuple[Path, ...] = (run.depth(frame_id), run.twin(frame_id))
    if config.augment.depth_from is not None:
        files = (Path(config.augment.depth_from) / f"{frame_id}.png",)
    if mask_kind(config) == "files":
        folder = Path(str(config.augment.semantics).partition(":")[2])
        files += (folder / f"{frame_id}.png", folder / "mask.json")
    return files


def _augment_weights(config: Config) -> tuple[Path, ...]:
    return () if mask_kind(config) is None else mask_weights(str(config.augment.semantics))


AUGMENT = FrameStage(
    prepare_augment,
    _augment_record,
    _augment_parts,
    _augment_files,
    _augment_weights,
    ("pipeline/pointcloud", "pipeline/semantics", "pipeline/geometry", "pipeline/data"),
    seconds=0.3,
    megabytes=0.8,
)
