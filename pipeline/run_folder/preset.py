"""What the augment section of a configuration asks for."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from pipeline.base.errors import UsageError
from pipeline.base.settings import nearest_name, with_changes
from pipeline.run_folder.config import AugmentConfig, Config

if TYPE_CHECKING:
    from pipeline.pointcloud.presets import AugmentSettings


def augment_settings(config: Config) -> AugmentSettings:
    """The preset with the changes of the configuration. Raises UsageError when they cannot be used."""
    section, settings = config.augment, preset_with_changes(config.augment)
    if settings.needs_semantics and section.semantics is None:
        raise UsageError(
            f"augment.preset {section.preset} needs object masks: set augment.semantics to truth, boxes, files:FOLDER, "
            "network, onnx:FILE or hf:FOLDER, or choose a preset without masks (L_D_F)"
        )
    return settings


def preset_with_changes(section: AugmentConfig) -> AugmentSettings:
    """The settings of a section, wherever its masks come from.

    A section that lists every field (the config.yaml of a run does) means those numbers, whatever its preset is today.
    Raises UsageError for an unknown preset, field or value.
    """
    from pipeline.pointcloud.presets import PRESETS, AugmentSettings

    fields = {field.name for field in dataclasses.fields(AugmentSettings)}
    base = AugmentSettings() if fields <= section.library.keys() else PRESETS.get(section.preset)
    if base is None:
        raise UsageError(f"augment.preset: unknown preset {section.preset!r}; {nearest_name(section.preset, PRESETS)}")
    return with_changes(base, section.library, "augment", type(section).model_fields)


def uses_raw_lidar(config: Config) -> bool:
    """True with preset L: the detector takes the sensor's points, and nothing is completed or augmented for it."""
    return config.augment.preset == "L" and preset_with_changes(config.augment).leaves_lidar_as_it_is
