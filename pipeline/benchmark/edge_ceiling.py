"""How low can the error at depth edges of `held_out_rings` get? Estimated by answers that know more than any method.

The measure asks for the depth of one LiDAR return within three columns of a jump in its own ring. Returns of a ring lie
about two pixels apart, LiDAR and camera look from two places, and what is given may hold no depth near the right one.
Each `REFERENCES` answers the same question with one of these limits left in and the others taken away.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.benchmark.camera import frame_pictures
from pipeline.benchmark.held_out_rings import BEAM_STRIDES, HeldOutFrame, hold_out
from pipeline.data import Dataset, Frame
from pipeline.geometry.calibration import Calibration
from pipeline.geometry.rings import split_rings
from pipeline.geometry.visibility import visible_points

Array = NDArray[np.float64]

# "Given returns nearby": columns to either side of the pixel; the rows are the next given rings above and below.
NEARBY_COLUMNS = 8.0
# The picture's outline is looked for between the two returns of the jump and so many columns beyond.
OUTLINE_MARGIN = 2


@dataclass(frozen=True)
class Returns:
    """The returns that the camera sees, sorted by ring and column: (N,) column, row (pixels), depth (m), ring."""

    column: Array
    row: Array
    depth: Array
    ring: NDArray[np.int64]

    @classmethod
    def of(cls, frame: Frame) -> Returns:
        """Every visible return of all rings."""
        ring = split_rings(frame.points)
        seen = visible_points(frame.points, ring, frame.calibration, frame.image_size)
        pixels, depth = frame.calibration.cam_to_image(frame.calibration.velo_to_cam(frame.points[seen]))
        order = np.lexsort((pixels[:, 0], ring[seen]))
        return cls(pixels[order, 0], pixels[order, 1], depth[order], ring[seen][order])

    def nearest(self, ring: int, column: float, without: int = -1) -> int:
        """Index of the return of a ring that is nearest in column, other than `without`; -1 where there is none."""
        start, end = np.searchsorted(self.ring, [ring, ring + 1])
        there = [i for i in self._around(start, end, column) if i != without]
        return min(there, key=lambda i: abs(self.column[i] - column)) if there else -1

    def _around(self, start: int, end: int, column: float) -> range:
        at = int(start + np.searchsorted(self.column[start:end], column))
        return range(max(start, at - 2), min(end, at + 3))


@dataclass(frozen=True)
class Edge:
    """One edge window: the asked return, and the two returns of its own ring between which the depth jumps.

    asked        index of the return whose depth is the truth
    left, right  indices of the neighbours round the jump, left of it and right of it
    """

    returns: Returns
    held_out: HeldOutFrame
    step: int
    asked: int
    left: int
    right: int

    @property
    def truth(self) -> float:
        """Depth of the asked return, metres."""
        return float(self.returns.depth[self.asked])

    @property
    def column(self) -> float:
        """Of the asked return, pixels."""
        return float(self.returns.column[self.asked])

    def depth_at(self, ring: int, column: float, without: int = -1) -> float:
        """Depth of the nearest return of a ring, NaN where it has none."""
        index = self.returns.nearest(ring, column, without)
        return float(self.returns.depth[index]) if index >= 0 else float("nan")

    @property
    def ring(self) -> int:
        """Of the asked return."""
        return int(self.returns.ring[self.asked])

    def given_nearby(self) -> Array:
        """Depths of the given rings next above and below, within `NEARBY_COLUMNS`; none where they are empty there."""
        above = self.ring - self.ring % self.step
        there = np.isin(self.returns.ring, (above, above + self.step))
        there &= np.abs(self.returns.column - self.column) <= NEARBY_COLUMNS
        return self.returns.depth[there]

    def side(self, outline: float) -> float:
        """Depth of the surface on the asked return's side of an outline at this column."""
        index = self.left if self.column <= outline else self.right
        return float(self.returns.depth[index])


