"""Every setting is listed with its meaning, in files that equal what the program would write."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from pipeline.base.meanings import meanings
from pipeline.base.settings import with_changes
from pipeline.reference import PAGE, YAML_FILE, Setting, all_settings, reference_page, reference_yaml, sources
from pipeline.run_folder.config import Config, dump_config, load_config
from pipeline.run_folder.preset import preset_with_changes
from pipeline.run_folder.resolved import resolved_config
from pipeline.training.settings import SETTINGS, with_training_settings


def walk(settings: tuple[Setting, ...]) -> Iterator[Setting]:
    for item in settings:
        yield item
        yield from walk(item.inner)


def test_the_files_are_what_the_program_writes() -> None:
    again = "run python -m pipeline.reference"
    assert YAML_FILE.read_text(encoding="utf-8") == reference_yaml(), again
    assert PAGE.read_text(encoding="utf-8") == reference_page(), again


def test_every_setting_has_a_meaning() -> None:
    found = all_settings()
    assert {key.partition(":")[0] for key in found} - {""} == set(Config.model_fields) - {"seed", "made_with"}
    assert [item.name for items in found.values() for item in walk(items) if not item.meaning] == []


def test_the_reference_is_the_defaults_and_reads_back(tmp_path: Path) -> None:
    config = load_config(YAML_FILE)
    assert config == with_training_settings(resolved_config(Config()))
    (tmp_path / "again.yaml").write_text(dump_config(config))
    assert load_config(tmp_path / "again.yaml") == config


def test_what_is_commented_out_holds_when_it_is_taken_in() -> None:
    lines = YAML_FILE.read_text(encoding="utf-8").splitlines()
    start = lines.index("  # range_image:")
    block = "\n".join(re.sub(r"^(\s*)# ", r"\1", line) for line in lines[start + 1 :] if line.startswith("    # "))
    keys = dict(re.findall(r"^    (\w+): (.+)$", block, re.MULTILINE))
    grid = {key: yaml.safe_load(keys[key]) for key in ("rows", "az_steps", "top", "vertical", "horizontal", "origin")}
    settings = preset_with_changes(load_config(None, [f"augment.range_image={grid}"]).augment)
    assert settings == preset_with_changes(load_config(None, ["augment.range_image={}"]).augment)


@pytest.mark.parametrize("network", SETTINGS)
def test_the_listed_defaults_of_a_training_are_those_it_uses(network: str) -> None:
    config = load_config(None, [f"train.network={network}"])
    settings = SETTINGS[network](config)
    listed = {item.key: item.default for item in all_settings()[f"train: {network}"] if not item.inner and item.free}
    assert with_changes(settings, listed, "train") == settings


def test_numbers_units_and_sources_of_the_central_stage() -> None:
    found = {item.name: item for item in walk(all_settings()["augment"])}
    gap = found["augment.sigma.gap"]
    assert (gap.default, gap.unit, gap.source) == (3.0, "m", "Fig. 5.6a")
    assert (found["augment.near_lidar.split"].default, found["augment.near_lidar.split"].unit) == (40.0, "m")
    assert found["augment.range_image.top"].unit == "degrees"
    assert found["augment.range_image.rows"].unit == ""
    assert found["augment.grid.size"].source == "thesis 5.3.4.2; Fig. 5.7; Tables 5.5 and 5.7"
    assert sources("(Wang et al. 2019), see Eq. 4.5.") == "Wang et al. 2019; Eq. 4.5"


@dataclass(frozen=True)
class Listed:
    """A first line naming size  and nothing else.

    size   metres; and a second
           line of it           count, other  how many
    Text that belongs to no field.
    kind   which
    """

    size: float = 1.0
    count: int = 2
    other: int = 3
    kind: str = "a"
    untold: int = 4


def test_meanings_are_read_from_the_docstring() -> None:
    assert meanings(Listed) == {
        "size": "metres; and a second line of it",
        "count": "how many",
        "other": "how many",
        "kind": "which",
    }


@dataclass(frozen=True)
class Longer(Listed):
    """More of them.

    more      a further one
    """

    more: int = 1


def test_meanings_come_along_with_the_fields_of_another_dataclass() -> None:
    assert meanings(Longer) == meanings(Listed) | {"more": "a further one"}
