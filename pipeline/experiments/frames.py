"""Frames of the completion experiments: made or read once per experiment folder, kept small, held in memory.

OUT/data/completion-KEY/{train,test}/ID.npz. Of every frame: the image, the sparse map at 64, 32, 16 and 8 rows, the
exact depth where a LiDAR measures, and which pixels belong to foreground objects. ID.semi.npz: semi-dense ground truth.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from auglidar_base.atomic import write_bytes
from pipeline.base.errors import UsageError
from pipeline.experiments.budgets import CompletionBudget
from pipeline.runner.keys import code_version

if TYPE_CHECKING:
    from pipeline.data import Dataset
    from pipeline.simulation.render import View

ROWS = (64, 32, 16, 8)
# Table 4.2: pole, wall, fence, traffic sign and light, person, vehicle (Cityscapes trainIds).
FOREGROUND = (3, 4, 5, 6, 7, 11, 12, 13, 14, 15, 16, 17, 18)
FIRST_TEST = 100_000  # streets of the test set; training counts from 0
SCANS_ASIDE = 2  # the pseudo ground truth joins this many scans before and after (Uhrig et al.: 5)
AZIMUTH_STEP = 0.36  # degrees; twice the usual step suits images of half the usual size


@dataclass(frozen=True, eq=False)
class StoredFrame:
    """Maps (H, W); depths float32 metres, 0 = none.

    sparse      by LiDAR rows; without points only 64
    clean       the data set's truth (exact on the synthetic world); semi_dense: pseudo ground truth, None without it
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
    if frame.foreground is not None:
        parts["foreground"] = frame.foreground
    write_npz(path, parts)


def write_npz(path: Path, parts: Mapping[str, Any]) -> None:
    """Writes arrays atomically."""
    buffer = io.BytesIO()
    np.savez(buffer, **parts)
    write_bytes(path, buffer.getvalue())


def load(path: Path) -> StoredFrame:
    """Reads what `store` wrote."""
    with np.load(path) as parts:
        sparse = {rows: _unpack(parts[f"sparse_{rows}"]) for rows in ROWS if f"sparse_{rows}" in parts}
        frame = StoredFrame(parts["image"], sparse, _unpack(parts["clean"]), None, parts.get("foreground"))
    if not semi_dense_file(path).is_file():
        return frame
    with np.load(semi_dense_file(path)) as parts:
        return replace(frame, semi_dense=_unpack(parts["semi_dense"]))


def _fields(budget: CompletionBudget) -> dict[str, Any]:
    names = ("size", "test_rows", "test_columns", "data_seed")
    return {name: getattr(budget, name) for name in names}


def identity(data: Path | None, budget: CompletionBudget) -> dict[str, Any]:
    """What determines a frame: the budget's numbers, and the user's data set by name and ids."""
    if data is None:
        return {"synthetic": _fields(budget), "world": code_version("pipeline/simulation")}
    dataset = open_any(data)
    ids = hashlib.sha256("\n".join(dataset.ids).encode()).hexdigest()
    return {"name": dataset.name, "ids": ids, **_fields(budget)}


def open_any(root: Path) -> Dataset:
    """The data set in a folder, recognised by its folders. UsageError when it is none that has true depth."""
    from pipeline.data import open_dataset
    from pipeline.data.vkitti2 import looks_like_vkitti2

    signs = (
        ("kitti_depth", "data_depth_annotated"),
        ("kitti_object", "training/depth_2"),
        ("nyuv2", "*.mat"),
        ("nyuv2", "**/*.h5"),
        ("nyuv2", "*/**/rgb.*"),
    )
    if looks_like_vkitti2(root):
        return open_dataset("vkitti2", root)
    for name, sign in signs:
        if any(root.glob(sign)):
            return open_dataset(name, root)
    raise UsageError(
        f"{root}: expected a data set with true depth (KITTI depth completion with data_depth_annotated/, KITTI object "
        "with training/depth_2/, Virtual KITTI 2 with Scene01/ or another, or NYU Depth v2), found none of them"
    )


def folder_of(out: Path, data: Path | None, budget: CompletionBudget) -> Path:
    """OUT/data/completion-KEY."""
    text = json.dumps(identity(data, budget), sort_keys=True)
    return out / "data" / f"completion-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


def ensure_frames(
    out: Path,
    data: Path | None,
    budget: CompletionBudget,
    say: Callable[[str], None],
    semi_dense: tuple[str, ...] = (),
) -> tuple[list[Path], list[Path]]:
    """Training and test files; those that are missing are made (a killed preparation continues).

    semi_dense  splits ("train", "test") whose pseudo ground truth is made too, in ID.semi.npz beside ID.npz: it takes
                twice the time of the rest
    """
    folder = folder_of(out, data, budget)
    if semi_dense and data is not None:
        raise UsageError("semi-dense beside clean ground truth (figure 4.11) is made on the synthetic world only")
    makers = _synthetic(budget) if data is None else _read(open_any(data), budget)
    paths: dict[str, list[Path]] = {"train": [], "test": []}
    made = 0
    for split, name, make in makers:
        path = folder / split / f"{name}.npz"
        paths[split].append(path)
        if not path.is_file():
            store(_cut(make(), budget), path)
            made += 1
        if split in semi_dense and not semi_dense_file(path).is_file():
            noisy = simulate_semi_dense(budget, int(name))
            write_npz(semi_dense_file(path), {"semi_dense": _pack(_area(noisy, budget))})
            made += 1
        if made and made % 20 == 0:
            say(f"  {made} files of frames made")
    return paths["train"], paths["test"]


