"""detect: cloud -> KITTI result lines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from pipeline.data.frame import Frame
from pipeline.run_folder.config import Config
from pipeline.run_folder.detectors import open_detector
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.run_folder.preset import uses_raw_lidar
from pipeline.run_folder.weights import detection_weights, detector_name
from pipeline.stages.clouds import cloud_of, lidar_parts
from pipeline.stages.stage import FRAME_CODE, FrameStage, Work


@dataclass(frozen=True)
class DetectStage(FrameStage):
    """Augmented cloud (or raw LiDAR with preset L) in, detections/ID.txt out.

    detector   weights by name or file
    device     as `detection.infer.load_detector` takes it
    options    keyword arguments of a class of one's own
    raw_lidar  the sensor's points instead of the augmented cloud
    seed       of the run
    """

    detector: str
    device: str
    raw_lidar: bool
    seed: int
    options: Mapping[str, Any] = field(default_factory=dict)

    code: ClassVar = (
        "detection",
        "completion/types.py",
        "auglidar_base/torch_pickle.py",
        "pipeline/run_folder/detectors.py",
        "pipeline/run_folder/own_methods.py",
        *FRAME_CODE,
    )
    seconds: ClassVar = 2.0
    megabytes: ClassVar = 0.01

    @classmethod
    def of(cls, config: Config) -> DetectStage:
        """The detection section, and what the detector sees."""
        section = config.detection
        return cls(detector_name(config), section.device, uses_raw_lidar(config), config.seed, section.options)

    def parts(self, frame: Frame) -> tuple[str, ...]:
        """The camera, and the LiDAR when the detector takes that."""
        camera = "calibration", *frame.sources("image_size")
        return (*lidar_parts(frame), *camera) if self.raw_lidar else camera

    def reads(self) -> tuple[str, ...]:
        """The augmented cloud."""
        return () if self.raw_lidar else ("cloud", "counts", "cloud_columns")

    def weights(self) -> tuple[Path, ...]:
        """Network and card; the source of a class of one's own."""
        return detection_weights(self.detector, self.options)

    def writes(self) -> tuple[str, ...]:
        """KITTI result lines."""
        return ("detections",)

    def removes(self) -> tuple[str, ...]:
        """With raw LiDAR a cloud of another preset: report and exports would take it for what the detector saw."""
        return ("cloud", "cloud_columns", "counts") if self.raw_lidar else ()

    def open(self) -> Work:
        """Loads the detector."""
        from detection.results import result_objects
        from detection.types import PointFrame

        detector = open_detector(self.detector, self.device, self.seed, self.options)

        def detect(frame: Frame, files: FrameOutputs) -> None:
            camera = frame.calibration
            points = cloud_of(self.raw_lidar, frame, files)
            cloud = PointFrame(points, camera.T_cam_velo, camera.P2, frame.image_size, frame.id)
            files.write_detections(result_objects(detector.detect(cloud), cloud))
            if self.raw_lidar:
                files.remove_other_presets_cloud()

        return detect
