"""PyTorch's checkpoint files, legacy or zip, read without running anything in them.

They are pickles. torch's restricted unpickler reads them; the classes they mention beside tensors and containers
(argparse.Namespace, configuration objects, metrics, NumPy scalars, optimisers) are replaced by inert stand-ins that
hold nothing and run nothing. A file that *calls* an unknown function while loading is refused.
"""

from __future__ import annotations

import pickle
import re
import warnings
from collections import OrderedDict, defaultdict
from pathlib import Path
from typing import Any

import torch

from auglidar_base.errors import CheckpointError

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

    def forget(self: Any, *state: Any) -> None:
        return None

    return _NeverCalled(full_name, (), {"__new__": create, "__setstate__": forget, "__slots__": ()})


def _nothing(*args: Any) -> None:
    """Stands in for the constructors of NumPy scalars, which the files call: metrics, never weights."""
    return None


class _Dtype:
    """Stands in for numpy.dtype, which such scalars name."""

    def __init__(self, *args: Any) -> None: ...

    def __setstate__(self, state: Any) -> None:
        return None


_NUMPY: list[Any] = [
    (_Dtype, "numpy.dtype"),
    *(
        (_nothing, f"{package}.multiarray.{name}")
        for package in ("numpy.core", "numpy._core")
        for name in ("scalar", "_reconstruct")
    ),
]
# Calling these makes an empty container; whole optimisers hold them.
_CONTAINERS: list[Any] = [
    OrderedDict,
    (defaultdict, "collections.defaultdict"),
    *(
        (container, f"{module}.{container.__name__}")
        for module in ("builtins", "__builtin__")
        for container in (dict, set, list)
    ),
]


def read_torch_pickle(path: str | Path) -> Any:
    """Contents of a PyTorch file, with stand-ins for every class that is not a tensor or container.

    Raises CheckpointError when the file calls a function, is damaged, or is no PyTorch file. Nothing in it is executed.
    """
    allowed: list[Any] = [*_NUMPY, *_CONTAINERS]
    seen: set[str] = set()
    while len(seen) < _MOST_CLASSES:
        try:
            with torch.serialization.safe_globals(allowed), warnings.catch_warnings():
                # A file of an unusual pickle protocol is still read, or refused below.
                warnings.filterwarnings("ignore", message="Detected pickle protocol")
                return torch.load(path, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError as error:
            named = _NOT_ALLOWED.search(str(error))
            if named is None or named.group(1) in seen:
                raise CheckpointError(f"{path}: refused, nothing in it was executed: {_reason(error)}") from error
            seen.add(named.group(1))
            allowed.append((_stand_in(named.group(1)), named.group(1)))
        except FileNotFoundError:
            raise
        # Torn files end in a dozen kinds of error within torch: OSError, struct.error, AssertionError, MemoryError, ...
        except Exception as error:
            raise CheckpointError(f"{path}: expected a PyTorch checkpoint, cannot read it: {error}") from error
    raise CheckpointError(f"{path}: refused: it mentions more than {_MOST_CLASSES} classes")


def _reason(error: Exception) -> str:
    """The sentence of torch's long message that names the culprit."""
    sentences = [part.strip() for part in re.split(r"\n|\. ", str(error))]
    telling = [part for part in sentences if re.search(r"calls|GLOBAL|REDUCE|blocked|NEWOBJ|BUILD|persistent", part)]
    return (telling or sentences)[0][:300]
