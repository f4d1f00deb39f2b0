"""Readers that are tried in a process of their own, so that a crash is a find instead of the end of the search."""

from __future__ import annotations

import multiprocessing
import resource
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.errors import DataError

MEMORY_BYTES = 2_000_000_000


class ReaderProcess:
    """Reads files one after the other in a child; a new one is started after a crash."""

    def __init__(self, reader: Callable[[Path], object]) -> None:
        """reader  a function of a module; raises DataError to refuse"""
        self._reader = reader
        self._process: BaseProcess | None = None
        self._pipe: Connection

    def read(self, path: Path) -> None:
        """Raises DataError when the file is refused, AssertionError for every other end: an error or a signal."""
        if self._process is None:
            self._start()
        assert self._process is not None
        self._pipe.send(path)
        try:
            refused, error = self._pipe.recv()
        except EOFError:
            self._process.join()
            code, self._process = self._process.exitcode, None
            raise AssertionError(f"the reader's process ended with {code}") from None
        if refused:
            raise DataError(path, "a sound file", error)
        assert not error, error

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, inner = context.Pipe()
        self._process = context.Process(target=_serve, args=(inner, self._reader), daemon=True)
        self._process.start()
        inner.close()


def _serve(pipe: Connection, reader: Callable[[Path], object]) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    while True:
        try:
            path = pipe.recv()
        except EOFError:
            return
        try:
            reader(path)
            pipe.send((False, ""))
        except DataError as error:
            pipe.send((True, str(error)))
        except Exception as error:  # whatever it is, it is what is looked for
            pipe.send((False, f"{type(error).__name__}: {error}"))


def read_infos(path: Path) -> None:
    """Reads an info pickle and looks at every value of it: a wrong pointer is followed only then."""
    from pipeline.check.safe_pickle import load_infos

    _look_at(load_infos(path))


def _look_at(value: Any) -> None:
    if isinstance(value, dict):
        _look_at(list(value.items()))
    elif isinstance(value, (list, tuple, set, frozenset)):
        for item in value:
            _look_at(item)
    elif isinstance(value, np.ndarray):
        _look_at(value.copy().tolist())
    else:
        repr(value).encode()
