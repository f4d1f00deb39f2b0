"""report/index.html: a file with everything in it, opened from disk on any machine; further pages for more frames."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from auglidar_base.atomic import write_text
from pipeline.base.errors import UsageError
from pipeline.base.paths import RunFolder
from pipeline.base.versions import made_with
from pipeline.data import Dataset
from pipeline.report import pictures
from pipeline.report.cloud import palettes, point_budget
from pipeline.report.hover import hover_step
from pipeline.report.matches import (
    CurvePanel,
    MatchedFrames,
    Mistake,
    ap_cells,
    curve_panels,
    difference_rows,
    judge,
    mistakes,
)
from pipeline.report.views import Display, FrameView, MistakeView, frame_view, mistake_view
from pipeline.run_folder.config import Config
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.run_folder.thresholds import ScoreThresholds
from pipeline.run_folder.weights import detector_name
from pipeline.scoring.tables import DEPTH_NAMES, ap_header, ap_rows, depth_rows

FOLDER = Path(__file__).resolve().parent
# The worst mistakes listed at the top, and the share of the shown frames that is chosen for them.
LISTED_MISTAKES = 24
SCRIPTS = ("cloud.js", "script.js")


@dataclass(frozen=True)
class Page:
    """What stands on the page beside the frames and the files of the run."""

    views: list[FrameView]
    total: int
    worst: list[MistakeView] = field(default_factory=list)
    n_mistakes: int = 0
    ap: list[list[str]] = field(default_factory=list)
    curves: list[CurvePanel] = field(default_factory=list)
    other: RunFolder | None = None
    differences: list[list[str]] = field(default_factory=list)
    settings: list[tuple[str, str]] = field(default_factory=list)
    least: ScoreThresholds = field(default_factory=ScoreThresholds)
    parts: list[Part] = field(default_factory=list)
    part: Part | None = None

    @property
    def labelled(self) -> bool:
        """Whether any frame has labels: without, nothing on the page speaks of true boxes."""
        return any(view.labelled for view in self.views)

    @property
    def thresholds(self) -> dict[str, float]:
        """Class -> score from which it is drawn; "" for all others. Empty when everything is."""
        drawn = {box.kind: self.least.of(box.kind) for view in self.views for box in (*view.found, *view.other)}
        return {name: score for name, score in sorted(drawn.items()) if score > -math.inf}


@dataclass(frozen=True)
class Part:
    """A further page: the frames of the run from `first` on, counted from 0, in the run's order."""

    file: str
    first: int
    frames: tuple[str, ...]

    @property
    def title(self) -> str:
        """ "000020 to 000039"."""
        return self.frames[0] if len(self.frames) == 1 else f"{self.frames[0]} to {self.frames[-1]}"


def parts_of(frames: tuple[str, ...], count: int, most: int) -> list[Part]:
    """The pages for a run of more than `count` frames, at most `most`; none where one page holds them all."""
    if len(frames) <= count:
        return []
    starts = range(0, len(frames), count)[:most]
    return [Part(f"frames-{n}.html", start, frames[start : start + count]) for n, start in enumerate(starts, start=1)]


def write_report(config: Config, run: RunFolder, dataset: Dataset, frames: tuple[str, ...]) -> Path:
    """Writes the report of a run, and the figures or recordings that `report.format` asks for; returns its path.

    The page shows at most `report.frames` frames: those with the worst mistakes and others spread evenly over the run.
    Further pages, at most `report.pages`, show all frames in order.
    Raises UsageError when the run to compare with is not there.
    """
    other = other_run(config)
    matched = judge(config, run, dataset, frames)
    matched_other = judge(config, other, dataset, frames) if other is not None else MatchedFrames()
    found = mistakes(matched)
    least = ScoreThresholds.of_run(config)
    shown = chosen_frames(frames, found, config.report.frames)
    parts = parts_of(frames, config.report.frames, config.report.pages)
    display = Display(hover_step(len(shown)), point_budget(len(shown)), matched, other, matched_other, least)
    page = Page(
        views=[frame_view(dataset[frame_id], FrameOutputs(run, frame_id), display) for frame_id in shown],
        total=len(frames),
        worst=worst_views(found, dataset, shown, parts),
        n_mistakes=len(found),
        ap=ap_cells(matched),
        curves=curve_panels(matched),
        other=other,
        differences=difference_rows(matched, matched_other),
        settings=settings_of(config),
        least=least,
        parts=parts,
    )
    write_text(run.report, render(run, page))
    write_parts(run, dataset, page, display)
    write_beside(config, run, dataset, frames, matched, least)
    return run.report


