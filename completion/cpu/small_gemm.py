"""Products of a few dozen rows with a small matrix of weights, as the kernels of `winograd` need them.

BLAS libraries are made for large matrices: before each product they copy both factors into an order of their own, which
at 16 x 64 times 64 x 64 costs more than the product. Here a block of 6 rows and 16 columns of the result stays in
registers while one loop runs over the inner dimension: 12 vectors of 8, which with two of weights and one of inputs
nearly fill the 16 registers of AVX2. LLVM maps the same code to AVX-512 or NEON. A compiler does not find that
arrangement in plain loops, so the block is written in its intermediate language.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

Float = NDArray[np.float32]
# Rows of a block: numbers of rows that are its multiples waste nothing.
ROWS = 6
# The columns of weights must be a multiple of this.
LANES = 8


def with_whole_lanes(weights: Float) -> Float:
    """Weights (..., I, O) with columns of zeros up to a multiple of LANES."""
    missing = -weights.shape[-1] % LANES
    return np.ascontiguousarray(np.pad(weights, [(0, 0)] * (weights.ndim - 1) + [(0, missing)]))


def _block(rows: int, vectors: int) -> Any:
    """The product of `rows` rows with LANES x vectors columns, as a function for numba.

    (a, a_at, a_step, b, b_at, b_step, c, c_at, c_step, depth): element r, j of the result goes to
    c[c_at + r c_step + j] and is the sum over k < depth of a[a_at + r a_step + k] b[b_at + k b_step + j].
    """
    vector = ir.VectorType(ir.FloatType(), LANES)
    lanes = ir.VectorType(ir.IntType(32), LANES)

    @intrinsic
    def block(_context, a, a_at, a_step, b, b_at, b_step, c, c_at, c_step, depth):  # type: ignore[no-untyped-def]
        at = types.intp
        return types.void(a, at, at, b, at, at, c, at, at, at), generate

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        a, b, c = (context.make_array(signature.args[place])(context, builder, args[place]).data for place in (0, 3, 6))
        a_at, a_step, b_at, b_step, c_at, c_step, depth = (args[place] for place in (1, 2, 4, 5, 7, 8, 9))
        constant = depth.type

        def place(start, step, times, further=0):  # type: ignore[no-untyped-def]
            """start + step times + further."""
            return builder.add(builder.add(start, builder.mul(step, times)), constant(further))

        def vector_at(array, index):  # type: ignore[no-untyped-def]
            return builder.bitcast(builder.gep(array, [index]), vector.as_pointer())

        before = builder.block
        body, after = builder.append_basic_block("inner"), builder.append_basic_block("store")
        builder.branch(body)
        builder.position_at_end(body)
        k = builder.phi(constant)
        k.add_incoming(constant(0), before)
        sums = [[builder.phi(vector) for _ in range(vectors)] for _ in range(rows)]
        weights = [builder.load(vector_at(b, place(b_at, b_step, k, LANES * j)), align=4) for j in range(vectors)]
        found = []
        for r, line in enumerate(sums):
            single = builder.load(builder.gep(a, [builder.add(place(a_at, a_step, constant(r)), k)]))
            first = builder.insert_element(vector(ir.Undefined), single, ir.IntType(32)(0))
            everywhere = builder.shuffle_vector(first, vector(ir.Undefined), lanes([0] * LANES))
            products = [builder.fmul(everywhere, weight, flags=("contract",)) for weight in weights]
            found.append([builder.fadd(old, new, flags=("contract",)) for old, new in zip(line, products)])
        for line, new_line in zip(sums, found):
            for old, new in zip(line, new_line):
                old.add_incoming(vector([0.0] * LANES), before)
                old.add_incoming(new, body)
        following = builder.add(k, constant(1))
        k.add_incoming(following, body)
        builder.cbranch(builder.icmp_signed("<", following, depth), body, after)
        builder.position_at_end(after)
        for r, line in enumerate(found):
            for j, value in enumerate(line):
                builder.store(value, vector_at(c, place(c_at, c_step, constant(r), LANES * j)), align=4)
        return context.get_dummy_value()

    return block


_block_6x2, _block_4x2, _block_2x2, _block_1x2 = (_block(rows, 2) for rows in (6, 4, 2, 1))
_block_6x1, _block_4x1, _block_2x1, _block_1x1 = (_block(rows, 1) for rows in (6, 4, 2, 1))


@njit(cache=True, nogil=True, error_model="numpy")
def multiply(a, b, c):  # type: ignore[no-untyped-def]
    """c = a b for a (N, I), b (I, O) and c (N, O), float32, each row contiguous, I >= 1, O a multiple of LANES.

    Nothing is checked: neighbours in memory would be read and overwritten.
    """
    rows, depth = a.shape
    columns = b.shape[1]
    a_step, b_step, c_step = a.strides[0] // 4, b.strides[0] // 4, c.strides[0] // 4
    for column in range(0, columns, 2 * LANES):
        pair = column + 2 * LANES <= columns
        row = 0
        while row < rows:
            left = rows - row
            at, to = row * a_step, row * c_step + column
            if left >= 6:
                if pair:
                    _block_6x2(a, at, a_step, b, column, b_step, c, to, c_step, depth)
                else:
                    _block_6x1(a, at, a_step, b, column, b_step, c, to, c_step, depth)
                row += 6
            elif left >= 4:
                if pair:
                    _block_4x2(a, at, a_step, b, column, b_step, c, to, c_step, depth)
                else:
                    _block_4x1(a, at, a_step, b, column, b_step, c, to, c_step, depth)
                row += 4
            elif left >= 2:
                if pair:
                    _block_2x2(a, at, a_step, b, column, b_step, c, to, c_step, depth)
                else:
                    _block_2x1(a, at, a_step, b, column, b_step, c, to, c_step, depth)
                row += 2
            else:
                if pair:
                    _block_1x2(a, at, a_step, b, column, b_step, c, to, c_step, depth)
                else:
                    _block_1x1(a, at, a_step, b, column, b_step, c, to, c_step, depth)
                row += 1
