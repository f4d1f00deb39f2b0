"""detect: cloud -> KITTI result lines."""

from __future__ import annotations

from pathlib import Path

from pipeline.base.paths import RunFolder
from pipeline.data import Frame
from pipeline.run_folder.config import Config
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.run_folder.preset import uses_raw_lidar
from pipeline.run_folder.weights import detection_weights, detector_name
from pipeline.stages.clouds import cloud_of, lidar_parts
from pipeline.stages.stage import FrameFunction, FrameStage


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


def _detect_parts(config: Config, frame: Frame) -> tuple[str, ...]:
    return (*lidar_parts(frame), "image_size") if uses_raw_lidar(config) else ("calibration", "image_size")


def _detect_files(config: Config, run: RunFolder, frame_id: str) -> tuple[Path, ...]:
    if uses_raw_lidar(config):
        return ()
    return run.cloud(frame_id), run.cloud_columns(frame_id), run.counts(frame_id)


DETECT = FrameStage(
    prepare_detect,
    lambda config: {**config.detection.model_dump(), "name": detector_name(config), "seed": config.seed},
    _detect_parts,
    _detect_files,
    detection_weights,
    ("detection", "pipeline/geometry", "pipeline/data"),
    seconds=2.0,
    megabytes=0.01,
)