def edges_of(frame: Frame, rows: int) -> list[Edge]:
    """The edge windows of `held_out_rings.hold_out` whose jump lies between two returns of the asked one's ring."""
    held_out = hold_out(frame.points, frame.calibration, frame.image_size, rows)
    returns = Returns.of(frame)
    place = np.rint(returns.column).astype(int), np.rint(returns.row).astype(int)
    asked: dict[tuple[int, int], int] = {}
    step = BEAM_STRIDES[rows]
    for index in np.flatnonzero(returns.ring % step):
        key = int(place[1][index]), int(place[0][index])
        if key not in asked or returns.depth[index] < returns.depth[asked[key]]:
            asked[key] = int(index)
    found = []
    for row, column in held_out.edges[:, :2].astype(int).tolist():
        jump = _jump(returns, asked[row, column])
        if jump is not None:
            found.append(Edge(returns, held_out, step, asked[row, column], *jump))
    return found


def _jump(returns: Returns, asked: int) -> tuple[int, int] | None:
    """The neighbours in the asked return's ring, within three columns of it, with the largest step between them."""
    near = np.arange(max(0, asked - 6), min(len(returns.depth), asked + 7))
    near = near[(returns.ring[near] == returns.ring[asked])]
    near = near[np.abs(returns.column[near] - returns.column[asked]) <= 3.5]
    if len(near) < 2:
        return None
    step = np.abs(np.diff(returns.depth[near]))
    at = int(step.argmax())
    far = min(returns.depth[near[at]], returns.depth[near[at + 1]])
    return (int(near[at]), int(near[at + 1])) if step[at] > max(2.0, 0.1 * far) else None


def outline_column(edge: Edge, image: NDArray[np.uint8]) -> float:
    """Where the picture changes most along the row, between the returns of the jump and `OUTLINE_MARGIN` beyond."""
    row = int(np.rint(edge.returns.row[edge.asked]))
    first = max(0, int(np.floor(edge.returns.column[edge.left])) - OUTLINE_MARGIN)
    last = min(image.shape[1] - 1, int(np.ceil(edge.returns.column[edge.right])) + OUTLINE_MARGIN)
    strip = image[max(0, row - 1) : row + 2, first : last + 1].astype(np.float64).mean(axis=0)
    change = np.abs(np.diff(strip, axis=0)).sum(axis=1)
    return first + 0.5 + float(change.argmax())


def _given_for(edge: Edge, wanted: float) -> float:
    """Of the given returns nearby the one nearest in depth to `wanted`, metres."""
    given = edge.given_nearby()
    return float(given[np.abs(given - wanted).argmin()]) if len(given) and np.isfinite(wanted) else float("nan")


def _between_rings(edge: Edge) -> float:
    """Depth in the rings above and below (of all 64): of the two nearest returns the one nearer in column."""
    found = [edge.returns.nearest(edge.ring + each, edge.column) for each in (-1, 1)]
    found = [index for index in found if index >= 0]
    if not found:
        return float("nan")
    nearest = min(found, key=lambda index: abs(edge.returns.column[index] - edge.column))
    return float(edge.returns.depth[nearest])


def _moved(columns: float) -> Callable[[Edge, Any], list[float]]:
    return lambda edge, _: [edge.depth_at(edge.ring, edge.column + sign * columns) for sign in (-1, 1)]


def _sides(edge: Edge) -> list[float]:
    return [float(edge.returns.depth[each]) for each in (edge.left, edge.right)]


Pictures = dict[str, NDArray[np.uint8]]
# What is known -> the depths answered for an edge (several: their errors are averaged), given the pictures by name.
REFERENCES: dict[str, Callable[[Edge, Pictures], list[float]]] = {
    "own ring complete, camera off by 0.5 px": _moved(0.5),
    "own ring complete, camera off by 1 px": _moved(1.0),
    "own ring complete, camera off by 2 px": _moved(2.0),
    "own ring without the return itself": lambda edge, _: [edge.depth_at(edge.ring, edge.column, edge.asked)],
    "rings above and below of all": lambda edge, _: [_between_rings(edge)],
    "given returns nearby, the best by truth": lambda edge, _: [_given_for(edge, edge.truth)],
    "given returns nearby, chosen by the rings above and below of all": lambda edge, _: [
        _given_for(edge, _between_rings(edge))
    ],
    "given returns nearby, side by the picture's outline": lambda edge, pictures: [
        _given_for(edge, edge.side(outline_column(edge, pictures["true"])))
    ],
    "given returns nearby, side by another frame's outline": lambda edge, pictures: [
        _given_for(edge, edge.side(outline_column(edge, pictures["other"])))
    ],
    "given returns nearby, side by a coin": lambda edge, _: [_given_for(edge, depth) for depth in _sides(edge)],
    "both surfaces, side by the picture's outline": lambda edge, pictures: [
        edge.side(outline_column(edge, pictures["true"]))
    ],
    "both surfaces, side by another frame's outline": lambda edge, pictures: [
        edge.side(outline_column(edge, pictures["other"]))
    ],
    "both surfaces, side by a coin": lambda edge, _: _sides(edge),
}


