"""Detections of a run as one Parquet table, one row per box, frames in order."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

from pipeline.base.errors import UsageError
from pipeline.export.disk_buffer import DiskBuffer, write_streamed
from pipeline.export.record import Options, Record
from pipeline.export.source import ExportFrame

ROWS = "rows"
NUMBERS = ("score", "x", "y", "z", "h", "w", "l", "ry", "alpha", "x1", "y1", "x2", "y2")
FILE = "detections.parquet"
# Rows per group: large enough to compress, small enough that one group is all that is in memory.
_GROUP = 65536


def write_frame(item: ExportFrame, out: Path, options: Options) -> Record:
    """The rows of one frame, for `finish`."""
    rows = [
        {
            "frame": item.frame.id,
            "class": o.type,
            "values": [o.score, *o.location, *o.size, o.ry, o.alpha, *o.bbox],
        }
        for o in item.detections
    ]
    return Record(((ROWS, json.dumps(rows).encode()),), {"boxes": len(rows)})


def finish(
    out: Path, buffers: Mapping[str, DiskBuffer], names: list[str], splits: Mapping[str, frozenset[str]]
) -> list[Path]:
    """detections.parquet: frame, class (text) and the columns NUMBERS (float64). Raises UsageError without pyarrow."""
    path = out / FILE
    buffer = buffers.get(ROWS)
    write_streamed(path, lambda file: _write(file, buffer if buffer is not None else DiskBuffer()))
    return [path]


def _write(file: BinaryIO, buffer: DiskBuffer) -> None:
    pyarrow, parquet = _pyarrow()
    kinds = [("frame", pyarrow.string()), ("class", pyarrow.string()), *((n, pyarrow.float64()) for n in NUMBERS)]
    schema = pyarrow.schema(kinds)
    with parquet.ParquetWriter(file, schema) as writer:
        group: list[dict[str, object]] = []
        for entry in buffer:
            group += [
                {"frame": row["frame"], "class": row["class"], **dict(zip(NUMBERS, row["values"]))}
                for row in json.loads(entry)
            ]
            if len(group) >= _GROUP:
                writer.write_table(pyarrow.Table.from_pylist(group, schema=schema))
                group = []
        writer.write_table(pyarrow.Table.from_pylist(group, schema=schema))


def _pyarrow():  # type: ignore[no-untyped-def]
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError:
        raise UsageError("writing Parquet needs pyarrow: pip install 'auglidar[parquet]'") from None
    return pyarrow, pyarrow.parquet
