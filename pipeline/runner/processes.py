"""Local engine: the same tasks in this process or in N worker processes, each with one computing thread.

One thread per process makes results identical for any N (the order of a floating-point sum does not depend on it), and
uses the cores better than threads inside a frame do. A pipe per worker tells which task a dead worker had in hand.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Protocol

from auglidar_base.children import start_child
from pipeline.base.errors import UsageError
from pipeline.runner.jobs import Outcome, Task, crashed

# One in hand and one to go on with.
TASKS_PER_WORKER = 2
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


class Worker(Protocol):
    """What the engine needs of a worker."""

    def do(self, task: Task) -> Outcome:
        """The outcome of one task."""


WorkerFactory = Callable[[], Worker]


def available_cores() -> int:
    """Cores this process may use (containers and `taskset` are respected)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def use_one_thread() -> None:
    """One computing thread in this process: by environment for libraries yet to be imported, by call for the others."""
    # With an old TBB on the machine Numba takes another threading layer and says so: nothing a user has to act on.
    warnings.filterwarnings("ignore", message="The TBB threading layer requires")
    numba = sys.modules.get("numba")
    for name in _THREAD_VARIABLES:
        # Numba reads its variable again while it compiles, and refuses another value once its threads are running.
        if numba is None or not name.startswith("NUMBA"):
            os.environ[name] = "1"
    if numba is not None:
        numba.set_num_threads(1)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(1)


@contextmanager
def _one_thread_for_children() -> Iterator[None]:
    """The environment of processes started in the block asks for one thread; this process' own is put back after."""
    before = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


class LocalEngine:
    """Runs tasks with `workers` processes, or in this process when there is one worker."""

    def __init__(self, make_worker: WorkerFactory, workers: int) -> None:
        """make_worker  builds a worker; picklable when workers > 1"""
        self._make_worker, self._count = make_worker, workers
        self._inline: Worker | None = None
        self._processes: list[_WorkerProcess] = []

    def outcomes(self, tasks: Iterator[Task], stopping: Callable[[], bool]) -> Iterator[Outcome]:
        """Outcomes in the order they come. No new task is begun once `stopping()`; those in hand are finished.

        Each worker holds two tasks, one to work on and one to go on with while this process writes the ledger and
        looks at the files of the next (which brings them into the memory of the system). The next is taken from
        `tasks` when one is done: memory does not grow with the number of tasks.
        """
        if self._count == 1:
            yield from self._outcomes_here(tasks, stopping)
            return
        while len(self._processes) < self._count:
            self._processes.append(_WorkerProcess(self._make_worker))
        self._feed(tasks, self._processes * TASKS_PER_WORKER, stopping)
        while busy := [process for process in self._processes if process.tasks]:
            for ready in wait([process.pipe for process in busy]):
                process = next(process for process in busy if process.pipe is ready)
                yield process.receive()
                if process.ended:
                    process = self._replaced(process)
                self._feed(tasks, [process], stopping)

    def _replaced(self, ended: _WorkerProcess) -> _WorkerProcess:
        """A new process in the place of one that ended; it gets the task that one had not begun."""
        process = _WorkerProcess(self._make_worker)
        self._processes[self._processes.index(ended)] = process
        for task in ended.tasks:
            process.send(task)
        return process

    def _feed(self, tasks: Iterator[Task], free: list[_WorkerProcess], stopping: Callable[[], bool]) -> None:
        """Gives a task to each process of `free`, as long as there are tasks."""
        for process in free:
            task = None if stopping() else next(tasks, None)
            if task is None:
                return
            process.send(task)

    def _outcomes_here(self, tasks: Iterator[Task], stopping: Callable[[], bool]) -> Iterator[Outcome]:
        if self._inline is None:
            use_one_thread()
            self._inline = self._make_worker()
        while not stopping() and (task := next(tasks, None)) is not None:
            yield self._inline.do(task)

    def close(self) -> None:
        """Ends the worker processes."""
        for process in self._processes:
            process.close()
        self._processes.clear()
        self._inline = None


class _WorkerProcess:
    """A process, the pipe to it, and the tasks it was given, the one in hand first."""

    def __init__(self, make_worker: WorkerFactory) -> None:
        self.pipe, inner = multiprocessing.get_context("spawn").Pipe()
        with _one_thread_for_children():
            self.process: BaseProcess = start_child(inner, _serve, make_worker)
        inner.close()
        self.tasks: deque[Task] = deque()
        self.ended = False

    def send(self, task: Task) -> None:
        self.tasks.append(task)
        try:
            self.pipe.send(task)
        except OSError:
            # It died while idle; `receive` finds the closed pipe and reports the task.
            self.ended = True

    def receive(self) -> Outcome:
        """The outcome of the task in hand; a crash when the process ended."""
        task = self.tasks.popleft()
        try:
            answer = self.pipe.recv()
        except (EOFError, OSError):
            self.ended = True
            self.process.join(timeout=5)
            self.pipe.close()
            return crashed(task, self.process.exitcode)
        if isinstance(answer, Outcome):
            return answer
        raise UsageError(str(answer))

    def close(self) -> None:
        """Closing the pipe ends the process once its task is done."""
        if not self.ended:
            self.pipe.close()
        self.process.join(timeout=10)
        if self.process.is_alive():
            self.process.kill()


def _serve(pipe: Connection, make_worker: WorkerFactory) -> None:
    """Body of a worker process: answers tasks until the parent closes the pipe or dies."""
    use_one_thread()
    worker: Worker | None = None
    while True:
        try:
            task = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            worker = worker or make_worker()
            answer: Outcome | str = worker.do(task)
        except UsageError as error:
            answer = str(error)
        try:
            pipe.send(answer)
        except OSError:
            return