def edge_ceiling(dataset: Dataset, rows: Sequence[int], progress: Callable[[str], None]) -> list[dict[str, Any]]:
    """Per number of rows: edge tMAE (mm) of every reference, mean over frames as `held_out_rings.score` has it.

    Where a reference has no answer (nothing given nearby) it counts with the full cap of 1 m: "answered" is the share
    that has one. "parallax" is how far LiDAR and camera disagree on where the outline hides the far surface, in columns
    (median and 90th percentile).
    """
    return [_ceiling(dataset, number, progress) for number in rows]


def _ceiling(dataset: Dataset, rows: int, progress: Callable[[str], None]) -> dict[str, Any]:
    means: dict[str, list[NDArray[np.float64]]] = {name: [] for name in REFERENCES}
    shifts: list[float] = []
    for index, frame_id in enumerate(dataset.ids):
        frame = dataset[frame_id]
        edges, pictures = edges_of(frame, rows), frame_pictures(dataset, index)
        shifts += [parallax(edge, frame.calibration) for edge in edges]
        for name, answer in REFERENCES.items() if edges else ():
            means[name].append(np.mean([_error(edge, answer(edge, pictures)) for edge in edges], axis=0))
        progress(f"edges, {rows} rows {frame_id}")
    scores = {name: np.mean(frames, axis=0).tolist() for name, frames in means.items() if frames}
    return {
        "rows": rows,
        "windows": len(shifts),
        "parallax": np.percentile(shifts, [50, 90]).tolist() if shifts else None,
        "references": {name: {"edge_tmae": error, "answered": share} for name, (error, share) in scores.items()},
    }


def ceiling_tables(found: Sequence[dict[str, Any]]) -> str:
    """Markdown: one table for every number of rows."""
    lines = []
    for entry in found:
        shift = (
            ""
            if entry["parallax"] is None
            else ", LiDAR and camera {:.1f} columns apart (90 %: {:.1f})".format(*entry["parallax"])
        )
        lines += [f"Edge windows at {entry['rows']} rows: {entry['windows']} jumps within one ring{shift}", ""]
        lines += ["| known | edge tMAE (mm) | answered (%) |", "|---|---|---|"]
        lines += [
            f"| {name} | {score['edge_tmae']:.0f} | {100 * score['answered']:.0f} |"
            for name, score in entry["references"].items()
        ]
        lines.append("")
    return "\n".join(lines)


def _error(edge: Edge, answers: Sequence[float]) -> tuple[float, float]:
    """(error capped at 1 m in mm, share of the answers that are one)."""
    errors = np.abs(np.array(answers) - edge.truth)
    there = np.isfinite(errors)
    return 1000 * float(np.where(there, np.minimum(errors, 1), 1).mean()), float(there.mean())


def parallax(edge: Edge, calibration: Calibration) -> float:
    """Columns between the near surface's outline and the place it hides on the far one, as the LiDAR sees it."""
    depth = edge.returns.depth
    near, far = sorted((edge.left, edge.right), key=lambda index: depth[index])
    pixel = np.array([edge.returns.column[near], edge.returns.row[near], 1.0])
    P2 = calibration.P2
    point = np.linalg.solve(P2[:, :3], pixel * (P2[2, 2] * depth[near] + P2[2, 3]) - P2[:, 3])
    lidar = calibration.velo_to_cam(np.zeros((1, 3)))[0]
    behind = lidar + (point - lidar) * (depth[far] - lidar[2]) / (point[2] - lidar[2])
    return float(abs(calibration.cam_to_image(behind[None])[0][0, 0] - pixel[0]))
