"""Kernels that round numbers to float16, which the compiler has no type for, and read them."""

from __future__ import annotations

import numpy as np

from greenhouse_gym.common.jit import inlined

_HALF = np.float32(0.5)
# the smallest normal float16 as the bits of a float32, the difference of the exponents' biases, the bits lost
_SMALLEST_NORMAL, _BIAS, _LOST = np.uint32(113 << 23), np.uint32(112 << 23), np.uint32(13)
_SIGN, _HALF_BITS, _UP_TO_TIES, _ODD = np.uint32(1 << 31), np.uint32(126 << 23), np.uint32(0xFFF), np.uint32(1)
_MAGNITUDE, _SIGN_SHIFT, _RESCALED = np.uint32(0x7FFF), np.uint32(16), np.float32(2.0**112)


@inlined
def from_half_bits(bits):
    """Return the finite number with these bits as float16, as float32."""
    size = np.uint32((bits & _MAGNITUDE) << _LOST).view(np.float32) * _RESCALED
    return -size if (bits << _SIGN_SHIFT) & _SIGN else size


@inlined
def half_bits(value):
    """Return the bits of a number as float16, rounded to nearest and ties to even; overflow is not handled."""
    bits = np.float32(value).view(np.uint32)
    sign, size = bits & _SIGN, bits & ~_SIGN
    tiny = np.float32(abs(value) + _HALF).view(np.uint32) - _HALF_BITS
    normal = (size + _UP_TO_TIES + ((size >> _LOST) & _ODD) - _BIAS) >> _LOST
    return np.uint32((tiny if size < _SMALLEST_NORMAL else normal) | (sign >> np.uint32(16)))


@inlined
def as_half(value):
    """Return a number as float32 after rounding to float16."""
    bits = np.float32(value).view(np.uint32)
    sign, size = bits & _SIGN, bits & ~_SIGN
    if size < _SMALLEST_NORMAL:
        size = np.float32((abs(value) + _HALF) - _HALF).view(np.uint32)
    else:
        size = ((size + _UP_TO_TIES + ((size >> _LOST) & _ODD)) >> _LOST) << _LOST
    return np.uint32(size | sign).view(np.float32)
