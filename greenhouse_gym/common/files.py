"""Where the shipped data lies, which names and paths are safe, how files are read and written.

Files come from strangers, so they are read in one way only, `read_bytes`: regular files, no larger than their kind may
be. Names that become file names pass `checked_name`, paths that a file names pass `inside`. Files are written to a
temporary name, then renamed.
"""

from __future__ import annotations

import errno
import os
import re
import reprlib
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType

from pydantic import ValidationError

from greenhouse_gym.errors import FileFormatError, FileWriteError, InvalidValueError, MissingDependencyError

_PACKAGE = Path(__file__).resolve().parents[1]
_IN_CHECKOUT = {"scenes": Path("scenes"), "policies": Path("training/policies")}

MOST_BYTES = MappingProxyType(
    {
        "scene": 64 * 2**20,
        "bank manifest": 64 * 2**20,
        "recording index": 256 * 2**20,
        "calibration": 2**20,
        "trajectory": 256 * 2**20,
        "image": 256 * 2**20,
        "truth": 64 * 2**20,
        "row cloud": 16 * 2**30,
        "settings": 2**20,
        "cloud of points": 16 * 2**30,
        "policy": 2**30,
        "checkpoint": 4 * 2**30,
        "leaderboard entry": 2**28,
        "record journal": 2**28,
    }
)
"""The most bytes a file of each kind may have; what is larger is refused before it is read."""

_UNSAFE = re.compile(r'[/\\:*?"<>|\x00-\x1f\x7f\ud800-\udfff]')
_LONGEST_NAME = 200  # bytes; file systems allow 255, suffixes and temporary names take some


def data_path(kind: str) -> Path:
    """The folder of shipped ``"scenes"`` or ``"policies"``.

    A checkout's own folder comes first, so that an editable install sees the checkout and never a stale copy;
    otherwise the package data of the wheel.
    """
    checkout = _PACKAGE.parent
    if (checkout / "pyproject.toml").is_file() and (checkout / _IN_CHECKOUT[kind]).is_dir():
        return checkout / _IN_CHECKOUT[kind]
    return _PACKAGE / f"_{kind}"


def checked_name(kind: str, name: str) -> str:
    """Return a name that can be a file's name on any system and names no other place; else raise.

    Args:
        kind: What bears the name, for the message.
        name: One part of a path, without a suffix.

    Raises:
        InvalidValueError: It is empty, too long, "." or "..", begins with a dot or ends with one or with a space, holds
            a separator, a control character or one of ``:*?"<>|``, or is "manifest", a bank's own file.
    """
    unsafe = _UNSAFE.search(name)
    if unsafe or not name or name[0] == "." or name[-1] in ". " or name.casefold() == "manifest":
        raise InvalidValueError(
            f"{kind} cannot be named {name[:80]!r}: expected a file's name without separators, control characters and "
            ':*?"<>|, without a dot in front, and not "manifest"'
        )
    if len(name.encode()) > _LONGEST_NAME:
        raise InvalidValueError(f"{kind} cannot be named {name[:40]!r}...: longer than {_LONGEST_NAME} bytes")
    return name


def inside(folder: str | Path, relative: str, named_in: object) -> Path:
    """The path of a file that another file names relative to a folder.

    Args:
        folder: Everything must lie in it.
        relative: What the other file says.
        named_in: The other file, for the message.

    Raises:
        FileFormatError: It is absolute or leads out of the folder, also through a link.
    """
    path = Path(folder) / relative
    try:
        leaves = len(relative) > 1000 or Path(relative).is_absolute() or ".." in Path(relative).parts
        leaves = leaves or not path.resolve().is_relative_to(Path(folder).resolve())
    except (OSError, ValueError, RuntimeError) as error:  # a null character, a loop of links
        raise FileFormatError(named_in, f"names the file {relative[:200]!r}, which is no path ({error})") from error
    if leaves:
        raise FileFormatError(named_in, f"names the file {relative[:200]!r}, which is not inside {folder}")
    return path


