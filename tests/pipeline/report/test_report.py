"""The report and the scores: numbers worked out by hand, a page that needs nothing but itself."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from detection.kitti_format import KittiObject
from pipeline.base.paths import RunFolder
from pipeline.data import open_dataset
from pipeline.report import pictures
from pipeline.report.boxes import DrawnBox, drawn_boxes, footprint, wireframe
from pipeline.report.page import spread
from pipeline.report.views import tally
from pipeline.run_folder.config import load_config
from pipeline.run_folder.thresholds import ScoreThresholds
from pipeline.scoring.scores import evaluate_run, mean_of, mean_steps
from pipeline.scoring.tables import markdown_table, number
from tests.pipeline.report.scored import score_and_report
from tests.pipeline.tiny_kitti import CALIBRATION

VOID = {"meta", "input", "img", "br"}


class Page(HTMLParser):
    """Tags in balance, the addresses a browser would fetch, and the number of drawn boxes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open_tags: list[str] = []
        self.addresses: list[str] = []
        self.boxes = {"truth": 0, "found": 0}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.addresses += [values[name] for name in ("src", "href") if name in values]
        for kind in self.boxes:
            self.boxes[kind] += values.get("class") == f"box {kind}"
        if tag not in VOID:
            self.open_tags.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open_tags.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open_tags.pop() == tag


def test_the_page_is_whole_and_needs_nothing_else(run: RunFolder) -> None:
    text = score_and_report(run)
    page = Page(text)
    assert page.open_tags == []
    assert page.addresses
    assert all(address.startswith("data:image/webp;base64,") for address in page.addresses)
    assert not re.search(r"https?://(?!www\.w3\.org)", text)
    assert "@import" not in text
    assert page.boxes == {"truth": 6, "found": 6}  # three frames, in the image and from above
    assert text.count('class="cloud" data-colour') == 3
    for caption in ("sparse depth", "completed depth", "foreground", "background", "sigma", "true depth", "error"):
        assert caption in text
    assert "grid sampling" in text
    assert "100 → 40" in text


def test_scores_of_a_run_worked_out_by_hand(run: RunFolder) -> None:
    score_and_report(run)
    metrics = json.loads(run.metrics.read_text())
    # Every depth is 1 m too large.
    assert metrics["depth"]["mean"]["mae_mm"] == pytest.approx(1000, abs=2)
    assert metrics["augmentation"] == [
        {"step": "grid_sampling", "in": 100, "out": 40},
        {"step": "join", "in": 40, "out": 40},
    ]
    assert metrics["frames"] == {"scored": ["000000", "000001", "000002"], "without_label": []}
    # The cars are 16 px high: below every difficulty's limit, so none counts and no AP is claimed.
    assert {tuple(row["n_gt"]) for row in metrics["results"]} == {(0, 0, 0)}
    assert "mae_mm" in run.tables.read_text()


def test_a_frame_without_label_is_listed_and_the_others_are_scored(run: RunFolder) -> None:
    config = load_config(run.config)
    (Path(str(config.data.root)) / "training" / "label_2" / "000001.txt").unlink()
    dataset = open_dataset("kitti_object", str(config.data.root))
    collected = evaluate_run(config, run, dataset, dataset.ids)
    assert sorted(collected.labels) == ["000000", "000002"]
    (failure,) = collected.failures
    assert "frame 000001" in failure.line()
    assert "expected a label file, got none" in failure.line()
    assert "Frames without a label, not scored: 000001" in run.tables.read_text()


def test_text_from_files_is_escaped(run: RunFolder) -> None:
    failure = {
        "stage": "complete",
        "frame": "1",
        "file": "<script>alert(1)</script>",
        "expected": "",
        "found": "&",
        "hint": "",
    }
    run.failures.write_text(json.dumps({"failures": [failure]}))
    text = score_and_report(run)
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert(1)" in text


def test_a_damaged_result_is_named_in_the_page(run: RunFolder) -> None:
    run.twin("000001").write_bytes(b"damaged")
    text = score_and_report(run)
    assert "twin/000001.npz: expected an .npz with foreground" in text
    assert Page(text).boxes["truth"] == 6


