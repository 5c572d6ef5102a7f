"""Commands that are killed in the midst of their work, each forked from a process that has imported everything."""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

_SERVER = """
import json, os, signal, sys, tempfile
sys.path[:] = json.loads(sys.argv[1])
from greenhouse_gym.cli.main import main
exec(sys.argv[3])

def fill_disk_after(files):
    make, left = tempfile.mkstemp, [files]
    def mkstemp(*given):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(28, "No space left on device")
        return make(*given)
    tempfile.mkstemp = mkstemp

for line in sys.stdin:
    arguments, seconds, files = json.loads(line)
    pid = os.fork()
    if not pid:
        log = os.open("/dev/null" if seconds else sys.argv[2], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(log, 1), os.dup2(log, 2), os.dup2(os.open("/dev/null", os.O_RDONLY), 0)
        sys.argv[1:] = arguments
        if files is not None:
            fill_disk_after(files)
        signal.setitimer(signal.ITIMER_PROF, seconds)  # unhandled, its signal ends the process at once
        code = 0
        try:
            main()
        except SystemExit as end:
            code = end.code or 0
        os._exit(code if isinstance(code, int) else 1)
    _, status, used = os.wait4(pid, 0)
    print(json.dumps([os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime]), flush=True)
"""
_ALL = """
import cv2, mujoco, numba, torch, stable_baselines3, safetensors.torch, minari
from greenhouse_gym.common.open3d_loader import open3d
open3d()
from greenhouse_gym.learning.training_run import TrainingReport
TrainingReport.checkpoint_seconds = property(lambda self: 0.2, lambda self, seconds: None)
"""
_TIMES = re.compile(r'"(seconds|created|\w*_time|\w*_seconds)": ?(\[[^\]]*\]|\{[^}]*\}|[^,}\]]*)')


class Ended(NamedTuple):
    """Exit status of a command, negative after a signal; its processor time, seconds; and what it printed."""

    status: int
    seconds: float
    printed: str


class Commands:
    """Runs commands; use it in a ``with`` block.

    Args:
        folder: Working folder.
        imported: Code that imports what commands take long to import.
    """

    def __init__(self, folder: Path, imported: str = _ALL):
        self._log = folder / "printed.txt"
        arguments = [sys.executable, "-c", _SERVER, json.dumps(sys.path), str(self._log), imported]
        self._server = subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=folder)

    def __enter__(self) -> Commands:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.communicate()

    def run(self, *arguments: object, killed_after: float = 0.0, room: int | None = None) -> Ended:
        """Run a command.

        Args:
            *arguments: Its words.
            killed_after: Processor time, seconds, after which it is killed; zero for never.
            room: Number of files after which the disk is full.
        """
        assert self._server.stdin
        assert self._server.stdout
        self._server.stdin.write(json.dumps([[str(each) for each in arguments], killed_after, room]) + "\n")
        self._server.stdin.flush()
        status, seconds = json.loads(self._server.stdout.readline())
        return Ended(status, seconds, self._log.read_text() if self._log.exists() else "")


def contents(folder: Path, but: Sequence[str] = ()) -> dict[str, str]:
    """Return checksums of the files below a folder by their paths, without times.

    Args:
        folder: The folder.
        but: Parts of the names of files that are left out.
    """
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not any(part in path.name for part in but):
            content = path.read_bytes()
            if path.suffix == ".npz":
                with np.load(path) as arrays:
                    content = b"".join(arrays[name].tobytes() for name in arrays.files if name != "report")
            if path.suffix in (".json", ".jsonl"):
                content = _TIMES.sub("", content.decode()).encode()
            found[os.fspath(path.relative_to(folder))] = hashlib.sha256(content).hexdigest()
    return found
