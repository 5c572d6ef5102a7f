from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from greenhouse_gym.common import files as paths
from greenhouse_gym.common.files import data_path, exclusive, write_atomically
from greenhouse_gym.errors import FileWriteError


def test_write_makes_folders_and_returns_the_path(tmp_path: Path) -> None:
    path = write_atomically(tmp_path / "a" / "b" / "c.txt", "grün")
    assert path == tmp_path / "a" / "b" / "c.txt"
    assert path.read_bytes() == "grün".encode()
    assert write_atomically(path, b"\x00\xff").read_bytes() == b"\x00\xff"
    assert list(path.parent.iterdir()) == [path]


def test_a_failed_write_keeps_the_old_file_and_leaves_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_atomically(tmp_path / "file", "old")

    def fail(self: Path, target: Path) -> Path:
        raise OSError("disk full")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_an_interrupted_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_atomically(tmp_path / "file", "old")

    def interrupted(self: Path, mode: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "chmod", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_files_get_the_usual_permissions(tmp_path: Path) -> None:
    mask = os.umask(0o027)
    try:
        path = write_atomically(tmp_path / "file", "x")
    finally:
        os.umask(mask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


def test_the_checkout_comes_before_package_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "greenhouse_gym"
    monkeypatch.setattr(paths, "_PACKAGE", package)
    (tmp_path / "scenes").mkdir()
    assert data_path("scenes") == package / "_scenes"  # a folder called scenes alone is no checkout
    (tmp_path / "pyproject.toml").touch()
    assert data_path("scenes") == tmp_path / "scenes"
    assert data_path("policies") == package / "_policies"
    (tmp_path / "training" / "policies").mkdir(parents=True)
    assert data_path("policies") == tmp_path / "training" / "policies"


def test_one_process_at_a_time_works_in_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    with exclusive(folder):
        with (
            pytest.raises(FileWriteError, match=r"folder: cannot be written \(another process is at work"),
            exclusive(folder),
        ):
            pytest.fail("both are in")
        (folder / "result").touch()
    with exclusive(folder):
        assert (folder / "result").exists()
    assert [path.name for path in folder.iterdir()] == ["result"]


def test_a_lock_goes_with_its_process(tmp_path: Path) -> None:
    code = "import os, sys; from greenhouse_gym.common.files import exclusive\nwith exclusive(sys.argv[1]): os._exit(9)"
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert (tmp_path / ".lock").exists()
    with exclusive(tmp_path):
        pass