def test_depth_colours_are_shared_and_ordered() -> None:
    depth = np.array([[0.0, 1.0, 2.0, 12.65, 80.0, 200.0]], np.float32)
    picture = pictures.colour_depth(depth)[0]
    colours = pictures.depth_colours()
    np.testing.assert_array_equal(picture[0], pictures.NO_VALUE)
    np.testing.assert_array_equal(picture[1], colours[0])
    np.testing.assert_array_equal(picture[2], colours[0])
    np.testing.assert_array_equal(picture[4], colours[255])
    np.testing.assert_array_equal(picture[5], colours[255])
    # 12.65 m is the geometric mean of 2 and 80 m: the middle of the logarithmic scale.
    assert pictures.tick_position(np.sqrt(160)) == pytest.approx(50)
    np.testing.assert_allclose(picture[3].astype(int), colours[127].astype(int), atol=2)


def test_sparse_returns_are_drawn_three_pixels_wide_nearest_first() -> None:
    depth = np.zeros((5, 7), np.float32)
    depth[2, 2], depth[2, 4] = 5.0, 50.0
    picture = pictures.colour_sparse(depth)
    five = pictures.colour_depth(np.array([[5.0]], np.float32))[0, 0]
    np.testing.assert_array_equal(picture[1, 3], five)  # both reach this pixel
    np.testing.assert_array_equal(picture[2, 6], pictures.NO_VALUE)


def test_birds_eye_places_points_forward_up_and_left_left() -> None:
    view = pictures.BirdsEye()
    points = np.array([[0.0, 0.0], [80.0, 0.0], [0.0, 40.0]])
    np.testing.assert_allclose(view.pixels(points), [[320, 640], [320, 0], [0, 640]])
    picture = pictures.birds_eye_picture(np.array([[10.0, 5.0, 0.0]]), np.array([True]))
    row, column = np.argwhere(picture[:, :, 3] > 0)[0]
    assert (row, column) == ((80 - 10) * 8, (40 - 5) * 8)
    assert tuple(picture[row, column, :3]) == pictures.MEASURED_COLOUR


def test_the_wireframe_of_a_box_projects_by_hand() -> None:
    from detection.boxes import corners
    from detection.types import Boxes3D

    # A 2 m cube whose bottom centre is 10 m in front on the optical axis; P2 = diag(70) with offset (48, 20).
    cube = corners(Boxes3D(np.array([[0, 1, 10, 2, 2, 2, 0.0]])))[0]
    path = wireframe(
        cube, replace(CALIBRATION, P2=np.array([[70.0, 0, 48, 0], [0, 70, 20, 0], [0, 0, 1, 0]])), (40, 96)
    )
    u, v = 48 + 70 * 1 / 9, 20 + 70 * 1 / 9  # nearest bottom right corner: x = 1, y = 1, z = 9
    assert f"{u:.1f} {v:.1f}" in path
    assert path.count("M") == 12
    behind = cube - np.array([0, 0, 30])
    assert wireframe(behind, CALIBRATION, (40, 96)) == ""
    around = cube - np.array([0, 0, 10])  # half of it behind the camera: what is in front is drawn
    assert 0 < wireframe(around, CALIBRATION, (400, 960)).count("M") <= 12


def test_the_footprint_of_a_box_points_to_its_front() -> None:
    from detection.boxes import corners
    from detection.types import Boxes3D

    # ry = -pi/2 looks along the camera's +z, which is forward of the LiDAR: up in the picture.
    cube = corners(Boxes3D(np.array([[0, 1, 10, 2, 2, 4, -np.pi / 2]])))[0]
    numbers = [float(text) for text in re.findall(r"-?[\d.]+", footprint(cube, CALIBRATION))]
    (x0, y0), (x1, y1) = numbers[-4:-2], numbers[-2:]
    assert x1 == pytest.approx(x0, abs=0.2)
    assert y0 - y1 == pytest.approx(2 * 8, abs=0.2)  # half the length, 8 pixels a metre


def test_objects_without_a_3d_box_are_not_drawn() -> None:
    area = KittiObject("DontCare", -1, -1, -10, (0, 0, 9, 9), (-1, -1, -1), (-1000, -1000, -1000), -10)
    assert drawn_boxes([area], CALIBRATION, (48, 96)) == []


def person(x: float, score: float | None = None) -> KittiObject:
    return KittiObject("Pedestrian", 0.0, 0, 0.0, (40, 10, 60, 40), (1.7, 0.6, 0.8), (x, 1.6, 12.0), 0.0, score)


def boxes(items: list[KittiObject], statuses: list[str], met: list[float | None]) -> list[DrawnBox]:
    drawn = drawn_boxes(items, CALIBRATION, (48, 96))
    return [replace(box, status=status, met=score) for box, status, score in zip(drawn, statuses, met)]


