"""Disk budget: stop cleanly while there is still room for the ledger and for other people."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.disk import no_more_files

GB = 1e9


@dataclass
class DiskBudget:
    """Checked before every task.

    keep_free_gb  stop when the file system has less than this left
    max_gb        stop when this command has written more than this, or None
    """

    folder: Path
    keep_free_gb: float
    max_gb: float | None
    written_bytes: int = 0

    def exceeded(self) -> str:
        """Why nothing more may be written, or ""."""
        if self.max_gb is not None and self.written_bytes >= self.max_gb * GB:
            return f"disk budget of {self.max_gb:g} GB used up (run.max_gb)"
        free = shutil.disk_usage(self.folder).free / GB
        if free < self.keep_free_gb:
            return f"{self.folder}: {free:.2f} GB free, {self.keep_free_gb:g} GB are to be kept (run.keep_free_gb)"
        return self._no_more_files()

    def _no_more_files(self) -> str:
        reason = no_more_files(self.folder)
        return f"{self.folder}: {reason}" if reason else ""