def semi_dense_file(path: Path) -> Path:
    """ID.semi.npz of ID.npz."""
    return path.with_name(f"{path.stem}.semi.npz")


def _area(values: Any, budget: CompletionBudget) -> Any:
    """The bottom rows and centred columns that the budget uses."""
    height, width = values.shape[:2]
    top = max(0, height - budget.test_rows) if budget.test_rows else 0
    left = max(0, width - budget.test_columns) // 2 if budget.test_columns else 0
    return values[top:, left : left + (budget.test_columns or width)]


def _cut(frame: StoredFrame, budget: CompletionBudget) -> StoredFrame:
    """The area that the budget uses; truth only where the full scan says something."""
    from completion.diagnostics import measured_region
    from completion.types import DepthFrame

    clean = measured_region(DepthFrame(frame.image, frame.sparse[64], frame.clean))
    return StoredFrame(
        _area(frame.image, budget),
        {rows: _area(depth, budget) for rows, depth in frame.sparse.items()},
        _area(clean, budget),
        foreground=None if frame.foreground is None else _area(frame.foreground, budget),
    )


Maker = tuple[str, str, Callable[[], StoredFrame]]


def _synthetic(budget: CompletionBudget) -> Iterator[Maker]:
    for split, first, count in (("train", 0, budget.train_frames), ("test", FIRST_TEST, budget.test_frames)):
        for index in range(first, first + count):
            yield split, f"{index:06d}", partial(simulate, budget, index)


def simulate(budget: CompletionBudget, index: int) -> StoredFrame:
    """Street `index` of the synthetic world with clean depth."""
    from pipeline.geometry.project import project_points
    from pipeline.geometry.rings import split_rings

    street = Street(budget, index)
    view = street.views(0)[0]
    points = street.scan(0)
    ring = split_rings(points)
    size = view.depth.shape
    sparse = {rows: project_points(points[ring % (64 // rows) == 0], street.calibration, size) for rows in ROWS}
    return StoredFrame(view.image, sparse, view.depth, None, np.isin(view.semantics, FOREGROUND))


def simulate_semi_dense(budget: CompletionBudget, index: int) -> NDArray[np.float32]:
    """Pseudo ground truth of the same moment: joined scans with pose errors, checked by stereo."""
    from pipeline.simulation.semi_dense import semi_dense, stereo_depth

    street = Street(budget, index)
    numbers = range(-SCANS_ASIDE, SCANS_ASIDE + 1)
    left, right = street.views(0, stereo=True)
    stereo = stereo_depth(left.image, right.image, float(street.calibration.P2[0, 0]))
    scans, poses = [street.scan(number) for number in numbers], [street.pose(number) for number in numbers]
    return semi_dense(scans, poses, SCANS_ASIDE, stereo, street.calibration, street.rng(7))


class Street:
    """A street of the synthetic world at moments 0.1 s apart, number 0 being the frame's."""

    def __init__(self, budget: CompletionBudget, index: int) -> None:
        from pipeline.simulation.lidar import sensor
        from pipeline.simulation.rig import draw_rig
        from pipeline.simulation.scenes.layouts import draw_scene
        from pipeline.simulation.synth import SynthSettings

        self.settings, self.index = SynthSettings(seed=budget.data_seed, size=budget.size), index
        scene = draw_scene(self.rng(0), self.settings.streets)
        self.scene = replace(scene, ego=replace(scene.ego, speed=min(scene.ego.speed, 12.0)))
        self.calibration, self.size = draw_rig(self.rng(1), budget.size)
        self.beams = sensor(64) if budget.size is None else replace(sensor(64), azimuth_step=AZIMUTH_STEP)

    def rng(self, purpose: int) -> np.random.Generator:
        """Random numbers of one purpose."""
        from pipeline.simulation.synth import frame_rng

        return frame_rng(self.settings, self.index, purpose)

    def time(self, number: int) -> float:
        """Seconds since the street's beginning."""
        from pipeline.simulation.sequence import FRAME_PERIOD

        return (number + SCANS_ASIDE) * FRAME_PERIOD

    def pose(self, number: int) -> NDArray[np.float64]:
        """T_world_velo, (4, 4)."""
        from pipeline.simulation.rig import LIDAR_HEIGHT

        return np.asarray(self.scene.T_world_velo(self.time(number), LIDAR_HEIGHT), np.float64)

    def scan(self, number: int) -> NDArray[np.float32]:
        """(N, 4) points of one turn."""
        from pipeline.simulation.lidar import scan
        from pipeline.simulation.tracing import Tracer

        tracer = Tracer(self.scene.triangles(self.time(number)))
        return scan(tracer, self.beams, self.pose(number), self.rng(10 + SCANS_ASIDE + number))

    def views(self, number: int, stereo: bool = False) -> list[View]:
        """What camera 2 sees, and camera 3 with `stereo`."""
        from pipeline.simulation.render import render
        from pipeline.simulation.tracing import Tracer

        tracer = Tracer(self.scene.triangles(self.time(number)))
        T_world_cam = self.pose(number) @ self.calibration.T_velo_cam
        matrices = [self.calibration.P2, self.calibration.P3] if stereo else [self.calibration.P2]
        rng = self.rng(2)
        return [render(tracer, self.scene.light, P, T_world_cam, self.size, rng) for P in matrices if P is not None]


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
    from pipeline.geometry.project import project_points
    from pipeline.geometry.rings import split_rings

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