def read_bytes(path: str | Path, kind: str) -> bytes:
    """The content of a regular file that is no larger than files of its kind may be.

    Args:
        path: The file; pipes, devices and folders are refused before they are read.
        kind: A key of `MOST_BYTES`.

    Raises:
        FileFormatError: It is missing, cannot be read, is no regular file, or is too large.
    """
    try:
        with open(path, "rb", opener=_without_waiting) as file:
            status = os.fstat(file.fileno())
            readable = stat.S_ISREG(status.st_mode) and status.st_size <= MOST_BYTES[kind]
            content = file.read(status.st_size) if readable else b""
    except (OSError, ValueError) as error:
        raise FileFormatError(path, f"cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if not stat.S_ISREG(status.st_mode):
        raise FileFormatError(path, "cannot be read (not a regular file)")
    if not readable:
        raise FileFormatError(path, f"too large for a {kind}: {status.st_size} bytes, at most {MOST_BYTES[kind]}")
    return content


def _without_waiting(path: str, flags: int) -> int:
    """Open a file; a pipe that nobody writes to is opened as well, not waited for."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


@contextmanager
def parsing(path: object, kind: str) -> Iterator[None]:
    """Turn whatever a parser raises over damaged content into a `FileFormatError` that names the file.

    What a parser trips over cannot be listed: formats are read by libraries, and damage has any form.
    """
    try:
        yield
    except (FileFormatError, MissingDependencyError):
        raise
    except ValidationError as error:
        raise FileFormatError(path, f"not a valid {kind}: {first_fault(error)}") from error
    except Exception as error:
        what = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise FileFormatError(path, f"not a valid {kind}: {what}") from error


def first_fault(error: ValidationError) -> str:
    """The first field at fault, what is wrong with it and what it holds, in one line."""
    first = error.errors(include_url=False, include_context=False)[0]
    where = ".".join(map(str, first["loc"])) or "the file"
    if first["type"] == "value_error":  # raised by a class of ours, which says what it got
        return f"{where}: {first['msg'].removeprefix('Value error, ')}"
    return f"{where}: {first['msg']} (got {reprlib.repr(first['input'])})"


@contextmanager
def exclusive(folder: str | Path) -> Iterator[None]:
    """Work in a folder while no other process does; it is made if missing.

    The file ``.lock`` in it is locked meanwhile; the lock goes with the process, however that ends.

    Raises:
        FileWriteError: The folder cannot be made or written, or another process is at work in it.
    """
    path = Path(folder) / ".lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a")
    except OSError as error:
        raise FileWriteError(folder, error) from error
    with file:
        try:
            _lock(file.fileno())
            same = path.stat().st_ino == os.fstat(file.fileno()).st_ino  # nobody finished and removed it in between
        except OSError:
            same = False
        if not same:
            raise FileWriteError(folder, OSError("another process is at work in this folder"))
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def _lock(handle: int) -> None:
    """Lock an open file; `OSError` where another process has."""
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def require_writable(path: str | Path) -> None:
    """Raise `FileWriteError` if a file could not be written there; long work begins with it."""
    path = Path(path)
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        path.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise FileWriteError(path, error) from error


def write_atomically(path: str | Path, content: str | bytes) -> Path:
    """Write a file so that a reader sees the old content or the new, never a part: temporary name, then rename.

    Raises:
        FileWriteError: It could not be written, say because the disk is full.
    """
    path = Path(path)
    data = content.encode() if isinstance(content, str) else content
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise FileWriteError(path, error) from error
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        umask = os.umask(0)
        os.umask(umask)
        Path(temporary).chmod(0o666 & ~umask)
        Path(temporary).replace(path)
    except BaseException as error:
        Path(temporary).unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise FileWriteError(path, error) from error
        raise
    return path


def remove_leftovers(folder: Path, suffix: str) -> None:
    """Remove what `write_atomically` left of files of that suffix in a folder where its process was killed."""
    for path in folder.glob(f".*{suffix}.{'[a-z0-9_]' * 8}"):  # as `tempfile` names them
        path.unlink(missing_ok=True)
