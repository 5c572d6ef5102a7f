"""Scripts in a process of their own end with an error, whatever they do."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from greenhouse_gym.common import isolation
from greenhouse_gym.common.isolation import IsolatedError, isolated_output

LIMITED = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limits of memory and processor time")


def run(folder: Path, code: str, *arguments: str) -> bytes:
    (folder / "script.py").write_text(code)
    with isolated_output(folder / "script.py", [*arguments], seconds=1, memory=2**28) as output:
        return output.read()


def test_output_and_arguments(tmp_path: Path) -> None:
    code = "import sys, greenhouse_gym\nprint(__name__, *sys.argv[1:], sys.stdin.read(), end='')"
    assert run(tmp_path, code, "a b", "'") == b"__main__ a b ' "


@pytest.mark.parametrize(
    ("code", "problem", "kind"),
    [
        ("raise ValueError('no such\\nluck')", "luck", ""),
        ("raise ValueError('no luck')", "no luck", "ValueError"),
        ("class Panic(BaseException): pass\nraise Panic('a: b')", "a: b", "Panic"),
        ("raise SystemExit(3)", "without a message", ""),
        ("import os\nos.abort()", "signal 6", ""),
        ("import os\nos.kill(os.getpid(), 11)", "signal 11; it may take 1 s and 256 MiB", ""),
        pytest.param("while True: pass", "signal 24", "", marks=LIMITED),
        pytest.param("bytearray(2**29)", "MemoryError", "MemoryError", marks=LIMITED),
    ],
)
def test_failures_crashes_and_limits(tmp_path: Path, code: str, problem: str, kind: str) -> None:
    with pytest.raises(IsolatedError, match=problem) as error:
        run(tmp_path, code)
    if kind:
        assert error.value.kind == kind


def test_a_script_that_waits_forever_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isolation, "_SLOWEST", 0.5)
    with pytest.raises(IsolatedError, match=r"took longer than 0\.5 s"):
        run(tmp_path, "import time\ntime.sleep(1000)")
