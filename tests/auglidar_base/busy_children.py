"""Programs with children that are busy for a minute: `python -m tests.auglidar_base.busy_children KIND`."""

from __future__ import annotations

import ctypes
import multiprocessing
import sys
import time
from multiprocessing.connection import Connection

from auglidar_base.children import process_pool, start_child

BUSY_SECONDS = 60
if multiprocessing.parent_process() is not None and "importing" in sys.argv:
    time.sleep(BUSY_SECONDS)


def sleep(_: Connection) -> None:
    time.sleep(BUSY_SECONDS)


def hold_the_interpreter(_: Connection) -> None:
    """Computes in a library that lets no other thread of Python run."""
    ctypes.PyDLL(None).sleep(BUSY_SECONDS)


def main(kind: str) -> None:
    """Says so once its children are there, and waits for them."""
    if kind == "pool":
        with process_pool(2) as pool:
            waiting = [pool.submit(time.sleep, BUSY_SECONDS) for _ in range(20)]
            print("ready", flush=True)
            waiting[-1].result()
        return
    _, inner = multiprocessing.get_context("spawn").Pipe()
    child = start_child(inner, hold_the_interpreter if kind == "holding" else sleep)
    print("ready", flush=True)
    child.join()


if __name__ == "__main__":
    main(sys.argv[1])
