"""Image files: color as RGB uint8, depth as raw uint16 units, each checked while it is read.

Pixels are read as they are stored: an orientation in EXIF or TIFF tags is ignored, since color and depth must agree.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.array_files import read_array
from greenhouse_gym.common.extras import needs
from greenhouse_gym.common.files import parsing, read_bytes
from greenhouse_gym.errors import FileFormatError

with needs("reconstruct"):
    import cv2

MAX_BYTES = 192 * 10**6  # of a decoded image: 64 million pixels of color, as many as the largest cameras have
PNG_START, _JPEG_START = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_MAX_SCANS = 100  # of a progressive JPEG; each takes as long as decoding a whole image
_PNG_CHANNELS = {0: 1, 2: 3, 3: 4, 4: 4, 6: 4}  # of the decoded image, by its kind of color
_WIDTH, _HEIGHT, _BITS, _ORIENTATION, _SAMPLES, _TILE_WIDTH, _TILE_HEIGHT = 256, 257, 258, 274, 277, 322, 323  # in TIFF


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
            size = np.prod(np.subtract(last, first) + 1.0) * 4 * len(file.header()["channels"])
        if size > MAX_BYTES:
            raise FileFormatError(path, f"an image of {size:.0f} bytes is too large: at most {MAX_BYTES}")
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
    return decode(path, read_bytes(path, "image"), mode, foreign)


def decode(source: object, data: bytes, mode: int, foreign: bool = False) -> npt.NDArray[np.generic]:
    """Decode the content of an image file by OpenCV, which is given no more than it can hold in memory.

    Args:
        source: The file, or what else holds the image, for messages.
        data: The content.
        mode: One of OpenCV's modes of reading.
        foreign: Read PNM and TIFF as well.

    Raises:
        FileFormatError: It is no such image, damaged, or too large.
    """
    if data.startswith(PNG_START):
        kind, size, whole = "PNG", _png_size(data), _png_is_whole(data)
    elif data.startswith(_JPEG_START):
        kind, size, whole = "JPEG", _jpeg_size(data), b"\xff\xd9" in data.rstrip(b"\0")[-64:]
        if data.count(b"\xff\xda") > _MAX_SCANS:
            raise FileFormatError(source, f"a JPEG file of more than {_MAX_SCANS} scans is not read")
    elif foreign and data[:2] in (b"P5", b"P6"):
        kind, size, whole = "PNM", _pnm_size(data), True
    elif foreign and data[:4] in (b"II*\0", b"MM\0*"):
        data, size = _as_stored(data)
        kind, whole = "TIFF", True
    else:
        raise FileFormatError(source, f"neither a PNG nor a JPEG file ({len(data)} bytes)")
    if size is not None and size.width * size.height * size.pixel_bytes > MAX_BYTES:
        raise FileFormatError(
            source, f"an image of {size.width}x{size.height} pixels of {size.pixel_bytes} bytes is too large: at most "
            f"{MAX_BYTES} bytes are decoded",
        )  # fmt: skip
    if not whole or size is None:
        raise FileFormatError(source, f"truncated {kind} file ({len(data)} bytes)")
    with parsing(source, "image"):
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), mode)
    if image is None:
        raise FileFormatError(source, f"not a {kind} file that can be decoded ({len(data)} bytes)")
    return image


class _Size(NamedTuple):
    """Width and height of a decoded image, pixels, and bytes of a pixel."""

    width: int
    height: int
    pixel_bytes: int


def _png_size(data: bytes) -> _Size | None:
    """Return the size by the first chunk of a PNG file."""
    if len(data) < 26:
        return None
    width, height = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    return _Size(width, height, _PNG_CHANNELS.get(data[25], 4) * (2 if data[24] > 8 else 1))


def _png_is_whole(data: bytes) -> bool:
    """Return whether a PNG file holds its chunks whole; OpenCV allocates the length that each claims."""
    at, kind = len(PNG_START), b""
    while at + 12 <= len(data) and kind != b"IEND":
        length, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        at += 12 + length
    return kind == b"IEND" and at <= len(data)


def _jpeg_size(data: bytes) -> _Size | None:
    """Return the size by the frame header of a JPEG file; None without one."""
    at = 2
    while at + 10 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = int.from_bytes(data[at + 5 : at + 7], "big"), int.from_bytes(data[at + 7 : at + 9], "big")
            return _Size(width, height, max(3, data[at + 9]))
        at += 1 if marker == 0xFF else 2 + length
    return None


def _pnm_size(data: bytes) -> _Size | None:
    """Return the size by the header of a PGM or PPM file."""
    fields = re.sub(rb"#[^\n]*", b"", data[:1000]).split(maxsplit=4)[1:3]
    return _Size(int(fields[0]), int(fields[1]), 3) if len(fields) == 2 and all(map(bytes.isdigit, fields)) else None


def _as_stored(data: bytes) -> tuple[bytes, _Size | None]:
    """Return a TIFF file without its orientation, which OpenCV's decoder obeys, and its size or that of its tiles."""
    order: Literal["little", "big"] = "little" if data[:1] == b"I" else "big"
    content = bytearray(data)

    def number(at: int, length: int) -> int:
        return int.from_bytes(data[at : at + length], order)

    directory = number(4, 4)
    found = {_BITS: 1, _SAMPLES: 1, _TILE_WIDTH: 0, _TILE_HEIGHT: 0}
    for entry in range(directory + 2, directory + 2 + 12 * number(directory, 2), 12):
        tag, short = number(entry, 2), number(entry + 2, 2) == 3
        at = number(entry + 8, 4) if short and number(entry + 4, 4) > 2 else entry + 8
        found[tag] = number(at, 2 if short else 4)
        if tag == _ORIENTATION and entry + 10 <= len(content):
            content[entry + 8 : entry + 10] = (1).to_bytes(2, order)
    if not {_WIDTH, _HEIGHT} <= found.keys():
        return bytes(content), None
    width, height = max(found[_WIDTH], found[_TILE_WIDTH]), max(found[_HEIGHT], found[_TILE_HEIGHT])
    return bytes(content), _Size(width, height, max(1, found[_BITS] // 8) * max(1, found[_SAMPLES]))
