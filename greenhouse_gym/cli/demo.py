"""The main job from end to end: a simulated row becomes a bank, planners and a policy reach its tomatoes."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.table import Table

from greenhouse_gym.extras import require_extras
from greenhouse_gym.paths import exclusive, write_atomically
from greenhouse_gym.progress import CONSOLE, progress, say

if TYPE_CHECKING:
    from greenhouse_gym.capture import Recording
    from greenhouse_gym.evaluation import Evaluation
    from greenhouse_gym.plants import PlantRow
    from greenhouse_gym.reconstruction import RowCloud
    from greenhouse_gym.scene import Scene, SceneBank, Target
    from greenhouse_gym.shapes import RowShapes


@dataclass(frozen=True)
class DemoSettings:
    """How large the demo is."""

    length: float = 2.0  # m of row
    training_steps: int = 100_000  # from the shipped policy on, about two minutes of one core
    episodes: int = 100  # per agent
    scene_width: float = 1.6  # m
    followed: int = 16  # plans followed in the true row


QUICK = DemoSettings(length=0.6, training_steps=10_000, episodes=5, scene_width=0.4, followed=3)


@dataclass
class Report:
    """What the demo prints at its end: stages with their seconds, and figures."""

    stages: list[tuple[str, float, str]] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[list[str]]:
        """Time a stage; what is appended to the list it yields is printed as its result."""
        CONSOLE.rule(f"[bold]{name}", align="left")
        started, results = perf_counter(), list[str]()
        yield results
        self.stages.append((name, perf_counter() - started, ", ".join(results)))
        CONSOLE.print(self.stages[-1][2], highlight=False)

    def table(self) -> Table:
        """All stages as a table."""
        table = Table("stage", "seconds", "result", title="The demo")
        for name, seconds, result in self.stages:
            table.add_row(name, f"{seconds:.1f}", result)
        table.add_row("all", f"{sum(seconds for _, seconds, _ in self.stages):.1f}", "")
        return table


def demo(
    out: Annotated[Path, typer.Option(help="Folder for pictures and results.")] = Path("demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything.")] = 1,
    quick: Annotated[bool, typer.Option("--quick", help="Make a much smaller run, as the tests do.")] = False,
) -> None:
    """Simulate a row, reconstruct it, build a bank, plan, train, compare; about five minutes on two cores."""
    run_demo(out, seed, QUICK if quick else DemoSettings())


def run_demo(out: Path, seed: int, settings: DemoSettings) -> Report:
    """Run the demo; pictures and ``results.json`` go to ``out``."""
    require_extras("reconstruct", "plan", "train", "viz")
    with exclusive(out):
        return _run(out, seed, settings)


def _run(out: Path, seed: int, settings: DemoSettings) -> Report:
    report = Report()
    row, recording = _simulate(out, seed, settings, report)
    cloud = _reconstruct(out, row, recording, report)
    shapes = _extract(out, row, recording, cloud, report)
    bank = _build(out, recording, cloud, shapes, settings, report)
    _plan_to_every_tomato(out, bank, report)
    _follow_in_the_true_row(bank, settings, report)
    _draw_the_arm(out, recording, cloud, bank, report)
    curve = _train(out, seed, settings, report)
    evaluations = _compare(out, seed, settings, report)
    with report.stage("training curve") as results:
        from greenhouse_gym.reporting.pictures import training_curve

        random_rate = evaluations[-1].success_rate
        steps, success = ([float(point[key]) for point in curve] for key in ("steps", "success_rate"))
        results.append(str(training_curve(steps, success, random_rate, out / "11-training-curve.png")))
    CONSOLE.print(report.table())
    report.figures["seconds"] = {name: round(seconds, 1) for name, seconds, _ in report.stages}
    write_atomically(out / "results.json", json.dumps(report.figures, indent=1) + "\n")
    say(f"pictures and results.json in {out}")
    return report


def _simulate(out: Path, seed: int, settings: DemoSettings, report: Report) -> tuple[PlantRow, Recording]:
    from greenhouse_gym.capture import open_recording, simulate_recording, write_recording
    from greenhouse_gym.capture.recordings import INDEX
    from greenhouse_gym.plants import grow_row

    with report.stage("simulate a row") as results:
        row = grow_row(seed, settings.length)
        simulated = simulate_recording(row, seed)
        (out / "recording" / INDEX).unlink(missing_ok=True)  # an earlier demo's
        with progress("stations", len(simulated)) as done:
            write_recording(simulated, out / "recording", lambda i: done(i + 1))
        results += [f"{settings.length:g} m", f"{len(simulated)} stations", f"{len(row.tomatoes)} tomatoes grown"]
    return row, open_recording(out / "recording")


def _reconstruct(out: Path, row: PlantRow, recording: Recording, report: Report) -> RowCloud:
    from greenhouse_gym.accuracy import distance_to_truth, drift
    from greenhouse_gym.reconstruction import ReconstructionSettings, save_row, simplify_points, triangulate
    from greenhouse_gym.reconstruction.row import merge_segment, remove_outliers
    from greenhouse_gym.reconstruction.walk import walk_through
    from greenhouse_gym.reporting.pictures import registration_pictures, row_pictures

    settings = ReconstructionSettings()
    with report.stage("reconstruct") as results:
        with progress("stations", len(recording)) as done:
            walk = walk_through(recording, settings, lambda i: done(i + 1))
        merged, outlier = merge_segment(walk, 0, settings)
        cloud = remove_outliers(merged, outlier)
        few = simplify_points(cloud)
        mesh = triangulate(few)
        save_row(cloud, out / "row.npz")
        results += [
            f"{cloud.registered.sum()} of {len(cloud.registered)} stations registered",
            f"{len(cloud)} points, simplified to {len(few)}, {len(mesh.triangles)} faces",
        ]
    with report.stage("pictures of the reconstruction") as results:
        middle = len(recording) // 2
        paths = registration_pictures(recording, middle - 1, middle, walk.calibration, settings, out)
        paths += row_pictures(merged, cloud, mesh, out)
        results.append(f"{len(paths)} pictures")
    with report.stage("compare with the truth") as results:
        poses = true_poses(recording)
        error = drift(cloud, poses)
        first = int(np.flatnonzero(cloud.registered)[0])
        distance = distance_to_truth(cloud, row, poses[first])
        results += [
            f"drift {error.share:.2%} of {error.length:.2f} m",
            f"cloud to truth {1e3 * distance.mean():.1f} mm mean, {1e3 * np.quantile(distance, 0.95):.1f} mm at 95 %",
        ]
        report.figures |= {
            "stations": len(cloud.registered),
            "stations_registered": int(cloud.registered.sum()),
            "drift": error.share,
            "cloud_to_truth_mean": float(distance.mean()),
            "cloud_to_truth_95": float(np.quantile(distance, 0.95)),
            "points": len(cloud),
            "simplified_points": len(few),
            "faces": len(mesh.triangles),
        }
    return cloud


def true_poses(recording: Recording) -> np.ndarray[Any, np.dtype[np.float64]]:
    """True poses (stations, 4, 4) of a simulated recording, NaN where a station has none."""
    poses = [station.world_from_station for station in recording]
    return np.array([np.full((4, 4), np.nan) if pose is None else pose for pose in poses])


def _extract(out: Path, row: PlantRow, recording: Recording, cloud: RowCloud, report: Report) -> RowShapes:
    from greenhouse_gym.accuracy import match_tomatoes, visible_tomatoes
    from greenhouse_gym.geometry import invert, transform
    from greenhouse_gym.reporting.overlay import shapes_over_photograph
    from greenhouse_gym.reporting.pictures import save, upright
    from greenhouse_gym.shapes import extract_shapes

    with report.stage("extract shapes") as results:
        shapes = extract_shapes(cloud.points, cloud.colors, cloud.normals)
        results.append(f"{len(shapes.tomatoes)} tomatoes, {len(shapes.stems)} stems, {len(shapes.clutter)} boxes")
        registered = np.flatnonzero(cloud.registered)
        picture = shapes_over_photograph(recording, cloud, shapes, int(registered[len(registered) // 2]))
        save(upright(picture), out / "12-shapes-over-photograph.png")
    with report.stage("count the visible tomatoes") as results:
        poses = true_poses(recording)
        visible = visible_tomatoes(row, recording.rig, poses)
        first_from_world = invert(poses[int(np.flatnonzero(cloud.registered)[0])])
        centers = transform(first_from_world, np.array([t.center for t in row.tomatoes]))
        true = [replace(tomato, center=center) for tomato, center in zip(row.tomatoes, centers, strict=True)]
        matches = match_tomatoes(true, shapes.tomatoes)
        found = int(visible[matches.true].sum())
        false = len(shapes.tomatoes) - len(matches.found)
        results += [
            f"{found} of {visible.sum()} visible tomatoes found ({found / max(visible.sum(), 1):.0%}), {false} false",
            f"center {1e3 * np.median(matches.center_errors):.1f} mm",
            f"diameter {np.median(matches.diameter_errors):.1%}",
        ]
        report.figures |= {
            "visible_tomatoes": int(visible.sum()),
            "visible_tomatoes_found": found,
            "false_tomatoes": false,
            "center_error_median": float(np.median(matches.center_errors)),
            "diameter_error_median": float(np.median(matches.diameter_errors)),
        }
    return shapes


def _build(
    out: Path, recording: Recording, cloud: RowCloud, shapes: RowShapes, demo_settings: DemoSettings, report: Report
) -> SceneBank:
    from greenhouse_gym.cutting import BuildSettings, cut_scenes
    from greenhouse_gym.planning import certify_targets
    from greenhouse_gym.scene.bank import write_bank

    with report.stage("build a bank of two scenes, both for training") as results:
        walked = np.ptp(cloud.world_from_station[cloud.registered][:, 1, 3])
        settings = BuildSettings(spacing=float(walked) / 2.01, width=demo_settings.scene_width)  # two stands
        scenes = cut_scenes(cloud, shapes, recording, 0, settings)
        certified = []
        with progress("scenes certified", len(scenes)) as done:
            for scene in scenes:
                certified.append(scene.model_copy(update={"targets": certify_targets(scene)}))
                done(len(certified))
        bank = write_bank(out / "bank", [(scene, "train") for scene in certified], name="demo")
        counts = {d: sum(t.difficulty == d for s in bank for t in s.targets) for d in ("easy", "medium", "hard")}
        targets = sum(len(scene.targets) for scene in bank)
        results += [f"{targets} targets", *(f"{count} {difficulty}" for difficulty, count in counts.items())]
        report.figures |= {"scenes": len(bank), "targets": targets, **counts}
    return bank


def _plan_to_every_tomato(out: Path, bank: SceneBank, report: Report) -> None:
    from greenhouse_gym.agents import PlannerAgent
    from greenhouse_gym.evaluation import evaluate

    with report.stage("plan to every tomato, follow each path") as results:
        problems = [(scene.name, k) for scene in bank for k in range(len(scene.tomatoes))]
        # the world it acts in is the reconstruction, in which nothing stands where nothing was seen
        planner = PlannerAgent("RRTConnect", unseen="free")
        evaluation = evaluate(planner, "train", problems=problems, bank=str(bank.path))
        with_goal = [r for r in evaluation.records if r.status != "no_goal"]
        reached = sum(r.success for r in with_goal)
        share = reached / max(len(with_goal), 1)
        results.append(f"{reached} of {len(with_goal)} tomatoes with a goal configuration reached ({share:.1%})")
        report.figures |= {"targets_with_goal": len(with_goal), "targets_reached": reached}


def _follow_in_the_true_row(bank: SceneBank, settings: DemoSettings, report: Report) -> None:
    from greenhouse_gym.agents import PlannerAgent
    from greenhouse_gym.evaluation import evaluate

    with report.stage("plan with care for what was not seen, follow in the true row") as results:
        problems = [(scene.name, target.tomato) for scene in bank for target in scene.targets if target.witness]
        chosen = np.linspace(0, len(problems) - 1, min(settings.followed, len(problems))).round().astype(int)
        planner = PlannerAgent("RRTConnect", time_limit=None, max_checks=10_000)
        tried = [problems[k] for k in chosen]
        evaluation = evaluate(planner, "train", problems=tried, bank=str(bank.path), physics="truth", start="folded")
        planned = [r for r in evaluation.records if r.status == "solved"]
        held, refused = sum(r.success for r in planned), len(evaluation.records) - len(planned)
        results.append(f"{held} of {len(planned)} held in the true row, {refused} refused")
        report.figures |= {"plans_followed_in_truth": len(planned), "held_in_truth": held, "refused": refused}


def _draw_the_arm(out: Path, recording: Recording, cloud: RowCloud, bank: SceneBank, report: Report) -> None:
    from greenhouse_gym.planning import resample
    from greenhouse_gym.reporting.pictures import overview, save, splat, upright
    from greenhouse_gym.robots import get_robot
    from greenhouse_gym.scene.task_pictures import picture_of_path

    with report.stage("pictures of the arm") as results:
        scene, target = _showpiece(bank)
        path = np.array(scene.targets[target].witness or [get_robot("ur5e").start])
        pictures = {"9-arm-at-start": path[:1], "10-arm-at-target": resample(path, 0.03)}
        for name, joints in pictures.items():
            image = picture_of_path(scene, "ur5e", target, joints, width=960, height=720)
            save(image, out / f"{name}.png")
        station = recording[scene.provenance.station or 0]
        photograph = upright(station.frames[recording.rig.reference].color)
        overview(photograph, splat(cloud.points, cloud.colors), image, out / "0-overview.png")
        results.append(f"{scene.name}, tomato {target}")


def _showpiece(bank: SceneBank) -> tuple[Scene, int]:
    """A scene and a target worth a picture: the ripest tomato that can be reached and that the arm does not hide."""

    def worth(pair: tuple[Scene, Target]) -> tuple[bool, bool, float]:
        scene, target = pair
        tomato = scene.tomatoes[target.tomato]
        camera_side = bool(tomato.center[1] < -0.2)
        return target.witness is not None, camera_side, tomato.ripeness or 0.0

    scene, target = max(((scene, target) for scene in bank for target in scene.targets), key=worth)
    return scene, target.tomato


def _train(out: Path, seed: int, settings: DemoSettings, report: Report) -> list[dict[str, str]]:
    from greenhouse_gym.agents.policy_agent import BEST, PolicyAgent
    from greenhouse_gym.learning import FINE_TUNING, load_into, train_ppo

    with report.stage("train the shipped policy on with PPO") as results:
        shutil.rmtree(out / "ppo", ignore_errors=True)  # an earlier demo's
        # Steps and not seconds, so that a busy machine gives the same policy, only later.
        ppo = replace(
            FINE_TUNING, bank=str(out / "bank"), total_steps=settings.training_steps, seed=seed, critic_rollouts=3
        )
        train_ppo(ppo, out / "ppo", prepare=lambda model: load_into(model, PolicyAgent.load(BEST).policy))
        curve = list(csv.DictReader((out / "ppo" / "curve.csv").read_text().splitlines()))
        results.append(f"{int(float(curve[-1]['steps'])):,} steps")
        report.figures["training_steps"] = int(float(curve[-1]["steps"]))
    return curve


def _compare(out: Path, seed: int, settings: DemoSettings, report: Report) -> tuple[Evaluation, ...]:
    from greenhouse_gym.agents import Agent, PlannerAgent, PolicyAgent, RandomAgent
    from greenhouse_gym.evaluation import compare, comparison_table

    with report.stage("planner, policy and random agent on the same episodes") as results:
        policy = PolicyAgent.load(out / "ppo" / "policy.json")
        agents: list[Agent] = [PlannerAgent("RRTConnect", unseen="free"), policy, RandomAgent()]
        evaluations = compare(agents, "train", settings.episodes, seed + 1_000_000, bank=str(out / "bank"))
        table = comparison_table(evaluations)
        typer.echo(table)
        write_atomically(out / "comparison.md", table)
        for name, evaluation in zip(("planner", "policy", "random"), evaluations, strict=True):
            results.append(f"{name} {evaluation.success_rate:.0%}")
            report.figures[f"{name}_success"] = evaluation.success_rate
            report.figures[f"{name}_collision"] = evaluation.collision_rate
    return evaluations
