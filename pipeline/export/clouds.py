"""Clouds for viewers: PLY and PCD with every per-point column (x y z intensity source ..., sigma, surfaces)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from auglidar_base.atomic import write_bytes
from pipeline.data.cloud_files import Cloud, pcd_bytes, ply_bytes
from pipeline.export.record import Options, Record
from pipeline.export.source import ExportFrame


def write_ply(item: ExportFrame, out: Path, options: Options) -> Record:
    """NAME.ply of one frame."""
    return _write(item, out / f"{item.name}.ply", ply_bytes)


def write_pcd(item: ExportFrame, out: Path, options: Options) -> Record:
    """NAME.pcd of one frame."""
    return _write(item, out / f"{item.name}.pcd", pcd_bytes)


def _write(item: ExportFrame, path: Path, encode: Callable[[Cloud], bytes]) -> Record:
    write_bytes(path, encode(item.columns))
    return Record(counts={"points": len(item.columns.values)})
