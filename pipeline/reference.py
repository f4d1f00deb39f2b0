"""Every setting with its unit, default, meaning and source: configs/reference.yaml and docs/settings.md.

Nothing is written down here: defaults come from the dataclasses, meanings from the lists in their docstrings and from
the descriptions of the sections. `python -m pipeline.reference` writes both files anew; a test compares them.
"""

from __future__ import annotations

import dataclasses
import re
import textwrap
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel

from auglidar_base.atomic import write_text
from pipeline.base.meanings import meanings, nested_settings
from pipeline.base.settings import plain
from pipeline.run_folder.config import Config, LibrarySection
from pipeline.run_folder.preset import preset_with_changes
from pipeline.run_folder.resolved import synth_settings
from pipeline.training.settings import SETTINGS

ROOT = Path(__file__).resolve().parent.parent
YAML_FILE, PAGE = ROOT / "configs" / "reference.yaml", ROOT / "docs" / "settings.md"

# A unit is named at the start of a meaning, after "in", or after a comma; some names end with it.
UNITS = {
    r"metres?": "m",
    r"pixels?": "px",
    r"degrees": "degrees",
    r"radians": "radians",
    r"seconds": "seconds",
    r"GB": "GB",
    r"MB": "MB",
    r"grey levels": "grey levels",
    r"steps|updates": "steps",
    r"epochs": "epochs",
    r"(?:largest )?share|probability|\[0, 1\]": "0 to 1",
}
UNIT_PLACES = r"(?:^|\bin |, )(?:{})(?!\w)"
UNIT_ENDINGS = {"_mb": "MB", "_gb": "GB", "_seconds": "seconds"}
SOURCE = re.compile(
    r"(?:thesis(?: sections?)?|[Ss]ections?|Eqs?\.|Tables?|Figs?\.|chapter) \d(?:[\d.]*\d)?[a-z]?"
    r"(?:(?:, | and )[1-9]\.\d(?:[\d.]*\d)?[a-z]?)*"
    r"|[A-Z]\w+(?: et al\.| and [A-Z]\w+)?,? (?:19|20)\d\d"
)
HEAD = """\
# Every setting with its default. Written by `python -m pipeline.reference`; nobody has to start from this file:
# a configuration names what it changes, as configs/kitti.yaml does. The same as tables: docs/settings.md.
"""
PAGE_HEAD = """\
# Settings

Every key of a configuration file and of `--set key.sub=value`, with its default. The same as YAML:
`configs/reference.yaml`. Both are written by `python -m pipeline.reference` from the program's own settings. Keys under
a key that may be `null` hold when it is not. The `config.yaml` of a run lists all of them with the values it used.
"""
TRAIN_NOTE = {network: f"With `train.network={network}`:" for network in SETTINGS}


@dataclass(frozen=True)
class Setting:
    """One key.

    inner  the keys below it, which hold when it is not null
    free   False for a library's seed, which follows the run's until it is given
    """

    name: str
    default: Any
    meaning: str
    source: str = ""
    inner: tuple[Setting, ...] = ()
    free: bool = True

    @property
    def key(self) -> str:
        """The last part of the dotted name."""
        return self.name.rpartition(".")[2]

    @property
    def unit(self) -> str:
        """The unit that the meaning or the name gives, or ""."""
        if self.inner or isinstance(self.default, (bool, str)):
            return ""
        places = {unit: re.search(UNIT_PLACES.format(words), self.meaning) for words, unit in UNITS.items()}
        found = [(match.start(), unit) for unit, match in places.items() if match]
        by_name = next((unit for ending, unit in UNIT_ENDINGS.items() if self.key.endswith(ending)), "")
        return by_name or (min(found)[1] if found else "")


def library_settings(settings: Any, section: str) -> tuple[Setting, ...]:
    """The fields of a library's dataclass, and of those inside it."""
    kind = type(settings)
    known, hints = meanings(kind), typing.get_type_hints(kind)
    # What a small dataclass as a whole comes from holds for its fields; a stage's or a training's has many origins.
    whole = sources((kind.__doc__ or "").partition("\n\n")[0]) if "." in section else ""
    found = []
    for field in dataclasses.fields(kind):
        if not field.init:
            continue
        name, value, meaning = f"{section}.{field.name}", getattr(settings, field.name), known.get(field.name, "")
        nested = value if dataclasses.is_dataclass(value) else nested_settings(hints[field.name])
        inner = library_settings(nested, name) if nested is not None else ()
        default = None if value is None else ({} if inner else plain(value))
        free = field.name != "seed"
        meaning += "" if free else " (the run's own unless given)"
        found.append(Setting(name, default, meaning, sources(meaning) or whole, inner, free))
    return tuple(found)


