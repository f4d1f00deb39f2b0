"""augment: dense depth -> augmented LiDAR."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from pipeline.base.seeds import derive_seed
from pipeline.data.frame import Frame
from pipeline.run_folder.config import Config
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.run_folder.preset import augment_settings
from pipeline.run_folder.weights import mask_weights
from pipeline.stages.clouds import lidar_of, lidar_parts
from pipeline.stages.completed import completed_depth, with_sigma
from pipeline.stages.stage import FRAME_CODE, FrameStage, Work

if TYPE_CHECKING:
    from pipeline.pointcloud.presets import AugmentSettings


@dataclass(frozen=True)
class AugmentStage(FrameStage):
    """Completed depth, raw LiDAR and masks in, cloud/ID.bin out.

    cloud       what goes into the cloud
    masks       source of object masks, as `pipeline.semantics.sources` takes it; None when `cloud` needs none
    convention  label convention of the masks, when there are some
    depth_from  folder of depth maps used instead of this run's completed depth
    compare     refuse maps of that folder that do not fit the LiDAR
    seed        of the run
    """

    cloud: AugmentSettings
    masks: str | None
    convention: str | None
    depth_from: str | None
    compare: bool
    seed: int

    code: ClassVar = (
        "completion/types.py",
        "pipeline/pointcloud",
        "pipeline/semantics",
        "pipeline/base/seeds.py",
        *FRAME_CODE,
    )
    seconds: ClassVar = 0.3
    megabytes: ClassVar = 0.8

    @classmethod
    def of(cls, config: Config) -> AugmentStage:
        """The augment section; what it says of masks counts only when some are needed."""
        section, cloud = config.augment, augment_settings(config)
        masks, convention = (section.semantics, section.convention) if cloud.needs_semantics else (None, None)
        return cls(cloud, masks, convention, section.depth_from, section.check_depth, config.seed)

    @property
    def mask_kind(self) -> str | None:
        """The kind of mask source: truth, boxes, files, network, soft, onnx, hf; None without masks."""
        return None if self.masks is None else self.masks.partition(":")[0]

    def parts(self, frame: Frame) -> tuple[str, ...]:
        """The LiDAR, and what masks and depth maps from elsewhere are made of or checked against."""
        size, image = frame.sources("image_size"), ("image",)
        of_masks = {None: (), "truth": ("semantics",), "boxes": ("labels", *size), "files": size}.get(
            self.mask_kind, image
        )
        compared = ("sparse_depth", *frame.sources("sparse_depth")) if self.compare else ()
        return *lidar_parts(frame), *of_masks, *((*size, *compared) if self.depth_from is not None else ())

    def reads(self) -> tuple[str, ...]:
        """This run's completed depth."""
        return ("depth", "twin") if self.depth_from is None else ()

    def user_files(self, frame_id: str) -> tuple[Path, ...]:
        """Depth and mask of the frame in the user's folders."""
        files = () if self.depth_from is None else (Path(self.depth_from) / f"{frame_id}.png",)
        if self.mask_kind != "files":
            return files
        folder = Path(str(self.masks).partition(":")[2])
        return *files, folder / f"{frame_id}.png", folder / "mask.json"

    def weights(self) -> tuple[Path, ...]:
        """Files of the segmentation model."""
        return () if self.masks is None else mask_weights(self.masks)

    def writes(self) -> tuple[str, ...]:
        """Points, counts of the steps, and further columns when the cloud has some."""
        return ("cloud", "counts", "cloud_columns") if self.cloud.columns else ("cloud", "counts")

    def removes(self) -> tuple[str, ...]:
        """Columns of another preset."""
        return () if self.cloud.columns else ("cloud_columns",)

    def open(self) -> Work:
        """Opens the source of masks."""
        from pipeline.pointcloud.augment import augment_frame
        from pipeline.semantics.sources import open_semantics

        source = None if self.masks is None else open_semantics(self.masks, self.convention)

        def augment(frame: Frame, files: FrameOutputs) -> None:
            completed = with_sigma(completed_depth(self.depth_from, self.compare, frame, files), self.cloud)
            semantics = source.semantics(frame) if source is not None else None
            seed = derive_seed(self.seed, frame.id, "augment")
            files.write_cloud(augment_frame(completed, lidar_of(frame), frame.calibration, self.cloud, semantics, seed))

        return augment
