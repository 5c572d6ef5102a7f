"""The command demo: a simulated row becomes a bank, and planners and a policy reach its tomatoes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer

from greenhouse_gym.common.extras import require_extras
from greenhouse_gym.common.files import exclusive, write_atomically
from greenhouse_gym.common.progress import CONSOLE, say
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


def demo(
    out: Annotated[Path, typer.Option(help="Folder for pictures and results.")] = Path("demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of all stages.")] = 1,
    quick: Annotated[bool, typer.Option("--quick", help="Run a much smaller demo, as the tests do.")] = False,
) -> None:
    """Simulate a row, reconstruct it, build a bank, plan, train, compare; about four minutes on two cores."""
    run_demo(out, seed, QUICK if quick else DemoSettings())


def run_demo(out: Path, seed: int, settings: DemoSettings) -> DemoReport:
    """Run the demo; pictures and ``results.json`` go to ``out``."""
    require_extras("reconstruct", "plan", "train", "viz", "warp")
    with exclusive(out):
        return _run(out, seed, settings)


def _run(out: Path, seed: int, settings: DemoSettings) -> DemoReport:
    from greenhouse_gym.cli.demo_acting import (
        build,
        compare_agents,
        draw_the_arm,
        follow_in_the_true_row,
        plan_to_every_tomato,
        train,
    )
    from greenhouse_gym.cli.demo_sensing import extract, reconstruct, simulate
    from greenhouse_gym.reporting.plots import training_curve

    report = DemoReport()
    row, recording = simulate(out, seed, settings, report)
    cloud = reconstruct(out, row, recording, report)
    shapes = extract(out, row, recording, cloud, report)
    bank = build(out, recording, cloud, shapes, settings, report)
    plan_to_every_tomato(bank, report)
    follow_in_the_true_row(bank, settings, report)
    draw_the_arm(out, recording, cloud, bank, report)
    curve = train(out, seed, settings, report)
    evaluations = compare_agents(out, seed, settings, report)
    with report.stage("training curve") as results:
        random_rate = evaluations[-1].success_rate
        steps, success = ([float(point[key]) for point in curve] for key in ("steps", "success_rate"))
        results.append(str(training_curve(steps, success, random_rate, out / "11-training-curve.png")))
    report.show()
    report.figures["seconds"] = {name: round(seconds, 1) for name, seconds, _ in report.stages}
    write_atomically(out / "results.json", json.dumps(report.figures, indent=1) + "\n")
    say(f"pictures and results.json in {out}")
    return report
