"""report/index.html: one file with everything in it, opened from disk on any machine."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config import Config
from pipeline.data import Dataset, Frame
from pipeline.errors import DataError
from pipeline.frame_files import FrameFiles
from pipeline.paths import RunFolder
from pipeline.report import pictures
from pipeline.report.boxes import DrawnBox, drawn_boxes
from pipeline.report.tables import ap_header, ap_rows, depth_rows
from pipeline.runner.atomic import write_text

PHOTO_WIDTH, MAP_WIDTH = 1242, 760
FOLDER = Path(__file__).resolve().parent


@dataclass(frozen=True)
class MapPicture:
    """A map of a frame: caption, picture, and the legend it is read with ("depth", "sigma" or "error")."""

    caption: str
    uri: str
    legend: str


@dataclass
class FrameView:
    """Everything shown of one frame; `problem` says why something is missing."""

    id: str
    height: int = 0
    width: int = 0
    photo: str = ""
    maps: list[MapPicture] = field(default_factory=list)
    birds_eye: str = ""
    truth: list[DrawnBox] = field(default_factory=list)
    found: list[DrawnBox] = field(default_factory=list)
    steps: list[dict[str, Any]] = field(default_factory=list)
    points: int = 0
    problem: str = ""


def write_report(config: Config, run: RunFolder, dataset: Dataset, frames: tuple[str, ...]) -> Path:
    """Writes the report of a run; returns its path.

    At most `report.frames` frames are shown, spread evenly over the run.
    """
    shown = spread(frames, config.report.frames)
    views = [frame_view(config, dataset[frame_id], FrameFiles(run, frame_id)) for frame_id in shown]
    write_text(run.report, render(run, views, len(frames)))
    return run.report


def spread(frames: tuple[str, ...], count: int) -> tuple[str, ...]:
    """At most `count` of the frames, evenly spread, in order."""
    if len(frames) <= count:
        return frames
    return tuple(frames[index] for index in np.linspace(0, len(frames) - 1, count).round().astype(int))


def render(run: RunFolder, views: list[FrameView], total: int) -> str:
    """The HTML text."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(FOLDER), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["thousands"] = lambda value: f"{value:,}"
    metrics = _read_json(run.metrics)
    failures = _read_json(run.failures)
    return environment.get_template("page.html.j2").render(
        title=run.root.name,
        style=(FOLDER / "style.css").read_text(encoding="utf-8"),
        script=(FOLDER / "script.js").read_text(encoding="utf-8"),
        views=views,
        total=total,
        facts=headline(metrics, total),
        ap_header=ap_header(metrics),
        ap_rows=ap_rows(metrics),
        warnings=metrics.get("warnings", []),
        depth_rows=depth_rows(metrics),
        depth_frames=metrics.get("depth", {}).get("frames", 0),
        steps=metrics.get("augmentation", []),
        failures=failures.get("failures", []),
        config=run.config.read_text(encoding="utf-8") if run.config.is_file() else "",
        legends=legends({map.legend for view in views for map in view.maps}),
        bev=pictures.BirdsEye(),
        bev_scale=pictures.BEV_PIXELS_PER_METRE,
        bev_rings=(20, 40, 60),
    )


def headline(metrics: dict[str, Any], frames: int) -> list[tuple[str, str, str]]:
    """(value, name, remark) of the figures at the top."""
    facts = [(str(frames), "frames", "")]
    for metric, name in (("3d", "Car 3D AP"), ("bev", "Car bird's-eye AP")):
        for row in metrics.get("results", []):
            if (row["class"], row["metric"], row["iou"]) == ("Car", metric, 0.7) and row["moderate"] is not None:
                remark = f"moderate, IoU 0.7, R{row['recall_points']}, {row['n_gt'][1]} cars"
                facts.append((f"{row['moderate']:.1f}", name, remark))
    steps = metrics.get("augmentation", [])
    if steps:
        facts.append((f"{steps[-1]['out']:,}", "points per frame", "mean of the augmented clouds"))
    return facts


def legends(used: set[str]) -> dict[str, dict[str, Any]]:
    """The colour scales that the page uses: CSS gradient and ticks (percent from the left, text)."""
    depth = [(pictures.tick_position(metres), f"{metres}") for metres in pictures.DEPTH_TICKS]
    error = [(pictures.error_position(metres), f"{metres:g}") for metres in pictures.ERROR_TICKS]
    sigma = [(0.0, "0 background"), (50.0, "0.5"), (100.0, "1 foreground")]
    scales = {
        "depth": ("Depth, m", pictures.depth_colours(), depth),
        "sigma": ("Sigma", pictures.sigma_colours(), sigma),
        "error": ("Error, m", pictures.error_colours(), error),
    }
    return {
        name: {"title": title, "gradient": pictures.gradient(colours), "ticks": ticks}
        for name, (title, colours, ticks) in scales.items()
        if name in used
    }


def frame_view(config: Config, frame: Frame, files: FrameFiles) -> FrameView:
    """Pictures and boxes of a frame; what cannot be read is named in the view, the rest is shown."""
    view = FrameView(frame.id)
    for part in (_add_photo, _add_maps, _add_cloud, _add_boxes):
        try:
            part(frame, files, view)
        except DataError as error:
            view.problem = str(error)
    return view


def _add_photo(frame: Frame, files: FrameFiles, view: FrameView) -> None:
    view.height, view.width = frame.image_size
    view.photo = pictures.data_uri(frame.image, PHOTO_WIDTH, quality=72)


def _add_maps(frame: Frame, files: FrameFiles, view: FrameView) -> None:
    if not files.run.depth(frame.id).is_file():
        return
    completed = files.read_completed()

    def add(caption: str, picture: pictures.RGB, legend: str = "depth", quality: int = 78) -> None:
        view.maps.append(MapPicture(caption, pictures.data_uri(picture, MAP_WIDTH, quality), legend))

    add("sparse depth, the input", pictures.colour_sparse(frame.sparse_depth))
    add("completed depth", pictures.colour_depth(completed.depth))
    if completed.foreground is not None and completed.background is not None and completed.sigma is not None:
        add("foreground surface", pictures.colour_depth(completed.foreground))
        add("background surface", pictures.colour_depth(completed.background))
        add("sigma, weight of the foreground", pictures.colour_sigma(completed.sigma, completed.depth > 0), "sigma")
    if frame.has("target_depth"):
        add("true depth", pictures.colour_depth(frame.target_depth))
        add("error of the completed depth", pictures.colour_error(completed.depth, frame.target_depth), "error")


def _add_cloud(frame: Frame, files: FrameFiles, view: FrameView) -> None:
    if files.run.cloud(frame.id).is_file():
        cloud = files.read_cloud()
        counts = files.read_counts()
        view.steps, view.points = counts["steps"], counts["points"]
        points, measured = cloud[:, :3], cloud[:, 4] == 0
    elif not frame.has("points"):
        return
    else:
        points = frame.points[:, :3]
        measured = np.ones(len(points), dtype=bool)
    view.birds_eye = pictures.data_uri(pictures.birds_eye_picture(points, measured), 10_000, quality=101)


def _add_boxes(frame: Frame, files: FrameFiles, view: FrameView) -> None:
    if files.run.detections(frame.id).is_file():
        view.found = drawn_boxes(files.read_detections(), frame.calibration, frame.image_size)
    if frame.has("labels"):
        view.truth = drawn_boxes(frame.labels, frame.calibration, frame.image_size)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}
