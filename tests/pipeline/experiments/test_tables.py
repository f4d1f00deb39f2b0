"""Tables as data, intervals, verdicts, outputs."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.base.errors import UsageError
from pipeline.experiments import outputs
from pipeline.experiments.catalogue import TABLES, find
from pipeline.experiments.intervals import FAILS, HOLDS, PERHAPS, UNKNOWN, estimate, judge, kendall_tau, over_seeds
from pipeline.experiments.plan import Order, TableResult, carry_out, gather, make_plan
from pipeline.experiments.runs import Outcome
from pipeline.experiments.tables import HIGHER, Claim, Column, RankClaim, Recipe, Row, Table

ORDER = Order((), Path("out"), "smoke", 3)


def small_table(*claims: Claim | RankClaim, better: str = "lower") -> Table:
    rows = tuple(Row(label, (1.0,), Recipe("analysis", {"what": label})) for label in "abcd")
    quoted = Row("quoted & <50 %>", (9.0,), reason="not ours")
    return Table("9.9", "table", "T", "p", (Column("x", "X", "mm", better),), (*rows, quoted), claims, ("m",))


def outcomes(**values: list[float]) -> dict[str, list[Outcome]]:
    return {label: [Outcome({"x": value}) for value in row] for label, row in values.items()}


def test_t_interval_by_hand() -> None:
    found = over_seeds([1.0, 2.0, 3.0])
    # t(0.975, 2) = 4.302653, deviation 1, divided by sqrt(3).
    assert found.low == pytest.approx(2 - 4.302653 / math.sqrt(3), abs=1e-5)
    assert (found.mean, found.deviation, found.how) == (2.0, 1.0, "t over 3 seeds")


def test_one_seed_is_given_a_bootstrap_over_frames(rng: np.random.Generator) -> None:
    frames = rng.normal(5, 1, 400).tolist()
    row, column = small_table().rows[0], small_table().columns[0]
    found = estimate([Outcome({"x": float(np.mean(frames))}, {"x": frames})], row, column)
    assert found is not None
    assert found.high - found.low == pytest.approx(2 * 1.96 / 20, rel=0.15)
    own = estimate([Outcome({"x": 5.0}, intervals={"x": (4.0, 7.0)})], row, column)
    assert own is not None
    assert (own.low, own.high) == (4.0, 7.0)


def test_orderings_are_judged_in_pairs_of_seeds() -> None:
    claim = Claim("a before b and c", "x", ("a",), ("b", "c"))
    table = small_table(claim)
    clear = outcomes(a=[1, 2, 3], b=[2.1, 3.0, 4.2], c=[3, 4.1, 5])
    assert judge(table, clear)[0].verdict == HOLDS
    assert judge(table, outcomes(a=[2.1, 3.0, 4.2], b=[1, 2, 3], c=[9, 9, 9]))[0].verdict == FAILS
    assert judge(table, outcomes(a=[1, 2, 3], b=[0.5, 3, 3], c=[9, 9, 9]))[0].verdict == PERHAPS
    assert judge(table, outcomes(a=[1, 2, 3], b=[2, 3, 4]))[0].verdict == UNKNOWN
    assert judge(small_table(claim, better=HIGHER), clear)[0].verdict == FAILS


def test_an_exact_computation_decides_without_trainings(tmp_path: Path) -> None:
    table = find("figure", "3.3")
    order = Order((table,), tmp_path, "smoke", 1)
    plan = make_plan(order)
    carry_out(plan, say=lambda line: None)
    assert [verdict.verdict for verdict in gather(plan, table).verdicts] == [HOLDS]


def test_ranks_are_compared_by_kendalls_tau() -> None:
    assert kendall_tau([1, 2, 3], [1, 2, 3]) == pytest.approx(1)
    assert kendall_tau([1, 2, 3], [2, 1, 3]) == pytest.approx(1 / 3)
    same = RankClaim("alike", "x", ("a", "b"), ("c", "d"))
    other = RankClaim("not alike", "x", ("a", "b"), ("c", "d"), same=False)
    verdicts = judge(small_table(same, other), outcomes(a=[1, 1], b=[2, 2], c=[5, 5], d=[7, 7]))
    assert [verdict.verdict for verdict in verdicts] == [HOLDS, FAILS]
    assert "1.00" in verdicts[0].evidence


def test_five_methods_in_one_order_rank_alike() -> None:
    # Five equal ranks give Kendall's tau 0.9999999999999999.
    rows = tuple(Row(label, recipe=Recipe("analysis", {"what": label})) for label in "abcdefghij")
    claim = RankClaim("alike", "x", tuple("abcde"), tuple("fghij"))
    values = {label: [float(place % 5), 2.0 * (place % 5)] for place, label in enumerate("abcdefghij")}
    verdict = judge(replace(small_table(), rows=rows, claims=(claim,)), outcomes(**values))[0]
    assert verdict.verdict == HOLDS
    assert verdict.evidence.endswith("1.00; per seed 1.00, 1.00")


def test_latex_escapes_what_latex_reads_as_commands() -> None:
    text = outputs.latex(ORDER, TableResult(small_table(), outcomes(a=[1, 2, 3]), []))
    assert r"quoted \& $<$50 \%$>$ & -- & 9.0 \\" in text
    assert r"a & 2.0 $\pm$ 1.0 & 1.0 \\" in text
    assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") == 1


def test_csv_has_a_line_for_every_cell() -> None:
    lines = list(csv.DictReader(io.StringIO(outputs.csv_text(TableResult(small_table(), outcomes(a=[1, 2, 3]), [])))))
    assert [line["ours"] for line in lines] == ["2", "", "", "", ""]
    assert lines[4]["status"] == "not ours"
    assert lines[0]["thesis"] == "1.0"


def test_rows_of_quoted_networks_never_have_numbers_of_ours() -> None:
    quoted = [(table, row) for table in TABLES for row in table.rows if row.recipe is None]
    assert len(quoted) > 10
    for table, row in quoted:
        text = outputs.markdown(ORDER, TableResult(table, {}, []))
        assert f"| {row.label} *({row.reason})* |" in text


def test_every_table_of_chapters_2_to_4_is_there() -> None:
    wanted = {("table", f"3.{i}") for i in range(1, 5)} | {("table", f"4.{i}") for i in range(1, 9)}
    wanted |= {("figure", number) for number in ("2.5", "3.3", "4.3", "4.7", "4.8", "4.9", "4.11")}
    assert wanted <= {(table.kind, table.number) for table in TABLES}


def test_one_training_serves_all_tables_that_show_it() -> None:
    four_five = find("table", "4.5").row("MultiStack TWISE").recipe
    assert four_five == find("table", "4.6").row("learned sigma").recipe
    assert four_five == find("table", "4.7").row("gamma 2").recipe
    assert four_five == find("table", "4.8").row("64R TWISE").recipe
    assert four_five == find("figure", "4.11").row("MultiStack TWISE, clean").recipe


def test_unknown_numbers_name_the_nearest_table() -> None:
    with pytest.raises(UsageError, match=r"did you mean --figure 4.11\?"):
        find("table", "4.11")
    with pytest.raises(UsageError, match=r"no experiment for table 4.51; did you mean '4.5'"):
        find("table", "4.51")


def test_lidar_rows_choose_or_replace() -> None:
    chosen = find("table", "4.8").with_lidar_rows(16)
    assert [row.label for row in chosen.rows if row.recipe] == ["16R DC", "16R MultiStack", "16R NLSPN", "16R TWISE"]
    assert {claim.text for claim in chosen.claims} == {
        "16R: TWISE has the lowest MAE",
        "16R: TWISE has a lower MAE than NLSPN",
        "16R: TWISE has the lower RMSE",
    }
    replaced = find("table", "4.7").with_lidar_rows(16)
    assert {row.recipe.settings["rows"] for row in replaced.rows if row.recipe} == {16}


def test_a_claim_about_rows_that_are_not_there_is_refused() -> None:
    with pytest.raises(ValueError, match="names z, which it has not"):
        small_table(Claim("c", "x", ("a",), ("z",)))


def test_findings_name_orderings_that_exist() -> None:
    from pipeline.experiments.findings import FINDINGS

    for finding in FINDINGS:
        for kind, number, beginnings in finding.tests:
            texts = [claim.text for claim in find(kind, number).claims]
            for beginning in beginnings:
                assert any(text.startswith(beginning) for text in texts), (number, beginning)


def test_findings_say_what_is_not_decidable(tmp_path: Path) -> None:
    from pipeline.experiments.findings import CONFIRMED, NOT_CONFIRMED, NOT_DECIDABLE, markdown, summary
    from pipeline.experiments.intervals import Verdict

    verdicts = {name: Verdict("t", name, "") for name in (HOLDS, FAILS, PERHAPS, UNKNOWN)}
    assert summary([verdicts[HOLDS]]) == CONFIRMED
    assert summary([verdicts[HOLDS], verdicts[PERHAPS]]) == NOT_DECIDABLE
    assert summary([verdicts[PERHAPS], verdicts[FAILS]]) == NOT_CONFIRMED
    assert summary([]) == NOT_DECIDABLE
    text = markdown(tmp_path, "smoke", 1)
    assert "TWISE smears less than L2 and L1 (4.5). | **not decidable**: not run |" in text


def test_table_4_1_has_every_row_and_the_time_column() -> None:
    table = find("table", "4.1")
    assert len(table.rows) == 11
    times = {row.label: row.printed[-1] for row in table.rows}
    assert table.columns[-1].unit == "s"
    assert (times["Ma"], times["DeepLidar"], times["Depth-Normal"], times["TWISE"]) == (0.081, 0.097, None, 0.022)
    assert table.row("3DepthNet").printed[:6] == (226.2, 798.40, 1.02, 2.36, 208.96, 693.23)
    assert table.row("Ma").recipe is not None


def test_figure_1_1_varies_rows_and_sensors() -> None:
    settings = [row.recipe.settings for row in find("figure", "1.1").rows if row.recipe is not None]
    assert {(item["rows"], item["colour"]) for item in settings} == {
        (0, True),
        *((rows, colour) for rows in (64, 32, 16, 8) for colour in (True, False)),
    }
    assert {(item["network"], item["loss"]) for item in settings} == {("resnet18", "l2")}
