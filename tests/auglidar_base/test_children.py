"""No child outlives its parent by more than five seconds, whatever it does; pools stop when they are left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import uuid

import pytest

from auglidar_base.children import end_with_parent, process_pool
from tests.pipeline.left_behind import ENDS_WITHIN, ROOT, marked, started

pytestmark = pytest.mark.skipif(not os.path.isdir("/proc"), reason="looks for processes in /proc")


@pytest.mark.parametrize(
    ("kind", "number"),
    [
        ("importing", signal.SIGKILL),
        ("holding", signal.SIGKILL),
        ("sleeping", signal.SIGTERM),
        ("pool", signal.SIGKILL),
        ("pool", signal.SIGTERM),
        ("pool", signal.SIGINT),
    ],
)
def test_children_end_with_their_parent(kind: str, number: signal.Signals) -> None:
    mark = uuid.uuid4().hex
    program = started(["tests.auglidar_base.busy_children", kind], mark)
    assert program.stdout is not None
    assert program.stdout.readline() == "ready\n"
    time.sleep(0.5)  # the children are past the start of the interpreter, or in it
    assert len(marked(mark)) >= 2
    program.send_signal(number)
    program.communicate(timeout=ENDS_WITHIN)
    deadline = time.monotonic() + ENDS_WITHIN
    while marked(mark) and time.monotonic() < deadline:
        time.sleep(0.02)
    stayed = marked(mark)
    for pid in stayed:
        os.kill(pid, signal.SIGKILL)
    assert stayed == {}


def test_leaving_a_pool_by_an_exception_waits_for_nothing() -> None:
    start = time.monotonic()

    def leave() -> None:
        with process_pool(1) as pool:
            pool.submit(time.sleep, 60)
            raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        leave()
    assert time.monotonic() - start < 30


def test_a_pool_that_is_left_well_has_finished_its_work() -> None:
    with process_pool(1) as pool:
        found = [pool.submit(pow, 3, exponent) for exponent in range(5)]
    assert [future.result(timeout=0) for future in found] == [1, 3, 9, 27, 81]


def test_a_process_without_a_parent_of_ours_goes_on() -> None:
    program = "from auglidar_base.children import end_with_parent; end_with_parent(True); print('on')"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    assert subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True).stdout == b"on\n"
    end_with_parent()
