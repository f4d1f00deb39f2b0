"""Two surfaces and a sigma for depth maps that come without: from the local spread of depth.

A depth map of another method has one surface. Where a pixel lies between a near and a far neighbourhood and neither the
row nor the column through it continues smoothly, it is taken as a mixture of the two, so the sigma filter works on it.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from completion.types import CompletedDepth


def pseudo_sigma(depth: NDArray[np.float32], radius: int = 3, tolerance: float = 0.04) -> CompletedDepth:
    """(H, W) depth in metres, 0 = no value -> the same depth with foreground, background and sigma.

    foreground and background are the smallest and the largest valid depth within +-`radius` pixels, and sigma is the
    weight for which depth = sigma * foreground + (1 - sigma) * background (Eq. 4.5). A window that one plane explains
    to within `tolerance` (relative) has a single surface: foreground = background = depth, sigma = 1. Planes are
    linear in inverse depth, so the steep road far ahead is not taken for an edge.

    Raises ValueError for NaN or negative depth and for a radius or tolerance that is not positive.
    """
    if radius < 1 or not tolerance > 0:
        raise ValueError(f"pseudo_sigma: expected radius >= 1 and tolerance > 0, got {radius} and {tolerance:g}")
    depth = CompletedDepth(depth).depth
    foreground, background, sigma = depth.copy(), depth.copy(), np.ones_like(depth)
    _local_surfaces(depth, radius, tolerance, foreground, background, sigma)
    return CompletedDepth(depth, foreground, background, sigma)


@njit(cache=True, nogil=True)
def _local_surfaces(depth, radius, tolerance, foreground, background, sigma):  # type: ignore[no-untyped-def]
    height, width = depth.shape
    for v in range(height):
        for u in range(width):
            if not depth[v, u] > 0:
                sigma[v, u] = 1
                continue
            top, bottom = max(0, v - radius), min(height, v + radius + 1)
            left, right = max(0, u - radius), min(width, u + radius + 1)
            near, far = depth[v, u], depth[v, u]
            for row in range(top, bottom):
                for column in range(left, right):
                    value = depth[row, column]
                    if value > 0:
                        near, far = min(near, value), max(far, value)
            # Nearly flat windows are the rule; the plane fit is only for the others.
            if far - near <= tolerance * near or _is_plane(depth, v, u, top, bottom, left, right, tolerance):
                continue
            foreground[v, u], background[v, u] = near, far
            sigma[v, u] = (far - depth[v, u]) / (far - near)


@njit(cache=True, nogil=True)
def _is_plane(depth, v, u, top, bottom, left, right, tolerance):  # type: ignore[no-untyped-def]
    """True when inverse depth in the window is linear to within `tolerance` of its value at (v, u)."""
    n, x1, y1, xx, xy, yy, q1, qx, qy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for row in range(top, bottom):
        for column in range(left, right):
            if depth[row, column] > 0:
                x, y, q = float(column - u), float(row - v), 1.0 / depth[row, column]
                n, x1, y1, q1 = n + 1, x1 + x, y1 + y, q1 + q
                xx, xy, yy, qx, qy = xx + x * x, xy + x * y, yy + y * y, qx + q * x, qy + q * y
    # Cramer's rule for q = a + b x + c y.
    m00, m01, m02 = xx * yy - xy * xy, xy * y1 - x1 * yy, x1 * xy - xx * y1
    determinant = n * m00 + x1 * m01 + y1 * m02
    if abs(determinant) < 1e-9:
        return False
    m11, m12, m22 = n * yy - y1 * y1, x1 * y1 - n * xy, n * xx - x1 * x1
    a = (m00 * q1 + m01 * qx + m02 * qy) / determinant
    b = (m01 * q1 + m11 * qx + m12 * qy) / determinant
    c = (m02 * q1 + m12 * qx + m22 * qy) / determinant
    limit = tolerance / depth[v, u]
    for row in range(top, bottom):
        for column in range(left, right):
            if depth[row, column] > 0:
                x, y = float(column - u), float(row - v)
                if abs(a + b * x + c * y - 1.0 / depth[row, column]) > limit:
                    return False
    return True
