"""How our kernels are compiled: on first use, without the GIL, kept on disk for the next process."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])

# Lets LLVM vectorise running maxima; it allows no reordering and no fused multiply-add, so results keep every bit.
_NO_NANS = {"nnan", "nsz"}


def kernel(function: F) -> F:
    """Compile `function` with numba: nopython, no GIL, IEEE division, cached beside the file or in the user's cache.

    Where no folder can be written (a read-only image without a home), it is compiled anew in every process.
    """
    options = {"nogil": True, "error_model": "numpy", "fastmath": _NO_NANS}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:
        return numba.njit(**options)(function)


def for_ranges(work: Callable[[int, int], None], count: int, threads: int, minimum: int) -> None:
    """Call `work(start, stop)` on consecutive ranges that cover `count` items, in up to `threads` threads.

    Ranges hold at least `minimum` items. Plain threads round kernels without the GIL, rather than numba's own
    thread pool, because that pool survives neither fork nor two Python threads.
    """
    parts = max(1, min(threads, count // max(minimum, 1)))
    if parts == 1:
        work(0, count)
        return
    bounds = [count * part // parts for part in range(parts + 1)]
    with ThreadPoolExecutor(parts) as pool:
        list(pool.map(work, bounds[:-1], bounds[1:]))
