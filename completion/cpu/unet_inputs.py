"""From a frame to what a `selection.PixelUNet` takes, for inference on the CPU: the same values, much faster.

One pass over the image with numba on runs of pixels of one row that fit the first-level cache. Rows are shared among as
many threads as torch uses.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray

from completion.inputs import scale_rgb
from completion.models.rings import interpolate_rows, sweep
from completion.models.selection import INPUTS

Float = NDArray[np.float32]
RUN = 128  # pixels
_ONE, _ZERO = np.float32(1), np.float32(0)


@dataclass(frozen=True)
class UNetInputs:
    """A frame padded at the top and right to multiples of 32.

    features  (H/2, W/2, 40) see `selection.depth_features` and torch's pixel_unshuffle
    rings     (5, H, W) see `rings.enclose`        logs  (3, H, W) natural logarithms of their depths
    top       rows of padding
    """

    features: Float
    rings: Float
    logs: Float
    top: int


@njit(cache=True, nogil=True, error_model="numpy")
def _write_inputs(first, last, image, colours, sparse, rings, logs, out):  # type: ignore[no-untyped-def]
    """Network inputs of half-resolution rows first..last; see `selection.depth_features` and torch's pixel_unshuffle.

    image (H, W, 3) uint8, colours (3, 256) their scaled values, rings (5, H, W), logs (3, H, W) natural logarithms of
    the first three rings, out (H/2, W/2, 40)
    """
    height, width = sparse.shape
    run = np.empty((INPUTS, RUN), np.float32)
    for y in range(2 * first, 2 * last):
        run[9] = np.float32(2 * y / (height - 1) - 1)
        for start in range(0, width, RUN):
            count = min(RUN, width - start)
            for i in range(count):
                x = start + i
                for c in range(3):
                    run[c, i] = colours[c, image[y, x, c]]
                run[3, i] = logs[2, y, x] - np.float32(2.7)
                run[8, i] = _ONE if sparse[y, x] > 0 else _ZERO
            for side in range(2):
                for i in range(count):
                    x = start + i
                    difference = np.float32(3) * (logs[side, y, x] - logs[2, y, x])
                    run[4 + side, i] = min(max(difference, np.float32(-3)), np.float32(3))
                    run[6 + side, i] = rings[3 + side, y, x] * np.float32(0.0625) - _ONE
            for c in range(INPUTS):
                for side in range(2):
                    channel = 4 * c + 2 * (y % 2) + side
                    for i in range(count // 2):
                        out[y // 2, start // 2 + i, channel] = run[c, 2 * i + side]


def in_threads(kernel: Callable[..., None], rows: int, *arguments: object) -> None:
    """kernel(first, last, ...) over all rows, in as many threads as torch uses."""
    threads = max(1, min(torch.get_num_threads(), rows))
    if threads == 1:
        kernel(0, rows, *arguments)
        return
    edges = [rows * part // threads for part in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(kernel, a, b, *arguments) for a, b in itertools.pairwise(edges)]:
            done.result()


def _rings(sparse: Float) -> tuple[Float, Float]:
    """`rings.enclose` (5, H, W) and the natural logarithms of its depths (3, H, W), with as many threads as torch."""
    rings = np.empty((5, *sparse.shape), np.float32)
    logs = np.empty((3, *sparse.shape), np.float32)
    sides = ((sparse, rings[0], rings[3]), (sparse[::-1], rings[1, ::-1], rings[4, ::-1]))

    def sweep_sides(first: int, last: int) -> None:
        for side in sides[first:last]:
            sweep(*side)

    def finish_rows(first: int, last: int) -> None:
        interpolate_rows(first, last, rings)
        np.log(rings[:3, first:last], out=logs[:, first:last])

    in_threads(sweep_sides, 2)
    in_threads(finish_rows, len(sparse))
    return rings, logs


def unet_inputs(sparse: Float, image: NDArray[np.uint8], scaling: str, planes: bool) -> UNetInputs:
    """Sparse (h, w) metres and image (h, w, 3) of any size.

    scaling  of the colours, see `inputs.scale_rgb`
    planes   the pixels of a channel lie together, as exports take them; else the channels of a pixel
    """
    height, width = sparse.shape
    top, right = -height % 32, -width % 32
    padded = np.pad(sparse, ((top, 0), (0, right)))
    pixels = np.pad(image, ((top, 0), (0, right), (0, 0)), mode="edge")
    rings, logs = _rings(padded)
    levels = torch.arange(256, dtype=torch.float32).expand(1, 3, 1, 256)
    colours = scale_rgb(levels, scaling)[0, :, 0].contiguous().numpy()
    half = (padded.shape[0] // 2, padded.shape[1] // 2)
    if planes:
        features = np.empty((4 * INPUTS, *half), np.float32).transpose(1, 2, 0)
    else:
        features = np.empty((*half, 4 * INPUTS), np.float32)
    in_threads(_write_inputs, half[0], pixels, colours, padded, rings, logs, features)
    return UNetInputs(features, rings, logs, top)
