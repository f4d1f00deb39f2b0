"""The pieces the figures are made of: rows of maps with zoom-in views, clouds from above and from the side, curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from completion.types import CompletedDepth
from detection.boxes import corners
from detection.kitti_format import KittiObject, boxes_of
from pipeline.data import Frame
from pipeline.pointcloud.sigma_filter import SigmaBand
from pipeline.report import pictures
from pipeline.report.boxes import DRAWN, EDGES, MIN_DEPTH

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette.
TRUTH, FOUND, LEVEL_COLOURS = "#009E73", "#D55E00", {"easy": "#0072B2", "moderate": "#E69F00", "hard": "#CC79A7"}
LEVEL_LINES = {"easy": "-", "moderate": "--", "hard": ":"}
# Left, top, right, bottom in pixels, or x0, x1, y0, y1 in metres.
Window = tuple[float, float, float, float]
NOISE_ROWS = 3

depth_rgb, sigma_rgb, error_rgb = pictures.colour_depth, pictures.colour_sigma, pictures.colour_error


def difference_rgb(difference: NDArray[np.float32]) -> pictures.RGB:
    """(H, W) metres between the surfaces, 0 to 5 m, on the scale of errors."""
    return pictures.colour_error(difference + 1, np.ones_like(difference))


def thousands(count: int) -> str:
    """315k, or the number itself when it is small."""
    return f"{count / 1000:.0f}k" if count >= 10_000 else f"{count:,}"


def row(count: int, width: float, height: float) -> tuple[Figure, Any]:
    """A figure with `count` axes side by side, inches."""
    return grid(count, count, width, height)


def grid(count: int, columns: int, width: float, height: float) -> tuple[Figure, Any]:
    """A figure with `count` axes in `columns`, as a flat array; `height` of a row in inches. Spare axes are hidden."""
    from matplotlib.figure import Figure

    rows = -(-count // columns) if count else 1
    figure = Figure(figsize=(width, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes[count:]:
        axis.set_axis_off()
    return figure, axes


# --- maps


def zoom_windows(frame: Frame, count: int) -> list[Window]:
    """Pixel windows worth a closer look: around the largest labelled objects that do not overlap, else image parts."""
    height, width = frame.image_size
    wide, high = width / 6, height / 2.6
    items = [item for item in (frame.labels if frame.has("labels") else []) if item.type in DRAWN]
    found: list[Window] = []
    for item in sorted(items, key=lambda item: -item.height_2d):
        x, y = (item.bbox[0] + item.bbox[2]) / 2, (item.bbox[1] + item.bbox[3]) / 2
        left = float(np.clip(x - wide / 2, 0, width - wide))
        top = float(np.clip(y - high / 2, 0, height - high))
        if len(found) < count and 8 < item.location[2] < 40 and all(abs(left - old[0]) > wide for old in found):
            found.append((left, top, left + wide, top + high))
    for share in (0.1, 0.7):
        if len(found) < count:
            found.append((share * width, 0.3 * height, share * width + wide, 0.3 * height + high))
    return found


def maps_with_zooms(maps: Sequence[tuple[str, Any]], windows: Sequence[Window], width: float) -> Figure:
    """Two maps a row, each with its zoom-in views below and their places marked."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    colours = ("#E69F00", "#56B4E9", "#CC79A7")
    height, wide = maps[0][1].shape[:2]
    rows = -(-len(maps) // 2)
    zoom_height = (width / 4) * (windows[0][3] - windows[0][1]) / (windows[0][2] - windows[0][0])
    figure = Figure(figsize=(width, rows * (width / 2 * height / wide + zoom_height + 0.28)))
    outer = figure.add_gridspec(rows, 2, hspace=0.11, wspace=0.03, left=0, right=1, bottom=0, top=0.98)
    for place, (name, picture) in enumerate(maps):
        inner = outer[place // 2, place % 2].subgridspec(
            2, len(windows), height_ratios=(width / 2 * height / wide, zoom_height), hspace=0.03, wspace=0.03
        )
        axis = figure.add_subplot(inner[0, :])
        picture_axis(axis, picture)
        axis.set_title(f"({'abcdefgh'[place]}) {name}", pad=2)
        for window, colour, column in zip(windows, colours, range(len(windows))):
            left, top, right, bottom = window
            axis.add_patch(Rectangle((left, top), right - left, bottom - top, fill=False, edgecolor=colour, lw=1))
            closer = figure.add_subplot(inner[1, column])
            picture_axis(closer, picture[int(top) : int(bottom), int(left) : int(right)])
            for side in closer.spines.values():
                side.set(edgecolor=colour, linewidth=1, visible=True)
    return figure


def picture_axis(axis: Axes, picture: Any) -> None:
    """Shows a picture without ticks."""
    axis.imshow(picture, interpolation="nearest", aspect="auto")
    axis.set(xticks=[], yticks=[])
    for side in axis.spines.values():
        side.set_visible(False)


# --- clouds


def whole_window() -> Window:
    """x0, x1 (forward) and y0, y1 (left) of a view over the scene, metres."""
    return (4.0, 50.0, -16.0, 16.0)


def crowded_window(frame: Frame) -> Window:
    """A view around the nearest objects between 8 and 35 m, or over the scene when there is none."""
    items = [item for item in (frame.labels if frame.has("labels") else []) if item.type in DRAWN]
    near = [item for item in items if 8 < item.location[2] < 35]
    if not near:
        return whole_window()
    first = min(near, key=lambda item: item.location[2])
    x, y = first.location[2], -first.location[0]
    return (x - 6, x + 16, y - 9, y + 9)


def oblique(axis: Axes, points: NDArray[np.float32], colours: NDArray[np.float64], window: Window) -> None:
    """Draws a cloud as seen from behind and above, far points first."""
    x0, x1, y0, y1 = window
    inside = (points[:, 0] > x0) & (points[:, 0] < x1) & (points[:, 1] > y0) & (points[:, 1] < y1) & (points[:, 2] < 3)
    kept = points[inside]
    camera = ((x0 + x1) / 2, (y0 + y1) / 2, -1.0), 1.35 * (x1 - x0)
    place, depth = _seen_from(kept, *camera)
    order = np.argsort(-depth, kind="stable")
    size = 0.15 if len(kept) > 60_000 else 0.3 if len(kept) > 15_000 else 0.6
    axis.scatter(place[order, 0], place[order, 1], s=size, c=colours[inside][order], linewidths=0, rasterized=True)
    # The same limits for every cloud of a window, so that panels can be compared.
    edge, _ = _seen_from(np.array([(x, y, z) for x in (x0, x1) for y in (y0, y1) for z in (-2, 2)]), *camera)
    axis.set(xlim=(edge[:, 0].min(), edge[:, 0].max()), ylim=(edge[:, 1].min(), edge[:, 1].max()))
    axis.set(xticks=[], yticks=[], aspect="equal")


def _seen_from(points: Any, target: Any, distance: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(N, 2) places to the right and up, and (N,) depth, of a camera 35 degrees above the ground."""
    cos, sin = np.cos(np.deg2rad(35)), np.sin(np.deg2rad(35))
    forward, right, up = np.array([cos, 0, -sin]), np.array([0.0, -1, 0]), np.array([sin, 0, cos])
    relative = np.asarray(points, np.float64)[:, :3] - (np.asarray(target) - distance * forward)
    depth = np.maximum(relative @ forward, 0.1)
    return np.column_stack([relative @ right, relative @ up]) / depth[:, None], depth


def point_colours(frame: Frame, pixels: NDArray[np.int32]) -> NDArray[np.float64]:
    """(N, 3) colours of the image at the points' pixels, a little brighter."""
    return np.asarray((frame.image.reshape(-1, 3)[pixels] / 255.0) ** 0.75)


def height_colours(points: NDArray[np.float32]) -> NDArray[np.float64]:
    """(N, 3) colours of the height above the sensor, -2.5 to 2.5 m."""
    share = ((points[:, 2] + 2.5) / 5).clip(0, 0.92)
    return np.asarray(pictures.depth_colours()[::-1][(share * 255).astype(int)] / 255.0)


def sigma_plane(axis: Axes, twin: CompletedDepth, band: SigmaBand) -> None:
    """Pixels by sigma and depth difference, counted; the band that is dropped as a rectangle."""
    from matplotlib.colors import LogNorm
    from matplotlib.patches import Rectangle

    assert twin.sigma is not None
    assert twin.foreground is not None
    assert twin.background is not None
    valid = twin.depth > 0
    gap = (twin.background - twin.foreground)[valid].clip(0, 19.99)
    bins = (np.linspace(0, 1, 41), np.linspace(0, 20, 41))
    counts, _, _ = np.histogram2d(twin.sigma[valid], gap, bins=bins)
    mesh = axis.pcolormesh(*bins, counts.T, norm=LogNorm(1, max(counts.max(), 10)), cmap="cividis", rasterized=True)
    axis.add_patch(
        Rectangle((band.low, band.gap), band.high - band.low, 20 - band.gap, fill=False, edgecolor=FOUND, lw=1.4)
    )
    axis.set(xlabel=r"$\sigma$", ylabel="$d_2 - d_1$, m")
    axis.figure.colorbar(mesh, ax=axis, label="pixels", shrink=0.9)


# --- noise


def noise_rows(frame: Frame, completed: CompletedDepth, found: Sequence[KittiObject], width: float) -> Figure:
    """One row per kind of noise, at the object that has the most of it: image, depth, cloud from above."""
    from pipeline.pointcloud.taxonomy import (
        CLEAN,
        COLOURS,
        LABELS,
        NOISE_BG,
        NOISE_FG,
        NOISE_INBET,
        Taxonomy,
        label_noise,
    )
    from pipeline.report.cloud import object_pixels

    labels = label_noise(completed.depth, frame.target_depth, object_pixels(frame), Taxonomy())
    # Where the boxes and the drawing are large enough to see something.
    middle = (completed.depth > 8) & (completed.depth < 40) & (frame.target_depth > 8) & (frame.target_depth < 60)
    # Above the first LiDAR row every method invents; that is not what the figure is about.
    middle[: int(np.argmax((frame.sparse_depth > 0).any(axis=1)))] = False
    figure, axes = grid(3 * NOISE_ROWS, 3, width, 1.55)
    for index, kind in enumerate((NOISE_FG, NOISE_INBET, NOISE_BG)):
        window = _noisiest_window((labels == kind) & middle)
        left, top, right, bottom = (int(value) for value in window)
        crop = np.s_[top:bottom, left:right]
        image, depth, above = axes[3 * index : 3 * index + 3]
        picture_axis(image, frame.image[crop])
        picture_axis(depth, depth_rgb(completed.depth)[crop])
        image.set_title(f"({'adg'[index]}) {LABELS[kind]}")
        depth.set_title(f"({'beh'[index]}) estimated depth")
        _noise_from_above(above, frame, completed, labels, (crop, kind), found)
        above.set_title(f"({'cfi'[index]}) cloud from above, m")
    for kind in (CLEAN, NOISE_FG, NOISE_INBET, NOISE_BG):
        axes[2].scatter([], [], s=8, color=np.array(COLOURS[kind]) / 255, label=LABELS[kind])
    axes[2].legend(loc="lower left", fontsize=5, handletextpad=0.2, borderpad=0.3)
    return figure


def _noisiest_window(mask: NDArray[np.bool_], wide: int = 190, high: int = 100) -> Window:
    """The pixel window with the most marked pixels."""
    import cv2

    height, width = mask.shape
    wide, high = min(wide, width), min(high, height)
    sums = cv2.integral(mask.astype(np.uint8))
    inside = sums[high:, wide:] - sums[:-high, wide:] - sums[high:, :-wide] + sums[:-high, :-wide]
    top, left = np.unravel_index(int(inside.argmax()), inside.shape)
    return (float(left), float(top), float(left + wide), float(top + high))


def _noise_from_above(
    axis: Axes, frame: Frame, completed: CompletedDepth, labels: Any, part: Any, found: Sequence[KittiObject]
) -> None:
    """Points of a piece of the image from above in the colours of their kinds, boxes over them."""
    from pipeline.geometry.back_project import back_project
    from pipeline.pointcloud.taxonomy import CLEAN, COLOURS

    crop, kind = part
    keep = np.zeros(labels.shape, np.bool_)
    keep[crop] = (labels[crop] > 0) & (completed.depth[crop] < 60)
    cloud = back_project(completed.depth, frame.calibration, keep)
    kinds = cloud.look_up(labels)
    for value in (CLEAN, *sorted(set(kinds[kinds > CLEAN].tolist()), key=lambda other: other == kind)):
        chosen = cloud.points[kinds == value]
        axis.scatter(-chosen[:, 1], chosen[:, 0], s=0.6, color=np.array(COLOURS[value]) / 255, lw=0, rasterized=True)
    noisy = cloud.points[kinds == kind]
    middle = np.median(noisy if len(noisy) else np.array([[20.0, 0, 0]]), axis=0)
    axis.set(xlim=(-middle[1] - 9, -middle[1] + 9), ylim=(middle[0] - 7, middle[0] + 7), aspect="equal")
    labels_of = frame.labels if frame.has("labels") else []
    # Black, because the usual colour of predicted boxes is that of a kind of noise here.
    for objects, colour in ((labels_of, TRUTH), (found, "black")):
        footprints(axis, frame, objects, colour)


# --- boxes


def footprints(axis: Axes, frame: Frame, objects: Sequence[KittiObject], colour: str) -> None:
    """Outlines of boxes from above: right is right, forward is up."""
    solid = [item for item in objects if item.type in DRAWN and min(item.size) > 0]
    for box in corners(boxes_of(solid)):
        velo = frame.calibration.cam_to_velo(box[[0, 1, 2, 3, 0]])
        axis.plot(-velo[:, 1], velo[:, 0], color=colour, lw=0.9, clip_on=True)


def wireframes(axis: Axes, frame: Frame, objects: Sequence[KittiObject], colour: str) -> None:
    """Boxes in the image; those that reach behind the camera are left out."""
    solid = [item for item in objects if item.type in DRAWN and min(item.size) > 0]
    for box in corners(boxes_of(solid)):
        if (box[:, 2] > MIN_DEPTH).all():
            pixels = frame.calibration.cam_to_image(box)[0]
            for edge in EDGES:
                axis.plot(*pixels[list(edge)].T, color=colour, lw=0.7)


def image_over_bev(
    frame: Frame, cloud: Any, labels: Sequence[KittiObject], found: Sequence[KittiObject], width: float
) -> Figure:
    """Image with boxes above, cloud from above with boxes below."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    height, wide = frame.image_size
    tall = width * height / wide
    figure = Figure(figsize=(width, tall + 0.62 * width + 0.35), layout="constrained")
    upper, lower = figure.subplots(2, 1, height_ratios=(tall, 0.62 * width))
    picture_axis(upper, frame.image)
    upper.set_title("(a) image")
    for axis, draw in ((upper, wireframes), (lower, footprints)):
        draw(axis, frame, labels, TRUTH)
        draw(axis, frame, found, FOUND)
    upper.set(xlim=(0, wide), ylim=(height, 0))
    for source, colour, size in ((1, "#E69F00", 0.8), (0, "#4477AA", 0.5)):
        part = cloud[cloud[:, 4] == source]
        lower.scatter(-part[:, 1], part[:, 0], s=size, color=colour, lw=0, rasterized=True)
    lower.set(xlim=(-35, 35), ylim=(0, 60), aspect="equal", xlabel="m", ylabel="m")
    lower.set_title("(b) augmented LiDAR from above")
    lines = [("true box", TRUTH, "-", ""), ("predicted box", FOUND, "-", "")]
    dots = [("measured point", "#4477AA", "", "o"), ("completed point", "#E69F00", "", "o")]
    handles = [Line2D([], [], color=c, ls=ls, marker=m, ms=3, label=name) for name, c, ls, m in lines + dots]
    lower.legend(handles=handles, loc="lower left", framealpha=0.9)
    return figure


# --- curves


def curves(axis: Axes, precision: Mapping[str, NDArray[np.float64]]) -> None:
    """Interpolated precision over recall, percent."""
    for level, values in precision.items():
        recall = np.linspace(0, 100, len(values))
        axis.plot(recall, 100 * values, LEVEL_LINES[level], color=LEVEL_COLOURS[level], label=level)
    axis.set(xlim=(0, 100), ylim=(0, 102), xlabel="recall, %", ylabel="precision, %")
    axis.grid(lw=0.3)
    axis.legend(loc="upper right")
