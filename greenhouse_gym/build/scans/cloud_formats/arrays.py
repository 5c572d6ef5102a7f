"""Clouds in NumPy's files."""

from __future__ import annotations

from pathlib import Path

from greenhouse_gym.build.scans.cloud_formats.columns import Parts, named_parts, positional_parts
from greenhouse_gym.common.array_files import read_array, read_arrays
from greenhouse_gym.common.files import MAX_BYTES, read_bytes
from greenhouse_gym.errors import FileFormatError

_KIND = "cloud of points"
_NAMES = {
    "points": ("points", "positions", "xyz", "vertices"),
    "colors": ("colors", "color", "rgb"),
    "normals": ("normals", "normal"),
}


def read_npy(path: Path) -> Parts:
    """Read an array whose last axis holds x y z and optionally r g b and a normal, or whose fields have such names.

    Raises:
        FileFormatError: The array has another shape or type.
    """
    array = read_array(read_bytes(path, _KIND))
    if names := array.dtype.names:
        rows = array.reshape(-1)
        return named_parts(path, names, lambda k: rows[names[k]], len(rows))
    return positional_parts(path, array)


def read_npz(path: Path) -> Parts:
    """Read the arrays points, colors and normals, whose last axis has the length 3; colors may have an opacity, too.

    Raises:
        FileFormatError: There are no points.
    """
    arrays = read_arrays(read_bytes(path, _KIND), MAX_BYTES[_KIND])
    names = {name.lower(): name for name in arrays}
    points, colors, normals = (
        next((arrays[names[name]] for name in known if name in names), None) for known in _NAMES.values()
    )
    if points is None:
        raise FileFormatError(path, f"expected the arrays points, colors and normals; it has {', '.join(arrays)}")
    if colors is not None and colors.shape[-1:] == (4,):
        colors = colors[..., :3]
    rows = [each if each is None or each.ndim < 2 else each.reshape(-1, each.shape[-1]) for each in (colors, normals)]
    return Parts(points.reshape(-1, *points.shape[-1:]), colors=rows[0], normals=rows[1])
