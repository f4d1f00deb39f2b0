"""What the convolutions of a CPU read and add: the structs they take, and how a patch of their input is gathered."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from completion.cpu.small_gemm import ROWS

Float = NDArray[np.float32]
_ZERO = np.float32(0)
# Lower bounds of the inputs of a convolution.
RECTIFIED, LINEAR = np.float32(0), np.float32(-np.inf)
# What a convolution adds to its result: nothing, a map of its size, a coarser one (bilinear with aligned corners).
NOTHING, SAME, COARSER = 0, 1, 2
# Pixels of a block of the kernels of `strided`: few enough for a block to stay in the second-level cache.
PIXELS = 8 * ROWS


class Layer(NamedTuple):
    """Weights in the order that a kernel takes, and the bias (O,)."""

    weights: Float
    bias: Float


class Summands(NamedTuple):
    """The input of a convolution: the sum of the first `terms` of three maps (H, W, I), cut at `least`."""

    x: Float
    y: Float
    z: Float
    terms: int
    least: np.float32

    @classmethod
    def of(cls, maps: tuple[Float, ...], least: np.float32 = RECTIFIED) -> Summands:
        """One to three maps."""
        padded = (*maps, maps[0], maps[0])
        return cls(padded[0], padded[1], padded[2], len(maps), least)


class Added(NamedTuple):
    """What is added to the result: a map (H, W, O) or (h, w, O), as `kind` says: NOTHING (any map), SAME or COARSER."""

    map: Float
    kind: int


def bias_of(layer: Any) -> Float:
    """The bias (O,) of a convolution."""
    return np.asarray(layer.bias.detach().contiguous().numpy())


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def gather(x, y, z, summands, least, top, left, rows, columns, step, patch):  # type: ignore[no-untyped-def]
    """patch (rows, columns, C): the sum of one to three maps from (top, left), cut at `least`, zeros outside.

    With step 2 the even columns come first, then the odd ones.
    """
    height, width, channels = x.shape
    for i in range(rows):
        r = top + i
        for j in range(columns):
            place = j if step == 1 else (j % 2) * ((columns + 1) // 2) + j // 2
            q = left + j
            if r < 0 or r >= height or q < 0 or q >= width:
                for c in range(channels):
                    patch[i, place, c] = _ZERO
            elif summands == 1:
                for c in range(channels):
                    value = x[r, q, c]
                    patch[i, place, c] = value if value > least else least
            elif summands == 2:
                for c in range(channels):
                    value = x[r, q, c] + y[r, q, c]
                    patch[i, place, c] = value if value > least else least
            else:
                for c in range(channels):
                    value = x[r, q, c] + y[r, q, c] + z[r, q, c]
                    patch[i, place, c] = value if value > least else least
