"""How many float32 columns the clouds of a folder have: a .bin file does not say.

KITTI stores x y z intensity; others store 3 (no intensity), 5 (a ring behind it: nuScenes, SeeingThroughFog; the source
behind it: our own clouds), 6 (Waymo) or 8. With the right row length every column has its own range of values, with a
wrong one the columns are mixed and alike. So the row length fits whose columns tell most about the values: the mutual
information of a value's column and its quantile (Shannon 1948). Multiples of it tell no more.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

KITTI_COLUMNS = 4
CANDIDATES = tuple(range(3, 17))
_BINS = 24
# Information in nats below which the columns are alike: KITTI's clouds have 0.4 and more.
_LEAST_INFORMATION = 0.15
# Share of the most that a shorter row must tell: 1.00 for the right one, at most 0.6 for a divisor of it.
_NEARLY = 0.85
_MANY_EMPTY = 0.02
# Fewer numbers than this show nothing about columns.
_FEWEST_VALUES = 800
_SAMPLED_FILES, _SAMPLED_BYTES = 6, 240_240 * 4  # divisible by every candidate


@dataclass(frozen=True)
class CloudForm:
    """How the clouds of a folder are read.

    columns  float32 numbers per point that are read
    fits     the number that the files show; another one than `columns` is an error unless it was asked for
    asked    True when the user set `columns`
    keep_empty  True: points of PLY and PCD files without a return (0 0 0) are kept, and NaN is refused
    """

    columns: int = KITTI_COLUMNS
    fits: int = KITTI_COLUMNS
    asked: bool = False
    keep_empty: bool = False

    @property
    def refusal(self) -> str:
        """What came instead of `columns`, or nothing."""
        return "" if self.asked or self.fits == self.columns else f"{self.fits} float32 columns a point"

    def refusal_of(self, folder: Path) -> str:
        """One line for a folder whose clouds are not read, or nothing."""
        expected = f"expected {self.columns} float32 columns a point (x y z intensity)"
        return f"{folder}: {expected}, its clouds have {self.fits}; {advice(self.fits)}" if self.refusal else ""


def advice(columns: int) -> str:
    """What to do about clouds of another row length."""
    return f"set data.columns={columns} (check and export: --columns {columns}); x y z intensity are the first of them"


def cloud_form(files: Sequence[Path], asked: int | None) -> CloudForm:
    """The form of a folder's clouds, from the sizes of all and the numbers of a few of its .bin files."""
    if asked is not None:
        return CloudForm(asked, asked, asked=True)
    sizes = [size for size in map(_size, files) if size]
    if not sizes:
        return CloudForm()
    chosen = [files[i] for i in np.unique(np.linspace(0, len(files) - 1, _SAMPLED_FILES).astype(int))]
    fits = _by_values([values for path in chosen if len(values := _sample(path))])
    return CloudForm(fits=fits or _by_sizes(sizes))


def fitting_columns(values: NDArray[np.floating]) -> int | None:
    """The row length that fits the numbers of one cloud, None when they do not show it."""
    return _by_values([values[: _SAMPLED_BYTES // 4]])


def _size(path: Path) -> int:
    try:
        return os.stat(path).st_size
    except OSError:
        return 0


def _sample(path: Path) -> NDArray[np.float32]:
    """The first numbers of a file, none when it cannot be read (its own reading says why)."""
    try:
        if not path.is_file() or path.is_symlink():
            return np.zeros(0, np.float32)
        with open(path, "rb") as file:
            data = file.read(_SAMPLED_BYTES)
    except OSError:
        return np.zeros(0, np.float32)
    return np.zeros(0, np.float32) if is_text(data) else np.frombuffer(data[: len(data) // 4 * 4], dtype="<f4")


def is_text(data: bytes) -> bool:
    """True for a file that begins with printable characters only, as no cloud does."""
    return len(data) > 16 and all(32 <= byte < 127 or byte in b"\t\r\n" for byte in data[:512])


def _by_sizes(sizes: Sequence[int]) -> int:
    """4 unless most files are no whole rows of 4, and all are whole rows of another length."""
    if 2 * sum(size % 16 == 0 for size in sizes) >= len(sizes):
        return KITTI_COLUMNS
    return next((c for c in (5, 3, 6, 8, 7) if all(size % (4 * c) == 0 for size in sizes)), KITTI_COLUMNS)


def _by_values(samples: Sequence[NDArray[np.floating]]) -> int | None:
    """The shortest row length whose columns tell nearly as much about the values as those of any other."""
    binned = [_quantile_bins(values) for values in samples if len(values) >= _FEWEST_VALUES]
    if not binned:
        return None
    told = {c: float(np.mean([_information(bins, c) for bins in binned])) for c in CANDIDATES}
    most = max(told.values())
    if most < _LEAST_INFORMATION:
        return None
    return next(c for c in (KITTI_COLUMNS, *CANDIDATES) if told[c] > _NEARLY * most)


def _quantile_bins(values: NDArray[np.floating]) -> NDArray[np.int64]:
    """The values as bins of about equal counts, empty returns (x y z intensity all 0) left out when there are many."""
    with np.errstate(invalid="ignore"):  # damaged files hold signalling NaN
        whole = np.asarray(values, dtype=np.float64)
    rows = whole[: len(whole) // 4 * 4].reshape(-1, 4)
    empty = (rows == 0).all(axis=1)
    if len(rows) and empty.mean() > _MANY_EMPTY:
        whole = rows[~empty].ravel()
    whole = np.where(np.isfinite(whole), whole, 0.0)
    edges = np.unique(np.quantile(whole, np.linspace(0, 1, _BINS + 1)[1:-1])) if len(whole) else np.zeros(0)
    # A value that many points share (0, a ring) is a bin of its own.
    return np.asarray(np.searchsorted(edges, whole, "left") + np.searchsorted(edges, whole, "right"), dtype=np.int64)


def _information(bins: NDArray[np.int64], columns: int) -> float:
    """Mutual information in nats of a value's bin and its column, less what chance gives; 0 when columns are alike."""
    rows = bins[: len(bins) // columns * columns].reshape(-1, columns)
    if rows.size == 0:
        return 0.0
    kinds = int(rows.max()) + 1
    counts = np.bincount((rows + kinds * np.arange(columns)).ravel(), minlength=kinds * columns)
    counts = counts.reshape(columns, kinds)
    joint = counts[:, counts.any(axis=0)] / rows.size
    expected = joint.sum(axis=0) / columns
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(joint > 0, joint * np.log(joint / expected), 0.0)
    chance = (columns - 1) * (joint.shape[1] - 1) / (2 * rows.size)
    return float(terms.sum() - chance)
