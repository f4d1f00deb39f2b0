"""The surfaces of a synthetic frame, and photographs laid over them.

A network that is to complete real streets must not learn what our renderer's surfaces look like. With another
photograph on every surface, drawn anew, nothing but comparison is left to learn: a pixel that looks like the sample
beside it belongs to its surface. (Domain randomisation: Tobin et al. 2017.)
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.semantics.conventions import CLASSES
from pipeline.training.photographs import LEVELS, SIZE, Tiles

Float = NDArray[np.float32]
Image = NDArray[np.uint8]

# Steps of depth from column to column and from row to row (relative) at which a surface ends.
_STEP_ACROSS, _STEP_DOWN = 0.08, 0.15
# Things without faces: one photograph for all of it, laid from the front.
_FACELESS = [CLASSES.index(name) for name in ("pole", "traffic light", "traffic sign", "vegetation")]
_FRONT = 3
# Coordinates (0 = right, 1 = down, 2 = ahead) that a photograph runs along, by the axis a face looks along.
_ALONG = np.array([(2, 1), (0, 2), (0, 1), (0, 1)])


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What of a frame belongs together.

    label   (H, W) int32, 0 = nothing (sky, and pixels that no surface claims)
    points  (H, W, 3) float32 metres, camera frame
    face    (S,) int64, for every label the axis that it looks along, 3 for things without faces
    kind    (S,) int64 trainId of every label
    focal   pixels
    """

    label: NDArray[np.int32]
    points: Float
    face: NDArray[np.int64]
    kind: NDArray[np.int64]
    focal: float


def find_surfaces(
    depth: NDArray[np.floating], semantics: NDArray[np.uint8], instances: NDArray[np.integer], K: NDArray[np.floating]
) -> Surfaces:
    """Connected pixels of one class, object and facing, without a step in depth.

    depth (H, W) metres with 0 = none, semantics (H, W) trainIds, instances (H, W) with 0 = none, K (3, 3) pixels.
    """
    points = _unprojected(depth, K)
    face = _facing(points)
    face[(instances > 0) | np.isin(semantics, _FACELESS)] = _FRONT
    key = (semantics.astype(np.int64) * 4 + face) * 4096 + instances % 4096
    key[depth <= 0] = -1
    core = _components(key, _steps(depth))
    # Class and facing of a surface are those of its core; pixels that join it later may be of other ones.
    labels, pixels = np.unique(core, return_index=True)
    first = np.zeros(core.max() + 1, np.int64)
    first[labels] = pixels
    label = _grown(core, depth)
    return Surfaces(label, points, face.ravel()[first], semantics.ravel()[first].astype(np.int64), float(K[0, 0]))


def _unprojected(depth: NDArray[np.floating], K: NDArray[np.floating]) -> Float:
    row, column = np.mgrid[: depth.shape[0], : depth.shape[1]]
    right, down = (column - K[0, 2]) / K[0, 0] * depth, (row - K[1, 2]) / K[1, 1] * depth
    return np.stack([right, down, depth], axis=-1).astype(np.float32)


def _facing(points: Float) -> NDArray[np.int64]:
    """(H, W): the largest coordinate of the normal, 0 right, 1 down, 2 ahead; single pixels follow their neighbours."""
    across, down = cv2.Sobel(points, cv2.CV_32F, 1, 0), cv2.Sobel(points, cv2.CV_32F, 0, 1)
    normal = np.abs(np.cross(across, down))
    return cv2.medianBlur(normal.argmax(axis=-1).astype(np.uint8), 5).astype(np.int64)


def _steps(depth: NDArray[np.floating]) -> NDArray[np.bool_]:
    """(H, W): beside a step in depth."""
    log = np.log(np.maximum(depth, 0.1))
    step = np.zeros(depth.shape, bool)
    across, down = np.abs(np.diff(log, axis=1)) > _STEP_ACROSS, np.abs(np.diff(log, axis=0)) > _STEP_DOWN
    step[:, 1:] |= across
    step[:, :-1] |= across
    step[1:] |= down
    step[:-1] |= down
    return step


def _components(key: NDArray[np.int64], step: NDArray[np.bool_]) -> NDArray[np.int32]:
    """(H, W) labels from 1 of connected pixels with one key (-1 = none) away from steps."""
    label = np.zeros(key.shape, np.int32)
    count = 0
    for each in np.unique(key[key >= 0]):
        found, part = cv2.connectedComponents(((key == each) & ~step).astype(np.uint8), connectivity=4)
        label[part > 0] = part[part > 0] + count
        count += found - 1
    return label


def _grown(label: NDArray[np.int32], depth: NDArray[np.floating], rounds: int = 6) -> NDArray[np.int32]:
    """Pixels beside steps join the neighbour that is nearest in depth."""
    log = np.log(np.maximum(depth, 0.1))
    for _ in range(rounds):
        free, grown = (label == 0) & (depth > 0), label.copy()
        nearest = np.full(depth.shape, 0.25)
        for shift in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            other, distance = np.roll(label, shift, (0, 1)), np.abs(np.roll(log, shift, (0, 1)) - log)
            joins = free & (other > 0) & (distance < nearest)
            grown[joins], nearest[joins] = other[joins], distance[joins]
        label = grown
    return label


