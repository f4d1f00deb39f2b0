"""The bundled network beside its L2 twin: what a row trains, and one row of each kind at budget smoke."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

from pipeline.experiments.bundled import CLASSICAL, LARGE_L2, RECIPES, SMALL, SMALL_L2, TABLE
from pipeline.experiments.bundled_runs import BUDGETS, train_settings
from pipeline.experiments.plan import Order, carry_out, gather, make_plan


def test_twins_differ_in_nothing_but_the_loss_and_the_decoding() -> None:
    likelihood, squared = (train_settings(RECIPES[name], BUDGETS["small"], seed=1) for name in (SMALL, SMALL_L2))
    assert (likelihood.loss.kind, squared.loss.kind) == ("mixture", "l2")
    assert (likelihood.decoding, squared.decoding) == ("median", "expected")
    assert replace(squared, loss=likelihood.loss, decoding=likelihood.decoding) == likelihood


def test_one_row_of_each_kind_is_trained_and_scored(tmp_path: Path) -> None:
    labels = [f"{rows} rows, {name}" for rows in (64, 16) for name in (CLASSICAL, SMALL, LARGE_L2)]
    table = replace(TABLE, rows=tuple(row for row in TABLE.rows if row.label in labels), claims=())
    plan = make_plan(Order((table,), tmp_path, "smoke", 2))
    assert len(plan.all_runs()) == 1 + 2 + 2  # what is there already is scored once, whatever the number of seeds
    plan = make_plan(Order((table,), tmp_path, "smoke", 1))
    carry_out(plan, lambda text: None)
    outcomes = gather(plan, table).outcomes
    assert sorted(outcomes) == sorted(labels)
    for (found,) in outcomes.values():
        assert all(math.isfinite(value) for value in found.numbers.values())
        assert len(found.frames["16/mae_mm"]) == 2
    classical = outcomes[labels[0]][0].numbers
    assert classical["16/mae_mm"] > classical["64/mae_mm"] > 0
