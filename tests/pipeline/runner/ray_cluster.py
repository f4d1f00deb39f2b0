"""A program that runs a command on a Ray cluster of two nodes while a worker dies: see `test_ray_engine.py`.

    python -m tests.pipeline.runner.ray_cluster FLAG_FILE FRAME run_pipeline's arguments ...

The worker that takes FRAME kills itself in mid-frame, once: FLAG_FILE tells that it did.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

from pipeline.run_folder.config import Config
from pipeline.runner import batch
from pipeline.runner.jobs import Outcome, Task
from pipeline.runner.worker import FrameWorker


class DyingWorker(FrameWorker):
    """A worker whose process is killed after it wrote the files of one frame and before it could say so."""

    def __init__(self, flag: Path, frame: str, config: Config, out: Path) -> None:
        super().__init__(config, out)
        self.flag, self.frame = flag, frame

    def do(self, task: Task) -> Outcome:
        outcome = super().do(task)
        if task.frame == self.frame and not self.flag.exists():
            self.flag.write_text("killed")
            os.kill(os.getpid(), signal.SIGKILL)
        return outcome


class WorkerMaker:
    """Stands in for FrameWorker in the batch."""

    def __init__(self, flag: Path, frame: str) -> None:
        self.flag, self.frame = flag, frame

    def __call__(self, config: Config, out: Path) -> DyingWorker:
        return DyingWorker(self.flag, self.frame, config, out)


def run_on_two_nodes(flag: Path, frame: str, arguments: list[str]) -> int:
    """The exit code of the command line."""
    from ray.cluster_utils import Cluster

    from pipeline.cli import main
    from tests.pipeline.runner import ray_cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "object_store_memory": 80_000_000})
    cluster.add_node(num_cpus=1, object_store_memory=80_000_000)
    os.environ["RAY_ADDRESS"] = cluster.address
    # Found by its module name in the workers, not as part of __main__.
    batch.FrameWorker = ray_cluster.WorkerMaker(flag, frame)  # type: ignore[assignment,misc]
    try:
        return main(arguments)
    finally:
        cluster.shutdown()


if __name__ == "__main__":
    sys.exit(run_on_two_nodes(Path(sys.argv[1]), sys.argv[2], sys.argv[3:]))
