"""Batch normalisation of rows with what follows it, for training on the CPU. Float32 rows, float64 sums.

Every kernel works on the rows [start, stop) of one block and writes its own row of partial sums, so that the sums do
not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np

from detection.ops._numba import kernel


@kernel
def sums(rows, start, stop, total, squares):  # type: ignore[no-untyped-def]
    """Adds the rows (N, C) and their squares to total and squares (C,) float64."""
    for n in range(start, stop):
        for c in range(rows.shape[1]):
            value = np.float64(rows[n, c])
            total[c] += value
            squares[c] += value * value


@kernel
def relu_forward(rows, scale, shift, start, stop, out):  # type: ignore[no-untyped-def]
    """out = max(rows * scale + shift, 0)."""
    for n in range(start, stop):
        for c in range(rows.shape[1]):
            value = rows[n, c] * scale[c] + shift[c]
            out[n, c] = value if value > 0 else np.float32(0)


@kernel
def relu_sums(rows, mean, out, grad, start, stop, total, products):  # type: ignore[no-untyped-def]
    """Sums of the gradient that passes the ReLU, and of its products with rows - mean."""
    for n in range(start, stop):
        for c in range(rows.shape[1]):
            passed = np.float64(grad[n, c]) if out[n, c] > 0 else np.float64(0)
            total[c] += passed
            products[c] += passed * (rows[n, c] - mean[c])


@kernel
def relu_backward(rows, out, grad, scale, slope, offset, start, stop, result):  # type: ignore[no-untyped-def]
    """result = grad (where the ReLU lets it pass) * scale + rows * slope + offset."""
    for n in range(start, stop):
        for c in range(rows.shape[1]):
            passed = grad[n, c] if out[n, c] > 0 else np.float32(0)
            result[n, c] = passed * scale[c] + rows[n, c] * slope[c] + offset[c]


@kernel
def maximum_forward(rows, scale, shift, start, stop, out, chosen):  # type: ignore[no-untyped-def]
    """Of groups (R, K, C): out (R, C) = max(max over k of rows * scale + shift, 0); chosen (R, C) the first such k."""
    neighbours, channels = rows.shape[1], rows.shape[2]
    for r in range(start, stop):
        for c in range(channels):
            out[r, c] = rows[r, 0, c] * scale[c] + shift[c]
            chosen[r, c] = 0
        for k in range(1, neighbours):
            for c in range(channels):
                value = rows[r, k, c] * scale[c] + shift[c]
                larger = value > out[r, c]
                out[r, c] = value if larger else out[r, c]
                chosen[r, c] = k if larger else chosen[r, c]
        for c in range(channels):
            out[r, c] = out[r, c] if out[r, c] > 0 else np.float32(0)


@kernel
def maximum_sums(rows, mean, out, chosen, grad, start, stop, total, products):  # type: ignore[no-untyped-def]
    """`relu_sums` where only the chosen neighbour of each group and channel gets a gradient."""
    for r in range(start, stop):
        for c in range(rows.shape[2]):
            if out[r, c] > 0:
                passed = np.float64(grad[r, c])
                total[c] += passed
                products[c] += passed * (rows[r, chosen[r, c], c] - mean[c])


@kernel
def maximum_backward(rows, out, chosen, grad, scale, slope, offset, start, stop, result):  # type: ignore[no-untyped-def]
    """`relu_backward` where only the chosen neighbour of each group and channel gets a gradient."""
    neighbours, channels = rows.shape[1], rows.shape[2]
    for r in range(start, stop):
        for k in range(neighbours):
            for c in range(channels):
                result[r, k, c] = rows[r, k, c] * slope[c] + offset[c]
        for c in range(channels):
            if out[r, c] > 0:
                result[r, chosen[r, c], c] += grad[r, c] * scale[c]
