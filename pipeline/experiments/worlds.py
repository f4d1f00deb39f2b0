"""The frames of a detection experiment: training and test set, of the synthetic world or of the user's data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from auglidar_base.atomic import write_text
from detection.evaluation.difficulty import DifficultyRule, KittiDifficulty, Vkitti2Difficulty
from detection.evaluation.objects import Array, Mask
from pipeline.base.errors import UsageError
from pipeline.data import Dataset, open_dataset
from pipeline.runner.keys import code_version

# One seed of the synthetic world for training frames, another for test frames.
TRAIN_SEED, TEST_SEED = 1001, 2002
# A middle value of each of the occlusion levels 0, 1, 2, whose borders are those of thesis 5.4.1.2.
_OCCLUSION = np.array([0.0, 0.3, 0.8, 1.0])


@dataclass(frozen=True)
class World:
    """Where a detector is trained and tested.

    rule  the difficulty of labels: KITTI's, or the thesis' for Virtual KITTI 2 (section 5.4.1.2)
    """

    train: Dataset
    test: Dataset
    rule: DifficultyRule


@dataclass(frozen=True)
class ThesisLevels:
    """Virtual KITTI 2's easy, medium and hard (thesis 5.4.1.2) for labels that hold occlusion levels.

    `pipeline.data.vkitti2` cuts the occlusion at 0.1 and 0.6, so a level says all that the rule asks.
    """

    rule: Vkitti2Difficulty = field(default_factory=Vkitti2Difficulty)

    @property
    def min_height(self) -> tuple[float, float, float]:
        """Least 2D height in pixels of a detection that counts."""
        return self.rule.min_height

    def counts(self, height: Array, truncation: Array, occlusion: Array) -> Mask:
        """(3, N) whether each label counts at easy, medium, hard; `occlusion` holds levels 0 to 3."""
        level = np.asarray(occlusion).astype(np.int64).clip(0, 3)
        return self.rule.counts(height, truncation, _OCCLUSION[level])


def open_world(
    root: Path, data: Path | None, train_frames: int, test_frames: int, size: tuple[int, int] | None,
    say: Callable[[str], None] = print,
) -> World:  # fmt: skip
    """The frames of the user's data set `data`, or of the synthetic world, written below `root` once.

    size  (height, width) of synthetic images, None for KITTI's
    Virtual KITTI 2 and KITTI use the thesis' splits (ImageSets/train.txt and val.txt when there are some); longer sets
    are thinned evenly to the numbers of frames. UsageError when `data` is neither, or has too few frames.
    """
    if data is None:
        train = synthetic_frames(root, train_frames, TRAIN_SEED, size, say)
        test = synthetic_frames(root, test_frames, TEST_SEED, size, say)
        return World(train, test, KittiDifficulty("cpp"))
    name, train, test = _splits(data)
    rule: DifficultyRule = ThesisLevels() if name == "vkitti2" else KittiDifficulty("cpp")
    return World(_thinned(train, train_frames), _thinned(test, test_frames), rule)


def world_identity(data: Path | None, train_frames: int, test_frames: int, size: tuple[int, int] | None) -> Any:
    """Plain values that decide which frames `open_world` gives."""
    frames = [train_frames, test_frames]
    if data is None:
        world = code_version("pipeline/simulation")
        return {"world": world, "seeds": [TRAIN_SEED, TEST_SEED], "frames": frames, "size": size}
    return {"folder": str(Path(data).resolve()), "frames": frames}


def _splits(data: Path) -> tuple[str, Dataset, Dataset]:
    """Reader, training and test frames of a Virtual KITTI 2 or KITTI object folder."""
    from pipeline.data.vkitti2 import looks_like_vkitti2, thesis_split

    if looks_like_vkitti2(data):
        whole = open_dataset("vkitti2", data)
        return "vkitti2", thesis_split(whole, "train"), thesis_split(whole, "test")
    whole = open_dataset("kitti_object", data)
    files = [data / "ImageSets" / f"{name}.txt" for name in ("train", "val")]
    if all(path.is_file() for path in files):
        return "kitti_object", whole.select(files[0]), whole.select(files[1])
    half = len(whole) // 2
    return "kitti_object", whole.select(whole.ids[:half]), whole.select(whole.ids[half:])


def _thinned(dataset: Dataset, count: int) -> Dataset:
    if not len(dataset):
        raise UsageError(f"{dataset.root}: no frame in the thesis' split (Virtual KITTI 2: clone of scenes 01 to 20)")
    if len(dataset) <= count:
        return dataset
    places = np.linspace(0, len(dataset) - 1, count).round().astype(int)
    return dataset.select([dataset.ids[place] for place in places])


def synthetic_frames(
    root: Path, frames: int, seed: int, size: tuple[int, int] | None, say: Callable[[str], None]
) -> Dataset:
    """`frames` synthetic frames of `seed` in KITTI's object layout with dense truth, written below `root` if missing.

    A frame depends on seed, number, size and the world's code, so a folder with more frames serves a smaller experiment
    and another version of the world has a folder of its own.
    """
    shape = "kitti" if size is None else f"{size[0]}x{size[1]}"
    folder = root / f"frames-{seed}-{shape}-{code_version('pipeline/simulation')[:8]}"
    missing = [index for index in range(frames) if not (folder / "written" / f"{index:06d}").is_file()]
    if missing:
        from pipeline.simulation.synth import SynthSettings
        from pipeline.simulation.writers import write_job

        settings = SynthSettings(frames=frames, seed=seed, size=size)
        say(f"writing {len(missing)} synthetic frames (seed {seed}) to {folder}")
        for index in missing:
            write_job(folder, settings, index)
            write_text(folder / "written" / f"{index:06d}", "")
    return open_dataset("kitti_object", folder).select([f"{index:06d}" for index in range(frames)])
