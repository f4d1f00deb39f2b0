"""Frames through workers: in order, bounded, streamed into pickles."""

from __future__ import annotations

import io
import os
import pickle
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pipeline.export.disk_buffer import DiskBuffer, write_streamed
from pipeline.export.pickles import item_opcodes, write_dict_of_lists, write_list
from pipeline.export.workers import default_workers, map_ordered


def square(value: int) -> int:
    return value * value


def fail(value: int) -> int:
    raise ValueError(f"item {value}")


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_order_and_items_are_drawn_late(workers: int) -> None:
    drawn: list[int] = []

    def items() -> Iterator[int]:
        for value in range(60):
            drawn.append(value)
            yield value

    ahead = [len(drawn) - position for position, _ in enumerate(map_ordered(square, items(), workers), start=1)]
    assert max(ahead) <= 4 * workers
    assert list(map_ordered(square, range(30), workers)) == [value * value for value in range(30)]


def test_errors_of_workers_arrive() -> None:
    with pytest.raises(ValueError, match="item 0"):
        list(map_ordered(fail, range(3), 2))


def test_few_items_start_few_processes() -> None:
    assert default_workers(1) == 1
    assert default_workers(1_000_000) == len(os.sched_getaffinity(0))


def test_streamed_pickles_are_ordinary_pickles() -> None:
    # Equal and shared objects in different items: each item must bring its own memo.
    shared = np.arange(5.0)
    items = [{"name": "Car", "box": shared, "again": shared, "text": "Car"}, {"name": "Car", "box": shared + 1}]
    buffer = io.BytesIO()
    write_list(buffer, map(item_opcodes, items))
    read = pickle.loads(buffer.getvalue())
    assert [list(item) for item in read] == [list(item) for item in items]
    np.testing.assert_array_equal(read[1]["box"], shared + 1)
    assert read[0]["box"] is read[0]["again"]
    buffer = io.BytesIO()
    write_dict_of_lists(buffer, {"version": "1.1"}, [("list", [item_opcodes({"a": [1, "x"]}), item_opcodes(7)])])
    assert pickle.loads(buffer.getvalue()) == {"version": "1.1", "list": [{"a": [1, "x"]}, 7]}


def test_disk_buffers_can_be_read_more_than_once() -> None:
    buffer = DiskBuffer()
    for record in (b"", b"one", b"two" * 1000):
        buffer.add(record)
    assert list(buffer) == list(buffer) == [b"", b"one", b"two" * 1000]
    buffer.close()


def test_a_failing_stream_leaves_nothing_behind(tmp_path: Path) -> None:
    def write(file: object) -> None:
        raise RuntimeError("full")

    with pytest.raises(RuntimeError, match="full"):
        write_streamed(tmp_path / "infos.pkl", write)
    assert list(tmp_path.iterdir()) == []
