"""Turn the loose triangles that Helios returns into meshes of organs."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array


class Mesh(NamedTuple):
    """Vertices (v, 3) in metres and triangles (t, 3) that wind counter-clockwise seen from outside."""

    vertices: Array
    triangles: npt.NDArray[np.int64]


class Soup(NamedTuple):
    """Loose triangles: corners (t, 3, 3), colors (t, 3), texture coordinates (t, 3, 2) or NaN, the texture's path."""

    corners: Array
    colors: Array
    uv: Array
    texture: str


def cut_along_lobes(soup: Soup) -> tuple[Mesh, Array]:
    """Return the opaque part of textured leaflets; triangles at its edge are split in four, outside ones dropped."""
    textured = np.isfinite(soup.uv).all(axis=(1, 2))
    opaque, tones = _texture(soup.texture)
    corners, uv = soup.corners[textured], soup.uv[textured]
    inside = np.stack([_sample(opaque, at) for at in (*uv.transpose(1, 0, 2), uv.mean(axis=1))])
    whole = inside.all(axis=0)
    pieces, piece_uv = _split(corners[~whole], uv[~whole])
    kept = _sample(opaque, piece_uv.mean(axis=1)) > 0
    corners, uv = np.concatenate([corners[whole], pieces[kept]]), np.concatenate([uv[whole], piece_uv[kept]])
    around = (*uv.transpose(1, 0, 2), uv.mean(axis=1))
    tone = np.mean([_sample(tones, at) for at in around], axis=0)
    stalks = soup.corners[~textured]
    mesh, good = _welded(np.concatenate([corners, stalks]))
    return mesh, np.concatenate([tone, np.tile([1.0, 0.0], (len(stalks), 1))])[good]


def _split(corners: Array, uv: Array) -> tuple[Array, Array]:
    """Split triangles in four at the middles of their sides: corners (t, 3, 3) and texture coordinates (t, 3, 2)."""

    def four(a: Array) -> Array:
        middle = (a + np.roll(a, -1, axis=1)) / 2  # of sides 0-1, 1-2, 2-0
        parts = [
            np.stack([a[:, 0], middle[:, 0], middle[:, 2]], axis=1),
            np.stack([middle[:, 0], a[:, 1], middle[:, 1]], axis=1),
            np.stack([middle[:, 2], middle[:, 1], a[:, 2]], axis=1),
            middle,
        ]
        return np.concatenate(parts)

    return four(corners), four(uv)


@lru_cache(maxsize=4)
def _texture(path: str) -> tuple[Array, Array]:
    """Return the opaque pixels (h, w) of a leaf's texture and their tones (h, w, 2) as in `Frond`."""
    from PIL import Image

    try:
        with Image.open(Path(path)) as image:
            pixels = np.asarray(image.convert("RGBA"), dtype=np.float64) / 255
    except (OSError, ValueError) as error:
        raise FileFormatError(path or "(none)", f"the leaf's texture cannot be read ({error})") from error
    opaque = pixels[..., 3] > 0.5
    red, green = pixels[..., 0], pixels[..., 1]
    light = red + green
    redness = (red - green) / np.maximum(light, 1e-6)
    tones = np.stack([light / np.median(light[opaque]), redness - np.median(redness[opaque])], axis=-1)
    return opaque.astype(np.float64), np.clip(tones, [0.5, -0.2], [1.8, 0.2])


def _sample(image: Array, uv: Array) -> Array:
    """Return pixels (n, ...) of an image at texture coordinates (n, 2), whose second axis points upwards."""
    height, width = image.shape[:2]
    columns = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    rows = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
    return image[rows, columns]


def _welded(corners: Array) -> tuple[Mesh, npt.NDArray[np.bool_]]:
    """Weld loose triangles (t, 3, 3) to a mesh; also return which of them (t,) have an area and are kept."""
    keys = np.rint(corners.reshape(-1, 3) * 1e6).astype(np.int64)
    packed = ((keys[:, 0] + (1 << 20)) << 42) | ((keys[:, 1] + (1 << 20)) << 21) | (keys[:, 2] + (1 << 20))
    _, first, index = np.unique(packed, return_index=True, return_inverse=True)
    triangles = index.reshape(-1, 3)
    vertices = corners.reshape(-1, 3)[first]
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    good = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-12
    return Mesh(vertices, triangles[good]), good


def fruit_of(soup: Soup) -> tuple[Mesh, Mesh]:
    """Return skin and sepals of Helios' fruit without its long stalk: pedicels have their own lengths."""
    skin = soup.colors[:, 0] > soup.colors[:, 1]
    body, _ = _welded(soup.corners[skin])
    low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
    center = (low + high) / 2
    # the sepals sit at the stem end, so their middle determines the axis
    up = soup.corners[~skin].reshape(-1, 3).mean(axis=0) - center
    up /= np.linalg.norm(up)
    frame = _frame(up)
    local = (body.vertices - center) @ frame
    local -= (local.min(axis=0) + local.max(axis=0)) / 2
    scale = 1 / float(2 * np.linalg.norm(local[:, :2], axis=1).max())
    sepals = (soup.corners[~skin] - center) @ frame * scale
    top = local[:, 2].max() * scale
    middle = sepals.mean(axis=1)
    stalk = (middle[:, 2] > 1.25 * top) & (np.linalg.norm(middle[:, :2], axis=1) < 0.12)
    calyx, _ = _welded(sepals[~stalk])
    return Mesh(local * scale, _outward(Mesh(local * scale, body.triangles))), calyx


def flower_of(soup: Soup) -> tuple[Mesh, Array]:
    """Return a flower with its foot at the origin, opening upwards, and the colors (t, 3) of its triangles."""
    mesh, good = _welded(soup.corners)
    green = soup.colors[good][:, 0] < 0.5
    used = mesh.triangles[green] if green.any() else mesh.triangles
    foot, middle = mesh.vertices[used].reshape(-1, 3).mean(axis=0), mesh.vertices.mean(axis=0)
    up = middle - foot if np.linalg.norm(middle - foot) > 1e-6 else np.array([0.0, 0.0, 1.0])
    local = (mesh.vertices - foot) @ _frame(up / np.linalg.norm(up))
    return Mesh(local - [0.0, 0.0, local[:, 2].min()], mesh.triangles), soup.colors[good]


def _frame(up: Array) -> Array:
    """Return a rotation (3, 3) whose third column is ``up``."""
    side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    side /= np.linalg.norm(side)
    return np.column_stack([side, np.cross(up, side), up])


def _outward(mesh: Mesh) -> npt.NDArray[np.int64]:
    """Return the triangles of a star-shaped mesh, all wound counter-clockwise seen from outside."""
    a, b, c = mesh.vertices[mesh.triangles].transpose(1, 0, 2)
    inward = (np.cross(b - a, c - a) * (a + b + c)).sum(axis=1) < 0
    return np.where(inward[:, None], mesh.triangles[:, ::-1], mesh.triangles)
