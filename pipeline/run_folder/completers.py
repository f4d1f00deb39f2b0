"""What completes depth in a run: a class of one's own, or a network of `completion`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from completion.types import CompletedDepth, FloatMap
from pipeline.base.errors import DataError, UsageError
from pipeline.run_folder.own_methods import is_own, made

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from completion.infer import Completer


@dataclass(frozen=True)
class OwnCompleter:
    """A user's completion method; what it returns is checked."""

    name: str
    method: Any

    def complete(
        self, sparse: FloatMap, image: NDArray[np.uint8], K: NDArray[np.float64] | None = None
    ) -> CompletedDepth:
        """See `completion.infer.Completer`. DataError for a result that is no depth map of this frame."""
        found = self.method.complete(sparse, image, K)
        try:
            completed = found if isinstance(found, CompletedDepth) else CompletedDepth(found)
        except (ValueError, TypeError) as error:
            raise DataError(self.name, "a depth map in metres, or CompletedDepth", str(error)) from None
        if completed.depth.shape != sparse.shape:
            raise DataError(self.name, f"a depth map of shape {sparse.shape}", f"shape {completed.depth.shape}")
        return completed


def open_completer(
    name: str, device: str = "cpu", backend: str = "torch", options: Mapping[str, Any] | None = None
) -> Completer:
    """The completer of a class of one's own, or what `completion.infer.load_completer` gives."""
    if is_own("completion", name):
        return OwnCompleter(name, made("completion", name, options or {}))
    if options:
        raise UsageError(f"completion.options: only a class of one's own (module:Class) takes options, not {name}")
    from completion.infer import load_completer

    return load_completer(name, device, backend)
