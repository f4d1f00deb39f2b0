"""Frames through worker processes, in order and with a bounded number under way: 7481 need no more memory than 10."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from itertools import islice
from typing import TypeVar

from auglidar_base.children import process_pool

Item = TypeVar("Item")
Result = TypeVar("Result")


def default_workers(items: int) -> int:
    """Every core this process may use, but one per four items: starting a process takes about a second."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, items // 4))


def map_ordered(function: Callable[[Item], Result], items: Iterable[Item], workers: int) -> Iterator[Result]:
    """`function` of every item, in the order of the items, on `workers` processes (1: in this one).

    At most four items per worker are under way or waiting to be taken, so neither inputs nor results pile up.
    `function` goes along with every item, so it should be small; an exception of `function` is raised here.
    """
    if workers <= 1:
        yield from map(function, items)
        return
    waiting = iter(items)
    with process_pool(workers, _one_thread) as pool:
        under_way: deque[Future[Result]] = deque(pool.submit(function, item) for item in islice(waiting, 4 * workers))
        while under_way:
            result = under_way.popleft().result()
            under_way.extend(pool.submit(function, item) for item in islice(waiting, 1))
            yield result


def _one_thread() -> None:
    """The processes share the cores; OpenCV's own threads would compete with them."""
    import cv2

    cv2.setNumThreads(1)
