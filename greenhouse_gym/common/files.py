"""Locate shipped data, check names and paths, read untrusted files and write files atomically.

All files are read by `read_bytes`, which accepts regular files up to a size limit per kind. Names that become file
names pass `checked_name`; paths named inside a file pass `inside`. Files are written to a temporary name, then renamed.
"""

from __future__ import annotations

import codecs
import errno
import os
import re
import reprlib
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import TextIO

from pydantic import ValidationError

from greenhouse_gym.errors import FileFormatError, FileWriteError, InvalidValueError, MissingDependencyError

_PACKAGE = Path(__file__).resolve().parents[1]
_IN_CHECKOUT = {"scenes": Path("scenes"), "policies": Path("training/policies")}

MAX_BYTES = MappingProxyType(
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
        "robot": 16 * 2**20,
        "robot asset": 256 * 2**20,
        "cloud of points": 16 * 2**30,
        "policy": 2**30,
        "checkpoint": 4 * 2**30,
        "leaderboard entry": 2**28,
        "record journal": 2**28,
    }
)
"""Largest size of a file of each kind, bytes; larger files are refused before they are read."""

_TEXTS = ("scene", "bank manifest", "recording index", "calibration", "trajectory", "settings", "leaderboard entry",
          "record journal")  # fmt: skip
_UNSAFE = re.compile(r'[/\\:*?"<>|\x00-\x1f\x7f\ud800-\udfff]')
_TEMPORARY = ".part"  # suffix of names that begin with a dot
_MAX_NAME_BYTES = 200  # file systems allow 255, suffixes and temporary names take some


def data_path(kind: str) -> Path:
    """Return the folder of the shipped ``"scenes"`` or ``"policies"``.

    In a checkout this is the checkout's own folder, so that an editable install never sees a stale copy; otherwise it
    is the package data of the wheel.
    """
    checkout = _PACKAGE.parent
    if (checkout / "pyproject.toml").is_file() and (checkout / _IN_CHECKOUT[kind]).is_dir():
        return checkout / _IN_CHECKOUT[kind]
    return _PACKAGE / f"_{kind}"


def checked_name(kind: str, name: str) -> str:
    """Return ``name`` if it is a valid file name on every system, else raise.

    Args:
        kind: Kind of object that has the name, for the message.
        name: One part of a path, without a suffix.

    Raises:
        InvalidValueError: The name is empty, too long, "." or "..", begins with a dot or ends with one or with a
            space, contains a separator, a control character or one of ``:*?"<>|``, or is "manifest", a bank's own file.
    """
    unsafe = _UNSAFE.search(name)
    if unsafe or not name or name[0] == "." or name[-1] in ". " or name.casefold() == "manifest":
        raise InvalidValueError(
            f"{kind} cannot be named {name[:80]!r}: expected a file's name without separators, control characters and "
            ':*?"<>|, without a dot in front, and not "manifest"'
        )
    if len(name.encode()) > _MAX_NAME_BYTES:
        raise InvalidValueError(f"{kind} cannot be named {name[:40]!r}...: longer than {_MAX_NAME_BYTES} bytes")
    return name


def resolved(path: str | Path) -> Path:
    """Return an absolute path without links; unlike ``Path.resolve``, a loop of links is no error here.

    Raises:
        InvalidValueError: The argument is no path.
    """
    try:
        return Path(os.path.realpath(Path(path)))
    except (TypeError, ValueError) as error:
        raise InvalidValueError(f"expected a path, got {reprlib.repr(path)} ({error})") from error


def inside(folder: str | Path, relative: str, named_in: object) -> Path:
    """Return the path of a file that another file names relative to a folder.

    Args:
        folder: Folder that must contain the file.
        relative: Path as the other file gives it.
        named_in: The other file, for the message.

    Raises:
        FileFormatError: The path is absolute or leaves the folder, also through a link.
    """
    path = Path(folder) / relative
    try:
        leaves = len(relative) > 1000 or Path(relative).is_absolute() or ".." in Path(relative).parts
        leaves = leaves or not path.resolve().is_relative_to(Path(folder).resolve())
    except (OSError, ValueError, RuntimeError) as error:  # a null character, a loop of links
        raise FileFormatError(named_in, f"names the file {relative[:200]!r}, which is not a path ({error})") from error
    if leaves:
        raise FileFormatError(named_in, f"names the file {relative[:200]!r}, which is not inside {folder}")
    return path


