"""Progress of long work: nothing for quick work, lines without a terminal, results apart from it."""

from __future__ import annotations

import time

import pytest

from greenhouse_gym.common import progress as module
from greenhouse_gym.common.progress import progress, say


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FIRST", 0.05)


def test_quick_work_is_not_reported(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FIRST", 60.0)
    with progress("scenes", 3) as on_progress:
        on_progress(3)
    assert capsys.readouterr() == ("", "")


def test_work_is_reported_while_none_of_its_parts_ends(capsys: pytest.CaptureFixture[str]) -> None:
    with progress("scenes", 1200) as on_progress:
        time.sleep(0.3)
        on_progress(1200, "last one")
        say("a result")
    printed = capsys.readouterr()
    assert printed.out == "a result\n"
    lines = printed.err.splitlines()
    assert lines[0] == "scenes: 0 of 1,200, 0 s"
    assert lines[-1] == "scenes: 1,200 of 1,200, 0 s, last one"
    assert len(lines) < 8, "ever more rarely"


def test_work_without_parts_and_work_within_work(capsys: pytest.CaptureFixture[str]) -> None:
    with progress("outer", 2):
        with progress("inner"):
            time.sleep(0.3)
        with progress("hidden", 5, shown=False):
            time.sleep(0.1)
    lines = capsys.readouterr().err.splitlines()
    assert "inner, 0 s" in lines
    assert not [line for line in lines if "hidden" in line]
    first_inner = lines.index("inner, 0 s")
    assert all(line.startswith("inner") for line in lines[first_inner : first_inner + 2]), "only the innermost"


def test_an_error_ends_the_reports() -> None:
    with pytest.raises(KeyboardInterrupt), progress("scenes", 3):
        raise KeyboardInterrupt
    assert not module._running
