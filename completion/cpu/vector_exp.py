"""The exponential in plain arithmetic, which a compiler turns into vector instructions where numba's own is a call."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

_ONE = np.float32(1)
_LOG2_E, _ROUND = np.float32(1 / math.log(2)), np.float32(128.5)
_LN2_HIGH, _LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
_LEAST, _MOST = np.float32(-86), np.float32(86)
_TAYLOR = tuple(np.float32(1 / math.factorial(n)) for n in range(8))


@njit(inline="always")
def exp(x):  # type: ignore[no-untyped-def]
    """Float32 exponential to 2e-7 relative, cut at exp(+-86): 2^n times a Taylor polynomial on +-ln(2) / 2."""
    x = _LEAST if x < _LEAST else x
    x = _MOST if x > _MOST else x
    n = np.int32(np.int32(x * _LOG2_E + _ROUND) - np.int32(128))
    whole = np.float32(n)
    r = x - whole * _LN2_HIGH - whole * _LN2_LOW
    p = _TAYLOR[6] + r * _TAYLOR[7]
    p = _TAYLOR[4] + r * (_TAYLOR[5] + r * p)
    p = _TAYLOR[2] + r * (_TAYLOR[3] + r * p)
    p = _ONE + r * (_ONE + r * p)
    return p * np.int32(np.int32(n + np.int32(127)) << np.int32(23)).view(np.float32)
