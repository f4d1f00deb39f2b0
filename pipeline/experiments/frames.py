"""Frames of the completion experiments: made or read once per experiment folder, kept small, held in memory.

OUT/data/completion-KEY/{train,test}/ID.npz. Of every frame: the image, the sparse map at 64, 32, 16 and 8 rows, exact
(clean) and semi-dense ground truth where a LiDAR measures, and which pixels belong to foreground objects.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import UsageError
from pipeline.experiments.budgets import CompletionBudget
from pipeline.runner.atomic import write_bytes

if TYPE_CHECKING:
    from pipeline.data import Dataset

ROWS = (64, 32, 16, 8)
# Table 4.2: pole, wall, fence, traffic sign and light, person, vehicle (Cityscapes trainIds).
FOREGROUND = (3, 4, 5, 6, 7, 11, 12, 13, 14, 15, 16, 17, 18)
SCANS_ASIDE = 2  # the pseudo ground truth joins this many scans before and after (Uhrig et al.: 5)
AZIMUTH_STEP = 0.36  # degrees; twice the usual step suits images of half the usual size


@dataclass(frozen=True, eq=False)
class StoredFrame:
    """Maps (H, W); depths float32 metres, 0 = none.

    sparse      by LiDAR rows; without points only 64
    clean       exact depth, semi_dense: pseudo ground truth (None when the data set has only one kind: `clean`)
    foreground  bool, None without class maps
    """

    image: NDArray[np.uint8]
    sparse: dict[int, NDArray[np.float32]]
    clean: NDArray[np.float32]
    semi_dense: NDArray[np.float32] | None = None
    foreground: NDArray[np.bool_] | None = None


def _pack(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Metres as KITTI stores them: x 256."""
    return np.round(np.clip(depth, 0, 255.99) * 256).astype(np.uint16)


def _unpack(stored: NDArray[np.uint16]) -> NDArray[np.float32]:
    return stored.astype(np.float32) / np.float32(256)


def store(frame: StoredFrame, path: Path) -> None:
    """Writes a frame atomically."""
    parts: dict[str, Any] = {"image": frame.image, "clean": _pack(frame.clean)}
    parts |= {f"sparse_{rows}": _pack(depth) for rows, depth in frame.sparse.items()}
    if frame.semi_dense is not None:
        parts["semi_dense"] = _pack(frame.semi_dense)
    if frame.foreground is not None:
        parts["foreground"] = frame.foreground
    buffer = io.BytesIO()
    np.savez(buffer, **parts)
    write_bytes(path, buffer.getvalue())


def load(path: Path) -> StoredFrame:
    """Reads what `store` wrote."""
    with np.load(path) as parts:
        sparse = {rows: _unpack(parts[f"sparse_{rows}"]) for rows in ROWS if f"sparse_{rows}" in parts}
        semi_dense = _unpack(parts["semi_dense"]) if "semi_dense" in parts else None
        foreground = parts.get("foreground")
        return StoredFrame(parts["image"], sparse, _unpack(parts["clean"]), semi_dense, foreground)


def _fields(budget: CompletionBudget) -> dict[str, Any]:
    names = ("train_frames", "test_frames", "size", "test_rows", "test_columns", "data_seed")
    return {name: getattr(budget, name) for name in names}


def identity(data: Path | None, budget: CompletionBudget) -> dict[str, Any]:
    """What determines the frames: the budget's numbers, and the user's data set by name and ids."""
    if data is None:
        return {"synthetic": _fields(budget)}
    dataset = open_any(data)
    ids = hashlib.sha256("\n".join(dataset.ids).encode()).hexdigest()
    return {"name": dataset.name, "ids": ids, **_fields(budget)}


def open_any(root: Path) -> Dataset:
    """The data set in a folder, recognised by its folders. UsageError when it is none that has true depth."""
    from pipeline.data import open_dataset

    signs = {"kitti_depth": "data_depth_annotated", "kitti_object": "training/depth_2", "vkitti2": "Scene20"}
    for name, sign in signs.items():
        if (root / sign).is_dir():
            return open_dataset(name, root)
    if any(root.glob("*.mat")) or any(root.rglob("*.h5")):
        return open_dataset("nyuv2", root)
    raise UsageError(
        f"{root}: expected a data set with true depth (KITTI depth completion with data_depth_annotated/, KITTI object "
        "with training/depth_2/, Virtual KITTI 2 with Scene20/, or NYU Depth v2), found none of them"
    )


def folder_of(out: Path, data: Path | None, budget: CompletionBudget) -> Path:
    """OUT/data/completion-KEY."""
    text = json.dumps(identity(data, budget), sort_keys=True)
    return out / "data" / f"completion-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


def ensure_frames(
    out: Path, data: Path | None, budget: CompletionBudget, say: Callable[[str], None]
) -> tuple[list[Path], list[Path]]:
    """Training and test files; those that are missing are made (a killed preparation continues)."""
    folder = folder_of(out, data, budget)
    makers = _synthetic(budget) if data is None else _read(open_any(data), budget)
    paths: dict[str, list[Path]] = {"train": [], "test": []}
    made = 0
    for split, name, make in makers:
        path = folder / split / f"{name}.npz"
        paths[split].append(path)
        if not path.is_file():
            store(_cut(make(), budget), path)
            made += 1
            if made % 20 == 0:
                say(f"  {made} frames made")
    return paths["train"], paths["test"]


