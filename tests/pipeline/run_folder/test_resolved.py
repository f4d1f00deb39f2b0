"""config.yaml of a run holds every number, so that the run keeps its results when presets and defaults change."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import pytest
import yaml

import pipeline.pointcloud.presets as presets
from pipeline.base.errors import UsageError
from pipeline.cli import main
from pipeline.pointcloud.grid_sampling import GridSampling
from pipeline.pointcloud.presets import PRESETS, AugmentSettings
from pipeline.pointcloud.sigma_filter import SigmaBand
from pipeline.run_folder.config import Config, dump_config, load_config
from pipeline.run_folder.preset import preset_with_changes, uses_raw_lidar
from pipeline.run_folder.resolved import resolved_config, synth_settings
from pipeline.stages.augment import AugmentStage
from pipeline.training.settings import SETTINGS, with_training_settings

FIELDS = {field.name for field in fields(AugmentSettings)}


def stored(config: Config, folder: Path) -> Path:
    """The configuration as a run leaves it in its folder."""
    path = folder / "config.yaml"
    path.write_text(dump_config(config.model_copy(update={"made_with": {"auglidar": "0"}})))
    return path


def config_with(*overrides: str) -> Config:
    return resolved_config(load_config(None, overrides))


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_reads_back_as_the_same_numbers(name: str, tmp_path: Path) -> None:
    config = config_with(f"augment.preset={name}", "augment.semantics=truth")
    assert config.augment.library.keys() >= FIELDS
    again = load_config(stored(config, tmp_path))
    assert preset_with_changes(again.augment) == PRESETS[name]
    assert resolved_config(again).augment == config.augment
    assert uses_raw_lidar(again) == (name == "L")


def test_other_presets_change_nothing_for_a_run_that_has_its_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = config_with("augment.grid.size=0.15", "augment.columns=[gap]")
    path = stored(config, tmp_path)
    before = preset_with_changes(config.augment)
    other = {name: replace(found, sigma=SigmaBand(0.1, 0.9, 1.0), grid=None) for name, found in PRESETS.items()}
    monkeypatch.setattr(presets, "PRESETS", other)
    assert (
        preset_with_changes(load_config(path).augment)
        == before
        == replace(PRESETS["L_D_F"], grid=GridSampling(0.15), columns=("gap",))
    )
    assert AugmentStage.of(load_config(path)).settings() == AugmentStage.of(config).settings()
    assert preset_with_changes(config_with().augment).sigma == SigmaBand(0.1, 0.9, 1.0)  # a new run takes the new ones
    monkeypatch.setattr(presets, "PRESETS", {})  # even when the preset has gone
    assert preset_with_changes(load_config(path).augment) == before


def test_another_preset_takes_the_place_of_the_numbers_of_the_old_one(tmp_path: Path) -> None:
    path = stored(config_with("augment.grid.size=0.15", "augment.semantics=truth"), tmp_path)
    switched = load_config(path, ["augment.max_points=7", "augment.preset=D"])
    assert preset_with_changes(switched.augment) == replace(PRESETS["D"], max_points=7)
    assert switched.augment.semantics == "truth"
    same = load_config(path, ["augment.preset=L_D_F"])
    assert preset_with_changes(same.augment) == replace(PRESETS["L_D_F"], grid=GridSampling(0.15))


def test_preset_l_is_raw_lidar_until_something_changes_it() -> None:
    assert uses_raw_lidar(load_config(None, ["augment.preset=L"]))
    assert uses_raw_lidar(config_with("augment.preset=L"))
    assert not uses_raw_lidar(config_with("augment.preset=L", "augment.max_points=100"))
    assert not uses_raw_lidar(config_with("augment.preset=table_5_6_lidar"))


def test_the_synthetic_world_is_written_out_and_its_seed_stays_with_the_run(tmp_path: Path) -> None:
    config = config_with("seed=5", "synth.frames=3")
    assert config.synth.library["rows"] == 64
    assert "seed" not in config.synth.library
    path = stored(config, tmp_path)
    assert synth_settings(load_config(path)) == synth_settings(config)
    assert synth_settings(load_config(path, ["seed=6"])).seed == 6
    assert config_with("synth.seed=9").synth.library["seed"] == 9
    assert load_config("kitti").synth.library == resolved_config(load_config("kitti")).synth.library == {}


@pytest.mark.parametrize("network", SETTINGS)
def test_training_is_written_out(network: str, tmp_path: Path) -> None:
    config = with_training_settings(load_config(None, [f"train.network={network}", "seed=3"]))
    again = load_config(stored(config, tmp_path))
    assert again.train == config.train
    assert SETTINGS[network](again) == SETTINGS[network](config)
    assert SETTINGS[network](again).seed == 3


def test_another_network_takes_the_place_of_the_old_ones_settings(tmp_path: Path) -> None:
    config = with_training_settings(load_config(None, ["train.network=completion"]))
    path = stored(config, tmp_path)
    switched = load_config(path, ["train.network=detection", "train.steps=2"])
    assert switched.train.library == {"steps": 2}
    other = load_config(path, ["train.model.architecture=msg_chn"])
    assert SETTINGS["completion"](other) == SETTINGS["completion"](
        load_config(None, ["train.model.architecture=msg_chn"])
    )


def test_unknown_presets_and_fields_are_refused() -> None:
    with pytest.raises(UsageError, match=r"augment.preset: unknown preset 'L_D_G'; did you mean 'L_D_F'\?"):
        config_with("augment.preset=L_D_G")
    with pytest.raises(UsageError, match=r"unknown setting augment.gird; did you mean 'grid'\?"):
        config_with("augment.gird.size=1")


def test_the_run_folder_holds_the_numbers(tmp_path: Path) -> None:
    out = tmp_path / "run"
    options = ["--config", "kitti", "--data", str(tmp_path / "nowhere"), "--set", "augment.sigma.gap=2"]
    assert main(["--stage", "complete", "--out", str(out), *options]) == 2  # no data; the folder is prepared before
    tree = yaml.safe_load((out / "config.yaml").read_text())
    assert tree["augment"]["preset"] == "L_D_F"
    assert tree["augment"]["sigma"] == {"low": 0.2, "high": 0.8, "gap": 2.0}
    assert tree["augment"]["near_lidar"] == {"near": 0.3, "far": 1.5, "split": 40.0}
    assert tree["augment"]["semantic"] is None
    assert tree["made_with"]
