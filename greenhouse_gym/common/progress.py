"""Progress of long work on standard error: a bar on a terminal, plain lines elsewhere; results on standard output."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Event, Lock, Thread
from time import perf_counter

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

CONSOLE = Console()
ERRORS = Console(stderr=True)

FIRST = 3.0
"""Seconds after which work is reported for the first time; work that is done earlier is not reported."""

_MAX_WAIT = 60.0  # seconds between two lines
_REFRESH = 0.2  # seconds between two updates of a bar


def say(text: str, style: str | None = None) -> None:
    """Print a line of results verbatim: brackets are not markup, and long paths are not wrapped."""
    CONSOLE.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def report(text: str) -> None:
    """Print a line about the course of some work, as `say` does, but on standard error and above the bars."""
    ERRORS.print(text, markup=False, highlight=False, soft_wrap=True)


@dataclass(eq=False)
class _Work:
    name: str
    total: int | None
    started: float
    done: int = 0
    note: str = ""

    def advance(self, done: int, note: str = "") -> None:
        self.done, self.note = done, note

    def __str__(self) -> str:
        count = f": {self.done:,}" if self.done or self.total is not None else ""
        of = "" if self.total is None else f" of {self.total:,}"
        note = f", {self.note}" if self.note else ""
        return f"{self.name}{count}{of}, {perf_counter() - self.started:.0f} s{note}"


_running: list[_Work] = []
"""Work in progress; where there are no bars, only the latest is reported."""


@contextmanager
def progress(name: str, total: int | None = None, shown: bool = True) -> Iterator[Callable[..., None]]:
    """Show the progress of work that takes more than `FIRST` seconds, even while no part of it ends.

    Work may be shown within other work, from several threads.

    Args:
        name: Name of its parts, or of the work if it has no parts.
        total: Number of its parts, if known.
        shown: False shows nothing.

    Yields:
        A callback that takes the number of finished parts and, optionally, a note on the latest.
    """
    work, ended = _Work(name, total, perf_counter()), Event()
    if not shown:
        yield work.advance
        return
    _running.append(work)
    reporter = Thread(target=_report_until, args=(work, ended), name=f"progress of {name}", daemon=True)
    reporter.start()
    try:
        yield work.advance
    finally:
        ended.set()
        reporter.join()
        _running.remove(work)


def _report_until(work: _Work, ended: Event) -> None:
    if ended.wait(FIRST):
        return
    if ERRORS.is_terminal:
        with _BARS.of(work) as update:
            while not ended.wait(_REFRESH):
                update()
        return
    reported = FIRST
    while True:
        if work is _running[-1]:
            report(str(work))
        if ended.wait(min(reported, _MAX_WAIT)):
            break
        reported = perf_counter() - work.started
    report(str(work))


class _Bars:
    """The bars of all work in progress: a terminal has room for one display."""

    def __init__(self) -> None:
        self._lock, self._shown = Lock(), 0
        self._display: Progress | None = None

    @contextmanager
    def of(self, work: _Work) -> Iterator[Callable[[], None]]:
        """Show the bar of some work; yield a function that updates it."""
        with self._lock:
            if self._display is None:
                self._display = Progress(
                    TextColumn("{task.description}"), BarColumn(20), MofNCompleteColumn(), TimeElapsedColumn(),
                    TimeRemainingColumn(), TextColumn("{task.fields[note]}"),
                    console=ERRORS, transient=True, redirect_stdout=CONSOLE.is_terminal,
                )  # fmt: skip
                self._display.start()
            display, self._shown = self._display, self._shown + 1
        task = display.add_task(work.name, total=work.total, note="")
        display.tasks[-1].start_time = display.get_time() - (perf_counter() - work.started)
        try:
            yield lambda: display.update(task, completed=work.done, note=work.note)
        finally:
            display.remove_task(task)
            with self._lock:
                self._shown -= 1
                if not self._shown:
                    display.stop()
                    self._display = None


_BARS = _Bars()
