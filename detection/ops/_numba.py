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


def for_blocks(work: Callable[[slice, slice], None], shape: tuple[int, int], threads: int, minimum: int) -> None:
    """Call `work(batch_slice, item_slice)` until `shape` = (batch, items) is covered, in up to `threads` threads.

    Whole batch elements are shared out when there are enough of them, otherwise the items of one after the other;
    either way a slice of a C-contiguous array stays contiguous.
    """
    batch, count = shape
    if batch >= threads:
        everything = slice(0, count)
        for_ranges(lambda i, j: work(slice(i, j), everything), batch, threads, max(1, minimum // max(1, count)))
        return
    for element in range(batch):
        one = slice(element, element + 1)
        for_ranges(lambda i, j, one=one: work(one, slice(i, j)), count, threads, minimum)  # type: ignore[misc]