def test_counts_of_a_frame_add_up() -> None:
    """Six labels: one found, one whose detection lies under the threshold, three missed, one that does not count."""
    least = ScoreThresholds({"Pedestrian": 0.5})
    truth = boxes(
        [person(x) for x in range(6)],
        ["matched", "matched", "missed", "missed", "missed", "ignored"],
        [0.8, 0.4, None, None, None, None],
    )
    scores = [0.8, 0.4, 0.7, 0.6]
    found = boxes([person(x, score) for x, score in enumerate(scores)],
                  ["matched", "matched", "false positive", "ignored"], [None] * 4)  # fmt: skip
    assert tally(truth, found, least) == (
        "6 true: 1 found, 4 missed, 1 not counted; 3 predicted: 1 right, 1 false, 1 not counted"
    )
    assert tally(truth, None, least) == "6 true: 1 found, 4 missed, 1 not counted"
    assert tally(None, found, ScoreThresholds()) == "4 predicted: 2 right, 1 false, 1 not counted"
    assert tally(None, boxes([person(0, 0.9)], [""], [None]), least) == "1 predicted"


def test_boxes_carry_their_names_in_the_image(run: RunFolder) -> None:
    names = re.findall(r"<text class=\"name (\w+)[^>]*>(?:([^<]*)<)", score_and_report(run))
    assert sorted(names) == [("found", "Car")] * 3 + [("truth", "Car")] * 3


def test_without_labels_nothing_speaks_of_true_boxes(run: RunFolder) -> None:
    shutil.rmtree(run.root.parent / "kitti" / "training" / "label_2")
    text = score_and_report(run)
    shown = re.sub(r"<(script|style)[^>]*>.*?</\1>", "", text, flags=re.DOTALL)
    for word in ("true box", "show-truth", "missed", " true"):
        assert word not in shown.replace("true depth", ""), word
    assert "1 predicted" in shown


def test_all_frames_can_be_reached(run: RunFolder) -> None:
    """Three frames, two on a page: a summary with two of them, and two pages that hold all in order."""
    index = score_and_report(run, "report.frames=2")
    folder = run.report.parent
    assert sorted(path.name for path in folder.glob("*.html")) == ["frames-1.html", "frames-2.html", "index.html"]
    assert 'href="frames-1.html">000000 to 000001<' in index
    assert 'href="frames-2.html">000002<' in index
    pages = [(folder / f"frames-{n}.html").read_text(encoding="utf-8") for n in (1, 2)]
    held = [re.findall(r'<article id="[^"]*" data-id="(\d+)"', page) for page in pages]
    assert held == [["000000", "000001"], ["000002"]]
    assert all('href="index.html"' in page and "Average precision" not in page for page in pages)
    # One page fewer is asked for: the rest is named, and nothing of the earlier report is left.
    index = score_and_report(run, "report.frames=2", "report.pages=1")
    assert "more frames than" in index
    assert not (folder / "frames-2.html").exists()
    score_and_report(run)
    assert [path.name for path in folder.glob("*.html")] == ["index.html"]


def test_surfaces_are_visible_when_they_differ_in_one_pixel() -> None:
    gap, valid = np.zeros((9, 9), np.float32), np.ones((9, 9), bool)
    gap[4, 4] = 5.0
    darkest = pictures.error_colours()[255]
    assert (pictures.colour_gap(gap, valid) == darkest).all(axis=2).sum() == 25
    sigma = np.full((9, 9), 1.0, np.float32)
    shown = pictures.colour_sigma_between(sigma, gap, valid)
    assert (shown == pictures.sigma_colours()[255]).all(axis=2).sum() == 25
    assert (shown[0, 0] == pictures.UNDECIDED).all()
    depth = np.array([[4.0, 9.0, 0.0]], np.float32)
    assert pictures.widened(depth, nearest=True).tolist() == [[4.0, 4.0, 4.0]]
    assert pictures.widened(depth, nearest=False).tolist() == [[9.0, 9.0, 9.0]]


def test_small_functions() -> None:
    assert spread(("a", "b", "c", "d", "e"), 3) == ("a", "c", "e")
    assert spread(("a", "b"), 3) == ("a", "b")
    assert (number(0.14284), number(305.44), number(15940.2)) == ("0.1428", "305.4", "15,940")
    assert markdown_table(["a", "b"], [["1", "2"]]) == "| a | b |\n|---|---:|\n| 1 | 2 |\n"
    assert mean_of([{"a": 1.0, "b": 2.0}, {"a": 3.0}]) == {"a": 2.0}
    steps = [[{"step": "s", "in": 10, "out": 4}], [{"step": "s", "in": 20, "out": 6}]]
    assert mean_steps(steps) == [{"step": "s", "in": 15, "out": 5}]
