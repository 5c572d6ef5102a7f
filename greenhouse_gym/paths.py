"""Where the shipped data lies, and how files are written: to a temporary name, then renamed."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

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
    """Write a file so that a reader sees the old content or the new, never a part: temporary name, then rename."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    data = content.encode() if isinstance(content, str) else content
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        umask = os.umask(0)
        os.umask(umask)
        Path(temporary).chmod(0o666 & ~umask)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    return path
