"""Bytes as compressed text for JSON files: xz, then base64."""

from __future__ import annotations

import base64
import binascii
import lzma
from typing import Any

from greenhouse_gym.errors import InvalidValueError

_FILTERS: list[dict[str, int]] = [{"id": lzma.FILTER_LZMA2, "preset": 6, "dict_size": 2**20, "lc": 0, "pb": 0}]
"""Without literal context and alignment, since neighboring bytes are unrelated. A small dictionary is cheap to read."""

_MAX_MEMORY = 2**24
"""Memory that reading a text may take, bytes."""


def compress(data: bytes) -> str:
    """Compress bytes to text."""
    packed = lzma.compress(data, format=lzma.FORMAT_XZ, check=lzma.CHECK_CRC32, filters=_FILTERS)
    return base64.b64encode(packed).decode("ascii")


def decompress(text: Any, size: int) -> bytes:
    """Return the bytes of `compress`; at most ``size`` bytes are unpacked.

    Raises:
        InvalidValueError: The text is damaged or does not hold exactly ``size`` bytes.
    """
    try:
        unpacker = lzma.LZMADecompressor(format=lzma.FORMAT_XZ, memlimit=_MAX_MEMORY)
        data = unpacker.decompress(base64.b64decode(text, validate=True), size + 1)
    except (binascii.Error, ValueError, TypeError, lzma.LZMAError, EOFError) as error:
        raise InvalidValueError(f"damaged data: {error}") from error
    if len(data) != size or not unpacker.eof:
        raise InvalidValueError(f"damaged data: expected {size} bytes, got {len(data)} or an unfinished stream")
    return data
