"""What the augment section of a configuration asks for."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.base.errors import UsageError
from pipeline.base.settings import nearest_name, with_changes
from pipeline.run_folder.config import Config

if TYPE_CHECKING:
    from pipeline.pointcloud.presets import AugmentSettings


def augment_settings(config: Config) -> AugmentSettings:
    """The preset with the changes of the configuration. Raises UsageError when they cannot be used."""
    from pipeline.pointcloud.presets import PRESETS

    section = config.augment
    if section.preset not in PRESETS:
        raise UsageError(f"augment.preset: unknown preset {section.preset!r}; {nearest_name(section.preset, PRESETS)}")
    settings = with_changes(PRESETS[section.preset], section.library, "augment", type(section).model_fields)
    if settings.needs_semantics and section.semantics is None:
        raise UsageError(
            f"augment.preset {section.preset} needs object masks: set augment.semantics to truth, boxes, files:FOLDER, "
            "network, onnx:FILE or hf:FOLDER, or choose a preset without masks (L_D_F)"
        )
    return settings


def uses_raw_lidar(config: Config) -> bool:
    """True with preset L: the detector takes the sensor's points, and nothing is completed or augmented for it."""
    return config.augment.preset == "L" and not config.augment.library
