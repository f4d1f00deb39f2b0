"""Chapter 5: its tables are complete, and run on two frames (budget smoke)."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from detection.evaluation.bootstrap import Resampling
from detection.evaluation.difficulty import KittiDifficulty
from detection.kitti_format import KittiObject
from pipeline.data import Frame
from pipeline.experiments import chapter_5, chapter_5_exact, chapter_5_figures, detection_scores
from pipeline.experiments.catalogue import find
from pipeline.experiments.chapter_5_findings import FINDINGS
from pipeline.experiments.cloud_runs import picked_by_fps
from pipeline.experiments.common_pretraining import Mixture, start_inputs
from pipeline.experiments.detection_budget import DETECTION
from pipeline.experiments.findings import markdown as findings_page
from pipeline.experiments.intervals import HOLDS, PERHAPS, judge, margin
from pipeline.experiments.outputs import markdown, write_outputs
from pipeline.experiments.plan import Order, TableResult, carry_out, gather, make_plan
from pipeline.experiments.runs import Outcome, plan_run
from pipeline.experiments.tables import Recipe, Table
from tests.pipeline.data.vkitti2_tree import write_tree

SMOKE_TABLES = ("5.8", "5.9", "5.1", "5.3", "5.6", "5.7")


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("experiments")


@pytest.fixture(scope="module")
def results(out: Path) -> Callable[[str, str], TableResult]:
    """The results of a table at budget smoke, one seed; runs are shared between tables."""

    def of(kind: str, number: str) -> TableResult:
        table = find(kind, number)
        plan = make_plan(Order((table,), out, "smoke", 1))
        carry_out(plan, lambda text: None)
        return gather(plan, table)

    return of


@pytest.mark.parametrize("number", SMOKE_TABLES)
def test_table_runs_on_two_frames(number: str, results: Callable[[str, str], TableResult], out: Path) -> None:
    result = results("table", number)
    ours = [row for row in result.table.rows if row.recipe is not None]
    assert set(result.outcomes) == {row.label for row in ours}
    for row in ours:
        numbers = result.outcomes[row.label][0].numbers
        prefix = f"{row.view}/" if row.view else ""
        assert all(0 <= numbers[prefix + column.key] <= 100 for column in result.table.columns)
        assert numbers["cloud/points"] > 50
    order = Order((result.table,), out, "smoke", 1)
    assert f"--table {number} --budget smoke --seeds 1" in markdown(order, result)
    assert all(path.stat().st_size > 500 for path in write_outputs(order, result, out))


def test_figures_are_drawn(results: Callable[[str, str], TableResult], out: Path) -> None:
    for number in ("5.4", "5.6", "5.7", "5.8"):
        result = results("figure", number)
        written = write_outputs(Order((result.table,), out, "smoke", 1), result, out)
        assert written[-1].name == f"figure_{number}.png"
        assert written[-1].stat().st_size > 10_000
    result = results("figure", "5.7")
    points = [result.outcomes[row.label][0].numbers["points"] for row in result.table.rows]
    assert points == sorted(points, reverse=True)
    sweep = results("figure", "5.6").outcomes[chapter_5_figures.sigma_view(0.2, 3.0)][0].numbers
    assert sweep["0.2-0.8, 3 m/removed"] <= sweep["0.01-0.99, 0.25 m/removed"]


def test_two_runs_and_a_continued_one_are_equal(out: Path, tmp_path: Path) -> None:
    table = chapter_5_exact.TABLE_5_8
    files = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        plan = make_plan(Order((table,), folder, "smoke", 1))
        run = plan.runs[table.name]["64R + Gaussian blur"][0]
        one = type(plan)(plan.order, {table.name: {"64R + Gaussian blur": [run]}})
        carry_out(one, lambda text: None)
        files.append(run.folder(folder) / "result.json")
    first = files[0].read_bytes()
    assert files[1].read_bytes() == first
    files[0].unlink()
    next((files[0].parent / "detections").glob("*.txt")).unlink()
    next((tmp_path / "a" / "data").glob("trained-*/last.safetensors")).unlink()
    carry_out(type(plan)(Order((table,), tmp_path / "a", "smoke", 1), one.runs), lambda text: None)
    assert files[0].read_bytes() == first
    assert json.loads(first)["draws"]["bev_0.5_moderate"]


def test_virtual_kitti_2_is_split_and_scored_as_in_the_thesis(tmp_path: Path) -> None:
    root = write_tree(write_tree(tmp_path / "vkitti", "Scene01", 1), "Scene20", 2)
    table = chapter_5_exact.TABLE_5_9
    label = "2D bounding box"
    plan = make_plan(Order((table,), tmp_path / "out", "smoke", 1, root))
    runs = {table.name: {label: plan.runs[table.name][label]}}
    carry_out(type(plan)(plan.order, runs), lambda text: None)
    folder = runs[table.name][label][0].folder(tmp_path / "out")
    numbers = json.loads((folder / "result.json").read_text())["numbers"]
    assert sorted(path.name for path in folder.glob("detections/Scene20/clone/*")) == ["Camera_0", "Camera_1"]
    assert numbers["labels_easy"] == 2
    assert numbers["cloud/clean %"] == 100
    assert numbers["cloud/object %"] > 50


def test_tables_hold_what_the_thesis_printed() -> None:
    def printed(table: Table, label: str) -> tuple[float | None, ...]:
        return table.row(label).printed[:6]

    assert printed(chapter_5.TABLE_5_3, "PointRCNN2, L and D and SF") == (92.5, 79.5, 73.2, 96.3, 88.5, 82.3)
    assert printed(chapter_5_exact.TABLE_5_8, "64R + Gaussian blur") == (67.4, 54.4, 47.1, 73.4, 62.4, 54.8)
    assert printed(chapter_5.TABLE_5_2, "30-70 m, dense") == (39.38, 42.35, 36.83, 54.07, 58.37, 51.56)
    voxel = printed(chapter_5_exact.TABLE_5_7, "Voxel-RCNN, all, Alldep")
    assert voxel == (89.7, 80.7, 79.7, 90.4, 89.8, 81.5)
    numbers = [table.number for module in (chapter_5, chapter_5_exact) for table in module.TABLES]
    assert numbers[:9] == [f"5.{index}" for index in range(1, 10)]
    assert [table.number for table in chapter_5_figures.TABLES] == ["5.4", "5.6", "5.7", "5.8"]
    for row in (row for module in (chapter_5, chapter_5_exact) for table in module.TABLES[:6] for row in table.rows):
        assert row.recipe is not None or "quoted" in row.reason


def test_equal_recipes_are_shared_and_rows_change_them(tmp_path: Path) -> None:
    tables = (chapter_5.TABLE_5_1, chapter_5.TABLE_5_2, chapter_5.TABLE_5_3)
    plan = make_plan(Order(tables, tmp_path, "small", 1))
    keys = {name: {label: runs[0].key for label, runs in rows.items()} for name, rows in plan.runs.items()}
    assert (
        keys["table_5.1"]["Object, raw LiDAR"] == keys["table_5.3"]["PointRCNN2, L"] == keys["table_5.2"]["0-30 m, raw"]
    )
    sparse = chapter_5.TABLE_5_3.with_lidar_rows(16)
    assert sparse.name == "table_5.3_16_rows"
    other = make_plan(Order((sparse,), tmp_path, "small", 1)).runs[sparse.name]["PointRCNN2, L"][0]
    assert other.recipe.settings["rows"] == 16
    assert other.key != keys["table_5.3"]["PointRCNN2, L"]


def test_findings_name_orderings_that_exist_and_clouds_need_no_seeds(tmp_path: Path) -> None:
    for finding in FINDINGS:
        for kind, number, beginnings in finding.tests:
            texts = [claim.text for claim in find(kind, number.partition("@")[0]).claims]
            assert all(any(text.startswith(beginning) for text in texts) for beginning in beginnings), finding.claim
    page = findings_page(tmp_path, "smoke", 1, FINDINGS)
    assert page.count("**not decidable**: not run") == len(FINDINGS)
    plan = make_plan(Order((find("figure", "5.4"), chapter_5_exact.TABLE_5_8), tmp_path, "smoke", 3))
    assert {len(runs) for runs in plan.runs["figure_5.4"].values()} == {1}
    assert {len(runs) for runs in plan.runs["table_5.8"].values()} == {3}


def car(x: float, score: float | None = None) -> KittiObject:
    return KittiObject("Car", 0.0, 0, 0.0, (100, 100, 200, 180), (1.5, 1.6, 3.9), (x, 1.6, 20.0), 0.0, score)


def test_scores_say_where_ap_is_lost() -> None:
    labels = {str(index): [car(0.0), car(8.0)] for index in range(30)}
    found = {str(index): [car(0.2, 0.9), car(-9.0, 0.8)] for index in range(30)}
    evaluation = detection_scores.evaluation_of(labels, found, KittiDifficulty("cpp"))
    numbers = detection_scores.ap_numbers(evaluation)
    assert numbers["labels_moderate"] == 60
    assert numbers["recall_0.5_moderate"] == 50
    assert numbers["30-70/bev_0.5_moderate"] == 0
    lost = detection_scores.where_lost(evaluation)
    assert lost["lost/label missed: no detection overlaps"] == 30
    assert lost["lost/detection false positive: nothing there"] == 30
    resampling = Resampling(20)
    draws = detection_scores.ap_draws(evaluation, resampling)
    low, high = detection_scores.intervals_of(draws, resampling)["bev_0.5_moderate"]
    assert low <= numbers["bev_0.5_moderate"] + 1e-3
    assert high >= numbers["bev_0.5_moderate"] - 1e-3


def test_single_runs_are_compared_by_paired_draws() -> None:
    table = chapter_5_exact.TABLE_5_9
    outcomes = {
        "semantic": [Outcome({"bev_0.5_moderate": 60.0}, draws={"bev_0.5_moderate": [58.0, 60.0, 62.0]})],
        "all": [Outcome({"bev_0.5_moderate": 50.0}, draws={"bev_0.5_moderate": [48.0, 50.0, 52.0]})],
    }
    found = margin(table, "bev_0.5_moderate", "semantic", "all", outcomes)
    assert found is not None
    assert (found.mean, found.low, found.high) == (10, 10, 10)
    # One training each decides nothing, however sure the frames are.
    verdict = judge(table, outcomes)[0]
    assert verdict.verdict == PERHAPS
    assert verdict.evidence.endswith("by +10.0 [+10.0, +10.0] over test frames, one training each")
    twice = {label: [Outcome(one[0].numbers), Outcome(one[0].numbers)] for label, one in outcomes.items()}
    assert judge(table, twice)[0].verdict == HOLDS


def test_fps_keeps_the_far_points() -> None:
    from detection.types import PointFrame

    near = np.random.default_rng(0).normal((20, 0, 0), 0.5, (500, 3))
    points = np.concatenate([near, [[60, 10, 0], [60, -10, 0], [40, 0, 0]]]).astype(np.float32)
    T = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    P = np.array([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]])
    many, few = picked_by_fps(PointFrame(points, T, P, (375, 1242)), (64, 8))
    assert len(many) == 64
    assert set(few) <= set(many)
    assert {500, 501, 502} <= set(few)


def test_all_rows_begin_with_one_detector(out: Path, results: Callable[[str, str], TableResult]) -> None:
    results("table", "5.8")
    cards = [json.loads(path.read_text()) for path in (out / "data").glob("trained-*/last.json")]
    starts = {card["training"]["warm_start"] for card in cards if card["training"]["preset"] == "small"}
    (start,) = starts - {None}
    assert Path(start).is_file()


def test_the_common_pretraining_sees_every_kind_of_cloud_equally_often() -> None:
    kinds = [["L0", "L1"], ["D0", "D1"], ["L_D0", "L_D1"]]
    mixture = Mixture(kinds)  # type: ignore[arg-type]
    assert [mixture[index] for index in range(len(mixture))] == ["L0", "L1", "D0", "D1", "L_D0", "L_D1"]
    with pytest.raises(IndexError, match="below 6"):
        mixture[6]


def test_the_common_pretraining_uses_what_the_data_has() -> None:
    scan, truth = {"points": lambda: None}, {"target_depth": lambda: None}
    recipes = start_inputs(Frame("000001", {**scan, **truth}, "synthetic"))
    assert len({json.dumps(recipe.record(), sort_keys=True) for recipe in recipes}) == len(recipes) == 9
    assert {recipe.depth_name for recipe in start_inputs(Frame("000001", scan, "kitti"))} == {None, "completed"}
    assert {recipe.rows for recipe in start_inputs(Frame("Scene01/clone/Camera_0/00000", truth, "vkitti2"))} == {64}


def test_a_run_depends_on_its_own_detector_and_first_stage_alone() -> None:
    budget = DETECTION["smoke"]
    longer = replace(budget.detectors["SECOND"], start_steps=3)
    changed = replace(budget, detectors={**budget.detectors, "SECOND": longer})
    same = {}
    for name in ("PointRCNN2", "SECOND", "Voxel-RCNN"):
        recipe = Recipe("detection", {"detector": name})
        same[name] = plan_run(recipe, budget, None, 0).key == plan_run(recipe, changed, None, 0).key
    assert same == {"PointRCNN2": True, "SECOND": False, "Voxel-RCNN": False}
