"""Every kind of damage through the command line: each is reported with its cause, and the rest is right."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.cli import main
from tests.pipeline.runner.damage import DAMAGE, DEPTH_DAMAGE, write_depth_folder
from tests.pipeline.test_cli import contents
from tests.pipeline.tiny_kitti import write_tiny_kitti

GOOD = 4
OPTIONS = ("--config", "kitti", "--stage", "augment", "--workers", "1")
MASKS = ("--set", "augment.preset=L_D_SF", "--set", "augment.semantics=boxes")


def failures_of(run: Path) -> dict[str, dict[str, str]]:
    """Frame -> its failure, checked to be the frame's only one."""
    recorded = json.loads((run / "failures.json").read_text())["failures"]
    assert len({item["frame"] for item in recorded}) == len(recorded)
    return {item["frame"]: item for item in recorded}


def test_every_kind_of_damage_is_reported_with_its_cause_and_the_rest_is_right(tmp_path: Path, capsys) -> None:
    assert len(DAMAGE) >= 25
    data = write_tiny_kitti(tmp_path / "kitti", GOOD + len(DAMAGE))
    good = [*OPTIONS, *MASKS, "--data", str(data), "--out", str(tmp_path / "good"), "--frames", f"0:{GOOD}"]
    assert main(good) == 0
    for index, (damage, _) in enumerate(DAMAGE.values()):
        damage(data / "training", f"{GOOD + index:06d}")
    run = tmp_path / "run"
    capsys.readouterr()
    assert main([*OPTIONS, *MASKS, "--data", str(data), "--out", str(run)]) == 1
    said = capsys.readouterr().err
    assert "Traceback" not in said
    found = failures_of(run)
    wrong = []
    for index, (kind, (_, cause)) in enumerate(DAMAGE.items()):
        failure = found.get(f"{GOOD + index:06d}")
        text = "" if failure is None else f"{failure['file']}: expected {failure['expected']}, got {failure['found']}"
        if failure is None or failure["kind"] != "data" or cause not in text:
            wrong.append(f"{kind}: {'not reported' if failure is None else failure['kind'] + ': ' + text}")
    assert not wrong, "\n".join(wrong)
    assert set(found) == {f"{GOOD + index:06d}" for index in range(len(DAMAGE))}
    assert sum(line.startswith(("complete: frame", "augment: frame")) for line in said.splitlines()) == len(DAMAGE)
    clouds = {name: file for name, file in contents(run).items() if name.startswith("cloud/")}
    assert clouds == {name: file for name, file in contents(tmp_path / "good").items() if name.startswith("cloud/")}


def test_every_kind_of_damaged_depth_map_is_reported_with_its_cause(tmp_path: Path) -> None:
    data = write_tiny_kitti(tmp_path / "kitti", 1 + len(DEPTH_DAMAGE))
    names = [f"{index:06d}" for index in range(1 + len(DEPTH_DAMAGE))]
    folder = tmp_path / "depth"
    write_depth_folder(folder, np.full((48, 96), 2560, np.uint16), names)
    for name, (change, _) in zip(names[1:], DEPTH_DAMAGE.values()):
        path = folder / f"{name}.png"
        path.write_bytes(change(path.read_bytes()))
    run = tmp_path / "run"
    command = [
        *OPTIONS,
        "--set",
        "augment.preset=D",
        "--set",
        "augment.check_depth=false",
        "--data",
        str(data),
        "--out",
        str(run),
    ]
    assert main([*command, "--depth-from", str(folder)]) == 1
    found = failures_of(run)
    for name, (kind, (_, cause)) in zip(names[1:], DEPTH_DAMAGE.items()):
        assert found[name]["kind"] == "data", (kind, found[name])
        assert cause in f"{found[name]['expected']}, got {found[name]['found']}", (kind, found[name])
        assert found[name]["file"] == str(folder / f"{name}.png")
    assert {path.stem for path in (run / "cloud").glob("*.bin")} == {"000000"}


def test_a_file_name_that_leads_elsewhere_costs_its_frame_only(tmp_path: Path) -> None:
    data = write_tiny_kitti(tmp_path / "kitti", 1)
    for folder, suffix in (("image_2", ".png"), ("velodyne", ".bin"), ("calib", ".txt")):
        path = data / "training" / folder / f"000000{suffix}"
        path.with_name(f"a\\..\\b{suffix}").write_bytes(path.read_bytes())
    run = tmp_path / "run"
    assert main([*OPTIONS, "--set", "augment.preset=D", "--data", str(data), "--out", str(run)]) == 1
    assert set(failures_of(run)) == {"a\\..\\b"}
    assert {path.stem for path in (run / "cloud").glob("*.bin")} == {"000000"}


def test_a_linked_folder_is_the_users_own_and_is_read(tmp_path: Path) -> None:
    data = write_tiny_kitti(tmp_path / "kitti", 1)
    elsewhere = tmp_path / "disk2"
    (data / "training" / "velodyne").rename(elsewhere)
    (data / "training" / "velodyne").symlink_to(elsewhere)
    command = [*OPTIONS, "--set", "augment.preset=D", "--data", str(data), "--out", str(tmp_path / "run")]
    assert main(command) == 0


@pytest.mark.parametrize("frame_id", ["../secret", "/etc/passwd", "a/../../b"])
def test_frame_lists_cannot_name_files_outside(tmp_path: Path, frame_id: str, capsys) -> None:
    data = write_tiny_kitti(tmp_path / "kitti", 1)
    command = [*OPTIONS, "--set", "augment.preset=D", "--data", str(data), "--out", str(tmp_path / "run")]
    (tmp_path / "list.txt").write_text(frame_id + "\n")
    assert main([*command, "--frames", str(tmp_path / "list.txt")]) == 2
    assert frame_id in capsys.readouterr().err
