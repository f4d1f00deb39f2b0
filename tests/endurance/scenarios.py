"""What the long harness kills: a command that uses processes, the files it must end with, and how it is started."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from tests.pipeline.runner.damage import write_depth_folder
from tests.pipeline.tiny_kitti import HEIGHT, WIDTH, write_tiny_kitti

FRAMES = 24
_WORKERS = ("--workers", "2")


@dataclass(frozen=True)
class Scenario:
    """commands: what is started side by side on one folder; results: relative path -> bytes of what they made.

    code  with which an undisturbed run ends: 1 for `check`, which finds that the data set is a toy
    """

    name: str
    commands: Callable[[Path], list[list[str]]]
    results: Callable[[Path], dict[str, bytes]]
    code: int = 0


def files_below(*folders: str) -> Callable[[Path], dict[str, bytes]]:
    """The files in these folders of a run; hidden ones are what a kill left, no result."""

    def found(out: Path) -> dict[str, bytes]:
        paths = (path for folder in folders for path in (out / folder).rglob("*") if path.is_file())
        shown = (path for path in paths if not any(part.startswith(".") for part in path.relative_to(out).parts))
        return {path.relative_to(out).as_posix(): path.read_bytes() for path in shown}

    return found


def scenarios(folder: Path) -> list[Scenario]:
    """All of them, over one small data set that is written below `folder`."""
    data = write_tiny_kitti(folder / "kitti", FRAMES)
    depth = np.random.default_rng(1).integers(1200, 9000, (HEIGHT, WIDTH)).astype(np.uint16)
    write_depth_folder(folder / "depth", depth, [f"{index:06d}" for index in range(FRAMES)])
    kitti = ["--config", "kitti", "--data", str(data)]
    augment = [*kitti, "--stage", "augment", "--depth-from", str(folder / "depth")]
    augment += ["--set", "augment.preset=D", "--set", "augment.check_depth=false", *_WORKERS]
    complete = [*kitti, "--stage", "complete", "--set", "completion.model=classical", *_WORKERS]
    detect = [*kitti, "--stage", "detect", "--set", "augment.preset=L", "--frames", "0:6", *_WORKERS]
    synth = ["--config", "synthetic", "--stage", "synth", "--set", "synth.frames=8", *_WORKERS]
    export = ["--stage", "export", "--format", "openpcdet", "--data", str(data), *_WORKERS]
    check = ["--stage", "check", str(data), *_WORKERS]
    frames = files_below("depth", "twin", "cloud", "detections")

    def alone(command: list[str]) -> Callable[[Path], list[list[str]]]:
        return lambda out: [[*command, "--out", str(out)]]

    def beside(command: list[str], *more: tuple[str, ...]) -> Callable[[Path], list[list[str]]]:
        return lambda out: [[*command, *words, "--out", str(out)] for words in more]

    on_ray = [Scenario("ray", alone([*augment, "--engine", "ray"]), frames)] if find_spec("ray") else []
    return [
        *on_ray,
        Scenario("complete", alone(complete), frames),
        Scenario("augment", alone(augment), frames),
        Scenario("detect", alone(detect), frames),
        Scenario("two shards", beside(augment, ("--shard", "0/2"), ("--shard", "1/2")), frames),
        Scenario("two processes", beside(augment, (), ()), frames),
        Scenario("synth", alone(synth), files_below("data")),
        Scenario("export", alone(export), files_below(".")),
        Scenario("check", lambda out: [[*check, "--json", str(out / "report.json")]], files_below("."), code=1),
    ]
