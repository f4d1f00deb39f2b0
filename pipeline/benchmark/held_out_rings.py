"""Depth completion on real frames, scored on LiDAR rings that were kept back.

A 64-ring scan gives every 2nd, 4th or 8th ring to the method; the visible returns of the other rings are the truth.
Three questions are asked: how large is the error (MAE, RMSE, and with errors capped at 1 m, tMAE and tRMSE), how often
does the method invent a depth between two surfaces (mixed), and how large is the capped error at depth edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from pipeline.geometry.calibration import Calibration
from pipeline.geometry.held_out import ring_maps
from pipeline.geometry.project import project_points
from pipeline.geometry.rings import split_rings
from pipeline.geometry.visibility import visible_points

Array = NDArray[np.float64]

BEAM_STRIDES = {32: 2, 16: 4, 8: 8}
# "Clean" windows: nothing measured between the two surfaces within 8 columns and so many rows (half an input gap + 3).
CLEAN_ROWS = {2: 10, 4: 16, 8: 28}
CLEAN_COLUMNS = 8
MARGIN = 0.5
MIN_CLEAN_WINDOWS = 5


@dataclass(frozen=True)
class HeldOutFrame:
    """What a method is given and what it is scored on, for one frame and one number of rows.

    sparse       (H, W) float32 input, metres, 0 = none
    truth        (H, W) float32 visible held-out depth at evaluation pixels, 0 elsewhere
    visible      (H, W) float32 visible depth of all rings, nearest per pixel, 0 elsewhere
    hull         (H, W) bool, inside the convex hull of the input pixels
    edges        (E, 4) float64 rows of (row, column, near surface, far surface): centres of the edge windows
    clean        (E,) bool, windows in which any depth between the surfaces is invented
    """

    sparse: NDArray[np.float32]
    truth: NDArray[np.float32]
    visible: NDArray[np.float32]
    hull: NDArray[np.bool_]
    edges: Array
    clean: NDArray[np.bool_]


def hold_out(
    points: NDArray[np.floating], calibration: Calibration, image_size: tuple[int, int], rows: int
) -> HeldOutFrame:
    """Splits a 64-ring scan into input rings and held-out truth. rows: 32, 16 or 8."""
    step = BEAM_STRIDES[rows]
    ring = split_rings(points)
    given = ring % step == 0
    seen = visible_points(points, ring, calibration, image_size)
    sparse, truth = ring_maps(points, given, seen, calibration, image_size)
    visible = project_points(points[seen], calibration, image_size)
    hull = convex_hull_mask(sparse > 0)
    truth[~hull] = 0
    everything = project_points(points, calibration, image_size)
    edges = _edge_windows(truth, visible, cv2.erode(hull.astype(np.uint8), np.ones((7, 7), np.uint8), borderValue=0))
    clean = _clean_windows(edges, everything, CLEAN_COLUMNS, CLEAN_ROWS[step])
    return HeldOutFrame(sparse, truth, visible, hull, edges, clean)


def convex_hull_mask(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(H, W) bool: the filled convex hull of the true pixels."""
    filled = np.zeros(mask.shape, dtype=np.uint8)
    row, column = np.nonzero(mask)
    if len(row):
        hull = cv2.convexHull(np.column_stack([column, row]).astype(np.int32))
        cv2.fillConvexPoly(filled, hull, 1)
    return filled.astype(bool)


def score(prediction: NDArray[np.floating], frame: HeldOutFrame) -> dict[str, float]:
    """Scores of one completed depth map (H, W) in metres, 0 = hole.

    Keys: mae, rmse, tmae, trmse, edge_tmae in mm; mixed, mixed_all, missing in percent; counts pixels, edge_windows,
    clean_windows. Holes take the nearest predicted pixel before errors are computed; `mixed` ignores them. `mixed` is
    NaN when the frame has fewer than five clean windows.
    """
    prediction = np.asarray(prediction, dtype=np.float64)
    predicted, everywhere = prediction > 0, filled(prediction)
    at = frame.truth > 0
    error = np.abs(everywhere[at] - frame.truth[at])
    row, column = frame.edges[:, 0].astype(int), frame.edges[:, 1].astype(int)
    edge_error = np.abs(everywhere[row, column] - frame.truth[row, column])
    mixed, total = _mixed_counts(prediction, frame.visible.astype(np.float64), frame.edges)
    enough = int(frame.clean.sum()) >= MIN_CLEAN_WINDOWS
    return {
        "mae": 1000 * float(error.mean()),
        "rmse": 1000 * float(np.sqrt((error**2).mean())),
        "tmae": 1000 * float(np.minimum(error, 1).mean()),
        "trmse": 1000 * float(np.sqrt(np.minimum(error**2, 1).mean())),
        "edge_tmae": 1000 * float(np.minimum(edge_error, 1).mean()) if len(edge_error) else float("nan"),
        "mixed": _percent(mixed[frame.clean].sum(), total[frame.clean].sum()) if enough else float("nan"),
        "mixed_all": _percent(mixed.sum(), total.sum()),
        "missing": _percent((frame.hull & ~predicted).sum(), frame.hull.sum()),
        "pixels": float(at.sum()),
        "edge_windows": float(len(frame.edges)),
        "clean_windows": float(frame.clean.sum()),
    }


