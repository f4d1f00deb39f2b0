"""What travels between the runner and its workers: a task, and what became of it."""

from __future__ import annotations

import errno
import traceback
from dataclasses import asdict, dataclass, field
from typing import Any

from pipeline.base.disk import why_full
from pipeline.base.errors import DataError, UsageError
from pipeline.run_folder.frame_outputs import Written
from pipeline.runner.limits import is_out_of_memory

# Errors after which going on with the next frame would only repeat them.
_FATAL_ERRNO = {errno.ENOSPC: "the disk is full", errno.EDQUOT: "the disk quota is used up", errno.EROFS: "read-only"}


@dataclass(frozen=True)
class Task:
    """One stage of one frame."""

    stage: str
    frame: str


@dataclass(frozen=True)
class Failure:
    """Why a task could not be done, in the words of failures.json.

    kind   "data" (damage or a missing part), "unexpected" (a fault of the program; `detail` holds the traceback) or
           "crash" (the worker process ended)
    """

    stage: str
    frame: str
    kind: str
    file: str
    expected: str
    found: str
    hint: str = ""
    detail: str = ""

    def line(self) -> str:
        """One clear line."""
        middle = f"expected {self.expected}, got {self.found}" if self.expected else self.found
        place = f"{self.file}: " if self.file else ""
        return f"{self.stage}: frame {self.frame}: {place}{middle}" + (f"; {self.hint}" if self.hint else "")

    def as_dict(self) -> dict[str, Any]:
        """For failures.json."""
        return asdict(self)


@dataclass(frozen=True)
class Outcome:
    """A task that was done (`failure` is None) or not.

    written   files below the run folder
    seconds   wall time of the work
    fatal     a reason to stop the whole run (disk full), or ""
    refused   the stage cannot be carried out at all (weights not found, wrong settings): the reason, or ""
    """

    task: Task
    written: dict[str, Written] = field(default_factory=dict)
    seconds: float = 0.0
    failure: Failure | None = None
    fatal: str = ""
    refused: str = ""


def outcome_of_error(task: Task, error: BaseException, seconds: float) -> Outcome:
    """The outcome of a task that raised `error`."""
    if isinstance(error, OSError) and error.errno in _FATAL_ERRNO and not isinstance(error, DataError):
        what = why_full(error.filename) if error.errno == errno.ENOSPC else _FATAL_ERRNO[error.errno]
        reason = f"{what} ({error.filename or error.strerror})"
        return Outcome(task, {}, seconds, _failure(task, "data", found=reason), fatal=reason)
    if isinstance(error, DataError):
        failure = Failure(task.stage, task.frame, "data", error.where, error.expected, error.found, error.hint)
        return Outcome(task, {}, seconds, failure)
    if isinstance(error, UsageError):
        return Outcome(task, {}, seconds, _failure(task, "data", found=str(error)))
    if is_out_of_memory(error):
        hint = "try fewer --workers, a smaller frame, or a larger limits.memory_gb"
        return Outcome(task, {}, seconds, _failure(task, "data", "it takes more memory than there is", hint))
    text = "".join(traceback.format_exception(type(error), error, error.__traceback__))
    found = f"{type(error).__name__}: {' '.join(str(error).split())[:500]}"
    return Outcome(task, {}, seconds, _failure(task, "unexpected", found=found, detail=text))


def crashed(task: Task, exit_code: int | None) -> Outcome:
    """The outcome of a task whose worker process ended while it worked."""
    hint = "out of memory? try fewer --workers" if exit_code == -9 else ""
    how = f"signal {-exit_code}" if exit_code is not None and exit_code < 0 else f"exit code {exit_code}"
    return Outcome(task, failure=_failure(task, "crash", found=f"the worker process ended ({how})", hint=hint))


def _failure(task: Task, kind: str, found: str, hint: str = "", detail: str = "") -> Failure:
    return Failure(task.stage, task.frame, kind, "", "", found, hint, detail)
