"""Threads that share the rows of a kernel, and the maps they write, kept for the next frame."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float32]


class RowThreads:
    """Runs kernels that release the interpreter on parts of their rows; holds maps by name."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self.pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self.kept: dict[str, Float] = {}

    def map(self, name: str, *shape: int) -> Float:
        """An array that is this name's until it is asked for again; its values are arbitrary."""
        found = self.kept.get(name)
        if found is None or found.shape != shape:
            found = self.kept[name] = np.empty(shape, np.float32)
        return found

    def run(self, kernel: Callable[..., None], rows: int, *arguments: object) -> None:
        """kernel(first, last, ...) over all rows, shared among the threads."""
        if self.pool is None or rows < 2:
            kernel(0, rows, *arguments)
            return
        # More parts than threads: one that is held up by another process takes fewer.
        parts = min(rows, 4 * self.threads)
        edges = [rows * part // parts for part in range(parts + 1)]
        for done in [self.pool.submit(kernel, a, b, *arguments) for a, b in itertools.pairwise(edges)]:
            done.result()
