"""Figures for papers from a run, in the manner of thesis figures 4.5, 4.6, 5.3 and 5.6-5.8: PNG, PDF or SVG.

Fonts are embedded (TrueType in PDF, outlines in SVG); colours are told apart with any colour vision.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from auglidar_base.atomic import write_bytes
from completion.types import CompletedDepth
from detection.evaluation.curves import Curve
from detection.evaluation.difficulty import LEVELS
from detection.evaluation.protocol import Target
from detection.kitti_format import KittiObject
from pipeline.base.errors import DataError
from pipeline.base.paths import RunFolder
from pipeline.data import Dataset, Frame
from pipeline.report import panels
from pipeline.report.matches import MatchedFrames, strictest
from pipeline.run_folder.config import Config
from pipeline.run_folder.frame_outputs import FrameOutputs
from pipeline.run_folder.thresholds import ScoreThresholds

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLE = {
    "font.size": 7,
    "axes.titlesize": 7,
    "axes.labelsize": 7,
    "xtick.labelsize": 6,
    "ytick.labelsize": 6,
    "legend.fontsize": 6,
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.2,
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "auglidar",
    "savefig.dpi": 200,
}
# Text width of a one-column page, inches.
WIDTH = 6.8


@dataclass(frozen=True)
class Material:
    """What one frame offers to the figures."""

    frame: Frame
    completed: CompletedDepth
    detections: list[KittiObject] | None
    semantics: Any
    cloud: Any

    @classmethod
    def of(cls, run: RunFolder, frame: Frame) -> Material:
        """Reads it. Raises DataError when the frame's files are damaged or absent."""
        files = FrameOutputs(run, frame.id)
        return cls(
            frame,
            files.read_completed(),
            files.read_detections() if run.detections(frame.id).is_file() else None,
            frame.semantics if frame.has("semantics") else None,
            files.read_cloud() if run.cloud(frame.id).is_file() else None,
        )

    @property
    def twin(self) -> CompletedDepth:
        """The completed depth with two surfaces; estimated from its spread where the network gives one."""
        if self.completed.has_surfaces:
            return self.completed
        from pipeline.pointcloud.pseudo_sigma import pseudo_sigma

        return pseudo_sigma(self.completed.depth)


def write_figures(
    config: Config,
    run: RunFolder,
    dataset: Dataset,
    frames: Sequence[str],
    matched: MatchedFrames,
    least: ScoreThresholds | None = None,
) -> list[Path]:
    """Writes report/figures/*.png|pdf|svg (`report.format`) and returns their paths.

    The frame shown is the one with the most labelled objects among the first `report.frames`; a figure whose data the
    run does not have (no detections, no true depth) is left out. Detections are drawn from the scores `least` on.
    """
    import matplotlib

    folder = run.report.parent / "figures"
    written = []
    with matplotlib.rc_context(STYLE):
        for name, draw in _drawings(run, dataset, frames[: config.report.frames], matched, least or ScoreThresholds()):
            figure = draw()
            path = folder / f"{name}.{config.report.format}"
            write_bytes(path, saved(figure, config.report.format))
            written.append(path)
    return written


def saved(figure: Figure, kind: str) -> bytes:
    """The file's bytes; the same data gives the same bytes."""
    import io

    buffer = io.BytesIO()
    undated = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(kind, {})
    figure.savefig(buffer, format=kind, bbox_inches="tight", pad_inches=0.03, metadata=undated)
    return buffer.getvalue()


def _drawings(
    run: RunFolder, dataset: Dataset, frames: Sequence[str], matched: MatchedFrames, least: ScoreThresholds
) -> list[tuple[str, Callable[[], Figure]]]:
    """(file name, function that draws) of every figure this run has data for."""
    drawings: list[tuple[str, Callable[[], Figure]]] = []
    if _found_targets(matched):
        drawings.append(("precision_recall", lambda: precision_recall(matched)))
    material = _richest(run, dataset, frames)
    if material is None:
        return drawings
    drawings.append(("completion", lambda: completion(material)))
    drawings.append(("sigma_filter", lambda: sigma_filter(material)))
    drawings.append(("sampling", lambda: sampling(material)))
    if material.frame.has("target_depth"):
        drawings.append(("noise", lambda: noise(material)))
    if material.detections is not None:
        drawings.append(("detections", lambda: detections(material, least)))
    return drawings


def _richest(run: RunFolder, dataset: Dataset, frames: Sequence[str]) -> Material | None:
    """The frame with the most objects of those that have completed depth and can be read."""

    def objects(frame: Frame) -> int:
        return len([item for item in frame.labels if item.type != "DontCare"]) if frame.has("labels") else 0

    usable = [dataset[name] for name in frames if run.depth(name).is_file() and dataset[name].has("calibration")]
    for frame in sorted(usable, key=objects, reverse=True):
        try:
            return Material.of(run, frame)
        except DataError:
            continue
    return None


# --- the figures


