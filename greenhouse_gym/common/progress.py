"""Progress of long work: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

CONSOLE = Console()
_SECONDS_BETWEEN_LINES = 10.0


def say(text: str, style: str | None = None) -> None:
    """Print a line verbatim: brackets are not markup, and long paths are not wrapped."""
    CONSOLE.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def progress(name: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show the progress of some work.

    Args:
        name: Name of its parts.
        total: Number of its parts.

    Yields:
        A callback that takes the number of finished parts.
    """
    if CONSOLE.is_terminal:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        with Progress(*columns, TimeRemainingColumn(), console=CONSOLE, transient=True) as bars:
            task = bars.add_task(name, total=total)
            yield lambda done: bars.update(task, completed=done)
        return
    started = last = perf_counter()

    def report(done: int) -> None:
        nonlocal last
        now = perf_counter()
        if done >= total or now - last >= _SECONDS_BETWEEN_LINES:
            last = now
            say(f"{name}: {done} of {total}, {now - started:.0f} s")

    yield report
