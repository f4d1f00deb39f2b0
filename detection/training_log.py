"""What a training run writes while it goes on."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

from auglidar_base.atomic import write_bytes


class TrainingLog:
    """A CSV file of a run, one row after so many steps, and TensorBoard when it is installed."""

    def __init__(self, folder: Path, done: int, name: str = "log.csv") -> None:
        self.path = folder / name
        rows = list(csv.reader(io.StringIO(self.path.read_text()))) if self.path.is_file() else []
        self.header = rows[0] if rows else []
        # Rows written after the last saved state are written again.
        kept = [row for row in rows if row and (row[0] == "step" or int(row[0]) <= done)]
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(kept)
        if rows:
            write_bytes(self.path, text.getvalue().encode())
        self.board = _tensorboard(folder)

    def write(self, step: int, values: dict[str, float]) -> None:
        """Append one row."""
        with self.path.open("a", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            if not self.header:
                self.header = ["step", *values]
                writer.writerow(self.header)
            writer.writerow([step, *(f"{values[name]:.6g}" for name in self.header[1:])])
        if self.board is not None:
            for name, value in values.items():
                self.board.add_scalar(name, value, step)


def _tensorboard(folder: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder / "tensorboard"))
