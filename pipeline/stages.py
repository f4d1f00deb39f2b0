"""The stages, each read, call, write; and what each depends on, so that the runner redoes exactly what changed.

This file is the application's table of contents. The arithmetic is one call further: `completion.infer`,
`pipeline.pointcloud.augment`, `detection.infer`, `detection.evaluation.kitti_ap`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import DataError, UsageError
from pipeline.base.paths import RunFolder
from pipeline.base.seeds import derive_seed
from pipeline.base.settings import nearest_name, plain, with_changes
from pipeline.data import Dataset, Frame, open_dataset
from pipeline.data.depth_png import read_depth_png
from pipeline.run_folder.config import Config
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.run_folder.weights import completion_weights, detection_weights, detector_name, mask_weights

if TYPE_CHECKING:
    from completion.types import CompletedDepth
    from pipeline.pointcloud.presets import AugmentSettings
    from pipeline.semantics.sources import SemanticsSource

FrameFunction = Callable[[Frame, FrameOutputs], None]

# The order of the work; asking for a stage runs what it needs before it.
STAGES = ("synth", "train", "complete", "augment", "detect", "evaluate", "report")


@dataclass(frozen=True)
class FrameStage:
    """A stage that works on one frame at a time.

    prepare   loads networks and gives the function that reads, calls and writes
    settings  everything of the configuration its result depends on
    parts     the parts of the frame it reads
    files     the files of earlier stages (or of the user) it reads for a frame
    weights   the weight files it loads
    code      package folders whose source decides the result
    seconds   wall time of one KITTI frame on one core, for --dry-run before anything was measured
    megabytes size of what it writes for one KITTI frame
    """

    prepare: Callable[[Config], FrameFunction]
    settings: Callable[[Config], Any]
    parts: Callable[[Config, Frame], tuple[str, ...]]
    files: Callable[[Config, RunFolder, str], tuple[Path, ...]]
    weights: Callable[[Config], tuple[Path, ...]]
    code: tuple[str, ...]
    seconds: float
    megabytes: float


# --- complete: sparse depth + image -> dense depth with two surfaces


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


# --- augment: dense depth -> augmented LiDAR


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


def lidar_of(frame: Frame) -> NDArray[np.float32]:
    """(N, 4) LiDAR points; where sparse depth is stored instead (Virtual KITTI 2), its pixels back-projected."""
    if frame.has("points"):
        return frame.points
    from pipeline.geometry.back_project import back_project

    sparse = frame.sparse_depth
    points = back_project(sparse, frame.calibration, sparse > 0).points
    return np.column_stack([points, np.zeros(len(points))]).astype(np.float32)


def augment_settings(config: Config) -> AugmentSettings:
    """The preset with the changes of the configuration. Raises UsageError when they cannot be used."""
    from pipeline.pointcloud.presets import PRESETS

    section = config.augment
    if section.preset not in PRESETS:
        raise UsageError(f"augment.preset: unknown preset {section.preset!r}; {nearest_name(section.preset, PRESETS)}")
    settings = with_changes(PRESETS[section.preset], section.library, "augment", type(section).model_fields)
    if settings.needs_semantics and section.semantics is None:
        raise UsageError(
            f"augment.preset {section.preset} needs object masks: set augment.semantics to truth, boxes, files:FOLDER, "
            "network, onnx:FILE or hf:FOLDER, or choose a preset without masks (L_D_F)"
        )
    return settings


def open_masks(config: Config, settings: AugmentSettings) -> SemanticsSource | None:
    """Where the object masks come from, or None when the settings use none."""
    if not settings.needs_semantics or config.augment.semantics is None:
        return None
    from pipeline.semantics.sources import open_semantics

    return open_semantics(config.augment.semantics, config.augment.convention)


def completed_depth(config: Config, frame: Frame, files: FrameOutputs) -> CompletedDepth:
    """Completed depth of this run, or of the folder `augment.depth_from`."""
    from completion.types import CompletedDepth

    if config.augment.depth_from is None:
        return files.read_completed()
    from pipeline.pointcloud.depth_source import placed_bottom_centre

    path = Path(config.augment.depth_from) / f"{frame.id}.png"
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


def _augment_record(config: Config) -> Any:
    section = config.augment
    masks = (section.semantics, section.convention) if augment_settings(config).needs_semantics else None
    return {"settings": plain(augment_settings(config)), "masks": masks, "seed": config.seed}


def _augment_parts(config: Config, frame: Frame) -> tuple[str, ...]:
    parts = (*lidar_parts(frame), "image_size")
    kind = mask_kind(config)
    return parts if kind is None else (*parts, *{"truth": ("semantics",), "boxes": ("labels",)}.get(kind, ("image",)))


def lidar_parts(frame: Frame) -> tuple[str, ...]:
    """The parts that `lidar_of` reads."""
    return ("points" if frame.has("points") else "sparse_depth", "calibration")


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


# --- detect: cloud -> KITTI result lines


def prepare_detect(config: Config) -> FrameFunction:
    """Augmented cloud (or raw LiDAR with preset L) in, detections/ID.txt out."""
    from detection.infer import load_detector
    from detection.results import result_objects
    from detection.types import PointFrame

    detector = load_detector(detector_name(config), config.detection.device, config.seed)
    raw = uses_raw_lidar(config)

    def detect(frame: Frame, files: FrameOutputs) -> None:
        camera = frame.calibration
        points = cloud_of(config, frame, files)
        cloud = PointFrame(points, camera.T_cam_velo, camera.P2, frame.image_size, frame.id)
        files.write_detections(result_objects(detector.detect(cloud), cloud))
        if raw:
            files.remove_other_presets_cloud()

    return detect


def uses_raw_lidar(config: Config) -> bool:
    """True with preset L: the detector takes the sensor's points, and nothing is completed or augmented for it."""
    return config.augment.preset == "L" and not config.augment.library


