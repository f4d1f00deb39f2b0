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

# What a reader of arrays may map (the libraries alone take 3 GB with PyTorch), and what it may really take.
MEMORY_BYTES = 6_000_000_000
MOST_RESIDENT_BYTES = 1_000_000_000
HANG_SECONDS = 60.0


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
        if not self._pipe.poll(HANG_SECONDS):
            self._process.kill()
            self._process = None
            raise AssertionError(f"no answer within {HANG_SECONDS:.0f} s")
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
            try:
                reader(path)
            finally:
                _check_memory()
            pipe.send((False, ""))
        except DataError as error:
            pipe.send((True, str(error)))
        except Exception as error:  # whatever it is, it is what is looked for
            pipe.send((False, f"{type(error).__name__}: {error}"))


def _check_memory() -> None:
    taken = _peak_resident_bytes()
    assert taken < MOST_RESIDENT_BYTES, f"{taken / 1e6:.0f} MB were taken"


def _peak_resident_bytes() -> int:
    """Of this process. Not `ru_maxrss`, which a new program takes over from the process that started it."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))


def read_infos(path: Path) -> None:
    """Reads an info pickle and looks at every value of it: a wrong pointer is followed only then."""
    from pipeline.check.safe_pickle import load_infos

    _look_at(load_infos(path))


def read_npz_file(path: Path) -> None:
    """Reads an .npz as the surfaces of a frame are read."""
    from pipeline.run_folder.frame_outputs import read_npz

    _look_at(read_npz(path, ("foreground", "sigma")))


def read_npy_file(path: Path) -> None:
    """Reads a .npy as a cloud is read."""
    from pipeline.data.cloud_files import read_points

    _look_at(read_points(path))


def read_torch_file(path: Path) -> None:
    """Reads a PyTorch checkpoint, zip or legacy, and looks at its tensors."""
    import torch

    from auglidar_base.errors import CheckpointError
    from auglidar_base.torch_pickle import read_torch_pickle

    try:
        contents = read_torch_pickle(path)
    except CheckpointError as error:
        raise DataError(path, "a checkpoint", str(error)) from None
    for value in contents.values() if isinstance(contents, dict) else ():
        if isinstance(value, torch.Tensor):
            value.double().sum()


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
