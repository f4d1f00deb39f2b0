"""A tiny Virtual KITTI 2 tree written from the format page alone (no code of the project): two cars, two cameras."""

from __future__ import annotations

import zlib
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

HEIGHT, WIDTH = 375, 1242
FOCAL, CX, CY = 725.0087, 620.5, 187.0
# track, label, location of the bottom centre in camera 0, width height length, ry
CARS = ((0, "Car", (-2.0, 1.5, 12.0), (1.6, 1.5, 4.0), -1.57), (3, "Van", (3.0, 1.6, 20.0), (1.9, 2.2, 5.0), 0.4))
BASELINE = 0.532725


def rectangle(location: tuple[float, float, float], size: tuple[float, float, float], ry: float) -> list[int]:
    """left right top bottom of the projected cuboid, inclusive pixels."""
    width, height, length = size
    pixels = []
    for along in (-length / 2, length / 2):
        for across in (-width / 2, width / 2):
            for up in (0, height):
                x = location[0] + along * np.cos(ry) + across * np.sin(ry)
                z = location[2] - along * np.sin(ry) + across * np.cos(ry)
                pixels.append((FOCAL * x / z + CX, FOCAL * (location[1] - up) / z + CY))
    u, v = np.array(pixels).T
    return [int(np.ceil(u.min())), int(np.floor(u.max())), int(np.ceil(v.min())), int(np.floor(v.max()))]


def write_tree(root: Path, scene: str, frames: int, variation: str = "clone") -> Path:
    """ROOT/SCENE/VARIATION with `frames` frames of both cameras; the cars come 1 m nearer per frame."""
    folder = root / scene / variation
    rows: dict[str, list[str]] = {name: [] for name in ("bbox", "pose", "intrinsic", "extrinsic")}
    for frame in range(frames):
        for camera in (0, 1):
            _write_images(folder, frame, camera, rows)
            rows["intrinsic"].append(f"{frame} {camera} {FOCAL} {FOCAL} {CX} {CY}")
            pose = np.eye(4)
            pose[0, 3], pose[2, 3] = -BASELINE * camera, -float(frame)
            rows["extrinsic"].append(f"{frame} {camera} " + " ".join(str(v) for v in pose.ravel()))
    heads = {
        "bbox": "frame cameraID trackID left right top bottom number_pixels truncation_ratio occupancy_ratio isMoving",
        "pose": "frame cameraID trackID alpha width height length world_space_X world_space_Y world_space_Z "
        "rotation_world_space_y rotation_world_space_x rotation_world_space_z camera_space_X camera_space_Y "
        "camera_space_Z rotation_camera_space_y rotation_camera_space_x rotation_camera_space_z",
        "intrinsic": "frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]",
        "extrinsic": "frame cameraID r1,1 r1,2 r1,3 t1 r2,1 r2,2 r2,3 t2 r3,1 r3,2 r3,3 t3 0 0 0 1",
    }
    for name, head in heads.items():
        (folder / f"{name}.txt").write_text("\n".join([head, *rows[name]]) + "\n")
    info = ["trackID label model color", *(f"{track} {label} Model_{track} Red" for track, label, *_ in CARS)]
    (folder / "info.txt").write_text("\n".join(info) + "\n")
    colors = ["Category r g b", "Sky 90 200 255", "Road 100 60 100", "Car 255 127 80", "Van 0 139 139"]
    (folder / "colors.txt").write_text("\n".join(colors) + "\n")
    return root


def _write_images(folder: Path, frame: int, camera: int, rows: dict[str, list[str]]) -> None:
    seed = zlib.crc32(f"{folder.parent.name}/{folder.name}/{frame}/{camera}".encode())
    rgb = np.random.default_rng(seed).integers(100, 150, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    depth = np.full((HEIGHT, WIDTH), 65535, np.uint16)
    depth[200:] = 3000
    classes = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    classes[:200], classes[200:] = (90, 200, 255), (100, 60, 100)
    tracks = np.zeros((HEIGHT, WIDTH), np.uint8)
    for track, label, location, size, ry in CARS:
        place = (location[0] - BASELINE * camera, location[1], location[2] - frame)
        left, right, top, bottom = rectangle(place, size, ry)
        window = np.s_[top : bottom + 1, left : right + 1]
        depth[window] = round(100 * place[2])
        classes[window] = (255, 127, 80) if label == "Car" else (0, 139, 139)
        # The silhouette fills 3/4 of its rectangle.
        rows_filled = round(0.75 * (bottom - top + 1))
        tracks[bottom + 1 - rows_filled : bottom + 1, left : right + 1] = track + 1
        pixels = int((tracks == track + 1).sum())
        fill = pixels / ((right - left) * (bottom - top))
        key = f"{frame} {camera} {track}"
        rows["bbox"].append(f"{key} {left} {right} {top} {bottom} {pixels} 0 {fill:.7f} False")
        alpha = ry - np.arctan2(place[0], place[2])
        sizes, where = " ".join(map(str, size)), " ".join(str(v) for v in place)
        rows["pose"].append(f"{key} {alpha:.6f} {sizes} {where} {ry} 0 0 {where} {ry} 0 0")
    for part, name, pixels_bgr in (("rgb", f"rgb_{frame:05d}.jpg", rgb), ("depth", f"depth_{frame:05d}.png", depth),
                                   ("classSegmentation", f"classgt_{frame:05d}.png", classes[..., ::-1])):  # fmt: skip
        path = folder / "frames" / part / f"Camera_{camera}" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), pixels_bgr)
    path = folder / "frames" / "instanceSegmentation" / f"Camera_{camera}" / f"instancegt_{frame:05d}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    indexed = Image.fromarray(tracks)
    indexed.putpalette([value for i in range(256) for value in (i, 255 - i, (7 * i) % 256)])
    indexed.save(path)
