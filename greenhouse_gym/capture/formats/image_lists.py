"""Lists of image files: their order, and which color image belongs to which depth image and pose.

Images are sorted and matched by the numbers in their names, so that 10 comes after 9 and 7.png belongs to 0007.png.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from greenhouse_gym.common.files import parsing, read_bytes
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, pose

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".tif", ".tiff", ".npy", ".exr")
"""Suffixes of image files that are read."""

_DIGITS = re.compile(r"([0-9]+)")

Number = tuple[int, ...]
"""The numbers in an image's name that differ from image to image."""

POSE_TOLERANCE = 0.05
"""Maximum time between an image and its pose, seconds."""


def sorted_images(files: Iterable[Path]) -> list[Path]:
    """Return the image files of a list in the order of the numbers in their names; other files are left out."""
    kept = (file for file in files if file.suffix.lower() in IMAGE_SUFFIXES and file.name[0] != ".")
    return sorted(kept, key=lambda file: ([(int(n), t) for t, n in _parts(file.stem)], str(file)))


def _parts(stem: str) -> list[tuple[str, str]]:
    """Return the texts of a name, each with the number before it; the first has the number -1."""
    parts = _DIGITS.split(stem)
    return list(zip(parts[::2], ["-1", *parts[1::2]], strict=True))


def numbers(files: Sequence[Path]) -> list[Number] | None:
    """Return the number of each image; None unless the numbers in their names are different."""
    found = [tuple(map(int, _DIGITS.findall(file.stem))) for file in files]
    if len(files) < 2 or len({len(each) for each in found}) != 1:
        return found if len(found) == 1 and len(found[0]) == 1 else None
    table = np.array(found, dtype=object).reshape(len(found), -1)
    varying = [len(set(column)) > 1 for column in table.T]
    result = [tuple(row[varying]) for row in table]
    return result if len(set(result)) == len(files) else None


def partners(color: Sequence[Path], depth: Sequence[Path]) -> list[Path | None]:
    """Return the depth image of each color image: that of the same name, else that of the same number, else None."""
    by_name = {file.stem: file for file in reversed(depth)}
    ours, theirs = numbers(color), numbers(depth)
    by_number = {} if theirs is None else dict(zip(theirs, depth, strict=True))
    named = [by_name.get(file.stem) for file in color]
    return [each or by_number.get(number) for each, number in zip(named, ours or [()] * len(color), strict=True)]


def depth_partners(folder: Path, color: Sequence[Path]) -> list[Path]:
    """Return the PNG file with the depth of each color image, in a folder; a missing one by the color image's name.

    Raises:
        FileFormatError: The folder holds images of other kinds only.
    """
    images = sorted_images(folder.glob("*"))
    found = partners(color, [file for file in images if file.suffix.lower() == ".png"])
    if images and not any(found) and images[0].suffix.lower() != ".png":
        raise FileFormatError(folder, f"expected depth as .png, found {images[0].name}; describe it in a cameras.yaml")
    return [folder / f"{file.stem}.png" if each is None else each for file, each in zip(color, found, strict=True)]


def check_numbers(path: object, lists: Mapping[str, Sequence[Path]]) -> list[str]:
    """Check that images which are paired by their order have the same numbers; return notes.

    Args:
        path: The file that names the images, for messages.
        lists: Equally many sorted images of each kind.

    Raises:
        FileFormatError: Two lists have some numbers in common, but not all.
    """
    notes = []
    (first, files), *others = lists.items()
    own = numbers(files)
    for kind, other in others:
        theirs = numbers(other)
        if own is None or theirs is None or own == theirs:
            continue
        if shared := set(own) & set(theirs):
            alone = next(file for file, number in zip(files, own, strict=True) if number not in shared)
            raise FileFormatError(
                path, f"{alone.name} has no partner of the same number among the images of {kind}: {first} and {kind} "
                "have different numbers; remove the images without a partner, or rename them"
            )  # fmt: skip
        notes.append(f"{first} and {kind} have different numbers ({files[0].name}, {other[0].name}): paired in order")
    return notes


def poses_by_id(path: object, ids: Array, poses: Sequence[Array], images: Sequence[Path]) -> list[Array | None]:
    """Return the pose of each image: by its number where the ids of the poses are such numbers, else in order.

    Args:
        path: The file of the poses, for messages.
        ids: (n,) first column of the file: numbers of images, or times.
        poses: n poses.
        images: The images, sorted.

    Raises:
        FileFormatError: An id is no image's or occurs twice, or the poses are neither numbered nor as many as images.
    """
    found = numbers(images)
    names = [each[-1] for each in found] if found is not None and {len(each) for each in found} == {1} else []
    whole = [int(each) for each in ids] if (ids == np.rint(ids)).all() else []
    if not set(whole) & set(names):
        if len(poses) != len(images):
            raise FileFormatError(path, f"{len(poses)} poses for {len(images)} images")
        return list(poses)
    if len(set(whole)) < len(whole):
        twice = next(each for each in whole if whole.count(each) > 1)
        raise FileFormatError(path, f"has several poses with the id {twice}")
    if strangers := sorted(set(whole) - set(names)):
        raise FileFormatError(path, f"has a pose with the id {strangers[0]}, but no image has that number")
    by_id = dict(zip(whole, poses, strict=True))
    return [by_id.get(name) for name in names]


def read_numbers(path: Path, columns: int) -> Array:
    """Read a text file of numbers (lines, columns) without empty lines and those that begin with #.

    Raises:
        FileFormatError: The file cannot be read, or holds something else.
    """
    with parsing(path, f"file of {columns} numbers a line"):
        lines = [line.split() for line in read_bytes(path, "trajectory").decode().splitlines()]
        rows = np.array([list(map(float, line)) for line in lines if line and line[0][0] != "#"])
        if rows.ndim != 2 or rows.shape[1] != columns:
            raise ValueError(f"shape {rows.shape}")
        if not np.isfinite(rows).all():
            raise ValueError("not all are finite")
    return rows


def read_poses(path: Path) -> tuple[Array, Array]:
    """Read times (n,) and poses (n, 4, 4) from lines ``time tx ty tz qx qy qz qw``, sorted by time.

    Raises:
        FileFormatError: The file cannot be read, or holds something else.
    """
    rows = read_numbers(path, 8)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    lengths = np.linalg.norm(rows[:, 4:], axis=1)
    if not (lengths > 1e-6).all():
        raise FileFormatError(path, f"the quaternion at {rows[np.argmin(lengths), 0]} is zero")
    turns = Rotation.from_quat(rows[:, 4:]).as_matrix()
    return rows[:, 0], np.array([pose(turn, row[1:4]) for turn, row in zip(turns, rows, strict=True)])


def nearest_in_time(times: Array, others: Array, within: float) -> npt.NDArray[np.int64]:
    """Return the index of the nearest of the sorted ``others`` (m,) for each time (n,), -1 beyond ``within``."""
    if not len(others):
        return np.full(len(times), -1, dtype=np.int64)
    after = np.clip(np.searchsorted(others, times), 1, max(1, len(others) - 1))
    before = after - 1
    after = np.minimum(after, len(others) - 1)
    nearest = np.where(np.abs(others[after] - times) < np.abs(others[before] - times), after, before)
    return np.where(np.abs(others[nearest] - times) <= within, nearest, -1)