def _cut(frame: StoredFrame, budget: CompletionBudget) -> StoredFrame:
    """The bottom rows and centred columns that the budget uses; truth only where the full scan says something."""
    from completion.diagnostics import measured_region
    from completion.types import DepthFrame

    def measured(target: NDArray[np.float32]) -> NDArray[np.float32]:
        return measured_region(DepthFrame(frame.image, frame.sparse[64], target))

    semi_dense = None if frame.semi_dense is None else measured(frame.semi_dense)
    whole = replace(frame, clean=measured(frame.clean), semi_dense=semi_dense)
    height, width = frame.clean.shape
    top = max(0, height - budget.test_rows) if budget.test_rows else 0
    left = max(0, width - budget.test_columns) // 2 if budget.test_columns else 0
    area = (slice(top, None), slice(left, left + (budget.test_columns or width)))
    return StoredFrame(
        whole.image[area],
        {rows: depth[area] for rows, depth in whole.sparse.items()},
        whole.clean[area],
        None if whole.semi_dense is None else whole.semi_dense[area],
        None if whole.foreground is None else whole.foreground[area],
    )


Maker = tuple[str, str, Callable[[], StoredFrame]]


def _synthetic(budget: CompletionBudget) -> Iterator[Maker]:
    for index in range(budget.train_frames + budget.test_frames):
        split = "train" if index < budget.train_frames else "test"
        yield split, f"{index:06d}", partial(simulate, budget, index)


def simulate(budget: CompletionBudget, index: int) -> StoredFrame:
    """Street `index` of the synthetic world with clean depth and pseudo ground truth."""
    from pipeline.data.projection import project_points
    from pipeline.simulation.lidar import scan, sensor
    from pipeline.simulation.lidar_rows import split_rings
    from pipeline.simulation.render import render
    from pipeline.simulation.rig import LIDAR_HEIGHT, draw_rig
    from pipeline.simulation.scenes.layouts import draw_scene
    from pipeline.simulation.semi_dense import semi_dense, stereo_depth
    from pipeline.simulation.sequence import FRAME_PERIOD
    from pipeline.simulation.synth import SynthSettings, frame_rng
    from pipeline.simulation.tracing import Tracer

    settings = SynthSettings(seed=budget.data_seed, size=budget.size)
    scene = draw_scene(frame_rng(settings, index, 0), settings.streets)
    scene = replace(scene, ego=replace(scene.ego, speed=min(scene.ego.speed, 12.0)))
    calibration, size = draw_rig(frame_rng(settings, index, 1), settings.size)
    beams = sensor(64) if budget.size is None else replace(sensor(64), azimuth_step=AZIMUTH_STEP)
    scans, poses = [], []
    for number in range(2 * SCANS_ASIDE + 1):
        time = number * FRAME_PERIOD
        tracer = Tracer(scene.triangles(time))
        poses.append(np.asarray(scene.T_world_velo(time, LIDAR_HEIGHT), np.float64))
        scans.append(scan(tracer, beams, poses[-1], frame_rng(settings, index, 10 + number)))
        if number == SCANS_ASIDE:
            camera = frame_rng(settings, index, 2)
            views = [
                render(tracer, scene.light, matrix, poses[-1] @ calibration.T_velo_cam, size, camera)
                for matrix in (calibration.P2, calibration.P3)
                if matrix is not None
            ]
    left, right = views
    stereo = stereo_depth(left.image, right.image, float(calibration.P2[0, 0]))
    noisy = semi_dense(scans, poses, SCANS_ASIDE, stereo, calibration, frame_rng(settings, index, 7))
    points = scans[SCANS_ASIDE]
    ring = split_rings(points)
    sparse = {rows: project_points(points[ring % (64 // rows) == 0], calibration, size) for rows in ROWS}
    return StoredFrame(left.image, sparse, left.depth, noisy, np.isin(left.semantics, FOREGROUND))


def _read(dataset: Dataset, budget: CompletionBudget) -> Iterator[Maker]:
    """Training frames from the first three quarters of a data set, test frames from the last, evenly spaced."""
    border = max(1, 3 * len(dataset) // 4)
    parts = {"train": (dataset.ids[:border], budget.train_frames), "test": (dataset.ids[border:], budget.test_frames)}
    for split, (ids, count) in parts.items():
        if not ids:
            raise UsageError(f"{dataset.root}: expected at least 2 frames to train and test on, got {len(dataset)}")
        for position in np.unique(np.linspace(0, len(ids) - 1, min(count, len(ids))).astype(int)):
            name = ids[position].replace("/", "_")
            yield split, name, partial(read_frame, dataset, ids[position])


def read_frame(dataset: Dataset, frame_id: str) -> StoredFrame:
    """A frame of the user's data set; fewer rows only where it has points."""
    from pipeline.data.projection import project_points
    from pipeline.simulation.lidar_rows import split_rings

    frame = dataset[frame_id]
    if not frame.has("target_depth"):
        raise UsageError(f"{dataset.root}: frame {frame_id} has no true depth")
    sparse = {64: frame.sparse_depth}
    if frame.has("points") and frame.has("calibration"):
        points = frame.points
        ring = split_rings(points)
        sparse |= {
            rows: project_points(points[ring % (64 // rows) == 0], frame.calibration, frame.image_size)
            for rows in ROWS[1:]
        }
    foreground = np.isin(frame.semantics, FOREGROUND) if frame.has("semantics") else None
    return StoredFrame(frame.image, sparse, frame.target_depth, None, foreground)
