"""Where a frame's mask comes from: one small class per source, all with `semantics(frame)`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from detection.kitti_format import KittiObject
from pipeline.base.errors import DataError, UsageError
from pipeline.data.frame import Frame
from pipeline.data.images import read_unchanged
from pipeline.semantics.conventions import GROUPS, NONE, to_train_ids
from pipeline.semantics.riders import without_parked_cycles

if TYPE_CHECKING:
    from pipeline.semantics.inference import NetworkSegmenter

# KITTI type -> Cityscapes trainId.
KITTI_CLASSES = {
    "Car": 13,
    "Van": 13,
    "Truck": 14,
    "Tram": 16,
    "Pedestrian": 11,
    "Person_sitting": 11,
    "Cyclist": 12,
}


# The bundled network of "network" and "soft" without a name.
DEFAULT_WEIGHTS = "street-lite"


class SemanticsSource(Protocol):
    """Anything that gives a frame's semantics."""

    def semantics(self, frame: Frame) -> NDArray[np.uint8] | NDArray[np.float32]:
        """(H, W) uint8 Cityscapes trainIds, 255 = none; or float32 scores in [0, 1] of the relevant classes."""
        ...


@dataclass(frozen=True)
class TrueClasses:
    """The data set's own label maps (synthetic scenes, Virtual KITTI 2)."""

    def semantics(self, frame: Frame) -> NDArray[np.uint8]:
        """The stored map. Raises MissingPart when the data set has none."""
        return frame.semantics


@dataclass(frozen=True)
class TrueBoxes:
    """The labelled 2D boxes, filled (Table 5.9, "2D Bounding Box")."""

    def semantics(self, frame: Frame) -> NDArray[np.uint8]:
        """Boxes as label map, see `boxes_to_semantics`."""
        return boxes_to_semantics(frame.labels, frame.image_size)


@dataclass(frozen=True)
class MaskFolder:
    """Label maps in files FOLDER/ID.png of a stated convention."""

    folder: Path
    convention: str | None

    def semantics(self, frame: Frame) -> NDArray[np.uint8]:
        """The file of this frame as trainIds. Raises DataError when it is missing or of another size."""
        path = self.folder / f"{frame.id}.png"
        labels = to_train_ids(_rgb(read_unchanged(path, "a label map named after the frame")), self.convention, path)
        if labels.shape != tuple(frame.image_size):
            raise DataError(path, f"a label map of {frame.image_size}", f"{labels.shape}", "is it of a cropped image?")
        return labels


class Segmenter(Protocol):
    """A model that labels an image."""

    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB -> (H, W) uint8 trainIds."""
        ...


@dataclass(frozen=True)
class ModelMasks:
    """A segmentation model applied to the image."""

    model: Segmenter

    def semantics(self, frame: Frame) -> NDArray[np.uint8]:
        """The model's labels of this frame."""
        return self.model.segment(frame.image)


@dataclass(frozen=True)
class ObjectsOnly:
    """Labels without what looks like an object of KITTI's and is none: cycles that nobody rides."""

    masks: ModelMasks

    def semantics(self, frame: Frame) -> NDArray[np.uint8]:
        """The labels, see `pipeline.semantics.riders`."""
        return without_parked_cycles(self.masks.semantics(frame))


@dataclass(frozen=True)
class SoftMasks:
    """Our network's probability that a pixel shows any of `classes` (trainIds)."""

    model: NetworkSegmenter
    classes: tuple[int, ...]

    def semantics(self, frame: Frame) -> NDArray[np.float32]:
        """(H, W) float32 scores of this frame."""
        return self.model.score(frame.image, self.classes)