@dataclass(frozen=True, eq=False)
class _Drawn:
    """For every surface: the photograph (-1: stays as it is), metres it spans, where it begins, tint, how opaque."""

    photograph: NDArray[np.int64]
    span: Float
    offset: Float
    tint: Float
    opaque: Float


def retextured(image: Image, surfaces: Surfaces, tiles: tuple[Tiles, ...], rng: np.random.Generator) -> Image:
    """The image (H, W, 3) RGB with photographs on about two thirds of its surfaces, its light and shade kept in part.

    tiles  `photographs.read_photographs`
    """
    drawn = _draw(surfaces, len(tiles[0]), rng)
    label, shape = surfaces.label.ravel(), image.shape
    at = np.flatnonzero(drawn.photograph[label] >= 0)
    chosen = label[at]
    colours = _sampled(surfaces, drawn, tiles, at) * drawn.tint[chosen]
    colours *= _shade(image, surfaces.label, rng.uniform(0.3, 1.0)).ravel()[at, None]
    out: Float = image.reshape(-1, 3).astype(np.float32)
    opaque = drawn.opaque[chosen, None]
    out[at] = (1 - opaque) * out[at] + opaque * colours
    out = out.reshape(shape)
    if rng.random() < 0.5:
        out = _with_sky(out, surfaces.points[..., 2] <= 0, tiles, rng)
    return out.clip(0, 255).round().astype(np.uint8)


def _draw(surfaces: Surfaces, photographs: int, rng: np.random.Generator) -> _Drawn:
    """Surfaces of one class and facing often share a photograph: a street has one asphalt."""
    count = len(surfaces.kind)
    group = surfaces.kind * 4 + surfaces.face
    source = np.arange(count)
    shared = rng.random(count) < rng.uniform(0.2, 0.9)
    _, first, which = np.unique(group, return_index=True, return_inverse=True)
    source[shared] = first[which][shared]
    photograph = np.where(rng.random(count) < 0.7, rng.integers(photographs, size=count), -1)[source]
    photograph[0] = -1
    span = np.exp(rng.uniform(0, np.log(8), count)).astype(np.float32)[source]
    tint = (rng.uniform(0.5, 1.3, (count, 3)) * rng.uniform(0.6, 1.2, (count, 1))).astype(np.float32)[source]
    opaque = rng.uniform(0.6, 1, count).astype(np.float32)[source]
    return _Drawn(photograph, span, rng.random((count, 2)).astype(np.float32)[source], tint, opaque)


def _sampled(surfaces: Surfaces, drawn: _Drawn, tiles: tuple[Tiles, ...], at: NDArray[np.int64]) -> Float:
    """(N, 3) colours of the photographs at the pixels `at`, from tiles that are as coarse as the pixels."""
    label = surfaces.label.ravel()[at]
    points, face = surfaces.points.reshape(-1, 3)[at], surfaces.face[label]
    position = np.take_along_axis(points, _ALONG[face], axis=1) / drawn.span[label, None] + drawn.offset[label]
    position -= np.floor(position)
    # Pixels of the finest tile that one pixel of the image covers; ground is seen at a grazing angle.
    covered = points[:, 2] / surfaces.focal * SIZE / drawn.span[label] * np.where(face == 1, 2, 1)
    level = np.log2(np.maximum(covered, 1)).round().astype(int).clip(0, LEVELS - 1)
    colours = np.empty((len(at), 3), np.float32)
    for each in np.unique(level):
        here = level == each
        side = SIZE >> each
        column, row = np.minimum((position[here] * side).astype(int), side - 1).T
        colours[here] = tiles[each][drawn.photograph[label[here]], row, column]
    return colours


def _shade(image: Image, label: NDArray[np.int32], power: float) -> Float:
    """(H, W): brightness of a pixel against the mean of its surface, to a power: shadows, folds, windows."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    flat = label.ravel()
    mean = np.bincount(flat, grey.ravel()) / np.maximum(np.bincount(flat), 1)
    shade: Float = ((grey / np.maximum(mean[label], 8)).clip(0.3, 2) ** power).astype(np.float32)
    return shade


def _with_sky(image: Float, sky: NDArray[np.bool_], tiles: tuple[Tiles, ...], rng: np.random.Generator) -> Float:
    """A blurred photograph as sky."""
    tile = tiles[1][int(rng.integers(len(tiles[1])))]
    height, width = sky.shape
    drawn = cv2.GaussianBlur(cv2.resize(tile, (width, height)), (0, 0), rng.uniform(1, 12))
    light, bright = 0.5 * rng.uniform(0.6, 1.4), 100 * rng.uniform(0.5, 1.3)
    found: Float = np.where(sky[..., None], light * drawn + bright, image).astype(np.float32)
    return found
