"""Image files: color as RGB uint8, depth as raw uint16 units, each checked while it is read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import FileFormatError


def read_color(path: str | Path) -> npt.NDArray[np.uint8]:
    """A color image file as (height, width, 3) uint8 RGB."""
    return np.asarray(_decode(Path(path), cv2.IMREAD_COLOR_RGB), dtype=np.uint8)


def read_depth(path: str | Path) -> npt.NDArray[np.uint16]:
    """A one-channel 16-bit depth image file as (height, width) uint16, in the file's own units."""
    image = _decode(Path(path), cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise FileFormatError(path, f"expected one channel of 16 bits, got {image.dtype} of shape {image.shape}")
    return np.asarray(image, dtype=np.uint16)


def encode_png(image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> bytes:
    """An image, (height, width) or (height, width, 3) RGB, as the bytes of a PNG file."""
    stored = image[..., ::-1] if image.ndim == 3 else image
    done, buffer = cv2.imencode(".png", np.ascontiguousarray(stored), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise FileFormatError("png", f"cannot encode an image of shape {image.shape} and type {image.dtype}")
    return buffer.tobytes()


def _decode(path: Path, mode: int) -> npt.NDArray[np.generic]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FileFormatError(path, f"image cannot be read ({error.strerror or error})") from error
    if path.suffix.lower() == ".png" and not data.endswith(b"IEND\xaeB`\x82"):
        raise FileFormatError(path, f"truncated or not a PNG file ({len(data)} bytes)")
    if path.suffix.lower() in (".jpg", ".jpeg") and b"\xff\xd9" not in data[-64:]:
        raise FileFormatError(path, f"truncated or not a JPEG file ({len(data)} bytes)")
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), mode) if data else None
    if image is None:
        raise FileFormatError(path, f"not an image that can be decoded ({len(data)} bytes)")
    return image
