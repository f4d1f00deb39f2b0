"""Synthetic frames under photographs and on uneven ground: what changes, what must not, and the command that trains."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from auglidar_base.errors import SettingsError
from completion.sensor_effects import SensorEffects
from pipeline.base.errors import UsageError
from pipeline.cli import main
from pipeline.data import Dataset, open_dataset
from pipeline.run_folder.config import load_config
from pipeline.semantics.conventions import CLASSES
from pipeline.training.photographs import LEVELS, read_photographs
from pipeline.training.relief import relief
from pipeline.training.stage import completion_samples
from pipeline.training.surfaces import find_surfaces, retextured

K = np.array([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]])
ROAD, BUILDING, CAR = (CLASSES.index(name) for name in ("road", "building", "car"))


def street() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sky over a facade 20 m ahead over a road 1.6 m below, and a car of the facade's colour 10 m ahead of it."""
    depth, kind = np.zeros((48, 60), np.float32), np.full((48, 60), CLASSES.index("sky"), np.uint8)
    depth[8:24], kind[8:24] = 20, BUILDING
    rows = np.arange(24, 48)
    depth[24:], kind[24:] = (1.6 * 50 / (rows - 20))[:, None], ROAD
    depth[16:28, 20:40], kind[16:28, 20:40] = 10, CAR
    return depth, kind, (kind == CAR).astype(np.int32)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    rng = np.random.default_rng(0)
    for name in ("bricks.png", "below/grass.jpg"):
        (folder / name).parent.mkdir(exist_ok=True)
        coarse = rng.integers(0, 255, (40, 30, 3), dtype=np.uint8)
        assert cv2.imwrite(str(folder / name), cv2.resize(coarse, (300, 400), interpolation=cv2.INTER_NEAREST))
    assert cv2.imwrite(str(folder / "icon.png"), np.zeros((16, 16, 3), np.uint8))
    assert cv2.imwrite(str(folder / "plan.png"), np.full((300, 300, 3), 255, np.uint8))
    (folder / "note.txt").write_text("no picture")
    return folder


def test_photographs_are_told_from_icons_and_plans(photographs: Path, tmp_path: Path) -> None:
    tiles = read_photographs(photographs)
    assert [level.shape for level in tiles] == [(2, 512 >> n, 512 >> n, 3) for n in range(LEVELS)]
    assert abs(float(tiles[0].mean()) - float(tiles[-1].mean())) < 1
    with pytest.raises(UsageError, match=r"expected a folder of photographs"):
        read_photographs(tmp_path)
    (tmp_path / "broken.png").write_bytes(b"no picture at all")
    with pytest.raises(UsageError, match=r"none of 1 pictures is a photograph"):
        read_photographs(tmp_path, 3)


def test_a_surface_ends_at_a_step_a_turn_or_another_thing() -> None:
    depth, kind, objects = street()
    surfaces = find_surfaces(depth, kind, objects, K)
    assert (surfaces.label[depth == 0] == 0).all()
    facade, road, car = (surfaces.label[row, column] for row, column in ((12, 5), (40, 5), (20, 30)))
    assert len({0, facade, road, car}) == 4
    assert surfaces.label[12, 55] == facade
    assert surfaces.label[40, 55] == road
    assert (surfaces.kind[facade], surfaces.kind[road], surfaces.kind[car]) == (BUILDING, ROAD, CAR)
    # A facade looks along 2 (ahead), a road along 1 (down); things have no face.
    assert (surfaces.face[facade], surfaces.face[road], surfaces.face[car]) == (2, 1, 3)


def test_pictures_change_surface_by_surface_and_depth_does_not(photographs: Path) -> None:
    depth, kind, objects = street()
    surfaces, grey = find_surfaces(depth, kind, objects, K), np.full((48, 60, 3), 90, np.uint8)
    tiles = read_photographs(photographs)
    drawn = [retextured(grey, surfaces, tiles, np.random.default_rng(seed)) for seed in range(12)]
    np.testing.assert_array_equal(drawn[3], retextured(grey, surfaces, tiles, np.random.default_rng(3)))
    changed = np.array([[(one != 90).any(-1)[surfaces.label == each].mean() for each in range(1, 4)] for one in drawn])
    # A surface is covered as a whole or left as it is, two of three are covered.
    assert set(np.round(changed[changed < 0.9], 6)) == {0.0}
    assert 0.4 < (changed > 0.9).mean() < 0.95
    assert grey.min() == grey.max() == 90


def test_raised_ground_is_nearer_and_walls_stay() -> None:
    depth, kind, _ = street()
    kind[kind == ROAD] = CLASSES.index("terrain")
    factors = np.stack([relief(depth, kind, K, np.random.default_rng(seed)) for seed in range(8)])
    wall, ground = kind == BUILDING, kind == CLASSES.index("terrain")
    assert (factors[:, wall] == 1).all()
    assert factors[:, ground].std() > 0.02
    assert factors.min() >= 0.6
    assert factors.max() <= 1.5
    kind[wall] = CLASSES.index("vegetation")
    crowns = relief(depth, kind, K, np.random.default_rng(1))[wall]
    assert 0 < crowns.std() < 0.1


