"""The configuration of a run with every number that shapes it: presets and defaults of the libraries written out.

A later version may change a preset or a default; a run started again from its own config.yaml keeps its numbers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

from pipeline.base.settings import plain, with_changes
from pipeline.run_folder.config import Config, LibrarySection
from pipeline.run_folder.preset import preset_with_changes

if TYPE_CHECKING:
    from pipeline.simulation.synth import SynthSettings

S = TypeVar("S", bound=LibrarySection)


def resolved_config(config: Config) -> Config:
    """The same configuration, every field of the point-cloud stage and of the synthetic world (when used) listed.

    Raises UsageError for an unknown preset, field or value.
    """
    changes: dict[str, Any] = {"augment": with_every_field(config.augment, preset_with_changes(config.augment))}
    if config.data.name == "synthetic":
        changes["synth"] = with_every_field(config.synth, synth_settings(config))
    return config.model_copy(update=changes)


def synth_settings(config: Config) -> SynthSettings:
    """Settings of the synthetic world; the run's seed unless the section has its own."""
    from pipeline.simulation.synth import SynthSettings

    changes = {"seed": config.seed, **config.synth.library}
    return with_changes(SynthSettings(), changes, "synth")


def with_every_field(section: S, settings: object) -> S:
    """The section with all fields of the library's settings; a seed that is the run's own stays with the run."""
    fields = plain(settings)
    if "seed" not in section.library:
        fields.pop("seed", None)
    own = {name: getattr(section, name) for name in type(section).model_fields}
    return section.model_validate({**own, **fields})
