"""Image files: color as RGB uint8, depth as raw uint16 units, each checked while it is read.

Pixels are read as they are stored: an orientation in EXIF or TIFF tags is ignored, since color and depth must agree.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.array_files import read_array
from greenhouse_gym.common.extras import needs
from greenhouse_gym.common.files import parsing, read_bytes
from greenhouse_gym.errors import FileFormatError

with needs("reconstruct"):
    import cv2

MAX_PIXELS = 64 * 10**6  # as many as the largest cameras have
PNG_START, _JPEG_START = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_WIDTH, _HEIGHT, _ORIENTATION = 256, 257, 274  # tags of TIFF


def read_color(path: str | Path) -> npt.NDArray[np.uint8]:
    """Read a color image file as (height, width, 3) uint8 RGB."""
    return np.asarray(_decode(Path(path), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION), dtype=np.uint8)


def read_depth(path: str | Path) -> npt.NDArray[np.uint16]:
    """Read a one-channel 16-bit depth image file as (height, width) uint16, in the file's own units."""
    image = _decode(Path(path), cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise FileFormatError(path, f"expected one channel of 16 bits, got {image.dtype} of shape {image.shape}")
    return np.asarray(image, dtype=np.uint16)


def read_image(path: str | Path) -> npt.NDArray[np.generic]:
    """Read an image file unchanged, color as BGR; PNM and TIFF, which the package never writes, are read as well."""
    return _decode(Path(path), cv2.IMREAD_UNCHANGED, foreign=True)


def read_exr(path: Path) -> npt.NDArray[np.generic]:
    """Read the depth in an OpenEXR file (height, width): its only channel, or the one called Z, V, Y or R.

    OpenCV's wheels do not read OpenEXR.

    Raises:
        FileFormatError: It is missing, damaged, too large, or has no such channel.
        MissingDependencyError: The extra ``exr`` is not installed.
    """
    with needs("exr"):
        import OpenEXR
    read_bytes(path, "image")
    with parsing(path, "OpenEXR image"):
        with OpenEXR.File(str(path), header_only=True) as file:
            first, last = file.header()["dataWindow"]
        if np.prod(np.subtract(last, first) + 1.0) > MAX_PIXELS:
            raise FileFormatError(path, f"an image of more than {MAX_PIXELS} pixels is too large")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {channel.rpartition(".")[2]: data.pixels for channel, data in file.channels().items()}
    named = [channel for channel in ("Z", "V", "Y", "R") if channel in channels]
    if len(channels) > 1 and not named:
        raise FileFormatError(path, f"which of its channels {', '.join(channels)} is depth? Expected Z, V, Y or R")
    return np.asarray(channels[named[0]] if named else next(iter(channels.values())))


def read_any_color(path: Path) -> npt.NDArray[np.uint8]:
    """Read a color image of any known kind as RGB."""
    image = read_image(path)
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    if image.dtype != np.uint8 or image.shape[2] not in (3, 4):
        raise FileFormatError(path, f"expected color of 8 bits, got {image.dtype} of shape {image.shape}")
    return np.ascontiguousarray(cv2.cvtColor(np.asarray(image[..., :3]), cv2.COLOR_BGR2RGB))


def read_any_depth(path: Path) -> npt.NDArray[Any]:
    """Read a depth image file in its own units: PNG, PGM or TIFF of 16 bits or of fractions, NPY or OpenEXR.

    Raises:
        FileFormatError: It is missing, damaged, of an unknown kind, or has several channels.
    """
    if path.suffix.lower() == ".npy":
        with parsing(path, "depth image"):
            image = read_array(read_bytes(path, "image"))
    elif path.suffix.lower() == ".exr":
        image = read_exr(path)
    else:
        image = read_image(path)
    if image.ndim != 2 or image.dtype.kind not in "uif" or image.dtype == np.uint8:
        raise FileFormatError(path, f"expected one channel of depth, got {image.dtype} of shape {image.shape}")
    return image


def encode_png(image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> bytes:
    """Encode an image, (height, width) or (height, width, 3) RGB, as a PNG file.

    OpenCV's default settings are twice as fast as any explicit level of compression.
    """
    stored = image[..., ::-1] if image.ndim == 3 else image
    done, buffer = cv2.imencode(".png", np.ascontiguousarray(stored))
    if not done:
        raise FileFormatError("png", f"cannot encode an image of shape {image.shape} and type {image.dtype}")
    return buffer.tobytes()


def _decode(path: Path, mode: int, foreign: bool = False) -> npt.NDArray[np.generic]:
    data = read_bytes(path, "image")
    size = declared_size(data)
    if data.startswith(PNG_START):
        kind, whole = "PNG", data.endswith(b"IEND\xaeB`\x82")
    elif data.startswith(_JPEG_START):
        kind, whole = "JPEG", b"\xff\xd9" in data[-64:]
    elif foreign and data[:2] in (b"P5", b"P6"):
        kind, size, whole = "PNM", _pnm_size(data), True
    elif foreign and data[:4] in (b"II*\0", b"MM\0*"):
        data, size = _as_stored(data)
        kind, whole = "TIFF", True
    else:
        raise FileFormatError(path, f"neither a PNG nor a JPEG file ({len(data)} bytes)")
    if not whole or size is None:
        raise FileFormatError(path, f"truncated {kind} file ({len(data)} bytes)")
    if size[0] * size[1] > MAX_PIXELS:
        raise FileFormatError(path, f"an image of {size[0]}x{size[1]} pixels is too large: at most {MAX_PIXELS}")
    with parsing(path, "image"):
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), mode)
    if image is None:
        raise FileFormatError(path, f"not a {kind} file that can be decoded ({len(data)} bytes)")
    return image


def declared_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height of a PNG or JPEG file by its headers; None if it is neither or has none."""
    if data.startswith(PNG_START):
        return _png_size(data)
    return _jpeg_size(data) if data.startswith(_JPEG_START) else None


def _png_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height from the first chunk of a PNG file."""
    return (int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")) if len(data) >= 24 else None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height from the frame header of a JPEG file; None without one."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        at += 1 if marker == 0xFF else 2 + length
    return None


def _pnm_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height from the header of a PGM or PPM file."""
    fields = re.sub(rb"#[^\n]*", b"", data[:1000]).split(maxsplit=4)[1:3]
    return (int(fields[0]), int(fields[1])) if len(fields) == 2 and all(map(bytes.isdigit, fields)) else None


def _as_stored(data: bytes) -> tuple[bytes, tuple[int, int] | None]:
    """Return a TIFF file without its orientation, which OpenCV's decoder obeys, and its width and height."""
    order: Literal["little", "big"] = "little" if data[:1] == b"I" else "big"
    content = bytearray(data)

    def number(at: int, length: int) -> int:
        return int.from_bytes(data[at : at + length], order)

    directory = number(4, 4)
    found = {}
    for entry in range(directory + 2, directory + 2 + 12 * number(directory, 2), 12):
        tag, short = number(entry, 2), number(entry + 2, 2) == 3
        found[tag] = number(entry + 8, 2 if short else 4)
        if tag == _ORIENTATION and entry + 10 <= len(content):
            content[entry + 8 : entry + 10] = (1).to_bytes(2, order)
    return bytes(content), (found[_WIDTH], found[_HEIGHT]) if {_WIDTH, _HEIGHT} <= found.keys() else None
