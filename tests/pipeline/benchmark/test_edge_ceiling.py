"""The ceiling of the edge measure: every reference by hand on three rings of a wall with something before it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.benchmark.edge_ceiling import REFERENCES, Edge, Returns, edges_of, outline_column, parallax
from pipeline.benchmark.held_out_rings import HeldOutFrame, hold_out
from pipeline.cli import main
from pipeline.data import open_dataset
from pipeline.geometry.calibration import Calibration

# Rings 0 and 2 are given (every 2nd), ring 1 is asked. Depths by column; the jump of ring 1 lies between 12 and 14.
RINGS = {0: {10: 5.0, 12: 5.0, 14: 20.0, 16: 20.0}, 1: {10: 5.2, 12: 5.2, 14: 21.0, 16: 21.0}, 2: {10: 30.0, 16: 40.0}}


def returns() -> Returns:
    rows = [(column, 4.0 + 3 * ring, depth, ring) for ring, line in RINGS.items() for column, depth in line.items()]
    column, row, depth, ring = (np.array(values, dtype=float) for values in zip(*rows, strict=True))
    return Returns(column, row, depth, ring.astype(np.int64))


def edge(asked: float) -> Edge:
    found = returns()
    of_ring = {column: int(np.flatnonzero((found.ring == 1) & (found.column == column))[0]) for column in RINGS[1]}
    nothing = np.zeros((12, 30), np.float32)
    whole = HeldOutFrame(nothing, nothing, nothing, nothing > -1, np.zeros((0, 4)), np.zeros(0, bool))
    return Edge(found, whole, 2, of_ring[asked], of_ring[12], of_ring[14])


def picture(outline: int) -> np.ndarray:
    image = np.full((12, 30, 3), 40, np.uint8)
    image[:, outline:] = 200
    return image


@pytest.mark.parametrize(
    ("name", "at_12", "at_14"),
    [
        ("own ring complete, camera off by 0.5 px", [5.2, 5.2], [21, 21]),
        ("own ring complete, camera off by 2 px", [5.2, 21], [5.2, 21]),
        ("own ring without the return itself", [5.2], [5.2]),  # of two neighbours 2 px away, the left one
        ("rings above and below of all", [5], [20]),
        ("given returns nearby, the best by truth", [5], [20]),
        ("given returns nearby, chosen by the rings above and below of all", [5], [20]),
        ("given returns nearby, side by the picture's outline", [5], [20]),
        ("given returns nearby, side by another frame's outline", [5], [5]),
        ("given returns nearby, side by a coin", [5, 20], [5, 20]),
        ("both surfaces, side by the picture's outline", [5.2], [21]),
        ("both surfaces, side by another frame's outline", [5.2], [5.2]),
        ("both surfaces, side by a coin", [5.2, 21], [5.2, 21]),
    ],
)
def test_references_by_hand(name: str, at_12: list[float], at_14: list[float]) -> None:
    pictures = {"true": picture(13), "other": picture(15)}
    for column, expected in ((12, at_12), (14, at_14)):
        assert REFERENCES[name](edge(column), pictures) == pytest.approx(expected)


def test_outline_is_where_the_picture_changes() -> None:
    assert [outline_column(edge(12), picture(column)) for column in (12, 13, 14)] == [11.5, 12.5, 13.5]


def test_given_returns_lie_in_the_next_given_rings_and_few_columns() -> None:
    assert sorted(edge(12).given_nearby()) == [5, 5, 20, 20, 30, 40]
    nowhere = edge(12)
    nowhere.returns.column[nowhere.returns.ring != 1] += 100
    assert len(nowhere.given_nearby()) == 0
    assert np.isnan(REFERENCES["given returns nearby, the best by truth"](nowhere, {})[0])


@pytest.mark.parametrize(("aside", "columns"), [(0.0, 0.0), (0.5, 0.5 * 100 * (1 / 5.2 - 1 / 21))])
def test_parallax_by_hand(aside: float, columns: float) -> None:
    """A LiDAR `aside` metres to the side: f B (1 / near - 1 / far) columns."""
    velo = np.array([[0, -1.0, 0, aside], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    camera = Calibration(np.array([[100.0, 0, 15, 0], [0, 100, 6, 0], [0, 0, 1, 0]]), np.eye(3), velo)
    assert parallax(edge(12), camera) == pytest.approx(columns)


@pytest.mark.real_data
def test_asked_returns_are_those_the_benchmark_scores(kitti_object: Path) -> None:
    frame = open_dataset("kitti_object", kitti_object)["000008"]
    found, scored = edges_of(frame, 16), hold_out(frame.points, frame.calibration, frame.image_size, 16)
    assert 0.5 * len(scored.edges) < len(found) <= len(scored.edges)
    for each in found:
        place = int(np.rint(each.returns.row[each.asked])), int(np.rint(each.column))
        assert scored.truth[place] == pytest.approx(each.truth, abs=1e-4)
        assert abs(each.returns.depth[each.left] - each.returns.depth[each.right]) > 2


def test_the_suite_prints_and_writes_it(streets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["--stage", "bench", "--suite", "edges", "--data", str(streets), "--rows", "16", "--out", str(tmp_path)]
    assert main(command) == 0
    entry = json.loads((tmp_path / "edges.json").read_text())[0]
    assert set(entry["references"]) == set(REFERENCES)
    best, chosen = (
        entry["references"][f"given returns nearby, {how}"]["edge_tmae"]
        for how in ("the best by truth", "chosen by the rings above and below of all")
    )
    assert 0 < best <= chosen <= 1000
    assert (tmp_path / "edges.md").read_text() in capsys.readouterr().out
