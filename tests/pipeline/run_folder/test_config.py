"""Configuration: names are checked, overrides typed, the resolved copy reads back."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from auglidar_base.errors import SettingsError
from pipeline.base.errors import RenamedSettingWarning, UsageError
from pipeline.base.settings import nearest_name, plain, with_changes
from pipeline.run_folder.config import Config, built_in_folder, dump_config, load_config, parse_config

BUILT_IN = sorted(path.stem for path in built_in_folder().glob("*.yaml"))


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in_files_are_valid_and_read_back(name: str, tmp_path: Path) -> None:
    config = load_config(f"configs/{name}.yaml")
    (tmp_path / "config.yaml").write_text(dump_config(config))
    assert load_config(tmp_path / "config.yaml") == config


def test_the_documented_files_are_there() -> None:
    assert {"kitti", "synthetic", "vkitti2", "nyuv2"} <= set(BUILT_IN)


def test_built_in_files_are_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert load_config("configs/kitti.yaml").data.name == "kitti_object"
    assert load_config("kitti").data.name == "kitti_object"
    with pytest.raises(UsageError, match=r"no such configuration file: other.yaml \(built in: .*kitti"):
        load_config("other.yaml")


def test_a_file_in_place_wins_over_the_built_in_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "kitti.yaml").write_text("seed: 77\n")
    monkeypatch.chdir(tmp_path)
    assert load_config("configs/kitti.yaml").seed == 77


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("sead=2", r"unknown key sead; did you mean 'seed'\?"),
        ("completion.modle=x", r"unknown key completion.modle; did you mean 'model'\?"),
        ("evaluation.recall=39", "evaluation.recall: .*got 39"),
        ("run.workers=-1", "run.workers: .*got -1"),
        ("seed=abc", "seed: .*got 'abc'"),
        ("seed", "expected key.sub=value"),
        ("seed.x=1", "seed is a value, not a section"),
        ("a..b=1", "expected key.sub=value"),
        ("seed=[1", "not valid YAML"),
    ],
)
def test_wrong_overrides_are_refused_by_name(override: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        load_config("kitti", [override])


def test_overrides_are_typed_as_yaml_types_them() -> None:
    overrides = ["seed=7", "run.keep_going=false", "evaluation.classes=[Car, Van]", "run.max_gb=1.5", "data.root='12'"]
    config = load_config("kitti", overrides)
    assert (config.seed, config.run.keep_going, config.run.max_gb, config.data.root) == (7, False, 1.5, "12")
    assert config.evaluation.classes == ("Car", "Van")


def test_keys_of_a_library_pass_through_and_keep_their_structure() -> None:
    config = load_config("kitti", ["augment.grid.size=0.1", "augment.max_points=9"])
    assert config.augment.library == {"grid": {"size": 0.1}, "max_points": 9}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- a\n", "expected 'section:' lines, got list"),
        ("a: [", "not valid YAML"),
        ("!!python/object:os.x {}", "not valid"),
    ],
)
def test_files_that_are_no_configuration(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(UsageError, match=message):
        load_config(path)


def test_an_empty_file_is_the_default(tmp_path: Path) -> None:
    (tmp_path / "empty.yaml").write_text("")
    assert load_config(tmp_path / "empty.yaml") == Config()


@dataclass(frozen=True)
class Inner:
    size: float = 0.2
    kind: str = "first"

    def __post_init__(self) -> None:
        if self.size <= 0:
            raise SettingsError(f"size: expected > 0, got {self.size}")


@dataclass(frozen=True)
class Needs:
    radius: float


@dataclass(frozen=True)
class Outer:
    count: int = 1
    inner: Inner | None = None
    other: Inner = field(default_factory=lambda: Inner(0.5))
    needs: Needs | None = None
    names: tuple[str, ...] = ()


def test_changes_reach_nested_settings() -> None:
    changed = with_changes(Outer(), {"count": 3, "other": {"kind": "last"}, "names": ["a", "b"]}, "outer")
    assert changed == Outer(3, None, Inner(0.5, "last"), None, ("a", "b"))
    assert with_changes(Outer(), {"inner": {"size": 1}}, "outer").inner == Inner(1.0)
    assert with_changes(Outer(inner=Inner()), {"inner": None}, "outer").inner is None
    assert with_changes(Outer(), {"needs": {"radius": 2}}, "outer").needs == Needs(2.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cuont": 1}, r"unknown setting outer.cuont; did you mean 'count'\?"),
        ({"other": {"sise": 1}}, r"unknown setting outer.other.sise; did you mean 'size'\?"),
        ({"count": "many"}, "outer.count: .*got 'many'"),
        ({"other": {"size": -1}}, r"outer.other: size: expected > 0, got -1"),
        ({"needs": {}}, "outer.needs: radius must be given too"),
        ({"other": 3}, "outer.other: .*got 3"),
    ],
)
def test_changes_that_do_not_fit_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        with_changes(Outer(), changes, "outer")


@dataclass(frozen=True)
class Renewed:
    RENAMED: ClassVar[dict[str, str]] = {"number": "count", "inner.peak": "rate", "inside": "inner"}

    count: int = 1
    rate: float = 0.1
    inner: Inner = field(default_factory=lambda: Inner(0.5))


def test_earlier_names_are_understood_with_a_warning() -> None:
    with pytest.warns(RenamedSettingWarning, match=r"outer.number is called outer.count now"):
        assert with_changes(Renewed(), {"number": 3}, "outer").count == 3
    with pytest.warns(RenamedSettingWarning, match=r"outer.inner.peak is called outer.rate now"):
        assert with_changes(Renewed(), {"inner": {"peak": 2, "size": 3}}, "outer") == Renewed(1, 2.0, Inner(3.0))
    with pytest.warns(RenamedSettingWarning, match=r"outer.inside is called outer.inner now"):
        assert with_changes(Renewed(), {"inside": {"size": 4}}, "outer").inner == Inner(4.0)
    with pytest.raises(UsageError, match=r"outer.number is the earlier name of outer.count: give one of them"):
        with_changes(Renewed(), {"number": 3, "count": 4}, "outer")
    with pytest.warns(RenamedSettingWarning, match=r"train.row_steps is called train.beam_strides now"):
        assert parse_config({"train": {"row_steps": [1, 4]}}, "file").train.beam_strides == (1, 4)


def test_a_fault_in_settings_is_no_usage_error() -> None:
    @dataclass(frozen=True)
    class Faulty:
        count: int = 1

        def __post_init__(self) -> None:
            np.zeros(2) + np.zeros(self.count + 2)

    with pytest.raises(ValueError, match="could not be broadcast"):
        with_changes(Faulty.__new__(Faulty), {"count": 1}, "faulty")


def test_nearest_name_lists_all_when_nothing_is_similar() -> None:
    assert nearest_name("zzz", ["alpha", "beta"]) == "known: alpha, beta"


def test_plain_values_can_be_written() -> None:
    assert plain(Outer(names=("a",))) == {
        "count": 1,
        "inner": None,
        "other": {"size": 0.5, "kind": "first"},
        "needs": None,
        "names": ["a"],
    }
