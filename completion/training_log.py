"""What a training run writes while it goes on: rows of CSV files, and TensorBoard events when it is installed."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Append a row to a CSV file; the header comes from the first row."""
    path.parent.mkdir(parents=True, exist_ok=True)
    is_new = not path.is_file() or path.stat().st_size == 0
    with open(path, "a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(row), lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerow(row)


def keep_rows(path: Path, step: int) -> None:
    """Drop rows after `step`, written by a run that was killed before it saved its state."""
    if not path.is_file():
        return
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    kept = lines[:1] + [line for line in lines[1:] if line.endswith("\n") and int(line.split(",", 1)[0]) <= step]
    path.write_text("".join(kept), encoding="utf-8")


def show_in_tensorboard(out: Path, step: int, values: Mapping[str, float]) -> None:
    """Scalars for TensorBoard, when it is installed; log.csv has the same."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return
    with SummaryWriter(str(out / "tensorboard")) as writer:
        for name, value in values.items():
            writer.add_scalar(name, value, step)
