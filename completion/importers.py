"""Reading the published checkpoint files of TWISE, MSG-CHN and sparse-to-dense without running anything in them.

These are pickles of PyTorch 0.4 to 1.3, legacy or zip. They are read by torch's restricted unpickler; the classes they
mention beside tensors (argparse.Namespace, metrics.Result, NumPy scalars, optimisers) are replaced by inert stand-ins
that hold nothing and run nothing. A file that *calls* an unknown function while loading is refused.
"""

from __future__ import annotations

import hashlib
import pickle
import re
from collections import defaultdict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from completion.models import ModelSpec, build_model, default_spec
from completion.state_dicts import CheckpointError, Match, fill, match

ARCHITECTURES = ("twise", "twise_maxpool", "msg_chn", "msg_chn_wacv", "sparse_to_dense")
_NOT_ALLOWED = re.compile(r"GLOBAL ([\w.]+) was not an allowed global")
_MOST_CLASSES = 40


class _NeverCalled(type):
    """Metaclass of the stand-ins: instances may be made by unpickling (`__new__`), but not by a call from the file."""

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        raise pickle.UnpicklingError(f"the file calls {cls.__qualname__}")


def _stand_in(full_name: str) -> type:
    """An inert class that is unpickled in place of `full_name`; state is thrown away."""

    def create(cls: type, *args: Any, **kwargs: Any) -> Any:
        return object.__new__(cls)

    def set_state(self: Any, state: Any) -> None:
        return None

    return _NeverCalled(full_name, (), {"__new__": create, "__setstate__": set_state, "__slots__": ()})


def _nothing(*args: Any) -> None:
    """Stands in for the constructors of NumPy scalars, which the files call: metrics, never weights."""
    return None


_NUMPY = [
    (_nothing, f"{package}.multiarray.{name}")
    for package in ("numpy.core", "numpy._core")
    for name in ("scalar", "_reconstruct")
]


# Calling these makes an empty container; whole optimisers hold them.
_CONTAINERS = [(defaultdict, "collections.defaultdict")] + [
    (container, f"{module}.{container.__name__}")
    for module in ("builtins", "__builtin__")
    for container in (dict, set, list)
]


class _Dtype:
    """Stands in for numpy.dtype."""

    def __init__(self, *args: Any) -> None: ...

    def __setstate__(self, state: Any) -> None:
        return None


def read_pickle(path: str | Path) -> Any:
    """Contents of a PyTorch file, legacy or zip, with stand-ins for every class that is not a tensor or container.

    CheckpointError when the file calls a function, is damaged, or is no PyTorch file. Nothing in it is executed.
    """
    stand_ins: list[Any] = [*_NUMPY, *_CONTAINERS, (_Dtype, "numpy.dtype")]
    seen: set[str] = set()
    for _ in range(_MOST_CLASSES):
        try:
            with torch.serialization.safe_globals(stand_ins):
                return torch.load(path, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError as error:
            named = _NOT_ALLOWED.search(str(error))
            if named is None or named.group(1) in seen:
                raise CheckpointError(f"{path}: refused, nothing in it was executed: {_reason(error)}") from error
            seen.add(named.group(1))
            stand_ins.append((_stand_in(named.group(1)), named.group(1)))
        except (RuntimeError, EOFError, ValueError, KeyError, AttributeError, TypeError) as error:
            raise CheckpointError(f"{path}: not a readable PyTorch file: {error}") from error
    raise CheckpointError(f"{path}: refused: it mentions more than {_MOST_CLASSES} classes")


def _reason(error: Exception) -> str:
    """The sentence of torch's long message that names the culprit."""
    sentences = re.split(r"\n|\. ", str(error))
    telling = [s.strip() for s in sentences if re.search(r"calls|GLOBAL|REDUCE|blocked|NEWOBJ|BUILD", s)]
    return telling[0] if telling else sentences[0].strip()


def read_tensors(path: str | Path) -> dict[str, Tensor]:
    """The network's tensors by name, one leading `module.` removed. CheckpointError when there are none."""
    content = read_pickle(path)
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


def _prepare(path: str | Path, architecture: str) -> tuple[nn.Module, ModelSpec, dict[str, Tensor]]:
    """An empty network of the file's size and the file's tensors."""
    if architecture not in SPECS:
        raise ValueError(f"architecture: expected one of {', '.join(ARCHITECTURES)}, got {architecture!r}")
    tensors = read_tensors(path)
    spec = SPECS[architecture](tensors)
    with torch.random.fork_rng(devices=[]):
        model = build_model(spec)
    for name, value in model.state_dict().items():
        # Files from before PyTorch 0.4.1 do not count batches; the count is not used.
        if name.endswith("num_batches_tracked") and name not in tensors:
            tensors[name] = torch.zeros_like(value)
    return model, spec, tensors


def compare_checkpoint(path: str | Path, architecture: str) -> Match:
    """Which tensors of the file match the architecture and which do not. CheckpointError for an unreadable file."""
    model, _, tensors = _prepare(path, architecture)
    return match(model, tensors)


def import_checkpoint(path: str | Path, architecture: str) -> nn.Module:
    """The published network with the file's weights, in evaluation mode on the CPU.

    architecture and call of the result:
        "twise", "twise_maxpool"   model(sparse / 80, rgb / 255) -> (out_1, out_2, out_4), (B, 3, ...) at 1, 1/2, 1/4
        "msg_chn", "msg_chn_wacv"  model(sparse in m, rgb / 255) -> (out_1, out_2, out_4), full-size metres; with and
                                   without the extra skips
        "sparse_to_dense"          model(sparse in m, rgb in 0..255) -> metres, never below 0.9 m in evaluation mode
    Width and depth are taken from the tensors. CheckpointError when the file is refused or does not fit.
    """
    return import_with_spec(path, architecture)[0]


def import_with_spec(path: str | Path, architecture: str) -> tuple[nn.Module, ModelSpec, dict[str, Any]]:
    """As `import_checkpoint`, with the network's input scaling and the facts for its card."""
    model, spec, tensors = _prepare(path, architecture)
    fill(model, tensors, f"{path} as {architecture!r}")
    facts = {
        "imported_from": Path(path).name,
        "source_sha256": hashlib.sha256(Path(path).read_bytes()).hexdigest(),
        "architecture": architecture,
    }
    if architecture.startswith("twise"):
        facts["gamma"] = "2.5 (name of the published file; the thesis' default is 2.0)"
    return model.eval(), spec, facts
