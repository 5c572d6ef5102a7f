"""Size of the demo, and the report that it prints at its end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

from greenhouse_gym.common.progress import CONSOLE
from greenhouse_gym.common.tables import Table


@dataclass(frozen=True)
class DemoSettings:
    """Sizes of the stages of the demo."""

    length: float = 2.0  # m of row
    training_bank: str = "default"
    training_steps: int = 2_000_000  # a minute or two of one core
    episodes: int = 100  # per agent
    scene_width: float = 1.6  # m
    followed: int = 16  # plans followed in the true row
    step_limit: int | None = None  # of the episodes that are compared and filmed


QUICK = DemoSettings(
    length=0.4, training_bank="mini", training_steps=10_000, episodes=5, scene_width=0.4, followed=3, step_limit=40
)


@dataclass
class DemoReport:
    """Stages with their seconds and results, and figures by name."""

    stages: list[tuple[str, float, str]] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[list[str]]:
        """Time a stage; texts appended to the yielded list are printed as its result."""
        CONSOLE.rule(f"[bold]{name}", align="left")
        started, results = perf_counter(), list[str]()
        yield results
        self.stages.append((name, perf_counter() - started, ", ".join(results)))
        CONSOLE.print(self.stages[-1][2], highlight=False)

    def show(self) -> None:
        """Print all stages as a table."""
        rows = [(name, f"{seconds:.1f}", result) for name, seconds, result in self.stages]
        total = f"{sum(seconds for _, seconds, _ in self.stages):.1f}"
        Table(("stage", "seconds", "result"), [*rows, ("all", total, "")], words=(0, 2)).show("The demo")
