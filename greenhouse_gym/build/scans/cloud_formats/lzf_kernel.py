"""Kernel that unpacks blocks that LZF packed."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import kernel

Bytes = npt.NDArray[np.uint8]


@kernel("i8(u1[::1], u1[::1])", writes=("result",))
def unpack(packed: Bytes, result: Bytes) -> int:
    """Unpack a block, a sequence of literal bytes and of repetitions of bytes at a distance of up to 8 KiB.

    Args:
        packed: (p,) the block.
        result: (n,) memory for its content.

    Returns:
        Number of bytes unpacked; -1 if the block ends early, refers to bytes before its start, or exceeds the memory.
    """
    at = filled = 0
    while at < len(packed):
        control = int(np.int64(packed[at]))
        at += 1
        if control < 32:
            length = control + 1
            if at + length > len(packed) or filled + length > len(result):
                return -1
            for k in range(length):
                result[filled + k] = packed[at + k]
            at += length
        else:
            length = (control >> 5) + 2
            if at + (2 if length == 9 else 1) > len(packed):
                return -1
            if length == 9:
                length += int(np.int64(packed[at]))
                at += 1
            start = filled - ((control & 31) << 8) - int(np.int64(packed[at])) - 1
            at += 1
            if start < 0 or filled + length > len(result):
                return -1
            for k in range(length):  # one by one: a repetition may include its own beginning
                result[filled + k] = result[start + k]
        filled += length
    return filled