def read_bytes(path: str | Path, kind: str) -> bytes:
    """Return the content of a regular file no larger than the limit for its kind.

    Texts are returned as UTF-8 without a byte order mark, which some editors write; UTF-16 with one is converted.

    Args:
        path: The file; pipes, devices and folders are refused before they are read.
        kind: A key of `MAX_BYTES`.

    Raises:
        FileFormatError: The file is missing, unreadable, not a regular file, or too large.
    """
    try:
        with open(Path(path), "rb", opener=_without_waiting) as file:  # a number would be an open file, and closed
            status = os.fstat(file.fileno())
            readable = stat.S_ISREG(status.st_mode) and status.st_size <= MAX_BYTES[kind]
            content = file.read(status.st_size) if readable else b""
    except (OSError, ValueError, TypeError) as error:
        raise FileFormatError(path, f"cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if not stat.S_ISREG(status.st_mode):
        raise FileFormatError(path, "cannot be read (not a regular file)")
    if not readable:
        raise FileFormatError(path, f"too large for a {kind}: {status.st_size} bytes, at most {MAX_BYTES[kind]}")
    return _as_utf8(path, content) if kind in _TEXTS else content


def _as_utf8(path: str | Path, content: bytes) -> bytes:
    if not content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.removeprefix(codecs.BOM_UTF8)
    try:
        return content.decode("utf-16").encode()
    except UnicodeError as error:
        raise FileFormatError(path, f"begins as UTF-16, but is no such text ({error})") from error


def text_encoding(path: Path) -> str:
    """Return the encoding of a text file by its byte order mark; UTF-8 without one."""
    with path.open("rb") as file:
        return "utf-16" if file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "utf-8-sig"


def _without_waiting(path: str, flags: int) -> int:
    """Open a file without blocking, even where it is a pipe without a writer."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


@contextmanager
def parsing(path: object, kind: str) -> Iterator[None]:
    """Turn any error of a parser over damaged content into a `FileFormatError` that names the file.

    The errors cannot be listed: formats are read by libraries, and damage takes any form.
    """
    try:
        yield
    except (FileFormatError, MissingDependencyError):
        raise
    except ValidationError as error:
        raise FileFormatError(path, f"not a valid {kind}: {first_fault(error)}") from error
    except MemoryError as error:
        raise FileFormatError(path, f"more memory than there is would be needed to read this {kind}") from error
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":  # of Rust's
            raise
        what = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise FileFormatError(path, f"not a valid {kind}: {what}") from error


def first_fault(error: ValidationError) -> str:
    """Return one line with the first invalid field, the problem and the value found."""
    first = error.errors(include_url=False, include_context=False)[0]
    where = ".".join(map(str, first["loc"])) or "the file"
    if first["type"] == "value_error":  # raised by a class of ours, which says what it got
        return f"{where}: {first['msg'].removeprefix('Value error, ')}"
    return f"{where}: {first['msg']} (got {reprlib.repr(first['input'])})"


@contextmanager
def exclusive(folder: str | Path, parts: str = "", only: str = "", wait: bool = False) -> Iterator[None]:
    """Lock a folder, or a file in it, for this process; the folder is created if missing.

    The file ``.lock``, or ``.NAME.lock``, in it holds the number of the process and is locked meanwhile; the lock ends
    with the process, however that ends. Temporary files that a killed process left behind are removed.

    Args:
        folder: The folder.
        parts: Pattern of the subfolders that belong to it, such as ``"*/*/"``; others may have holders of their own.
        only: Name of the file to lock; the whole folder if empty.
        wait: True to wait while another process holds the lock.

    Raises:
        FileWriteError: The folder cannot be created or written, or another process holds it.
    """
    prefix = f".{only}." if only else "."
    path = Path(folder) / f"{prefix}lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file, held = _locked(path, wait)
    except OSError as error:
        raise FileWriteError(folder, error) from error
    with file:
        if not held:
            file.seek(0)
            holder = f": {text}" if (text := file.read(200)) else ""
            what = f"another process is at work {'on this file' if only else 'in this folder'}{holder}"
            raise FileWriteError(Path(folder) / only, OSError(what))
        try:
            file.truncate(0)
            file.write(f"process {os.getpid()}")
            file.flush()
            for leftover in (*path.parent.glob(f"{prefix}*{_TEMPORARY}"), *path.parent.glob(f"{parts}.*{_TEMPORARY}")):
                shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink(missing_ok=True)
            yield
        finally:
            path.unlink(missing_ok=True)


def _locked(path: Path, wait: bool) -> tuple[TextIO, bool]:
    """Open a lock file and try to lock it; return the file, and whether this process holds the lock."""
    while True:
        file = path.open("a+")
        try:
            _lock(file.fileno(), wait)
            held = path.stat().st_ino == os.fstat(file.fileno()).st_ino  # not removed by its last holder in between
        except OSError:
            held = False
        if held or not wait:
            return file, held
        file.close()


def _lock(handle: int, wait: bool) -> None:
    """Lock an open file; raise `OSError` where another process holds the lock."""
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(handle, msvcrt.LK_LOCK if wait else msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


def require_writable(path: str | Path) -> None:
    """Raise `FileWriteError` if a file could not be written there; call it before long work."""
    path = Path(path)
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        path.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise FileWriteError(path, error) from error


def write_atomically(path: str | Path, content: str | bytes) -> Path:
    """Write a file under a temporary name and rename it, so that readers see the old content or the new, never a part.

    Raises:
        FileWriteError: The file could not be written, for example because the disk is full.
    """
    path = Path(path)
    data = content.encode() if isinstance(content, str) else content
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(_TEMPORARY, f".{path.name}.", path.parent)
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


def remove_folder(folder: Path) -> None:
    """Remove a folder such that no part of it remains under its name if the process is killed meanwhile."""
    renamed = folder.with_name(f".{folder.name}{_TEMPORARY}")
    folder.rename(renamed)
    shutil.rmtree(renamed)
