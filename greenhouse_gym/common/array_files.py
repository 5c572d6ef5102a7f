"""How ``.npz`` files from strangers are read: their sizes are checked before anything is allocated."""

from __future__ import annotations

import io
import math
import zipfile
from typing import Any

import numpy as np
import numpy.typing as npt


def read_arrays(content: bytes, most: int) -> dict[str, npt.NDArray[Any]]:
    """The arrays of an ``.npz`` file by name.

    Args:
        content: Content of the file.
        most: The most bytes it may have unpacked.

    Raises:
        ValueError: It is larger, or an array is not what its header says; other errors for what is no such file.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        unpacked = sum(member.file_size for member in archive.infolist())
        if unpacked > most:
            raise ValueError(f"unpacked it has {unpacked} bytes, at most {most} are read")
        return {name.removesuffix(".npy"): read_array(archive.read(name)) for name in archive.namelist()}


def read_array(content: bytes) -> npt.NDArray[Any]:
    """The array of an ``.npy`` file.

    Raises:
        ValueError: Its header promises something else than what is there.
    """
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
    shape, _, dtype = read(file)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(content) - file.tell():
        raise ValueError(f"{dtype} of shape {shape} is not what {len(content) - file.tell()} bytes hold")
    file.seek(0)
    return np.asarray(np.lib.format.read_array(file, allow_pickle=False))