def completion(material: Material) -> Figure:
    """As Fig. 4.6 with 4.5's zoom-in views: image, both surfaces, fused depth, difference, weight, error."""
    frame, twin = material.frame, material.twin
    assert twin.foreground is not None
    assert twin.background is not None
    assert twin.sigma is not None
    maps: list[tuple[str, Any]] = [
        ("image", frame.image),
        ("foreground depth $d_1$", panels.depth_rgb(twin.foreground)),
        ("background depth $d_2$", panels.depth_rgb(twin.background)),
        ("fused depth, 2 m (yellow) to 80 m", panels.depth_rgb(twin.depth)),
        (r"$d_2 - d_1$, 0 to 5 m (dark)", panels.difference_rgb(twin.background - twin.foreground)),
        (r"weight $\sigma$ of the foreground, 0 (blue) to 1 (brown)", panels.sigma_rgb(twin.sigma, twin.depth > 0)),
    ]
    if frame.has("target_depth"):
        maps.append(("true depth", panels.depth_rgb(frame.target_depth)))
        maps.append(("absolute error, 0 to 5 m (dark)", panels.error_rgb(twin.depth, frame.target_depth)))
    return panels.maps_with_zooms(maps, panels.zoom_windows(frame, 2), WIDTH)


def sigma_filter(material: Material) -> Figure:
    """As Fig. 5.6: the pixels in the plane of sigma and depth difference, and the cloud before and after the filter."""
    from pipeline.geometry.back_project import back_project
    from pipeline.pointcloud.sigma_filter import SigmaBand
    from pipeline.pointcloud.sigma_filter import sigma_filter as keep_of

    twin, camera, band = material.twin, material.frame.calibration, SigmaBand()
    keep = keep_of(twin, band)
    everything = back_project(twin.depth, camera, twin.depth > 0)
    kept = back_project(twin.depth, camera, keep)
    window = panels.crowded_window(material.frame)
    figure, axes = panels.row(3, WIDTH, 2.2)
    panels.sigma_plane(axes[0], twin, band)
    axes[0].set_title("(a) dropped: the rectangle")
    for axis, cloud, letter, name in ((axes[1], everything, "b", "unfiltered"), (axes[2], kept, "c", "filtered")):
        panels.oblique(axis, cloud.points, panels.point_colours(material.frame, cloud.pixels), window)
        axis.set_title(f"({letter}) {name}: {len(cloud) / 1000:.0f}k points")
    return figure


def sampling(material: Material) -> Figure:
    """As Fig. 5.7: dense depth, after the sigma filter, after grid sampling, after mask and context."""
    from pipeline.pointcloud.augment import augment_frame, preset

    full = preset("D_SF" if material.semantics is not None else "D_F")
    steps: list[tuple[str, Any]] = [("dense depth", preset("D")), ("sigma filter", preset("D_F"))]
    if material.semantics is not None:
        steps += [("grid sampling", replace(full, semantic=None)), ("semantic mask and context", full)]
    else:
        from pipeline.pointcloud.grid_sampling import GridSampling

        steps.append(("grid sampling", replace(full, grid=GridSampling(0.2))))
    raw = np.zeros((0, 4), np.float32)
    figure, axes = panels.row(len(steps), WIDTH, 2.1)
    window = panels.whole_window()
    for axis, (name, settings), letter in zip(axes, steps, "abcd"):
        semantics = material.semantics if settings.needs_semantics else None
        cloud = augment_frame(material.twin, raw, material.frame.calibration, settings, semantics).points
        panels.oblique(axis, cloud[:, :3], panels.height_colours(cloud[:, :3]), window)
        axis.set_title(f"({letter}) {name}\n{panels.thousands(len(cloud))} points")
    return figure


def noise(material: Material) -> Figure:
    """As Fig. 5.3: image, depth and cloud around the objects with the most noise, coloured by kind."""
    return panels.noise_rows(material.frame, material.completed, material.detections or [], WIDTH)


def detections(material: Material, least: ScoreThresholds) -> Figure:
    """As Fig. 5.8: the image with boxes, the cloud from above with true boxes and those from `least` on."""
    frame = material.frame
    cloud = (
        material.cloud if material.cloud is not None else np.column_stack([frame.points, np.zeros(len(frame.points))])
    )
    labels = frame.labels if frame.has("labels") else []
    found = [item for item in material.detections or [] if least.shows(item)]
    return panels.image_over_bev(frame, cloud, labels, found, WIDTH)


def precision_recall(matched: MatchedFrames) -> Figure:
    """3D and bird's-eye precision over recall of every class of which something was found."""
    targets = _found_targets(matched)
    figure, axes = panels.grid(len(targets), 2 if len(targets) in (2, 4) else min(3, len(targets)), WIDTH, 2.0)
    for axis, (target, curves) in zip(axes, targets):
        panels.curves(axis, {level: curve.precision() for level, curve in zip(LEVELS, curves)})
        axis.set_title(f"{target.cls}, {'3D' if target.metric == '3d' else 'bird’s eye'}, IoU {target.iou:g}")
    return figure


def _found_targets(matched: MatchedFrames) -> list[tuple[Target, tuple[Curve, ...]]]:
    """Targets with at least one true positive, and their curves."""
    if matched.evaluation is None:
        return []
    targets = [target for metric in ("3d", "bev") for target in strictest(matched.evaluation, metric)]
    pairs = [(target, matched.evaluation.curves(target)) for target in targets]
    return [(target, curves) for target, curves in pairs if any(len(curve.thresholds) for curve in curves)]