def write_parts(run: RunFolder, dataset: Dataset, page: Page, display: Display) -> None:
    """Writes the further pages, and removes those of an earlier report that had more."""
    folder = run.report.parent
    for old in set(folder.glob("frames-*.html")) - {folder / part.file for part in page.parts}:
        old.unlink()
    for part in page.parts:
        views = [frame_view(dataset[frame_id], FrameOutputs(run, frame_id), display) for frame_id in part.frames]
        write_text(folder / part.file, render(run, replace(page, views=views, part=part)))


def write_beside(
    config: Config,
    run: RunFolder,
    dataset: Dataset,
    frames: tuple[str, ...],
    matched: MatchedFrames,
    least: ScoreThresholds,
) -> list[Path]:
    """What `report.format` asks for beside the page: figures, or a recording of all frames for a viewer."""
    kind = config.report.format
    if kind in ("png", "pdf", "svg"):
        from pipeline.report.figures import write_figures

        return write_figures(config, run, dataset, frames, matched, least)
    if kind == "html":
        return []
    from pipeline.report.recordings.mcap_file import write_mcap
    from pipeline.report.recordings.rerun_file import write_rrd
    from pipeline.report.recordings.scene import scenes

    write = write_rrd if kind == "rrd" else write_mcap
    path = run.report.parent / f"{run.root.name}.{kind}"
    return [write(path, scenes(run, dataset, frames, least), run.root.name)]


def settings_of(config: Config) -> list[tuple[str, str]]:
    """(name, value) of what decides the results; the whole configuration stands at the end of the page."""
    cloud = config.augment.preset + (f", depth from {config.augment.depth_from}" if config.augment.depth_from else "")
    made = config.made_with or made_with()
    return [
        ("data", Path(config.data.root).name if config.data.root else config.data.name),
        ("completion", Path(config.completion.model).name),
        ("cloud", cloud),
        ("detector", Path(_detector(config)).name),
        ("seed", str(config.seed)),
        ("AugLiDAR", " ".join(filter(None, (made.get("auglidar"), made.get("git"))))),
    ]


def _detector(config: Config) -> str:
    try:
        return detector_name(config)
    except UsageError:
        return config.detection.model


def other_run(config: Config) -> RunFolder | None:
    """The run that `report.compare` names."""
    if config.report.compare is None:
        return None
    other = RunFolder(Path(config.report.compare))
    if not other.config.is_file():
        raise UsageError(f"report.compare: {other.root} is not a folder of a run (it has no config.yaml)")
    return other


