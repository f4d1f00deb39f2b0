"""Table 3.4 runs at budget smoke: on the synthetic world, and from the command line on a tiny KITTI folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from completion.types import CompletedDepth
from detection.evaluation.difficulty import KittiDifficulty
from detection.frustum.infer import FrustumDetector
from detection.frustum.network import FrustumPointNet
from detection.frustum.regions import object_regions
from detection.frustum.samples import frame_samples
from detection.kitti_format import KittiObject, format_line, parse_line
from pipeline.base.errors import DataError, UsageError
from pipeline.cli import main
from pipeline.data import open_dataset
from pipeline.data.kitti_object import read_labels, write_objects
from pipeline.experiments.catalogue import find
from pipeline.experiments.config import read_config
from pipeline.experiments.frustum_budget import FRUSTUM
from pipeline.experiments.frustum_points import Completion, FrustumFrames, completion_of, sparse_depth
from pipeline.experiments.frustum_runs import open_regions, outcome_of, train_settings
from pipeline.experiments.plan import Order, carry_out, gather, make_plan
from pipeline.experiments.runs import Context, budget_of
from pipeline.geometry.in_view import lidar_pixels
from tests.pipeline.tiny_kitti import HEIGHT, WIDTH, tiny_frame, write_tiny_kitti


def test_no_row_is_quoted() -> None:
    table = find("table", "3.4")
    assert all(row.recipe is not None for row in table.rows)
    assert [row.printed[:6] for row in table.rows] == [
        (54.4, 36.2, 31.3, 73.6, 58.1, 50.4),
        (36.7, 23.0, 18.5, 56.2, 33.8, 29.7),
        (64.9, 41.9, 34.7, 78.1, 54.0, 45.6),
    ]


def test_raw_rows_run_on_the_synthetic_world(tmp_path: Path) -> None:
    whole = find("table", "3.4")
    table = replace(whole, rows=whole.rows[:1], claims=())
    plan = make_plan(Order((table,), tmp_path, "smoke", 1))
    carry_out(plan, lambda text: None)
    result = gather(plan, table)
    (outcome,) = result.outcomes["Raw 16R"]
    assert all(0 <= outcome.numbers[column.key] <= 100 for column in table.columns)
    again = make_plan(Order((table,), tmp_path, "smoke", 1))
    assert again.open_runs() == []


def kitti_with_cars(root: Path, frames: int) -> Path:
    """A tiny KITTI folder whose car has a 2D box of more than 25 px."""
    write_tiny_kitti(root, frames)
    for index in range(frames):
        car = replace(tiny_frame(index).labels[0], bbox=(30.0, 10.0, 66.0, 44.0))
        write_objects(root / "training" / "label_2" / f"{index:06d}.txt", [car])
    return root


def test_a_tiny_kitti_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, out = kitti_with_cars(tmp_path / "kitti", 4), tmp_path / "out"
    options = ["--budget", "smoke", "--seeds", "1", "--data", str(root), "--out", str(out)]
    assert main(["--stage", "experiment", "--table", "3.4", *options]) == 0
    assert "DC, 3 coefficients" in capsys.readouterr().out
    files = sorted(out.glob("runs/frustum-*/detections/*.txt"))
    assert len(files) == 6  # two test frames, three rows
    lines = [line for file in files for line in read_labels(file, scored=True)]
    assert lines
    assert {(item.type, item.alpha, item.bbox) for item in lines} == {("Car", -10.0, (30.0, 10.0, 66.0, 44.0))}


def test_frames_without_usable_boxes_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = write_tiny_kitti(tmp_path / "kitti", 4)  # its boxes are 16 px high
    options = ["--budget", "smoke", "--seeds", "1", "--data", str(root), "--out", str(tmp_path / "out")]
    assert main(["--stage", "experiment", "--table", "3.4", *options]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("run_pipeline: training: no frustum of Car")


def test_completed_points_fall_onto_their_pixels(tmp_path: Path) -> None:
    dataset = open_dataset("kitti_object", write_tiny_kitti(tmp_path, 1))
    frame = dataset[0]

    class Flat:
        def complete(self, sparse: object, image: object, K: object) -> CompletedDepth:
            depth = np.zeros((HEIGHT, WIDTH), np.float32)
            depth[5, 7], depth[30, 60] = 10.0, 20.0
            return CompletedDepth(depth)

    frames = FrustumFrames(dataset, 16, Completion(Flat(), "flat"), tmp_path / "cache")
    points = frames.point_frame(frame).points
    assert points.shape == (2, 3)
    pixels = lidar_pixels(points, frame.calibration, frame.image_size)
    assert sorted(pixels.tolist()) == [5 * WIDTH + 7, 30 * WIDTH + 60]
    raw = FrustumFrames(dataset, 64, None, tmp_path / "cache").point_frame(frame).points
    np.testing.assert_array_equal(raw, frame.points[:, :3])


def test_boxes_come_from_lists_and_folders(tmp_path: Path) -> None:
    frame = tiny_frame(3)
    listed = tmp_path / "val.txt"
    listed.write_text("training/image_2/000003.png 2 0.75 1 2 30 40\ntraining/image_2/000004.png 1 0.5 1 2 3 4\n")
    (region,) = open_regions(str(listed))(frame)
    assert (region.type, region.score, region.bbox) == ("Car", 0.75, (1, 2, 30, 40))
    (tmp_path / "results").mkdir()
    assert open_regions(str(tmp_path / "results"))(frame) == []
    write_objects(tmp_path / "results" / "000003.txt", [replace(frame.labels[0], score=0.25)])
    assert open_regions(str(tmp_path / "results"))(frame)[0].score == 0.25
    assert open_regions("labels")(frame)[0].score is None
    listed.write_text("training/image_2/000003.png 9 0.75 1 2 30 40\n")
    with pytest.raises(DataError, match=r"val.txt:1: class 9"):
        open_regions(str(listed))
    with pytest.raises(UsageError, match="expected 'labels', a list of 2D detections or a folder"):
        open_regions(str(tmp_path / "none.txt"))


def test_perfect_boxes_have_full_precision_in_both_countings() -> None:
    cars = {
        f"{k:06d}": [KittiObject("Car", 0, 0, 0, (100, 100, 200, 160), (1.5, 1.6, 4), (k, 1.6, 15), 0.3)]
        for k in range(41)
    }
    found = {name: [replace(car, score=0.5 + int(name) / 100) for car in items] for name, items in cars.items()}
    numbers = outcome_of(cars, found, KittiDifficulty("cpp"), 10).numbers
    assert numbers["3d_0.7_easy"] > 95
    assert numbers["r11/3d_0.7_easy"] == 100
    half = {name: items if int(name) % 2 else [] for name, items in found.items()}
    numbers = outcome_of(cars, half, KittiDifficulty("cpp"), 10).numbers
    assert numbers["r11/3d_0.7_easy"] == pytest.approx(100 * 6 / 11, abs=9.1)
    assert numbers["r11/3d_0.7_easy"] != numbers["3d_0.7_easy"]


def test_all_rows_are_trained_alike() -> None:
    settings = train_settings(FRUSTUM["paper"], 3)
    assert (settings.batch_size, settings.points, settings.channels, settings.seed) == (32, 1024, 3, 3)
    assert (settings.learning_rate, settings.decay_samples, settings.copies) == (0.001, 800_000, 5)


def test_the_completion_of_a_row_is_trained_on_its_rows(tmp_path: Path) -> None:
    dataset = open_dataset("kitti_object", write_tiny_kitti(tmp_path / "kitti", 2))
    budget = replace(FRUSTUM["smoke"], completers={})
    context = Context(tmp_path / "out", tmp_path / "out" / "run", None, budget, 0, lambda text: None)
    first = completion_of("ma", 16, dataset, context)
    depth = first.completer.complete(sparse_depth(dataset[0], 16), dataset[0].image, None).depth
    assert depth.shape == (HEIGHT, WIDTH)
    assert (depth > 0).all()
    assert completion_of("ma", 16, dataset, context).name == first.name
    assert completion_of("dc", 16, dataset, context).name != first.name


def test_a_configuration_names_boxes_and_completers(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text('table: "3.4"\nfrustum:\n  boxes: val.txt\n  completers: {ma: a.safetensors}\n')
    budget = budget_of("frustum", "paper", read_config(path).changes)
    assert (budget.boxes, dict(budget.completers)) == ("val.txt", {"ma": "a.safetensors"})


def test_real_frames_give_frustums_and_result_lines(kitti_object: Path, tmp_path: Path) -> None:
    frames = FrustumFrames(open_dataset("kitti_object", kitti_object), 64, None, tmp_path)
    torch.manual_seed(0)
    detector = FrustumDetector(FrustumPointNet("tf", 3).eval(), torch.device("cpu"))
    frame, labels = frames[3]
    (sample,) = frame_samples(frame, labels, 3)
    # A box hugs its car: most points of the frustum are the object's, at the labelled distance.
    assert sample.type == "Car"
    assert sample.mask.mean() > 0.5
    distance = np.median(sample.points[sample.mask, 2])
    assert abs(float(distance) - float(sample.centre[2])) < 2.5
    (found,) = detector.detect(frame, object_regions(labels))
    assert parse_line(format_line(found), scored=True).bbox == pytest.approx(labels[0].bbox, abs=0.01)
