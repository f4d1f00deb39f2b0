"""The faults that the doctor knows by name, and one finding of one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Fault:
    """A kind of fault.

    tier   0 files, 1 contents of one part, 2 parts of different frames, 3 parts that disagree. A finding is left out
           when the same frame has one of a lower tier about the same part: the deeper cause is the one to repair.
    parts  parts of a frame that it concerns
    advice what to do
    """

    tier: int
    parts: frozenset[str]
    advice: str


def _fault(tier: int, parts: str, advice: str) -> Fault:
    return Fault(tier, frozenset(parts.split()), advice)


FAULTS: dict[str, Fault] = {
    # files
    "missing_file": _fault(0, "file", "copy the file from the data set, or leave the frame out with a split file"),
    "extra_file": _fault(0, "file", "remove it, or add the frame's other files"),
    "empty_file": _fault(0, "file", "the disk was full or a job was killed: write it again"),
    "truncated_file": _fault(0, "file", "copy or download it again"),
    "unreadable_file": _fault(0, "file", "see the message"),
    "eight_bit_depth": _fault(0, "depth", "store 16-bit PNG, metres x 256; 8-bit files lose the depth for good"),
    "truncated_cloud": _fault(0, "points", "copy or download it again; a KITTI cloud is whole rows of 16 bytes"),
    "wrong_columns": _fault(0, "points", "write the columns and the dtype that the format's loader reads"),
    "label_result_mixup": _fault(0, "labels", "labels have 15 columns, results 16 (score last): swap the folders back"),
    "malformed_labels": _fault(0, "labels", "see the message"),
    "resized_image": _fault(0, "image calibration labels", "scale the rows 1 and 2 of P2 with the image"),
    "old_info_format": _fault(0, "infos", "mmdetection3d 1.1 and later want {metainfo, data_list}: export again"),
    "split_overlap": _fault(0, "splits", "a frame belongs to train or to val, not to both"),
    # contents of one part
    "wrong_calibration_family": _fault(1, "calibration", "use the object benchmark's calibration of this frame"),
    "calibration_not_rigid": _fault(
        1, "calibration", "rotations must be orthonormal with determinant 1: copy it again"
    ),
    "non_finite_points": _fault(1, "points", "drop points with NaN, infinite or absurd values"),
    "cloud_in_millimetres": _fault(1, "points", "divide coordinates by 1000"),
    "axis_order": _fault(1, "points", "KITTI clouds are x forward, y left, z up"),
    "zero_returns": _fault(1, "points", "drop the points 0 0 0: pulses that did not come back"),
    "float16_loss": _fault(1, "points", "keep float32: float16 rounds by up to 3 cm beyond 64 m"),
    "intensity_scale": _fault(1, "points", "divide intensity by 255 (or by 100): KITTI stores 0..1"),
    "source_flag_swapped": _fault(1, "points", "VirConv wants 2 for measured rows (first) and 1 for virtual rows"),
    "colour_scale": _fault(1, "colour", "SFD stores colours 0..255, VirConv a third of that"),
    "rgb_bgr_swap": _fault(1, "image colour", "OpenCV loads BGR: reverse the last axis before saving or using it"),
    "swapped_dimensions": _fault(1, "labels", "KITTI lines hold height, width, length in this order"),
    "degrees_not_radians": _fault(1, "labels", "multiply by pi / 180: angles are in radians"),
    "yaw_sign": _fault(1, "labels", "ry turns about the camera's y axis, which points down: negate it"),
    "label_unit": _fault(1, "labels", "sizes and locations are in metres"),
    "labels_in_lidar_frame": _fault(1, "labels", "KITTI's locations are those of the rectified camera"),
    "unknown_class": _fault(1, "labels", "use KITTI's class names (Car, Van, Truck, Pedestrian, ...)"),
    "label_outside_image": _fault(1, "labels", "boxes belong to another image size or crop"),
    "far_plane_as_depth": _fault(1, "depth", "65535 is sky in Virtual KITTI 2: write 0 (no value) instead"),
    "infos_disagree": _fault(1, "infos", "make the info files again from these folders"),
    # parts of different frames
    "duplicated_frame": _fault(2, "frame", "remove one of the two"),
    "index_offset": _fault(2, "image points labels depth", "files are named by another index: rename them by frame id"),
    "other_rigs_calibration": _fault(2, "calibration", "use the calibration of the frame's own recording day"),
    # parts that disagree
    "wrong_crop": _fault(
        3, "depth image", "undo the crop: KITTI's is bottom-centre, top = H - 352, left = (W - 1216) / 2"
    ),
    "shifted_cloud": _fault(3, "points labels", "the origin is the LiDAR, not the ground below it"),
    "depth_unit": _fault(3, "depth", "KITTI depth is metres x 256; NYU is millimetres, Virtual KITTI 2 centimetres"),
    "depth_is_range": _fault(3, "depth", "store z along the optical axis, not the distance to the camera"),
    "depth_disagrees_with_lidar": _fault(3, "depth points", "was the network's checkpoint loaded (random weights)?"),
    "points_disagree_with_pixels": _fault(
        3, "points image", "virtual points, their pixels and this image do not belong together"
    ),
    "wrong_extrinsics": _fault(3, "calibration points", "Tr_velo_to_cam maps LiDAR to camera: is it inverted?"),
    "labels_disagree_with_cloud": _fault(3, "labels points", "labels, calibration and cloud are of different frames"),
}


@dataclass(frozen=True)
class Finding:
    """One fault in one place: its name, the frame ("" for the whole folder), the file or folder, and what is seen."""

    fault: str
    frame: str
    where: str
    message: str

    def __post_init__(self) -> None:
        if self.fault not in FAULTS:
            raise ValueError(f"unknown fault {self.fault!r}")

    def as_dict(self) -> dict[str, str]:
        """For JSON, with the fault's advice."""
        return {**asdict(self), "advice": FAULTS[self.fault].advice}


def causes(findings: Iterable[Finding]) -> list[Finding]:
    """The findings without those that a deeper one of the same frame explains, and without repetitions, in order."""
    unique = list(dict.fromkeys(findings))
    by_frame: dict[str, list[Fault]] = {}
    for finding in unique:
        by_frame.setdefault(finding.frame, []).append(FAULTS[finding.fault])
    return [finding for finding in unique if not _explained(FAULTS[finding.fault], by_frame[finding.frame])]


def _explained(fault: Fault, others: list[Fault]) -> bool:
    """True when another fault lies deeper and concerns the same part ("file" and "frame" concern every part)."""
    for other in others:
        whole = other.parts & {"file", "frame"}
        if other.tier < fault.tier and (whole or other.parts & fault.parts):
            return True
    return False
