"""Virtual KITTI 2.0.3 layout: five scenes, variation `clone`, both cameras, with all text files and colour tables.

The world frame of the text files is x right, y down, z forward of the first road metre. Objects are Car, Van, Truck;
trackIDs count them from 0 in each scene. People, cyclists and clutter are Misc.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from auglidar_base.atomic import write_bytes, write_text
from detection.boxes import observation_angle
from detection.types import Boxes3D
from pipeline.data.depth_png import png_bytes
from pipeline.geometry.calibration import Calibration

if TYPE_CHECKING:
    from pipeline.simulation.labels import ObjectTruth
    from pipeline.simulation.render import View
    from pipeline.simulation.scenes.scene import Scene
    from pipeline.simulation.synth import SynthSettings

SCENES = ("Scene01", "Scene02", "Scene06", "Scene18", "Scene20")
COLORS: dict[str, tuple[int, int, int]] = {
    "Terrain": (210, 0, 200), "Sky": (90, 200, 255), "Tree": (0, 199, 0), "Vegetation": (90, 240, 0),
    "Building": (140, 140, 140), "Road": (100, 60, 100), "GuardRail": (250, 100, 255), "TrafficSign": (255, 255, 0),
    "TrafficLight": (200, 200, 0), "Pole": (255, 130, 0), "Misc": (80, 80, 80), "Truck": (160, 60, 60),
    "Car": (255, 127, 80), "Van": (0, 139, 139), "Undefined": (0, 0, 0),
}  # fmt: skip
# Category of each Cityscapes trainId; sidewalks are Terrain, as the data set has no class for them.
CATEGORIES = ("Road", "Terrain", "Building", "Building", "GuardRail", "Pole", "TrafficLight", "TrafficSign", "Tree",
              "Terrain", "Sky", "Misc", "Misc", "Car", "Truck", "Truck", "Misc", "Misc", "Misc")  # fmt: skip
VEHICLES = ("Car", "Van", "Truck")
FOCAL, CENTRE, SIZE, BASELINE = 725.0087, (620.5, 187.0), (375, 1242), 0.532725
# Road world (x forward, y left, z up) -> the text files' world (x right, y down, z forward).
_T_TEXT_WORLD = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], dtype=np.float64)

_HEADERS = {
    "bbox": "frame cameraID trackID left right top bottom number_pixels truncation_ratio occupancy_ratio isMoving",
    "pose": "frame cameraID trackID alpha width height length world_space_X world_space_Y world_space_Z "
    "rotation_world_space_y rotation_world_space_x rotation_world_space_z camera_space_X camera_space_Y "
    "camera_space_Z rotation_camera_space_y rotation_camera_space_x rotation_camera_space_z",
    "intrinsic": "frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]",
    "extrinsic": "frame cameraID r1,1 r1,2 r1,3 t1 r2,1 r2,2 r2,3 t2 r3,1 r3,2 r3,3 t3 0 0 0 1",
    "info": "trackID label model color",
    "colors": "Category r g b",
}


def scene_lengths(frames: int) -> list[int]:
    """Frames of each scene when `frames` are spread over (up to) five."""
    scenes = min(len(SCENES), frames)
    return [frames // scenes + (index < frames % scenes) for index in range(scenes)]


def vkitti_calibration(size: tuple[int, int]) -> Calibration:
    """The data set's camera (scaled to `size`) with the right one beside it; the LiDAR is nominal, only a mount."""
    scale = size[1] / SIZE[1]
    centre = ((CENTRE[0] + 0.5) * scale - 0.5, (CENTRE[1] + 0.5) * size[0] / SIZE[0] - 0.5)
    P2 = np.array([[FOCAL * scale, 0, centre[0], 0], [0, FOCAL * scale, centre[1], 0], [0, 0, 1, 0]])
    P3 = P2.copy()
    P3[0, 3] = -FOCAL * scale * BASELINE
    mount = np.array([[0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]], dtype=np.float64)
    return Calibration(P2=P2, R0_rect=np.eye(3), T_cam0_velo=mount, P3=P3)


