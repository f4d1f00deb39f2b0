"""How kernels are compiled and shared out among threads, and the public names of the package."""

from __future__ import annotations

import threading

import numba
import pytest

import detection.ops
from detection.ops._numba import for_blocks, for_ranges, kernel


def test_without_a_writable_cache_the_kernel_is_still_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    real = numba.njit

    def no_cache(*args: object, cache: bool = False, **options: object) -> object:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return real(*args, **options)

    monkeypatch.setattr(numba, "njit", no_cache)

    @kernel
    def double(value: float) -> float:
        return 2 * value

    assert double(1.5) == 3.0
    assert double.signatures  # compiled, not interpreted


@pytest.mark.parametrize(("count", "threads", "minimum"), [(0, 2, 1), (1, 4, 1), (10, 3, 1), (10, 3, 6), (7, 100, 2)])
def test_ranges_cover_everything_once(count: int, threads: int, minimum: int) -> None:
    seen: list[int] = []
    workers = set()

    def work(start: int, stop: int) -> None:
        workers.add(threading.get_ident())
        seen.extend(range(start, stop))

    for_ranges(work, count, threads, minimum)
    assert sorted(seen) == list(range(count))
    assert len(workers) <= threads


@pytest.mark.parametrize(("batch", "count", "threads"), [(1, 100, 3), (2, 100, 3), (5, 7, 2), (3, 0, 2), (0, 5, 1)])
def test_blocks_cover_everything_once(batch: int, count: int, threads: int) -> None:
    seen: list[tuple[int, int]] = []

    def work(b: slice, n: slice) -> None:
        seen.extend((i, j) for i in range(b.start, b.stop) for j in range(n.start, n.stop))

    for_blocks(work, (batch, count), threads, 10)
    assert sorted(seen) == [(i, j) for i in range(batch) for j in range(count)]


def test_an_error_in_a_thread_reaches_the_caller() -> None:
    def work(start: int, stop: int) -> None:
        if start > 0:
            raise ValueError("from a thread")

    with pytest.raises(ValueError, match="from a thread"):
        for_ranges(work, 100, 2, 1)


def test_every_public_name_can_be_loaded() -> None:
    for name in detection.ops.__all__:
        assert callable(getattr(detection.ops, name)), name
        assert name in dir(detection.ops)
    with pytest.raises(AttributeError, match="no attribute 'matmul'"):
        _ = detection.ops.matmul
