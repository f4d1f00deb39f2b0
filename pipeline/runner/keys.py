"""The key of a task: a hash of everything its result depends on. A changed key means the task is done again."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.errors import DataError
from pipeline.data.frame import Frame
from pipeline.run_folder.frame_outputs import content_hash

PACKAGES = Path(__file__).resolve().parent.parent.parent


def stage_key(settings: Any, weights: Iterable[Path], code: Iterable[str], file_hash: Callable[[Path], str]) -> str:
    """Hash of what all frames of a stage share: settings, weights, and the source code in the folders `code`."""
    record = {
        "settings": settings,
        "weights": [file_hash(path) for path in weights],
        "code": [code_version(folder) for folder in code],
    }
    return content_hash(json.dumps(record, sort_keys=True, default=str).encode())


def task_key(
    shared: str, frame: Frame, parts: Iterable[str], files: Iterable[Path], file_hash: Callable[[Path], str]
) -> str:
    """Hash of a task: `shared` (see `stage_key`), the frame's parts it reads, and files of earlier stages."""
    record = [shared, frame.id]
    record += [f"{part}:{part_hash(frame, part, file_hash)}" for part in parts]
    record += [file_hash(path) for path in files]
    return content_hash("\n".join(record).encode())


def part_hash(frame: Frame, part: str, file_hash: Callable[[Path], str]) -> str:
    """Hash of the files a part is read from, or of its value when the reader names no file or a folder.

    A folder (the recording day of KITTI raw, the root of Virtual KITTI 2) does not tell which of its files are read.
    """
    if not frame.has(part):
        return "none"
    files = frame.files(part)
    if files and not any(path.is_dir() for path in files):
        return ",".join([*(file_hash(path) for path in files), *frame.forms(part)])
    try:
        value = getattr(frame, part)
    except DataError as error:
        return f"unreadable: {error}"
    return content_hash(_content(value))


def _content(value: Any) -> bytes:
    """All digits of an array, also within a dataclass (a calibration); the text of anything else."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape} ".encode() + np.ascontiguousarray(value).tobytes()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return b"|".join(_content(getattr(value, field.name)) for field in dataclasses.fields(value))
    return repr(value).encode()


@lru_cache(maxsize=64)
def code_version(folder: str) -> str:
    """Hash of the Python files of a package folder or of one file ("completion", "pipeline/pointcloud"), by content."""
    root = PACKAGES / folder
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted(root.rglob("*.py")) if root.is_dir() else [root]:
        digest.update(path.relative_to(PACKAGES).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