def write_scene(root: Path, settings: SynthSettings, number: int) -> None:
    """Simulates and writes one scene: images as they come, the text files at its end."""
    from pipeline.simulation.render import render
    from pipeline.simulation.rig import LIDAR_HEIGHT
    from pipeline.simulation.sequence import FRAME_PERIOD, MAX_TRAVEL, drive_scene
    from pipeline.simulation.synth import frame_rng
    from pipeline.simulation.tracing import Tracer

    scene, length = drive_scene(settings, number), scene_lengths(settings.frames)[number]
    calibration = vkitti_calibration(settings.size or SIZE)
    tracks = [k for k, item in enumerate(scene.objects) if item.model.label in VEHICLES]
    rows: dict[str, list[str]] = {name: [] for name in ("bbox", "pose", "intrinsic", "extrinsic")}
    period = min(FRAME_PERIOD, MAX_TRAVEL / max(scene.ego.speed, 0.1) / length)
    folder = root / SCENES[number] / "clone"
    for index in range(length):
        time = index * period
        tracer = Tracer(scene.triangles(time))
        T_world_cam = scene.T_world_velo(time, LIDAR_HEIGHT) @ calibration.T_velo_cam
        noise = frame_rng(settings, (number + 1) * 10_000 + index, 2)
        for camera, P in enumerate((calibration.P2, calibration.P3)):
            if P is None:
                continue
            view = render(tracer, scene.light, P, T_world_cam, settings.size or SIZE, noise)
            write_view(folder / "frames", f"Camera_{camera}", index, view, scene, tracks)
            _append_rows(rows, scene, time, index, camera, P, T_world_cam, view, tracks)
    _write_texts(folder, rows, scene, tracks)


def write_view(frames: Path, camera: str, index: int, view: View, scene: Scene, tracks: list[int]) -> None:
    """The four images of one camera at one moment."""
    write_bytes(frames / "rgb" / camera / f"rgb_{index:05d}.jpg", _jpeg(view.image))
    centimetres = np.rint(np.minimum(view.depth.astype(np.float64) * 100, 65534))
    code = np.where(view.depth > 0, np.maximum(centimetres, 1), 65535).astype(np.uint16)
    write_bytes(frames / "depth" / camera / f"depth_{index:05d}.png", png_bytes(code))
    track = np.zeros(len(scene.objects) + 1, dtype=np.uint16)
    track[np.array(tracks, dtype=np.int64) + 1] = np.arange(1, len(tracks) + 1)
    write_bytes(frames / "classSegmentation" / camera / f"classgt_{index:05d}.png", png_bytes(class_image(view, scene)))
    write_bytes(
        frames / "instanceSegmentation" / camera / f"instancegt_{index:05d}.png", _indexed_png(track[view.instances])
    )


def class_image(view: View, scene: Scene) -> NDArray[np.uint8]:
    """(H, W, 3) RGB class colours."""
    palette = np.full((256, 3), COLORS["Misc"], dtype=np.uint8)
    palette[: len(CATEGORIES)] = [COLORS[name] for name in CATEGORIES]
    image = palette[view.semantics]
    for index, item in enumerate(scene.objects):
        label = item.model.label
        image[view.instances == index + 1] = COLORS[label if label in VEHICLES else "Misc"]
    return image