@pytest.mark.parametrize(
    "effect", [{"exposure": 0.7}, {"balance": 0.3}, {"vignette": 0.8}, {"blur": 2.0}, {"jpeg": 25}], ids=str
)
def test_every_sensor_effect_does_what_it_is_called(effect: dict[str, float]) -> None:
    image = np.random.default_rng(0).integers(60, 140, (32, 48, 3), dtype=np.uint8)
    effects = SensorEffects(**effect)  # type: ignore[arg-type]
    drawn = np.stack([effects.apply(image, np.random.default_rng(seed)) for seed in range(16)]).astype(float)
    same = (drawn == image).all(axis=(1, 2, 3))
    assert 0 < same.sum() < 16
    changed = drawn[~same]
    if "exposure" in effect:
        assert (changed.mean(axis=(1, 2, 3)) > image.mean()).all()
    elif "balance" in effect:
        assert np.ptp(changed.mean(axis=(1, 2)), axis=1).mean() > 5
    elif "vignette" in effect:
        assert (changed <= image + 0.5).all()
    elif "blur" in effect:
        assert changed.std() < image.std()
    assert (SensorEffects().apply(image, np.random.default_rng(0)) == image).all()


def test_sensor_effects_that_no_camera_has_are_refused() -> None:
    with pytest.raises(SettingsError, match="jpeg: expected 0 or a quality of 20 to 100, got 5"):
        SensorEffects(jpeg=5)
    with pytest.raises(SettingsError, match="vignette: expected a share"):
        SensorEffects(vignette=2)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("streets")
    small = ["synth.frames=2", "synth.size=[64,208]"]
    assert main(["--stage", "synth", *(part for each in small for part in ("--set", each)), "--out", str(out)]) == 0
    return out / "data"


def section(*changes: str) -> list[str]:
    return ["train.beam_strides=[2,4]", *changes]


def drawn(dataset: Dataset, *changes: str, count: int = 24) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    samples = completion_samples(dataset, load_config("kitti", section(*changes)))
    sample = samples[0]
    frames = [sample.draw(np.random.default_rng(seed)) for seed in range(count)]  # type: ignore[union-attr]
    return [(frame.image, frame.sparse, np.asarray(frame.target)) for frame in frames]


def test_truth_is_of_both_kinds_and_the_picture_of_many(data: Path, photographs: Path) -> None:
    dataset = open_dataset("kitti_object", data)
    frames = drawn(dataset, "train.truth=both", f"train.photographs={photographs}")
    share = np.array([(target > 0).mean() for _, _, target in frames])
    assert 12 <= (share < 0.3).sum() <= 23
    assert (share > 0.5).sum() >= 1
    plain = dataset[0].image
    assert 8 <= sum((image != plain).any() for image, _, _ in frames) <= 22
    for _, sparse, target in frames:  # without relief depth stays what was measured
        assert np.abs(target[target > 0]).max() <= 655
        assert sparse.max() > 0


def test_relief_moves_given_and_asked_depth_alike(data: Path) -> None:
    dataset = open_dataset("kitti_object", data)
    changed = drawn(dataset, "train.truth=depth", "train.relief=1.0", count=3)
    truth = dataset[0].target_depth
    for _, sparse, target in changed:
        both = (sparse > 0) & (target > 0)
        factor = target[both] / truth[both]
        assert factor.std() > 0.001
        # Where LiDAR and camera agree before, they agree after.
        assert np.median(np.abs(sparse[both] / target[both] - 1)) < 0.02


def test_data_without_true_depth_and_strides_without_rings_are_refused(data: Path, tmp_path: Path) -> None:
    dataset = open_dataset("kitti_object", data)
    with pytest.raises(UsageError, match=r"held_out_rings expects numbers from 2"):
        completion_samples(dataset, load_config("kitti", ["train.truth=both", "train.beam_strides=[1,2]"]))
    for path in (data / "training" / "semantic_2").glob("*.png"):
        path.rename(tmp_path / path.name)
    try:
        with pytest.raises(UsageError, match=r"frame 000000 has no semantics; .* are for synthetic frames"):
            completion_samples(open_dataset("kitti_object", data), load_config("kitti", section("train.relief=1")))
    finally:
        for path in tmp_path.glob("*.png"):
            path.rename(data / "training" / "semantic_2" / path.name)


def test_the_shipped_configuration_trains(data: Path, photographs: Path, tmp_path: Path) -> None:
    tiny = ["train.steps=2", "train.augmentation.crop=[64,96]", "train.batch_size=2", "train.workers=0"]
    changes = [*tiny, "data.name=kitti_object", f"train.photographs={photographs}", "train.beam_strides=[2,4]"]
    command = ["--config", "configs/weights/completion-photographs.yaml", "--stage", "train", "--data", str(data)]
    command += [part for change in changes for part in ("--set", change)]
    assert main([*command, "--out", str(tmp_path)]) == 0
    assert (tmp_path / "weights" / "completion" / "last.safetensors").is_file()
