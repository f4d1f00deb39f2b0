"""Reading published checkpoint files (TWISE, MSG-CHN, sparse-to-dense, NLSPN, PENet) without running what is in them.

These are pickles of PyTorch 0.4 to 1.3, legacy or zip; `auglidar_base.torch_pickle` reads them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from auglidar_base.errors import CheckpointError, SettingsError
from auglidar_base.torch_pickle import read_torch_pickle
from completion.models import ModelSpec, build_model, default_spec
from completion.nlspn_import import nlspn_spec
from completion.penet_import import penet_spec, without_unused
from completion.state_dicts import Match, fill, match

ARCHITECTURES = ("twise", "twise_maxpool", "msg_chn", "msg_chn_wacv", "sparse_to_dense", "nlspn", "enet", "penet")


def read_tensors(path: str | Path) -> dict[str, Tensor]:
    """The network's tensors by name, one leading `module.` removed. CheckpointError when there are none."""
    content = read_torch_pickle(path)
    if isinstance(content, Mapping):
        for key in ("model", "net", "state_dict"):
            if isinstance(content.get(key), Mapping):
                content = content[key]
                break
    tensors = {}
    if isinstance(content, Mapping):
        tensors = {str(name).removeprefix("module."): t for name, t in content.items() if isinstance(t, Tensor)}
    if not tensors:
        raise CheckpointError(
            f"{path}: expected a dictionary with the network's tensors under 'model' or 'net', found none; "
            "a whole pickled module cannot be imported"
        )
    return tensors


def _channels(tensors: Mapping[str, Tensor]) -> int:
    first = tensors.get("rgb_encoder.init.0.weight")
    return 0 if first is None else int(first.shape[0])


def _twise(tensors: Mapping[str, Tensor], pooling: str) -> ModelSpec:
    inputs = tensors.get("depth_encoder2.init.0.weight")
    if inputs is not None and inputs.ndim == 4 and inputs.shape[1] == 3:
        raise CheckpointError(
            "these are weights of TWISE's same-size variant (3 inputs in stages 2 and 3), not this one"
        )
    return default_spec("twise", channels=_channels(tensors) or 64, pooling=pooling)


def _msg_chn(tensors: Mapping[str, Tensor], extra_skips: bool) -> ModelSpec:
    usual = 32 if extra_skips else 64
    return default_spec("msg_chn", channels=_channels(tensors) or usual, extra_skips=extra_skips)


def _sparse_to_dense(tensors: Mapping[str, Tensor]) -> ModelSpec:
    image = tensors.get("conv1_img.0.weight")
    return default_spec(
        "sparse_to_dense",
        layers=34 if "conv2.2.conv1.weight" in tensors else 18,
        grey=image is not None and image.ndim == 4 and image.shape[1] == 1,
    )


# Published files do not say their pooling or skips: the name given by the user decides (the tensors are the same).
SPECS: dict[str, Callable[[Mapping[str, Tensor]], ModelSpec]] = {
    "twise": lambda tensors: _twise(tensors, "avg"),
    "twise_maxpool": lambda tensors: _twise(tensors, "max"),
    "msg_chn": lambda tensors: _msg_chn(tensors, True),
    "msg_chn_wacv": lambda tensors: _msg_chn(tensors, False),
    "sparse_to_dense": _sparse_to_dense,
}


# Those whose files leave more open than a name can say; the user's choices by name.
ASKING: dict[str, Callable[[Mapping[str, Tensor], Mapping[str, object]], ModelSpec]] = {
    "nlspn": nlspn_spec,
    "enet": partial(penet_spec, "enet"),
    "penet": partial(penet_spec, "penet"),
}


def _spec(architecture: str, tensors: Mapping[str, Tensor], choices: Mapping[str, object]) -> ModelSpec:
    if architecture in ASKING:
        return ASKING[architecture](tensors, choices)
    if choices:
        raise SettingsError(f"{architecture} leaves nothing to choose, got {', '.join(choices)}")
    return SPECS[architecture](tensors)


