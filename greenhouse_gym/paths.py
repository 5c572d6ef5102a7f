"""Where the shipped data lies, and how files are written: to a temporary name, then renamed."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from greenhouse_gym.errors import FileWriteError

_PACKAGE = Path(__file__).resolve().parent
_IN_CHECKOUT = {"scenes": Path("scenes"), "policies": Path("training/policies")}


def data_path(kind: str) -> Path:
    """The folder of shipped ``"scenes"`` or ``"policies"``.

    A checkout's own folder comes first, so that an editable install sees the checkout and never a stale copy;
    otherwise the package data of the wheel.
    """
    checkout = _PACKAGE.parent
    if (checkout / "pyproject.toml").is_file() and (checkout / _IN_CHECKOUT[kind]).is_dir():
        return checkout / _IN_CHECKOUT[kind]
    return _PACKAGE / f"_{kind}"


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
