"""Files of pictures and films, in the format that the file's name asks for."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np
from PIL import Image as PillowImage
from PIL import ImageDraw

from greenhouse_gym.common.extras import needs
from greenhouse_gym.common.files import require_writable, write_atomically
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.rendering.renderer import Image
from greenhouse_gym.rendering.task_pictures import PINK, RED

PICTURES = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}
"""Formats of pictures by the suffix of their files."""

FILMS = (".mp4", ".gif", ".webp")
"""Suffixes of films."""

_COLORS = 256  # of a GIF
_TEXT, _HALO = (40, 40, 40), (245, 247, 247)


def require_picture(path: str | Path, suffixes: Iterable[str] = tuple(PICTURES)) -> None:
    """Check before long work that a picture or film can be written.

    Raises:
        InvalidValueError: The suffix is none of those given.
        FileWriteError: The folder is not writable.
        MissingDependencyError: The film is an MP4 file, and the extra ``viz`` is not installed.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in suffixes:
        raise InvalidValueError(f"{path}: expected a file that ends in {' or '.join(suffixes)}")
    if suffix == ".mp4":
        with needs("viz"):
            import imageio_ffmpeg  # noqa: F401
    require_writable(path)


def write_picture(image: Image, path: str | Path) -> Path:
    """Write an image (height, width, 3) as PNG or JPEG."""
    written = io.BytesIO()
    PillowImage.fromarray(image).save(written, PICTURES[Path(path).suffix.lower()], quality=92)
    return write_atomically(path, written.getvalue())


def write_film(images: Iterable[Image], path: str | Path, fps: float) -> Path:
    """Write images (height, width, 3) as MP4, GIF or WebP, with as many in a second as given."""
    frames = iter(images)
    if animated := {".gif": _gif, ".webp": _webp}.get(Path(path).suffix.lower()):
        return write_atomically(path, animated(frames, fps))
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "film.mp4"
        _write_mp4(frames, made, fps)
        return write_atomically(path, made.read_bytes())


def with_caption(image: Image, text: str) -> Image:
    """Return an image with lines of text in its upper left corner."""
    picture = PillowImage.fromarray(image)
    size = max(10, image.shape[1] // 42)
    ImageDraw.Draw(picture).multiline_text(
        (size // 2, size // 3), text, _TEXT, font_size=size, spacing=size // 4, stroke_width=1, stroke_fill=_HALO
    )
    return np.asarray(picture)


def _gif(frames: Iterator[Image], fps: float) -> bytes:
    opening = next(frames)
    # the tip's path is not in the first image yet
    shades = [np.multiply(255 * shade, color) for color in (RED, PINK) for shade in (0.6, 0.8, 1.0)]
    swatches = [np.full((4, opening.shape[1], 3), shade, np.uint8) for shade in shades]
    whole = PillowImage.fromarray(np.concatenate([opening, *swatches]))
    palette = whole.quantize(_COLORS, PillowImage.Quantize.FASTOCTREE)  # which keeps the colors of small areas
    images = (
        PillowImage.fromarray(frame).quantize(palette=palette, dither=PillowImage.Dither.NONE)
        for frame in chain((opening,), frames)
    )
    written = io.BytesIO()
    next(images).save(written, "gif", save_all=True, append_images=images, duration=round(1000 / fps), loop=0)
    return written.getvalue()


def _webp(frames: Iterator[Image], fps: float) -> bytes:
    images, written = map(PillowImage.fromarray, frames), io.BytesIO()
    next(images).save(
        written, "webp", save_all=True, append_images=images, duration=round(1000 / fps), loop=0, quality=70, method=4
    )
    return written.getvalue()


def _write_mp4(frames: Iterator[Image], path: Path, fps: float) -> None:
    from imageio_ffmpeg import write_frames

    first = next(frames)
    height, width = first.shape[:2]
    writer = write_frames(
        str(path), (width, height), fps=fps, macro_block_size=2, ffmpeg_log_level="error",
        output_params=["-preset", "veryfast"],
    )  # fmt: skip
    writer.send(None)
    try:
        for frame in chain((first,), frames):
            writer.send(np.ascontiguousarray(frame))
    finally:
        writer.close()
