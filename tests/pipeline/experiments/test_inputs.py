"""Input clouds of detection experiments: each recipe gives the points it names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from completion.types import CompletedDepth
from pipeline.base.errors import UsageError
from pipeline.base.settings import with_changes
from pipeline.data import Dataset, Frame
from pipeline.experiments.chapter_5_exact import BLUR, MISALIGNED, exact_input
from pipeline.experiments.cloud_cache import CloudCache, DepthCache
from pipeline.experiments.detection_runs import DetectionRecipe
from pipeline.experiments.inputs import InputCloud, InputRecipe, make_input
from pipeline.experiments.semi_dense_model import semi_dense_of
from pipeline.experiments.worlds import ThesisLevels, open_world, synthetic_frames
from pipeline.pointcloud.semantic_mask import OBJECTS, object_score
from pipeline.pointcloud.taxonomy import CLEAN, NOISE_INBET
from pipeline.semantics.sources import TrueBoxes, TrueClasses

LIMIT = 200_000


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return synthetic_frames(tmp_path_factory.mktemp("world"), 2, 1001, (188, 620), lambda text: None)


@pytest.fixture(scope="module")
def frame(dataset: Dataset) -> Frame:
    return max(dataset, key=lambda frame: int(np.isin(frame.semantics, OBJECTS).sum()))


def exact_cloud(frame: Frame, limit: int = LIMIT, **chosen: object) -> InputCloud:
    recipe = with_changes(InputRecipe(), exact_input(**chosen), "input")  # type: ignore[arg-type]
    masks = TrueBoxes() if recipe.masks == "boxes" else TrueClasses()
    return make_input(frame, recipe, CompletedDepth(frame.target_depth), masks, limit)


def test_exact_depth_is_clean_and_noise_is_not(frame: Frame) -> None:
    clean, blurred, misaligned = (exact_cloud(frame, noise=noise) for noise in (None, BLUR, MISALIGNED))
    assert (clean.kind[clean.kind > 0] == CLEAN).all()
    between = [float((cloud.kind == NOISE_INBET).mean()) for cloud in (clean, blurred, misaligned)]
    assert between[0] == 0
    assert between[1] > 2 * between[2]
    assert between[1] > 0.003
    # Misaligned points keep their pixel and leave their surface along the ray; the same seed gives the same points.
    again = exact_cloud(frame, noise=MISALIGNED)
    assert np.array_equal(again.points, misaligned.points)


def test_resolutions_grow(frame: Frame) -> None:
    counts = [len(exact_cloud(frame, resolution=name).points) for name in ("64R", "128R", "256R")]
    assert counts[0] < counts[1] < counts[2]
    everything = exact_cloud(frame, resolution="Alldep").points
    cells = np.unique(np.floor(everything[:, :3] / np.float32(0.1)), axis=0)
    assert len(cells) > 0.6 * len(everything)


def test_semantic_rows_keep_objects_and_what_is_within_the_radius(frame: Frame) -> None:
    cloud = exact_cloud(frame, pixels="semantic")
    everything = exact_cloud(frame)
    assert int(cloud.objects.sum()) == int(everything.objects.sum()) > 0
    anchors = cloud.points[cloud.objects, :3].astype(np.float64)
    for point in cloud.points[~cloud.objects, :3].astype(np.float64):
        assert np.linalg.norm(anchors - point, axis=1).min() <= 0.3 + 1e-6
    boxes = exact_cloud(frame, pixels="boxes")
    assert max(len(cloud.points), len(boxes.points)) < len(everything.points)
    assert everything.objects.mean() < boxes.objects.mean() < cloud.objects.mean()


def test_fewer_rows_and_the_join(frame: Frame) -> None:
    depth = CompletedDepth(frame.target_depth)
    full, sparse = (make_input(frame, InputRecipe("L", rows=rows), None, None, LIMIT) for rows in (64, 16))
    assert 0.15 < len(sparse.points) / len(full.points) < 0.35
    assert (full.kind == CLEAN).all()
    joined = make_input(frame, InputRecipe("L_D_SF_mask", rows=16), depth, TrueClasses(), LIMIT)
    measured = joined.points[joined.points[:, 4] == 0]
    assert np.array_equal(measured[:, :4], sparse.points[:, :4])
    assert InputRecipe("L_D_SF_mask").extra_features == ("source", "semantic")
    assert InputRecipe("L").extra_features == InputRecipe("D").extra_features == ()
    relevant = object_score(frame.semantics, OBJECTS) > 0
    assert relevant.any()
    assert set(np.unique(joined.points[:, 5])) == {0.0, 1.0}


def test_limit_thins_completed_points_first(frame: Frame) -> None:
    lidar = len(make_input(frame, InputRecipe("L", rows=16), None, None, LIMIT).points)
    cloud = make_input(
        frame, InputRecipe("L_D_F", rows=16), CompletedDepth(frame.target_depth), TrueClasses(), lidar + 50
    )
    assert len(cloud.points) == lidar + 50
    assert int((cloud.points[:, 4] == 0).sum()) == lidar


def test_semi_dense_model_has_the_errors_of_pseudo_truth(frame: Frame) -> None:
    depth, truth = semi_dense_of(frame), frame.target_depth
    both = (depth > 0) & (truth > 0)
    error = np.abs(depth - truth)[both]
    # Spec of semi-dense truth: about a sixth of the pixels; small mean error, much larger squared error.
    assert 0.08 < both.mean() < 0.5
    assert 0.01 < error.mean() < 0.5
    assert np.sqrt((error**2).mean()) > 1.5 * error.mean()


def test_caches_go_on_where_they_stopped(dataset: Dataset, tmp_path: Path) -> None:
    cache = CloudCache(dataset, InputRecipe("D", rows=16), DepthCache(tmp_path, "classical"), None, "", 2000)
    said: list[str] = []
    cache.prepare(said.append)
    first = cache.read(dataset.ids[0])
    path = next(cache.folder.glob("*.npz"))
    before = path.read_bytes()
    path.unlink()
    cache.prepare(said.append)
    cache.prepare(said.append)
    assert [text.split()[1] for text in said] == ["2", "1"]
    assert path.read_bytes() == before
    assert len(first.points) == 2000
    assert (tmp_path / "depth-classical-16" / "depth").is_dir()
    other = replace(cache, recipe=InputRecipe("D", rows=64))
    assert other.folder != cache.folder


def test_worlds_and_levels(dataset: Dataset, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such folder"):
        open_world(tmp_path, tmp_path / "none", 2, 2, None)
    folder = Path(dataset.root)
    world = open_world(tmp_path, folder.parent if folder.name == "training" else folder, 1, 1, None)
    assert world.train.ids != world.test.ids
    # Height 50 px, untruncated: levels 0, 1, 2, 3 of occlusion are easy, medium, hard, nothing (thesis 5.4.1.2).
    counts = ThesisLevels().counts(np.full(4, 50.0), np.zeros(4), np.arange(4.0))
    assert counts.astype(int).tolist() == [[1, 0, 0, 0], [1, 1, 0, 0], [1, 1, 1, 1]]


def test_wrong_recipes_are_refused() -> None:
    with pytest.raises(UsageError, match="input: depth: expected one of"):
        DetectionRecipe.of({"input": {"depth": "guess"}})
    with pytest.raises(UsageError, match="unknown setting 'inputs'"):
        DetectionRecipe.of({"inputs": {}})
    with pytest.raises(UsageError, match="rows: expected a divisor of 64"):
        DetectionRecipe.of({"input": {"rows": 17}})
    same = DetectionRecipe.of({"input": {"preset": "L", "depth": "truth"}}).train_input.record()
    assert same == DetectionRecipe.of({"input": {"preset": "L"}}).train_input.record()