def chosen_frames(frames: tuple[str, ...], found: Sequence[Mistake], count: int) -> tuple[str, ...]:
    """At most `count` frames in order: half of them those of the worst mistakes, the others spread over the run."""
    if len(frames) <= count:
        return frames
    worst = list(dict.fromkeys(mistake.frame for mistake in found))[: count // 2]
    rest = tuple(frame for frame in frames if frame not in worst)
    chosen = {*worst, *spread(rest, count - len(worst))}
    return tuple(frame for frame in frames if frame in chosen)


def spread(frames: tuple[str, ...], count: int) -> tuple[str, ...]:
    """At most `count` of the frames, evenly spread, in order."""
    if len(frames) <= count:
        return frames
    return tuple(frames[index] for index in np.linspace(0, len(frames) - 1, count).round().astype(int))


def worst_views(
    found: Sequence[Mistake], dataset: Dataset, shown: Sequence[str], parts: Sequence[Part] = ()
) -> list[MistakeView]:
    """The worst misses and the worst false positives, half each where there are enough of both."""
    half = LISTED_MISTAKES // 2
    missed = [mistake for mistake in found if mistake.kind == "missed"]
    false = [mistake for mistake in found if mistake.kind == "false"]
    listed = missed[: max(half, LISTED_MISTAKES - len(false))] + false[: max(half, LISTED_MISTAKES - len(missed))]
    places = {
        frame_id: f"{part.file}#frame-{number}"
        for part in parts
        for number, frame_id in enumerate(part.frames, start=1)
    }
    places |= {frame_id: f"#frame-{number}" for number, frame_id in enumerate(shown, start=1)}
    return [mistake_view(mistake, dataset[mistake.frame], places.get(mistake.frame, "")) for mistake in listed]


def render(run: RunFolder, page: Page) -> str:
    """The HTML text."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(FOLDER), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["thousands"] = lambda value: f"{value:,}"
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    metrics, failures = _read_json(run.metrics), _read_json(run.failures)
    return environment.get_template("page.html.j2").render(
        title=run.root.name,
        style=(FOLDER / "style.css").read_text(encoding="utf-8"),
        script="\n".join((FOLDER / name).read_text(encoding="utf-8") for name in SCRIPTS),
        page=page,
        views=page.views,
        total=page.total,
        shown_all=sum(len(part.frames) for part in page.parts) == page.total,
        palettes=palettes(),
        facts=headline(metrics, page.total),
        ap_header=ap_header(metrics),
        ap_rows=page.ap or ap_rows(metrics),
        warnings=metrics.get("warnings", []),
        depth_rows=depth_pairs(metrics, page.other),
        depth_frames=metrics.get("depth", {}).get("frames", 0),
        steps=metrics.get("augmentation", []),
        failures=failures.get("failures", []),
        config=run.config.read_text(encoding="utf-8") if run.config.is_file() else "",
        unfound=unfound(metrics, page.curves),
        legends=legends({map.legend for view in page.views for map in view.maps}),
        bev=pictures.BirdsEye(),
        bev_scale=pictures.BEV_PIXELS_PER_METRE,
        bev_rings=(20, 40, 60),
    )


def depth_pairs(metrics: dict[str, Any], other: RunFolder | None) -> list[list[str]]:
    """Depth measure in words, its mean, and the other run's mean when there is one."""
    rows = [[DEPTH_NAMES.get(name, name), value] for name, value in depth_rows(metrics)]
    if other is None:
        return rows
    theirs = dict(depth_rows(_read_json(other.metrics)))
    return [[*row, theirs.get(name, "-")] for row, (name, _) in zip(rows, depth_rows(metrics))]


def headline(metrics: dict[str, Any], frames: int) -> list[tuple[str, str, str]]:
    """(value, name, remark) of the figures at the top."""
    facts = [(str(frames), "frames", "")]
    for metric, name in (("3d", "Car 3D AP"), ("bev", "Car bird's-eye AP")):
        for row in metrics.get("results", []):
            asked = (row["class"], row["metric"], row["iou"], *row["range"]) == ("Car", metric, 0.7, 0, None)
            if asked and row["moderate"] is not None:
                remark = f"moderate, IoU 0.7, R{row['recall_points']}, {row['n_gt'][1]} cars"
                facts.append((f"{row['moderate']:.1f}", name, remark))
    depth = metrics.get("depth", {}).get("mean", {})
    if depth:
        mae, rmse = depth["mae_mm"] / 1000, depth["rmse_mm"] / 1000
        facts.append((f"{mae:.2f} m", "mean depth error", f"RMSE {rmse:.2f} m, {metrics['depth']['frames']} frames"))
    steps = metrics.get("augmentation", [])
    if steps:
        facts.append((f"{steps[-1]['out']:,}", "points per frame", "mean of the clouds given to the detector"))
    return facts


def unfound(metrics: dict[str, Any], curves: Sequence[CurvePanel]) -> list[str]:
    """Classes with objects but without a curve: nothing of them was found in 3D or from above."""
    drawn = {panel.title.split(",")[0] for panel in curves}
    classes = dict.fromkeys(row["class"] for row in metrics.get("results", []) if any(row["n_gt"]))
    return [name for name in classes if name not in drawn]


def legends(used: set[str]) -> dict[str, dict[str, Any]]:
    """The colour scales that the page uses: CSS gradient and ticks (percent from the left, text)."""
    depth = [(pictures.tick_position(metres), f"{metres}") for metres in pictures.DEPTH_TICKS]
    error = [(pictures.error_position(metres), f"{metres:g}") for metres in pictures.ERROR_TICKS]
    sigma = [(0.0, "0 background"), (50.0, "0.5"), (100.0, "1 foreground")]
    scales = {
        "depth": ("Depth, m", pictures.depth_colours(), depth),
        "sigma": ("Sigma", pictures.sigma_colours(), sigma),
        "error": ("Error, gap, m", pictures.error_colours(), error),
    }
    return {
        name: {"title": title, "gradient": pictures.gradient(colours), "ticks": ticks}
        for name, (title, colours, ticks) in scales.items()
        if name in used
    }


def _read_json(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}
