"""Which weight files a run uses: bundled ones by name, or the user's by path."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.base.errors import UsageError
from pipeline.run_folder.config import Config
from pipeline.run_folder.own_methods import is_own, own_files
from pipeline.semantics.sources import network_choice

ROOT = Path(__file__).resolve().parent.parent.parent


def bundled_folder(room: str) -> Path:
    """The folder of the weights that come with `completion` or `detection`."""
    return ROOT / room / "weights"


def bundled_names(room: str) -> list[str]:
    """Names of the bundled weights of a room."""
    return sorted(path.stem for path in bundled_folder(room).glob("*.safetensors"))


def completion_weights(name: str, options: Mapping[str, Any]) -> tuple[Path, ...]:
    """Weights and card of a network, the source of a class of one's own; nothing for the classical method."""
    if is_own("completion", name):
        return own_files("completion", name, options)
    return () if name == "classical" else _files("completion", name, "completion.model", also="classical")


def detection_weights(name: str, options: Mapping[str, Any]) -> tuple[Path, ...]:
    """Weights and card of a detector, see `detector_name`; the source of a class of one's own."""
    if is_own("detection", name):
        return own_files("detection", name, options)
    return _files("detection", name, "detection.model")


def detector_name(config: Config) -> str:
    """The detector asked for; 'auto' takes the bundled one trained on this preset's kind of cloud.

    Bundled detectors are named NETWORK_lidar (preset L) and NETWORK_augmented (all others).
    """
    name = config.detection.model
    if name != "auto":
        return name
    names = bundled_names("detection")
    if not names:
        raise UsageError(
            "no detector weights are bundled in this version: train one (--stage train --set train.network=detection) "
            "and give it as detection.model; a network with random weights is never used"
        )
    ending = "_lidar" if config.augment.preset == "L" else "_augmented"
    return next((name for name in names if name.endswith(ending)), names[0])


def mask_weights(source: str) -> tuple[Path, ...]:
    """Files of the segmentation model that `augment.semantics` names: network or soft, onnx:FILE, hf:FOLDER."""
    kind, _, place = source.partition(":")
    if kind in ("network", "soft"):
        return _files("pipeline/semantics", network_choice(place)[0], "augment.semantics")
    if kind == "onnx":
        return (Path(place),)
    if kind == "hf":
        return tuple(sorted(path for path in Path(place).rglob("*") if path.is_file()))
    return ()


def _files(room: str, name: str, key: str, also: str = "") -> tuple[Path, ...]:
    """The .safetensors and the card of a path or a bundled name. Raises UsageError listing what there is."""
    for path in (Path(name), Path(name).with_suffix(".safetensors"), bundled_folder(room) / f"{name}.safetensors"):
        if path.is_file():
            return path, path.with_suffix(".json")
    known = ", ".join([also, *bundled_names(room)] if also else bundled_names(room)) or "none"
    raise UsageError(f"{key}: no weights called {name!r} (no such file; bundled: {known})")
