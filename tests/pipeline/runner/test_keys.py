"""Keys: what changes a task's key, and what does not. Seeds: what they depend on."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from pipeline.base.seeds import derive_seed
from pipeline.data.frame import Frame
from pipeline.geometry.calibration import Calibration
from pipeline.run_folder.frame_outputs import content_hash
from pipeline.runner.keys import code_version, part_hash, stage_key, task_key


def file_hash(path: Path) -> str:
    return content_hash(path.read_bytes()) if path.exists() else "absent"


def read(path: Path) -> bytes:
    return path.read_bytes()


def test_a_stage_key_follows_settings_weights_and_code(tmp_path: Path) -> None:
    weights = tmp_path / "w"
    weights.write_bytes(b"1")
    keys = {stage_key({"a": 1, "b": 2}, [weights], ["completion"], file_hash)}
    assert stage_key({"b": 2, "a": 1}, [weights], ["completion"], file_hash) in keys
    keys.add(stage_key({"a": 2, "b": 2}, [weights], ["completion"], file_hash))
    keys.add(stage_key({"a": 1, "b": 2}, [weights], ["detection"], file_hash))
    weights.write_bytes(b"2")
    keys.add(stage_key({"a": 1, "b": 2}, [weights], ["completion"], file_hash))
    assert len(keys) == 4


def test_a_task_key_follows_the_files_of_the_parts_it_reads(tmp_path: Path) -> None:
    image, points = tmp_path / "image", tmp_path / "points"
    image.write_bytes(b"i")
    points.write_bytes(b"p")
    frame = Frame("1", {"image": partial(read, image), "points": partial(read, points)})
    before = task_key("s", frame, ("image",), (), file_hash)
    points.write_bytes(b"q")
    assert task_key("s", frame, ("image",), (), file_hash) == before
    image.write_bytes(b"j")
    assert task_key("s", frame, ("image",), (), file_hash) != before


def test_parts_without_files_are_recognised_by_content() -> None:
    def part(value: float) -> str:
        return part_hash(Frame("1", {"points": lambda: np.full((2, 4), value, np.float32)}), "points", file_hash)

    assert part(1.0) == part(1.0) != part(2.0)
    assert part_hash(Frame("1", {}), "points", file_hash) == "none"


def test_parts_read_from_a_folder_are_recognised_by_content(tmp_path: Path) -> None:
    def calibration(folder: Path) -> Calibration:
        P2 = np.eye(3, 4)
        P2[0, 3] = float((folder / "calib.txt").read_text())
        return Calibration(P2=P2, R0_rect=np.eye(3), T_cam0_velo=np.eye(4))

    frame = {"calibration": partial(calibration, tmp_path)}
    hashes = []
    # The ninth digit counts too; a printed array has eight.
    for text in ("1.0", "1.000000001", "1.0"):
        (tmp_path / "calib.txt").write_text(text)
        hashes.append(part_hash(Frame("1", frame), "calibration", file_hash))
    assert hashes[0] == hashes[2] != hashes[1]


def test_code_versions_differ_between_rooms() -> None:
    assert code_version("completion") != code_version("detection")
    assert code_version("pipeline/stages/order.py") == code_version("pipeline/stages/order.py")


def test_seeds_depend_on_run_frame_and_stage() -> None:
    seeds = {derive_seed(run, frame, stage) for run in (1, 2) for frame in ("a", "b") for stage in ("x", "y")}
    assert len(seeds) == 8
    assert all(0 <= seed < 2**31 for seed in seeds)
    assert derive_seed(1, "000001", "augment") == derive_seed(1, "000001", "augment")
