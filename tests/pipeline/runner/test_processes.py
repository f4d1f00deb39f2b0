"""The local engine: any number of workers, crashes, stops."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from pipeline.base.errors import UsageError
from pipeline.runner.jobs import Outcome, Task
from pipeline.runner.processes import LocalEngine
from pipeline.runner.signals import stop_on_signals


@dataclass
class Doubler:
    """Answers with the length of the frame's name; "kill" ends its process, "refuse" refuses."""

    def do(self, task: Task) -> Outcome:
        if task.frame == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if task.frame == "refuse":
            raise UsageError("no such weights")
        return Outcome(task, seconds=float(len(task.frame)))


def tasks(*frames: str) -> Iterator[Task]:
    return (Task("complete", frame) for frame in frames)


def never() -> bool:
    return False


@pytest.mark.parametrize("workers", [1, 2])
def test_every_task_has_one_outcome(workers: int) -> None:
    engine = LocalEngine(Doubler, workers)
    names = [f"{i}" * (i + 1) for i in range(6)]
    found = {outcome.task.frame: outcome.seconds for outcome in engine.outcomes(tasks(*names), never)}
    engine.close()
    assert found == {name: float(len(name)) for name in names}


def test_tasks_are_taken_only_when_a_worker_is_free() -> None:
    taken: list[str] = []

    def source() -> Iterator[Task]:
        for i in range(10):
            taken.append(str(i))
            yield Task("complete", str(i))

    engine = LocalEngine(Doubler, 1)
    for count, _ in enumerate(engine.outcomes(source(), never), start=1):
        assert len(taken) == count
    assert len(taken) == 10


def test_a_crash_costs_one_frame_and_the_worker_is_replaced() -> None:
    engine = LocalEngine(Doubler, 2)
    found = {o.task.frame: o.failure for o in engine.outcomes(tasks("a", "kill", "b", "c", "d"), never)}
    engine.close()
    assert set(found) == {"a", "kill", "b", "c", "d"}
    assert [name for name, failure in found.items() if failure is not None] == ["kill"]
    failure = found["kill"]
    assert failure is not None
    assert failure.kind == "crash"


def test_a_refusal_of_the_worker_is_a_refusal_of_the_request() -> None:
    engine = LocalEngine(Doubler, 2)
    with pytest.raises(UsageError, match="no such weights"):
        list(engine.outcomes(tasks("refuse", "refuse"), never))
    engine.close()


def test_after_a_stop_no_task_is_begun() -> None:
    done: list[str] = []
    engine = LocalEngine(Doubler, 1)
    for outcome in engine.outcomes(tasks("a", "b", "c"), lambda: len(done) >= 2):
        done.append(outcome.task.frame)  # noqa: PERF401 - the stop looks at it meanwhile
    assert done == ["a", "b"]


def test_signals_set_the_request_and_are_restored() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with stop_on_signals() as stop:
        assert not stop()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)
        assert stop()
        assert (stop.reason, stop.signal_number) == ("stopped by SIGTERM", signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before
