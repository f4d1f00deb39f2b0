"""What a recipe of kind "completion" stands for: its network, and the frames as that network sees them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import UsageError
from pipeline.experiments import frames as stored
from pipeline.experiments.budgets import CompletionBudget
from pipeline.experiments.frames import StoredFrame
from pipeline.experiments.tables import Recipe

if TYPE_CHECKING:
    from torch import nn

    from completion.models import ModelSpec

SAMPLES = 500


# network -> (builder for a loss on one depth, for twin surfaces, for coefficients)
NETWORKS: dict[str, tuple[str | None, str | None, str | None]] = {
    "multistack": ("msg_chn", "twise", None),
    "resnet18": ("sparse_to_dense", "twise_resnet", "resnet_dc_to_dc"),
    "nlspn": ("nlspn", None, None),
    "resnet18_plain": ("resnet_depth_to_depth", None, None),
    "resnet18_dc_input": ("resnet_dc_to_depth", None, None),
    "resnet18_depth_input": (None, None, "resnet_depth_to_dc"),
}


def model_spec(recipe: Recipe, budget: CompletionBudget) -> ModelSpec:
    """The network of a recipe at the budget's width. UsageError for a loss that the network does not offer."""
    from completion.models import default_spec, with_rgb

    network, loss = str(recipe.settings["network"]), str(recipe.settings["loss"])
    plain, twin, coefficients = NETWORKS[network]
    name = {"twin": twin, "dc": coefficients}.get(loss, plain)
    if name is None:
        raise UsageError(f"network {network!r} has no head for the loss {loss!r}")
    arguments: dict[str, Any] = {"channels": budget.channels, "init": budget.init}
    if network == "multistack":
        arguments |= {"extra_skips": False}
    elif network == "nlspn":
        # The authors' ResNet-34 at the published width, half as deep in narrow networks.
        arguments = {"layers": 34 if budget.resnet_width >= 64 else 18, "width": budget.resnet_width}
    else:
        arguments = {"width": budget.resnet_width}
        if "dc" in name:
            arguments |= {"count": budget.bins, "size": 80.0 / budget.bins}
    spec = default_spec(name, **arguments)
    if budget.depth_unit and spec.output != "coefficients":
        spec = replace(spec, depth_unit=float(budget.depth_unit))
    return with_rgb(spec, budget.rgb) if budget.rgb != "unit" else spec


def default_decoding(spec: ModelSpec) -> str:
    """How the rows without a view are read: coefficients by three of them, everything else as usual."""
    return {"twin": "fused", "coefficients": "peak", "depth": "depth"}[spec.output]


def load_weights(spec: ModelSpec, weights: Path) -> nn.Module:
    """The network of a finished training."""
    from safetensors.torch import load_file

    from completion.models import build_model

    model = build_model(spec)
    model.load_state_dict(load_file(weights))
    return model


def load_remembered(path: Path) -> StoredFrame:
    """A frame, from memory when it was read before (its second ground truth may be made later)."""
    return _remembered(path, stored.semi_dense_file(path).is_file())


@lru_cache(maxsize=512)
def _remembered(path: Path, with_semi_dense: bool) -> StoredFrame:
    """Frames stay in memory over the runs of a table (about 1 MB each)."""
    return stored.load(path)


def truth(frame: StoredFrame, kind: str, path: Path) -> NDArray[np.float32]:
    """Clean or semi-dense ground truth. UsageError when the data has no pseudo ground truth."""
    if kind == "clean":
        return frame.clean
    if frame.semi_dense is None:
        raise UsageError(f"{path}: this data set has one kind of ground truth; figure 4.11 needs the synthetic world")
    return frame.semi_dense


def image_of(recipe: Recipe, frame: StoredFrame) -> NDArray[np.uint8]:
    """The image, black where the recipe has no colour (in training and test alike)."""
    return frame.image if recipe.settings["colour"] else np.zeros_like(frame.image)


def sparse_of(recipe: Recipe, frame: StoredFrame, path: Path) -> NDArray[np.float32]:
    """The sparse map with the recipe's rows; empty for 0. UsageError when the data has no points to thin."""
    rows = int(recipe.settings["rows"])
    if rows == 0:
        return np.zeros_like(frame.clean)
    if rows not in frame.sparse:
        raise UsageError(f"{path}: fewer LiDAR rows need the data set's point clouds, which it does not have")
    return frame.sparse[rows]


def random_samples(depth: NDArray[np.float32], rng: np.random.Generator, count: int = SAMPLES) -> NDArray[np.float32]:
    """`count` valid pixels of a depth map, 0 elsewhere."""
    valid = np.flatnonzero(depth > 0)
    chosen = rng.choice(valid, min(count, len(valid)), replace=False)
    sparse = np.zeros_like(depth)
    sparse.ravel()[chosen] = depth.ravel()[chosen]
    return sparse


def test_frame(recipe: Recipe, path: Path) -> StoredFrame:
    """A test frame whose 64-row map and image are what the recipe's network sees."""
    frame = load_remembered(path)
    if recipe.settings["target"] == "clean":
        frame = replace(frame, semi_dense=None)  # so that a run's numbers do not depend on what else was made
    sparse = sparse_of(recipe, frame, path)
    if recipe.settings["scene"] == "samples_500":
        seed = int.from_bytes(path.stem.encode()[-6:], "big")
        sparse = random_samples(frame.clean, np.random.default_rng(seed))
    return replace(frame, image=image_of(recipe, frame), sparse={64: sparse})
