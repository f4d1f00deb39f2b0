"""What the camera adds: scores with the true picture, a flat one and another frame's, as a whole and over distance."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from completion.pictures import PICTURES, other_number, pictures_of
from pipeline.benchmark.held_out_rings import HeldOutFrame, filled
from pipeline.data import Dataset

# Bounds of the bins of distance, metres along the optical axis.
DISTANCES = (0.0, 10.0, 20.0, 40.0, 80.0)
# What is compared; see `held_out_rings.score`.
COMPARED = ("mae", "rmse", "tmae", "edge_tmae", "mixed")
# Okabe and Ito's blue and vermilion.
COLOURS = {"true": "#0072B2", "other": "#D55E00"}
NAMES = {"true": "true picture", "other": "another frame's"}


def frame_pictures(dataset: Dataset, number: int) -> dict[str, NDArray[np.uint8]]:
    """The pictures of `completion.pictures` for frame `number`; a data set of one frame takes its own, mirrored."""
    image = dataset[dataset.ids[number]].image
    count = len(dataset)
    other = image[:, ::-1] if count == 1 else dataset[dataset.ids[other_number(number, count)]].image
    return pictures_of(image, other)


def distance_sums(prediction: NDArray[np.floating], frame: HeldOutFrame) -> dict[str, NDArray[np.float64]]:
    """Sums over the evaluation pixels and the edge windows of a frame, to be added up over frames.

    (bins, 3) for "pixels" and "edges": how many there are, their error and their error capped at 1 m, in mm.
    """
    depth = filled(prediction)
    row, column = frame.edges[:, 0].astype(int), frame.edges[:, 1].astype(int)
    pixels = frame.truth > 0
    pairs = {
        "pixels": (depth[pixels], frame.truth[pixels]),
        "edges": (depth[row, column], frame.truth[row, column]),
    }
    return {name: _sums(*pair) for name, pair in pairs.items()}


def _sums(found: NDArray[np.floating], truth: NDArray[np.floating]) -> NDArray[np.float64]:
    error = np.abs(found.astype(np.float64) - truth)
    number = np.digitize(truth, DISTANCES) - 1
    columns = [np.ones_like(error), 1000 * error, 1000 * np.minimum(error, 1)]
    return np.array([[column[number == each].sum() for column in columns] for each in range(len(DISTANCES) - 1)])


def distance_means(frames: Sequence[dict[str, NDArray[np.float64]]]) -> dict[str, Any]:
    """{"pixels" and "edges": {"0-10": {"count", "mae", "tmae"}, ...}} of the sums of all frames, None where empty."""
    bins = [f"{low:g}-{high:g}" for low, high in itertools.pairwise(DISTANCES)]
    means: dict[str, Any] = {}
    for name in ("pixels", "edges"):
        total = np.sum([frame[name] for frame in frames], axis=0)
        means[name] = {
            label: {
                "count": int(count),
                "mae": error / count if count else None,
                "tmae": capped / count if count else None,
            }
            for label, (count, error, capped) in zip(bins, total.tolist())
        }
    return means


def camera_table(entries: Sequence[dict[str, Any]], frames: int) -> list[str]:
    """Markdown lines for the entries of `suite.completion_scores` that were tried with several pictures."""
    lines = [f"What the camera adds, {frames} frames: true picture / flat grey / another frame's (mm; %)", ""]
    lines += ["| rows | method | " + " | ".join(COMPARED) + " |", "|" + "---|" * (len(COMPARED) + 2)]
    for entry in sorted(entries, key=lambda each: -each["rows"]):
        cells = (" / ".join(_shown(name, value) for value in _values(entry, name)) for name in COMPARED)
        lines.append(f"| {entry['rows']} | {entry['method']} | " + " | ".join(cells) + " |")
    return lines


def _values(entry: dict[str, Any], name: str) -> Iterator[float | None]:
    return (entry["pictures"][picture][name] for picture in PICTURES)


def _shown(name: str, value: float | None) -> str:
    return "-" if value is None else f"{value:.{1 if name == 'mixed' else 0}f}"


def plot_camera(path: Path, entries: Sequence[dict[str, Any]]) -> Path:
    """One column per method: how much larger or smaller its error is than with a flat picture, over distance.

    Above all evaluation pixels (MAE), below the edge windows (tMAE). Below zero the picture helps.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1.5 + 3.6 * len(entries), 6.4), layout="constrained", dpi=120)
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(entries), squeeze=False, sharey="row")
    for column, entry in enumerate(entries):
        for row, (part, key, about) in enumerate((("pixels", "mae", "MAE"), ("edges", "tmae", "tMAE at edges"))):
            _bars(axes[row, column], entry["distance"], part, key)
            axes[row, column].set_title(f"{entry['method']}, {entry['rows']} rows: {about}", fontsize=9)
        axes[1, column].set_xlabel("distance [m] (values)")
    for row in range(2):
        axes[row, 0].set_ylabel("difference to a flat picture [%]")
    axes[0, 0].legend(fontsize=8)
    figure.savefig(path)
    return path


def _bars(axes: Any, distance: dict[str, Any], part: str, key: str) -> None:
    flat = distance["grey"][part]
    labels = [name for name in flat if flat[name][key]]
    place = np.arange(len(labels))
    for number, (picture, colour) in enumerate(COLOURS.items()):
        change = [100 * (distance[picture][part][name][key] / flat[name][key] - 1) for name in labels]
        axes.bar(place + 0.4 * (number - 0.5), change, 0.38, color=colour, label=NAMES[picture])
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set_xticks(place, [f"{name}\n({flat[name]['count']})" for name in labels], fontsize=8)