def open_semantics(source: str, convention: str | None = None) -> SemanticsSource:
    """The source a setting names: truth, boxes, files:FOLDER, network[:WEIGHTS], soft[:WEIGHTS], onnx:FILE, hf:FOLDER.

    "soft" gives the network's scores of vehicles, pedestrians and cyclists instead of labels. The scores from which
    "network" calls a pixel a vehicle or a person follow its name: network:WEIGHTS:vehicles=0.7:people=0.3. Its
    cycles that nobody rides become 255.

    convention  of the labels in files or of an ONNX model's output; a folder may hold it in mask.json instead

    Raises UsageError for an unknown kind, DataError for missing files and conventions.
    """
    kind, _, place = source.partition(":")
    if kind == "truth":
        return TrueClasses()
    if kind == "boxes":
        return TrueBoxes()
    if kind in ("network", "soft"):
        return _own_network(kind, place)
    if place and kind == "files":
        return MaskFolder(Path(place), _stated_convention(Path(place), convention))
    if place and kind == "onnx":
        from pipeline.semantics.onnx_model import OnnxSegmenter

        return ModelMasks(OnnxSegmenter(Path(place), convention))
    if place and kind == "hf":
        from pipeline.semantics.huggingface import HuggingFaceSegmenter

        return ModelMasks(HuggingFaceSegmenter(place))
    kinds = "truth, boxes, files:FOLDER, network, soft, onnx:FILE or hf:FOLDER"
    raise UsageError(f"semantics: expected {kinds}, got {source!r}")


def network_choice(place: str) -> tuple[str, dict[str, float]]:
    """WEIGHTS and thresholds of "WEIGHTS:vehicles=0.7:people=0.3"; any part may be missing.

    Raises UsageError for a threshold that is no number.
    """
    parts = place.split(":")
    # Only names of groups have an equals sign behind them; a colon may also belong to a path.
    named = [part for part in parts if part.partition("=")[0] in GROUPS]
    weights = ":".join(part for part in parts if part not in named)
    try:
        thresholds = {group: float(value) for group, _, value in (part.partition("=") for part in named)}
    except ValueError:
        raise UsageError(f"semantics: expected scores like vehicles=0.7, got {':'.join(named)!r}") from None
    return weights or DEFAULT_WEIGHTS, thresholds


def _own_network(kind: str, place: str) -> SemanticsSource:
    """Labels ("network") or scores ("soft") of our network. Raises UsageError for thresholds that do not fit."""
    from pipeline.pointcloud.semantic_mask import OBJECTS
    from pipeline.semantics.checkpoints import load_segmenter

    weights, thresholds = network_choice(place)
    if kind == "soft" and thresholds:
        raise UsageError("semantics: soft masks have one threshold, augment.mask.threshold; got " + repr(thresholds))
    try:
        model = load_segmenter(weights, thresholds)
    except ValueError as error:
        raise UsageError(f"semantics: {error}") from None
    return ObjectsOnly(ModelMasks(model)) if kind == "network" else SoftMasks(model, OBJECTS)


def boxes_to_semantics(labels: Sequence[KittiObject], image_size: tuple[int, int]) -> NDArray[np.uint8]:
    """(H, W) uint8 trainIds: the labelled 2D boxes filled, nearer objects over farther ones, 255 elsewhere."""
    height, width = image_size
    semantics = np.full((height, width), NONE, np.uint8)
    for item in sorted(labels, key=lambda item: -item.location[2]):
        if item.type in KITTI_CLASSES:
            left, top, right, bottom = (round(value) for value in item.bbox)
            semantics[max(0, top) : max(0, bottom + 1), max(0, left) : max(0, right + 1)] = KITTI_CLASSES[item.type]
    return semantics


def _stated_convention(folder: Path, given: str | None) -> str | None:
    """The convention given, or the one in FOLDER/mask.json."""
    sidecar = folder / "mask.json"
    if given is not None or not sidecar.is_file():
        return given
    try:
        stated = json.loads(sidecar.read_text(encoding="utf-8"))["convention"]
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(sidecar, 'JSON like {"convention": "cityscapes_labelIds"}', str(error)) from None
    return str(stated)


def _rgb(stored: NDArray[Any]) -> NDArray[Any]:
    """OpenCV reads colours as BGR(A)."""
    return stored[..., 2::-1] if stored.ndim == 3 else stored
