"""The numbers of the worked example in docs/evaluation.md, and that the page and its figures agree with the code."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks.ap_figures import FIGURES, worked_example, write_example
from detection.evaluation.kitti_ap import evaluate, prepare

PAGE = Path(__file__).resolve().parents[3] / "docs" / "evaluation.md"


def test_thresholds_and_counts_as_printed() -> None:
    labels, detections = worked_example()
    evaluation = prepare(labels, detections, classes=["Car"], metrics=["3d"], iou_set="strict")
    curve = evaluation.curves(evaluation.targets[0])[1]
    assert curve.n_labels == 4
    assert curve.thresholds.tolist() == [0.95, 0.85]
    assert (curve.tp.tolist(), curve.fp.tolist()) == ([1, 2], [0, 1])


@pytest.mark.parametrize(("copies", "recall", "ap"), [(1, 40, 1.67), (1, 11, 9.09), (20, 40, 41.67), (20, 11, 45.45)])
def test_ap_as_printed(copies: int, recall: int, ap: float) -> None:
    labels, detections = worked_example()
    report = evaluate(
        labels * copies, detections * copies, classes=["Car"], metrics=["3d"], iou_set="strict", recall=recall
    )
    assert report["results"][0]["moderate"] == pytest.approx(ap, abs=0.005)
    assert report["exact"][0]["moderate"] == pytest.approx(41.67, abs=0.005)
    assert f"{ap:.2f}" in PAGE.read_text()


def test_in_the_image_the_dontcare_area_absorbs_the_last_detection() -> None:
    labels, detections = worked_example()
    evaluation = prepare(labels, detections, classes=["Car"], iou_set="strict")
    by_metric = {target.metric: evaluation.records[target][1] for target in evaluation.targets}
    assert by_metric["3d"].fp.sum() == 3
    assert by_metric["2d"].fp.sum() == 2


def test_the_written_example_evaluates_alike(tmp_path: Path) -> None:
    write_example(tmp_path)
    report = evaluate(tmp_path / "label_2", tmp_path / "detections", classes=["Car"], iou_set="strict")
    values = {row["metric"]: row["moderate"] for row in report["results"]}
    assert values["3d"] == pytest.approx(100 * 2 / 3 / 40)


def test_every_figure_of_the_page_is_drawn_by_the_command(tmp_path: Path) -> None:
    shown = set(re.findall(r"images/(evaluation_\w+\.png)", PAGE.read_text()))
    assert shown == set(FIGURES)
    for name, draw in FIGURES.items():
        assert (PAGE.parent / "images" / name).is_file()
        draw(tmp_path / name)
        assert (tmp_path / name).stat().st_size > 5000
