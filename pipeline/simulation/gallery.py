"""Pictures of the synthetic world: image, dense depth, classes and the scan from above.

Command:  python -m pipeline.simulation.gallery --frames 12 --seed 40 --out docs/images
writes synthetic_scenes_1.jpg, ... with four frames each.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from detection.boxes import corners
from detection.kitti_format import boxes_of
from pipeline.simulation.synth import SyntheticFrame, SynthSettings, simulate_frame

Picture = NDArray[np.uint8]

# Cityscapes' own class colours by trainId.
CLASS_COLOURS = np.array(
    [
        (128, 64, 128), (244, 35, 232), (70, 70, 70), (102, 102, 156), (190, 153, 153), (153, 153, 153),
        (250, 170, 30), (220, 220, 0), (107, 142, 35), (152, 251, 152), (70, 130, 180), (220, 20, 60), (255, 0, 0),
        (0, 0, 142), (0, 0, 70), (0, 60, 100), (0, 80, 100), (0, 0, 230), (119, 11, 32),
    ],
    dtype=np.uint8,
)  # fmt: skip


def colour_depth(depth: NDArray[np.float32]) -> Picture:
    """(H, W, 3) RGB: near is warm, far is cold, black has no value; linear in the inverse of depth."""
    import cv2

    near = np.sqrt(np.clip(4.0 / np.maximum(depth, 4.0), 0, 1))
    coloured = cv2.applyColorMap((near * 255).astype(np.uint8), cv2.COLORMAP_TURBO)[:, :, ::-1]
    return np.where(depth[..., None] > 0, coloured, 0).astype(np.uint8)


def colour_classes(semantics: NDArray[np.uint8]) -> Picture:
    """(H, W, 3) RGB in Cityscapes' colours, black for 255."""
    table = np.zeros((256, 3), dtype=np.uint8)
    table[: len(CLASS_COLOURS)] = CLASS_COLOURS
    return table[semantics]


def from_above(frame: SyntheticFrame, size: tuple[int, int], reach: float = 60.0) -> Picture:
    """(H, W, 3) the scan ahead seen from above: brighter is higher, labelled boxes red, forward to the right."""
    import cv2

    height, width = size
    picture = np.full((height, width, 3), 16, dtype=np.uint8)
    scale = width / reach
    x, y, z = frame.points[:, 0] * scale, height / 2 - frame.points[:, 1] * scale, frame.points[:, 2]
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    shade = np.clip(90 + 55 * (z[inside] + 1.7), 60, 255).astype(np.uint8)
    picture[y[inside].astype(int), x[inside].astype(int)] = shade[:, None]
    labelled = [item for item in frame.labels if item.type != "DontCare"]
    for face in corners(boxes_of(labelled))[:, :4] if labelled else []:
        outline = frame.calibration.cam_to_velo(face) * scale
        points = np.stack([outline[:, 0], height / 2 - outline[:, 1]], axis=-1)
        cv2.polylines(picture, [np.rint(points).astype(np.int32)], True, (255, 70, 60), 1, cv2.LINE_AA)
    return picture


def tile(frame: SyntheticFrame, width: int = 620) -> Picture:
    """One frame as a picture of twice `width`: image and depth above, classes and the view from above below."""
    import cv2

    height = round(width * frame.depth.shape[0] / frame.depth.shape[1])
    shrunk = [
        cv2.resize(picture, (width, height), interpolation=how)
        for picture, how in (
            (frame.image, cv2.INTER_AREA),
            (colour_depth(frame.depth), cv2.INTER_NEAREST),
            (colour_classes(frame.semantics), cv2.INTER_NEAREST),
        )
    ]
    above = from_above(frame, (height, width))
    return np.vstack([np.hstack(shrunk[:2]), np.hstack([shrunk[2], above])]).astype(np.uint8)


def main(arguments: list[str] | None = None) -> int:
    """Command line; see the module's text."""
    import cv2

    parser = argparse.ArgumentParser(prog="python -m pipeline.simulation.gallery", description=__doc__)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--seed", type=int, default=40)
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    settings = SynthSettings(frames=options.frames, seed=options.seed, size=(375, 1242))
    for page, first in enumerate(range(0, options.frames, 4), start=1):
        tiles = [tile(simulate_frame(settings, k)) for k in range(first, min(first + 4, options.frames))]
        path = options.out / f"synthetic_scenes_{page}.jpg"
        cv2.imwrite(str(path), np.vstack(tiles)[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])
        print(path)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
