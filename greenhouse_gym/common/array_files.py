"""Read untrusted ``.npz`` files: sizes are checked before memory is allocated."""

from __future__ import annotations

import base64
import binascii
import io
import lzma
import math
import zipfile
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError

_SMALL, _MAX_RATIO = 2**28, 20  # unpacked bytes that any file may have, and per packed byte of a larger one

_FILTERS: list[dict[str, int]] = [{"id": lzma.FILTER_LZMA2, "preset": 6, "dict_size": 2**20, "lc": 0, "pb": 0}]
"""Without literal context and alignment, since neighboring bytes are unrelated. A small dictionary is cheap to read."""

_MAX_MEMORY = 2**24
"""Memory that reading a text may take, bytes."""


def read_arrays(content: bytes, max_bytes: int) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of an ``.npz`` file by name.

    Args:
        content: Content of the file.
        max_bytes: Largest size that the unpacked file may have. A small file may not unpack to a large one either.

    Raises:
        ValueError: The file is larger, or an array does not match its header. Content that is not an ``.npz`` file
            raises the errors of the underlying readers.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        unpacked = sum(member.file_size for member in archive.infolist())
        limit = min(max_bytes, max(_SMALL, _MAX_RATIO * len(content)))
        if unpacked > limit:
            raise ValueError(f"unpacked it has {unpacked} bytes, at most {limit} are read")
        return {name.removesuffix(".npy"): read_array(archive.read(name)) for name in archive.namelist()}


def read_array(content: bytes) -> npt.NDArray[Any]:
    """Return the array of an ``.npy`` file.

    Raises:
        ValueError: The header does not match the content.
    """
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
    shape, _, dtype = read(file)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(content) - file.tell():
        raise ValueError(f"{dtype} of shape {shape} is not what {len(content) - file.tell()} bytes hold")
    file.seek(0)
    return np.asarray(np.lib.format.read_array(file, allow_pickle=False))


def compress(data: bytes, quick: bool = False) -> str:
    """Compress bytes to text; with ``quick``, in a tenth of the time to a little more text."""
    filters = [each | {"preset": 0} for each in _FILTERS] if quick else _FILTERS
    packed = lzma.compress(data, format=lzma.FORMAT_XZ, check=lzma.CHECK_CRC32, filters=filters)
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
