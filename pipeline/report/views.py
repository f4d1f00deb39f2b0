"""What the page shows of one frame: photo, boxes, maps with their values, cloud, counts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detection.evaluation.explain import MATCHED
from pipeline.base.errors import DataError
from pipeline.base.paths import RunFolder
from pipeline.data import Frame
from pipeline.report import pictures
from pipeline.report.boxes import DrawnBox, drawn_boxes
from pipeline.report.cloud import cloud_of_frame, still_picture
from pipeline.report.hover import HoverGrid, hover_grid
from pipeline.report.matches import MatchedFrames, Mistake
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.run_folder.thresholds import ScoreThresholds

PHOTO_WIDTH, MAP_WIDTH = 1242, 620
THUMB_WIDTH, THUMB_HEIGHT = 240, 140
DEPTH_SCALE, SIGMA_SCALE = 256, 1000


@dataclass(frozen=True)
class MapPicture:
    """A map of a frame: caption, picture, the legend it is read with ("depth", "sigma" or "error"), and its values."""

    caption: str
    uri: str
    legend: str
    grid: HoverGrid


@dataclass(frozen=True)
class Display:
    """How the frames of one page are shown.

    step    pixels between two values under the pointer
    points  most points of one cloud
    matched  what became of labels and detections
    other   a second run to compare with, and its objects
    least   scores from which predicted boxes are drawn at first
    """

    step: int
    points: int
    matched: MatchedFrames = field(default_factory=MatchedFrames)
    other: RunFolder | None = None
    other_matched: MatchedFrames = field(default_factory=MatchedFrames)
    least: ScoreThresholds = field(default_factory=ScoreThresholds)


@dataclass
class FrameView:
    """Everything shown of one frame; `problem` says why something is missing."""

    id: str
    height: int = 0
    width: int = 0
    photo: str = ""
    maps: list[MapPicture] = field(default_factory=list)
    other_maps: list[MapPicture] = field(default_factory=list)
    birds_eye: str = ""
    truth: list[DrawnBox] = field(default_factory=list)
    found: list[DrawnBox] = field(default_factory=list)
    other: list[DrawnBox] = field(default_factory=list)
    steps: list[dict[str, Any]] = field(default_factory=list)
    other_steps: list[dict[str, Any]] = field(default_factory=list)
    tally: str = ""
    labelled: bool = False
    points: int = 0
    cloud: dict[str, Any] | None = None
    still: str = ""
    problem: str = ""


def frame_view(frame: Frame, files: FrameOutputs, display: Display) -> FrameView:
    """Pictures and boxes of a frame; what cannot be read is named in the view, the rest is shown."""
    view = FrameView(frame.id)
    parts: tuple[Callable[[Frame, FrameOutputs, Display, FrameView], None], ...] = (
        _add_photo,
        _add_maps,
        _add_boxes,
        _add_cloud,
        _add_other,
    )
    for part in parts:
        try:
            part(frame, files, display, view)
        except DataError as error:
            view.problem = view.problem or str(error)
    return view


def _add_photo(frame: Frame, files: FrameOutputs, display: Display, view: FrameView) -> None:
    view.height, view.width = frame.image_size
    view.photo = pictures.data_uri(frame.image, PHOTO_WIDTH, quality=68)


def _add_maps(frame: Frame, files: FrameOutputs, display: Display, view: FrameView) -> None:
    if not files.run.depth(frame.id).is_file():
        return
    completed = files.read_completed()
    view.maps = [
        depth_map("sparse depth, the input", frame.sparse_depth, display.step),
        depth_map("completed depth", completed.depth, display.step),
    ]
    if completed.foreground is not None and completed.background is not None and completed.sigma is not None:
        view.maps += surface_maps(completed.foreground, completed.background, completed.sigma, display.step)
    if frame.has("target_depth"):
        error = error_map("error of the completed depth", completed.depth, frame.target_depth, display.step)
        view.maps += [depth_map("true depth", frame.target_depth, display.step), error]


def depth_map(caption: str, depth: NDArray[np.float32], step: int) -> MapPicture:
    """A depth map on the shared scale; `sparse` ones are drawn with wide points."""
    sparse = (depth > 0).mean() < 0.3
    picture = pictures.colour_sparse(depth) if sparse else pictures.colour_depth(depth)
    grid = hover_grid(depth, depth > 0, step, DEPTH_SCALE, "m")
    return MapPicture(caption, pictures.data_uri(picture, MAP_WIDTH, 74), "depth", grid)


def surface_maps(
    foreground: NDArray[np.float32], background: NDArray[np.float32], sigma: NDArray[np.float32], step: int
) -> list[MapPicture]:
    """The two surfaces, how far they lie apart, and sigma where it chooses between them.

    They differ along outlines, which vanish when the maps are shrunk: the foreground keeps the nearest value of every
    few pixels, the background the farthest, and the other two maps are drawn a few pixels wide.
    """
    valid = (foreground > 0) & (background > 0)
    gap = np.where(valid, np.maximum(background - foreground, 0), 0).astype(np.float32)
    pairs = (
        ("foreground surface, the nearer", foreground, True),
        ("background surface, the farther", background, False),
    )
    maps = []
    for caption, surface, nearest in pairs:
        picture = pictures.colour_depth(pictures.widened(surface, nearest))
        grid = hover_grid(surface, valid, step, DEPTH_SCALE, "m")
        maps.append(MapPicture(caption, pictures.data_uri(picture, MAP_WIDTH, 74), "depth", grid))
    apart = pictures.colour_gap(gap, valid)
    grid = hover_grid(gap, valid, step, DEPTH_SCALE, "m")
    maps.append(MapPicture("between the surfaces", pictures.data_uri(apart, MAP_WIDTH, 74), "error", grid))
    chosen = pictures.colour_sigma_between(sigma, gap, valid)
    grid = hover_grid(sigma, valid, step, SIGMA_SCALE, "")
    maps.append(MapPicture("sigma, where they differ", pictures.data_uri(chosen, MAP_WIDTH, 74), "sigma", grid))
    return maps


def error_map(caption: str, depth: NDArray[np.float32], target: NDArray[np.float32], step: int) -> MapPicture:
    """Absolute error where both depths have a value."""
    uri = pictures.data_uri(pictures.colour_error(depth, target), MAP_WIDTH, 74)
    grid = hover_grid(np.abs(depth - target), (depth > 0) & (target > 0), step, DEPTH_SCALE, "m")
    return MapPicture(caption, uri, "error", grid)


def _add_boxes(frame: Frame, files: FrameOutputs, display: Display, view: FrameView) -> None:
    def verdicts_of(side: str) -> dict[int, Any]:
        found = display.matched.verdicts.items()
        return {place: verdict for (of, where, place), verdict in found if of == frame.id and where == side}

    found = files.read_detections() if files.run.detections(frame.id).is_file() else None
    if frame.has("labels"):
        view.truth = drawn_boxes(frame.labels, frame.calibration, frame.image_size, verdicts_of("label"), found or ())
    if found is not None:
        view.found = drawn_boxes(found, frame.calibration, frame.image_size, verdicts_of("detection"))
    view.labelled = frame.has("labels")
    shown = None if found is None else view.found
    view.tally = tally(view.truth if view.labelled else None, shown, display.least)


def tally(truth: Sequence[DrawnBox] | None, found: Sequence[DrawnBox] | None, least: ScoreThresholds) -> str:
    """Counts of a frame's boxes that add up: "6 true: 1 found, 4 missed, 1 not counted; 2 predicted: 1 right, 1 false".

    None where there are no labels, or no detections. A label whose detection is not shown counts as missed.
    """
    shown = [box for box in found or () if box.score is None or box.score >= least.of(box.kind)]
    parts = []
    if truth is not None:
        met = sum(box.met is not None and box.met >= least.of(box.kind) for box in truth)
        missed = sum(box.wrong or (box.met is not None and box.met < least.of(box.kind)) for box in truth)
        parts.append(_counts(len(truth), "true", {"found": met, "missed": missed}))
    if found is not None:
        right = sum(box.status == MATCHED for box in shown)
        parts.append(_counts(len(shown), "predicted", {"right": right, "false": sum(box.wrong for box in shown)}))
    return "; ".join(parts)


def _counts(total: int, what: str, kinds: dict[str, int]) -> str:
    """ "3 true: 1 found, 1 missed, 1 not counted"; the total alone where nothing was compared."""
    if not any(kinds.values()):
        return f"{total} {what}"
    rest = total - sum(kinds.values())
    words = [f"{count} {name}" for name, count in kinds.items()] + ([f"{rest} not counted"] if rest else [])
    return f"{total} {what}: {', '.join(words)}"


def _add_cloud(frame: Frame, files: FrameOutputs, display: Display, view: FrameView) -> None:
    if files.run.counts(frame.id).is_file():
        view.steps = files.read_counts()["steps"]
    cloud = cloud_of_frame(frame, files)
    if cloud is None:
        return
    view.points = cloud.total
    view.birds_eye = pictures.data_uri(pictures.birds_eye_picture(cloud.points, cloud.measured), 10_000, quality=101)
    shown = cloud.thinned(display.points, seed=0)
    view.cloud = shown.packed() | {"boxes": _boxes_3d(view)}
    sure = [box for box in view.found if box.score is None or box.score >= display.least.of(box.kind)]
    solid = [("truth", box.corners) for box in view.truth] + [("found", box.corners) for box in sure]
    view.still = pictures.data_uri(still_picture(cloud.thinned(8000, seed=0), solid), 10_000, quality=60)


def _boxes_3d(view: FrameView) -> list[dict[str, Any]]:
    return [
        {
            "kind": kind,
            "class": box.kind,
            "corners": box.corners.round(2).tolist(),
            "score": box.score,
            "wrong": box.wrong,
            "met": box.met,
        }
        for kind in ("truth", "found")
        for box in getattr(view, kind)
    ]


def _add_other(frame: Frame, files: FrameOutputs, display: Display, view: FrameView) -> None:
    """The same frame in the run compared with: what differs, and its boxes."""
    if display.other is None:
        return
    other = FrameOutputs(display.other, frame.id)
    if other.run.depth(frame.id).is_file():
        depth = other.read_completed().depth
        same = files.run.depth(frame.id).is_file() and np.array_equal(depth, files.read_completed().depth)
        if not same:
            view.other_maps.append(depth_map("completed depth", depth, display.step))
        if not same and frame.has("target_depth") and frame.target_depth.shape == depth.shape:
            view.other_maps.append(error_map("error of the completed depth", depth, frame.target_depth, display.step))
    if other.run.counts(frame.id).is_file():
        steps = other.read_counts()["steps"]
        view.other_steps = steps if steps != view.steps else []
    if other.run.detections(frame.id).is_file():
        found = display.other_matched.verdicts.items()
        wrong = {place: v for (of, side, place), v in found if of == frame.id and side == "detection"}
        view.other = drawn_boxes(other.read_detections(), frame.calibration, frame.image_size, wrong)


@dataclass(frozen=True)
class MistakeView:
    """A mistake in words, with a piece of the image and a link into the page (empty when its frame is not shown)."""

    title: str
    facts: str
    reason: str
    kind: str
    frame: str
    link: str
    thumb: str


def mistake_view(mistake: Mistake, frame: Frame, link: str) -> MistakeView:
    """Words and picture of a mistake."""
    item = mistake.item
    title = f"{item.type}, {item.location[2]:.0f}\u00a0m"
    facts = f"frame {mistake.frame}" + ("" if item.score is None else f", score {item.score:.2f}")
    return MistakeView(title, facts, mistake.reason, mistake.kind, mistake.frame, link, thumbnail(frame, mistake))


def thumbnail(frame: Frame, mistake: Mistake) -> str:
    """The object in the image with some surroundings, its rectangle drawn; empty when the image cannot be read."""
    import cv2

    try:
        image = frame.image
    except DataError:
        return ""
    height, width = image.shape[:2]
    left, top, right, bottom = mistake.item.bbox
    wide = max(2.2 * (right - left), 2.2 * (bottom - top) * THUMB_WIDTH / THUMB_HEIGHT, 60.0)
    wide = min(wide, width, height * THUMB_WIDTH / THUMB_HEIGHT)
    high = wide * THUMB_HEIGHT / THUMB_WIDTH
    x0 = float(np.clip((left + right - wide) / 2, 0, width - wide))
    y0 = float(np.clip((top + bottom - high) / 2, 0, height - high))
    crop = image[int(y0) : int(np.ceil(y0 + high)), int(x0) : int(np.ceil(x0 + wide))]
    picture = np.ascontiguousarray(cv2.resize(crop, (THUMB_WIDTH, THUMB_HEIGHT), interpolation=cv2.INTER_CUBIC))
    scale = THUMB_WIDTH / wide
    first, second = ((round((x - x0) * scale), round((y - y0) * scale)) for x, y in ((left, top), (right, bottom)))
    cv2.rectangle(picture, first, second, (43, 212, 164) if mistake.kind == "missed" else (255, 122, 26), 2)
    return pictures.data_uri(picture, THUMB_WIDTH, 70)