def cloud_of(config: Config, frame: Frame, files: FrameOutputs) -> NDArray[np.float32]:
    """(N, 4 or 5 + C) float32 points for the detector, LiDAR frame."""
    return lidar_of(frame) if uses_raw_lidar(config) else files.read_cloud()


def _detect_parts(config: Config, frame: Frame) -> tuple[str, ...]:
    return (*lidar_parts(frame), "image_size") if uses_raw_lidar(config) else ("calibration", "image_size")


def _detect_files(config: Config, run: RunFolder, frame_id: str) -> tuple[Path, ...]:
    if uses_raw_lidar(config):
        return ()
    return run.cloud(frame_id), run.cloud_columns(frame_id), run.counts(frame_id)


FRAME_STAGES: dict[str, FrameStage] = {
    "complete": FrameStage(
        prepare_complete,
        lambda config: config.completion.model_dump(),
        _complete_parts,
        lambda config, run, frame_id: (),
        completion_weights,
        ("completion", "pipeline/geometry", "pipeline/data"),
        seconds=3.0,
        megabytes=1.2,
    ),
    "augment": FrameStage(
        prepare_augment,
        _augment_record,
        _augment_parts,
        _augment_files,
        _augment_weights,
        ("pipeline/pointcloud", "pipeline/semantics", "pipeline/geometry", "pipeline/data"),
        seconds=0.3,
        megabytes=0.8,
    ),
    "detect": FrameStage(
        prepare_detect,
        lambda config: {**config.detection.model_dump(), "name": detector_name(config), "seed": config.seed},
        _detect_parts,
        _detect_files,
        detection_weights,
        ("detection", "pipeline/geometry", "pipeline/data"),
        seconds=2.0,
        megabytes=0.01,
    ),
}


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


def has_points(dataset: Dataset) -> bool:
    """True when the frames of the data set come with LiDAR points, or with sparse depth and labelled objects."""
    if len(dataset) == 0:
        return True
    frame = dataset[0]
    return frame.has("points") or (frame.has("sparse_depth") and frame.has("labels"))


def data_root(config: Config, run: RunFolder) -> Path:
    """The folder frames are read from. Raises UsageError when a data set needs one and none is given."""
    if config.data.root is not None:
        return Path(config.data.root)
    if config.data.name == "synthetic":
        return run.root / "data"
    raise UsageError(f"data set {config.data.name} needs a folder: give --data DIR or data.root in the configuration")


def reader_name(config: Config) -> str:
    """The reader of the data set; synthetic data is written in a public layout and read by that layout's reader."""
    if config.data.name != "synthetic":
        return config.data.name
    layout = str(config.synth.library.get("layout", "kitti"))
    return {"kitti": "kitti_object"}.get(layout, layout)


def open_frames(config: Config, run: RunFolder) -> Dataset:
    """The frames of the run, selected by `data.frames`.

    A name like `val` finds ROOT/ImageSets/val.txt. Raises UsageError when there is no frame.
    """
    root = data_root(config, run)
    dataset = open_dataset(reader_name(config), root)
    frames = config.data.frames
    if frames is None:
        return dataset
    split = root / "ImageSets" / f"{frames}.txt"
    selected = dataset.select(split if frames.isidentifier() and split.is_file() else frames)
    if not len(selected):
        raise UsageError(f"{root}: no frame is left of {len(dataset)} by the selection {frames!r}")
    return selected
