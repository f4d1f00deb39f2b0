"""Ray engine: the same workers as actors of a Ray cluster, placed, restarted and retried by Ray.

The data and the run folder must lie at the same path on every machine (a shared file system); only task names and
outcomes travel through Ray. The ledger stays with the process that asked for the run.
"""

from __future__ import annotations

import importlib.util
import os
import signal
from collections.abc import Callable, Iterator
from itertools import chain, repeat
from typing import Any

from pipeline.base.errors import UsageError
from pipeline.runner.jobs import Outcome, Task, crashed
from pipeline.runner.processes import TASKS_PER_WORKER, Worker, WorkerFactory, use_one_thread

# A machine that goes away costs its frames a repetition; a frame that ends its worker three times is at fault itself.
_RETRIES = 2


def check_available() -> None:
    """Raises UsageError when Ray is not installed."""
    if importlib.util.find_spec("ray") is None:
        raise UsageError("--engine ray needs Ray: pip install 'auglidar[ray]', or use --engine local")


class RemoteWorker:
    """What lives in an actor: a worker made there, at the first task, in the folder the run was started in."""

    def __init__(self, make_worker: WorkerFactory, folder: str) -> None:
        """folder  relative paths of the configuration are meant from here"""
        use_one_thread()
        os.chdir(folder)
        self._make_worker = make_worker
        self._worker: Worker | None = None

    def do(self, task: Task) -> Outcome | str:
        """The outcome, or why the run cannot be carried out."""
        try:
            self._worker = self._worker or self._make_worker()
            return self._worker.do(task)
        except UsageError as error:
            return str(error)


class RayEngine:
    """Runs tasks on the actors of a cluster: the one RAY_ADDRESS names, else one started on this machine."""

    def __init__(self, make_worker: WorkerFactory, workers: int) -> None:
        """workers  actors of one core each; 0 = one per core of the cluster. Raises UsageError without a cluster."""
        check_available()
        self._ray = _connected()
        count = workers or max(1, int(self._ray.cluster_resources().get("CPU", 1)))
        options = {"num_cpus": 1, "max_restarts": -1, "max_task_retries": _RETRIES}
        remote = self._ray.remote(**options)(RemoteWorker)
        self._actors = [remote.remote(make_worker, os.getcwd()) for _ in range(count)]

    def outcomes(self, tasks: Iterator[Task], stopping: Callable[[], bool]) -> Iterator[Outcome]:
        """Outcomes in the order they come; as `LocalEngine.outcomes`, with the same bound on tasks under way."""
        under_way: dict[Any, tuple[Task, Any]] = {}
        free = chain.from_iterable(repeat(self._actors, TASKS_PER_WORKER))
        self._feed(tasks, free, under_way, stopping)
        while under_way:
            ready, _ = self._ray.wait(list(under_way))
            for reference in ready:
                task, actor = under_way.pop(reference)
                yield self._received(reference, task)
                self._feed(tasks, iter([actor]), under_way, stopping)

    def _feed(
        self,
        tasks: Iterator[Task],
        free: Iterator[Any],
        under_way: dict[Any, tuple[Task, Any]],
        stopping: Callable[[], bool],
    ) -> None:
        for actor in free:
            task = None if stopping() else next(tasks, None)
            if task is None:
                return
            under_way[actor.do.remote(task)] = (task, actor)

    def _received(self, reference: Any, task: Task) -> Outcome:
        try:
            answer = self._ray.get(reference)
        except self._ray.exceptions.RayActorError:
            return crashed(task, None)
        if isinstance(answer, Outcome):
            return answer
        raise UsageError(str(answer))

    def close(self) -> None:
        """Ends the actors and leaves the cluster."""
        for actor in self._actors:
            self._ray.kill(actor)
        self._actors = []
        self._ray.shutdown()


def _connected() -> Any:
    """The ray module, connected. Raises UsageError when the cluster named by RAY_ADDRESS does not answer."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import ray

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        ray.init(log_to_driver=False, logging_level="error", include_dashboard=False)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise UsageError(f"no Ray cluster: {error}; start one with `ray start`, or unset RAY_ADDRESS") from None
    for number, handler in before.items():
        # Ray ends the program on SIGTERM; ours finishes the frames under way.
        signal.signal(number, handler)
    return ray