def _jpeg(image: NDArray[np.uint8]) -> bytes:
    import cv2

    done, data = cv2.imencode(".jpg", np.ascontiguousarray(image[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 95])
    if not done:
        raise ValueError(f"image of shape {image.shape} cannot be stored as JPEG")
    return bytes(data)


def _indexed_png(indices: NDArray[np.uint16]) -> bytes:
    """An indexed PNG with a palette of spread colours; raises ValueError above 255 tracks."""
    import io

    from PIL import Image

    if indices.max() > 255:
        raise ValueError(f"{int(indices.max())} tracks in one scene: an indexed PNG holds 255")
    image = Image.fromarray(indices.astype(np.uint8))
    palette = [(37 * k % 256, 91 * k % 256, 173 * k % 256) for k in range(256)]
    image.putpalette([channel for colour in palette for channel in colour])
    buffer = io.BytesIO()
    image.save(buffer, format="PNG")
    return buffer.getvalue()


def _append_rows(
    rows: dict[str, list[str]], scene: Scene, time: float, index: int, camera: int, P: NDArray[np.float64],
    T_world_cam: NDArray[np.float64], view: View, tracks: list[int],
) -> None:  # fmt: skip
    """The text rows of one camera at one moment."""
    from pipeline.simulation.labels import measure

    T_cam_world = np.asarray(np.linalg.inv(T_world_cam), dtype=np.float64)
    T_cam_world[0, 3] += P[0, 3] / P[0, 0]
    own = P.copy()
    own[:, 3] = 0
    rows["intrinsic"].append(f"{index} {camera} {P[0, 0]:.7g} {P[1, 1]:.7g} {P[0, 2]:.7g} {P[1, 2]:.7g}")
    T_cam_text = T_cam_world @ _T_TEXT_WORLD.T
    rows["extrinsic"].append(f"{index} {camera} " + " ".join(f"{value:.9g}" for value in T_cam_text.ravel()))
    for truth in measure(scene, time, own, T_cam_world, view.instances):
        if truth.instance - 1 in tracks and truth.visible_pixels > 0:
            track = tracks.index(truth.instance - 1)
            mask = view.instances == truth.instance
            rows["bbox"].append(f"{index} {camera} {track} " + _bbox_row(truth, mask))
            T_text_object = _T_TEXT_WORLD @ scene.objects[truth.instance - 1].pose(scene.ground, time)
            rows["pose"].append(f"{index} {camera} {track} " + _pose_row(truth, T_text_object))


def _bbox_row(truth: ObjectTruth, mask: NDArray[np.bool_]) -> str:
    """left right top bottom of the visible pixels (inclusive), their number, truncation, fill of the box, motion."""
    v, u = np.nonzero(mask)
    left, right, top, bottom = int(u.min()), int(u.max()), int(v.min()), int(v.max())
    fill = min(1.0, len(u) / max((right - left) * (bottom - top), 1))
    moving = abs(truth.speed) > 0.05
    return f"{left} {right} {top} {bottom} {len(u)} {truth.truncation:.7g} {fill:.7g} {moving}"


def _pose_row(truth: ObjectTruth, T_text_object: NDArray[np.float64]) -> str:
    """alpha, sizes (width height length), then position and rotations (y x z) in the world and in the camera."""
    x, y, z, height, width, length, ry = truth.box
    alpha = float(observation_angle(Boxes3D(truth.box[None]))[0])
    heading = T_text_object[:3, 0]
    turn = np.arctan2(-heading[2], heading[0])
    numbers = [alpha, width, height, length, *T_text_object[:3, 3], turn, 0.0, 0.0, x, y, z, ry, 0.0, 0.0]
    return " ".join(f"{value:.7g}" for value in numbers)


def _write_texts(folder: Path, rows: dict[str, list[str]], scene: Scene, tracks: list[int]) -> None:
    texts = dict(rows)
    labels = [scene.objects[k].model.label for k in tracks]
    texts["info"] = [f"{track} {label} Synthetic{label}{track} Mixed" for track, label in enumerate(labels)]
    texts["colors"] = [f"{name} {red} {green} {blue}" for name, (red, green, blue) in COLORS.items()]
    for name, lines in texts.items():
        write_text(folder / f"{name}.txt", "\n".join([_HEADERS[name], *lines]) + "\n")