def section_settings(section: BaseModel, name: str) -> tuple[Setting, ...]:
    """The keys that a section of the configuration declares itself."""
    prefix = f"{name}." if name else ""
    return tuple(
        Setting(prefix + key, plain(getattr(section, key)), field.description or "", sources(field.description or ""))
        for key, field in type(section).model_fields.items()
    )


def sources(text: str) -> str:
    """The sections, equations, tables and papers that a text names."""
    return "; ".join(dict.fromkeys(SOURCE.findall(text)))


def all_settings() -> dict[str, tuple[Setting, ...]]:
    """Section -> its settings; "" holds `seed`, "train: NETWORK" the keys of each network's training."""
    config = Config()
    found: dict[str, tuple[Setting, ...]] = {}
    for name, section in ((key, getattr(config, key)) for key in Config.model_fields):
        if isinstance(section, BaseModel):
            found[name] = section_settings(section, name)
        elif dataclasses.is_dataclass(section):
            found[name] = library_settings(section, name)
    seed = Config.model_fields["seed"]
    found = {"": (Setting("seed", config.seed, seed.description or ""),), **found}
    found["augment"] += library_settings(preset_with_changes(config.augment), "augment")
    found["synth"] += library_settings(synth_settings(config), "synth")
    for network, settings in SETTINGS.items():
        train = config.model_copy(update={"train": config.train.model_copy(update={"network": network})})
        found[f"train: {network}"] = library_settings(settings(train), "train")
    return found


def reference_yaml() -> str:
    """The text of configs/reference.yaml."""
    settings = all_settings()
    blocks = [HEAD]
    for name, keys in settings.items():
        if ":" in name:
            continue
        lines = [f"{name}:"] if name else []
        lines += _yaml_lines(keys, "  " if name else "")
        if name == "train":
            for network in SETTINGS:
                own = list(_yaml_lines(settings[f"train: {network}"], "  "))
                lines += (
                    ["", f"  # {TRAIN_NOTE[network]}", *own]
                    if network == Config().train.network
                    else ["", f"  # {TRAIN_NOTE[network]}", *(_commented(line) for line in own)]
                )
        blocks.append("\n".join(lines) + "\n")
    return "\n".join(blocks)


def _yaml_lines(settings: tuple[Setting, ...], indent: str) -> Iterator[str]:
    """Each key below its meaning; the keys of one that is null are commented out."""
    for item in settings:
        facts = "; ".join(part for part in (item.unit, item.source if item.source not in item.meaning else "") if part)
        text = item.meaning + (f" [{facts}]" if facts else "")
        yield from textwrap.wrap(text, 118, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")
        if not item.inner or item.default is None:
            line = f"{indent}{item.key}: {_inline(item.default)}"
            yield line if item.free else _commented(line)
        if item.inner:
            lines = [f"{indent}{item.key}:", *_yaml_lines(item.inner, indent + "  ")]
            yield from map(_commented, lines) if item.default is None else lines


def _commented(line: str) -> str:
    """The line as a comment at its own depth."""
    bare = line.lstrip()
    return f"{line[: len(line) - len(bare)]}# {bare}" if bare else line


def _inline(value: Any) -> str:
    """A value as YAML on one line."""
    return yaml.safe_dump(value, default_flow_style=True, width=10_000).removesuffix("...\n").strip()


def reference_page() -> str:
    """The text of docs/settings.md."""
    parts = [PAGE_HEAD]
    for name, keys in all_settings().items():
        section, _, network = name.partition(": ")
        note = f"{TRAIN_NOTE[network]}\n\n" if network else ""
        title = f"{section}, {network}" if network else section or "The run"
        about = "" if network or not section else _about(section)
        rows = [row for item in keys for row in _rows(item)]
        head = "| key | default | unit | meaning | source |\n|---|---|---|---|---|\n"
        parts.append(f"## {title}\n\n{note}{about}{head}" + "".join(rows))
    return "\n".join(parts)


def _about(section: str) -> str:
    """The first sentence of a section's class."""
    kind = type(getattr(Config(), section))
    first = " ".join((kind.__doc__ or "").partition("\n\n")[0].split())
    if issubclass(kind, LibrarySection):
        first = first.partition(";")[0].rstrip(".") + "."
    return f"{first}\n\n"


def _rows(item: Setting) -> Iterator[str]:
    """The row of a setting and those below it."""
    default = "" if item.inner and item.default is not None else f"`{_inline(item.default)}`"
    cells = (f"`{item.name}`", default, item.unit, item.meaning, item.source)
    yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"
    for inner in item.inner:
        yield from _rows(inner)


def main() -> None:
    """Writes both files."""
    write_text(YAML_FILE, reference_yaml())
    write_text(PAGE, reference_page())


if __name__ == "__main__":
    main()