def filled(prediction: NDArray[np.floating]) -> Array:
    """A depth map (H, W) whose holes (0) take the nearest predicted pixel."""
    found: Array = np.asarray(prediction, dtype=np.float64)
    predicted = found > 0
    if not predicted.all() and predicted.any():
        index = distance_transform_edt(~predicted, return_distances=False, return_indices=True)
        found = found[tuple(index)]
    return found


def _percent(part: float, whole: float) -> float:
    return 100 * float(part) / float(whole) if whole else float("nan")


@njit(cache=True)
def _edge_windows(truth, visible, inner):  # type: ignore[no-untyped-def]
    """(E, 4): row, column, near, far of the evaluation pixels whose 7 x 7 window holds a depth edge."""
    height, width = truth.shape
    found = []
    values = np.empty(21)
    for row in range(3, height - 3):
        for column in range(3, width - 3):
            if truth[row, column] == 0 or inner[row, column] == 0:
                continue
            n = 0
            # Only the middle three rows: they hold one ring, so the step from ring to ring on far road is no edge.
            for y in range(row - 1, row + 2):
                for x in range(column - 3, column + 4):
                    if visible[y, x] > 0:
                        values[n] = visible[y, x]
                        n += 1
            if n < 2:
                continue
            ordered = np.sort(values[:n])
            gap, at = 0.0, 0
            for k in range(n - 1):
                if ordered[k + 1] - ordered[k] > gap:
                    gap, at = ordered[k + 1] - ordered[k], k
            if gap > max(2.0, 0.1 * ordered[at]):
                found.append((float(row), float(column), ordered[at], ordered[at + 1]))
    out = np.empty((len(found), 4))
    for i in range(len(found)):
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = found[i]
    return out


@njit(cache=True)
def _clean_windows(edges, everything, columns, rows):  # type: ignore[no-untyped-def]
    """(E,) bool: no return of any ring lies between the two surfaces near the window."""
    height, width = everything.shape
    clean = np.ones(len(edges), dtype=np.bool_)
    for i in range(len(edges)):
        row, column, near, far = int(edges[i, 0]), int(edges[i, 1]), edges[i, 2], edges[i, 3]
        for y in range(max(0, row - rows), min(height, row + rows + 1)):
            for x in range(max(0, column - columns), min(width, column + columns + 1)):
                if near + MARGIN < everything[y, x] < far - MARGIN:
                    clean[i] = False
    return clean


@njit(cache=True)
def _mixed_counts(prediction, visible, edges):  # type: ignore[no-untyped-def]
    """Per edge window: predicted pixels at an invented intermediate depth, and predicted pixels."""
    mixed = np.zeros(len(edges), dtype=np.int64)
    total = np.zeros(len(edges), dtype=np.int64)
    for i in range(len(edges)):
        row, column, near, far = int(edges[i, 0]), int(edges[i, 1]), edges[i, 2], edges[i, 3]
        for y in range(row - 3, row + 4):
            for x in range(column - 3, column + 4):
                depth = prediction[y, x]
                if depth <= 0:
                    continue
                total[i] += 1
                if not near + MARGIN < depth < far - MARGIN:
                    continue
                measured = False
                for yy in range(row - 3, row + 4):
                    for xx in range(column - 3, column + 4):
                        if visible[yy, xx] > 0 and abs(visible[yy, xx] - depth) <= MARGIN:
                            measured = True
                if not measured:
                    mixed[i] += 1
    return mixed, total
