"""The command demo: a simulated row becomes a bank, and planners and a policy reach its tomatoes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from greenhouse_gym.cli.demo_acting import (
    build,
    compare_agents,
    draw_the_arm,
    follow_in_the_true_row,
    plan_to_every_tomato,
    train,
)
from greenhouse_gym.cli.demo_report import QUICK, DemoReport, DemoSettings
from greenhouse_gym.cli.demo_sensing import extract, reconstruct, simulate
from greenhouse_gym.common.extras import require_extras
from greenhouse_gym.common.files import exclusive, write_atomically
from greenhouse_gym.common.progress import say


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
        from greenhouse_gym.reporting.plots import training_curve

        random_rate = evaluations[-1].success_rate
        steps, success = ([float(point[key]) for point in curve] for key in ("steps", "success_rate"))
        results.append(str(training_curve(steps, success, random_rate, out / "11-training-curve.png")))
    report.show()
    report.figures["seconds"] = {name: round(seconds, 1) for name, seconds, _ in report.stages}
    write_atomically(out / "results.json", json.dumps(report.figures, indent=1) + "\n")
    say(f"pictures and results.json in {out}")
    return report
