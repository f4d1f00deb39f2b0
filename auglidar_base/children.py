"""Child processes that never outlive their parent, whatever they are doing, and pools that stop at once when asked to.

A child of a killed program waits for work that nobody will send, or finishes work that nobody wants. So every child
looks twice a second whether its parent still lives, from before its heavy imports on; on Linux the kernel ends it too,
even while it computes in a library that holds the interpreter. A child leaves SIGINT and SIGTERM, which reach whole
process groups, to its parent: that one decides whether the work in hand is finished.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any

_LOOK_EVERY_SECONDS = 0.5
_PR_SET_PDEATHSIG = 1  # <linux/prctl.h>


def end_with_parent(by_kernel: bool = False) -> None:
    """Called in a child process as early as possible: it ends within a second of its parent. Elsewhere: does nothing.

    by_kernel  the main thread of the parent started this process: Linux then ends it together with that thread
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    if by_kernel and sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    # A parent that died before this line is seen by the first look.
    threading.Thread(target=_watch, args=(parent.pid,), name="end with parent", daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_LOOK_EVERY_SECONDS)
    os._exit(1)


def loader_worker(_: int) -> None:
    """`worker_init_fn` of a torch DataLoader: its processes end with the training."""
    end_with_parent()
    _leave_signals_to_parent()


def start_child(pipe: Connection, function: Callable[..., None], *arguments: Any) -> BaseProcess:
    """A fresh process (spawn) that calls `function(pipe, *arguments)`.

    Function and arguments are unpickled there, which imports what they need, only after the child watches its parent.
    """
    payload = bytes(ForkingPickler.dumps((function, arguments)))
    child = multiprocessing.get_context("spawn").Process(
        target=_run_child, args=(pipe, _in_main_thread(), payload), daemon=True
    )
    child.start()
    return child


def _run_child(pipe: Connection, by_kernel: bool, payload: bytes) -> None:
    end_with_parent(by_kernel)
    _leave_signals_to_parent()
    function, arguments = pickle.loads(payload)  # made by `start_child`
    function(pipe, *arguments)


@contextmanager
def process_pool(workers: int, initializer: Callable[[], None] | None = None) -> Iterator[ProcessPoolExecutor]:
    """A pool of fresh processes (spawn: threads of torch or OpenCV in this process would not survive a fork).

    When the block ends well, the work handed over is finished. When it is left by an exception, Ctrl-C included, what
    has not begun is cancelled and the processes are ended at once: files appear whole or not at all.
    """
    payload = bytes(ForkingPickler.dumps(initializer))
    pool = ProcessPoolExecutor(
        workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin_work,
        initargs=(_in_main_thread(), payload),
    )
    try:
        yield pool
        pool.shutdown()
    except BaseException:
        _stop_at_once(pool)
        raise


def _begin_work(by_kernel: bool, payload: bytes) -> None:
    end_with_parent(by_kernel)
    _leave_signals_to_parent()
    initializer = pickle.loads(payload)  # made by `process_pool`
    if initializer is not None:
        initializer()


def _stop_at_once(pool: ProcessPoolExecutor) -> None:
    # The pool's own list: Python offers `kill_workers` from 3.14 on.
    processes = list((pool._processes or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.kill()


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _leave_signals_to_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
