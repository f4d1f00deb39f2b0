"""The arithmetic of the batch benchmark on rates given by hand."""

from __future__ import annotations

import pytest

from benchmarks import batch


def test_stages_follow_each_other() -> None:
    assert batch.end_to_end({"complete": (60.0, 1.0), "detect": (30.0, 2.0)}) == pytest.approx(1 / 3)


def test_measures_compare_more_workers_with_one() -> None:
    results = {1: {"augment": (600.0, 0.1)}, 2: {"augment": (1080.0, 0.11)}}
    stage, together = batch.measures_of(results)
    assert (stage.case, stage.ratio("1 worker")) == ("augment, 2 workers", pytest.approx(1.8))
    assert (together.ours, together.unit) == (pytest.approx(18.0), "frames/s")


def test_the_bottleneck_of_a_million_frames_moves_from_cores_to_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch, "ledger_row", lambda: 0.0001)
    rows = batch.million_frames({"complete": (60.0, 1.0), "augment": (600.0, 0.1), "detect": (120.0, 0.5)}, 3.0, 2.0)
    cells = [[cell.strip() for cell in row.split("|")[1:-1]] for row in rows.splitlines()[2:]]
    # 1.6 s on 16 cores: 27.8 h for a million; 8 MB a frame at 1 GB/s: 2.2 h.
    assert cells[0][:2] == ["1", "27.8"]
    assert cells[0][3] == "2.2"
    assert [row[-1].split(", ")[0] for row in cells] == ["cores", "cores", "disk", "disk"]


def test_a_ledger_row_takes_time() -> None:
    assert 0 < batch.ledger_row(5) < 1