def _prepare(
    path: str | Path, architecture: str, choices: Mapping[str, object]
) -> tuple[nn.Module, ModelSpec, dict[str, Tensor]]:
    """An empty network of the file's size and the file's tensors."""
    if architecture not in ARCHITECTURES:
        raise ValueError(f"architecture: expected one of {', '.join(ARCHITECTURES)}, got {architecture!r}")
    tensors = read_tensors(path)
    if architecture == "penet":
        tensors = without_unused(tensors)
    spec = _spec(architecture, tensors, choices)
    with torch.random.fork_rng(devices=[]):
        model = build_model(spec)
    for name, value in model.state_dict().items():
        # Files from before PyTorch 0.4.1 do not count batches; the count is not used.
        if name.endswith("num_batches_tracked") and name not in tensors:
            tensors[name] = torch.zeros_like(value)
    return model, spec, tensors


def fitting_architectures(tensors: Mapping[str, Tensor]) -> tuple[str, ...]:
    """The architectures whose networks have exactly these tensors; those that must be asked for choices left out."""
    found = []
    tensors = without_unused(tensors)
    for architecture in (*SPECS, "enet", "penet"):
        try:
            with torch.device("meta"):
                compared = match(build_model(_spec(architecture, tensors, {})), tensors)
        except (CheckpointError, SettingsError, RuntimeError):
            continue  # Its sizes cannot be read from these tensors, so it is another network.
        counters_only = all(name.endswith("num_batches_tracked") for name in compared.missing)
        found += [architecture] * (counters_only and not compared.unknown and not compared.misshapen)
    return tuple(found)


def compare_checkpoint(path: str | Path, architecture: str, **choices: object) -> Match:
    """Which tensors of the file match the architecture and which do not. CheckpointError for an unreadable file."""
    model, _, tensors = _prepare(path, architecture, choices)
    return match(model, tensors)


def import_checkpoint(path: str | Path, architecture: str, **choices: object) -> nn.Module:
    """The published network with the file's weights, in evaluation mode on the CPU.

    architecture and call of the result:
        "twise", "twise_maxpool"   model(sparse / 80, rgb / 255) -> (out_1, out_2, out_4), (B, 3, ...) at 1, 1/2, 1/4
        "msg_chn", "msg_chn_wacv"  model(sparse in m, rgb / 255) -> (out_1, out_2, out_4), full-size metres; with and
                                   without the extra skips
        "sparse_to_dense"          model(sparse in m, rgb in 0..255) -> metres, never below 0.9 m in evaluation mode
        "nlspn"                    model(sparse in m, rgb standardised) -> metres >= 0; the choices legacy=..., and
                                   preserve_input=... must be given, see `nlspn_import.nlspn_spec`
        "enet", "penet"            model(sparse in m, rgb in 0..255, position, K) -> (metres, ...), see `models.enet`;
                                   crop="bottom" or "top_left" and camera="published" or "frame" may be chosen
    Width and depth are taken from the tensors. CheckpointError when the file is refused or does not fit,
    SettingsError when a choice is missing or is none of the architecture's.
    """
    return import_with_spec(path, architecture, **choices)[0]


def import_with_spec(
    path: str | Path, architecture: str, **choices: object
) -> tuple[nn.Module, ModelSpec, dict[str, Any]]:
    """As `import_checkpoint`, with the network's input scaling and the facts for its card."""
    model, spec, tensors = _prepare(path, architecture, choices)
    try:
        fill(model, tensors, f"{path}: as {architecture!r}")
    except CheckpointError as error:
        others = fitting_architectures(read_tensors(path))
        raise CheckpointError(f"{error}; it fits {' or '.join(others)}" if others else str(error)) from None
    facts: dict[str, Any] = {
        "imported_from": Path(path).name,
        "source_sha256": hashlib.sha256(Path(path).read_bytes()).hexdigest(),
        "architecture": architecture,
    }
    if architecture.startswith("twise"):
        facts["gamma"] = "2.5 (name of the published file; the thesis' default is 2.0)"
    if architecture in ASKING:
        facts["choices"] = dict(choices)
    return model.eval(), spec, facts
