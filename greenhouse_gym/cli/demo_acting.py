"""The stages of the demo from the shapes to agents that reach tomatoes, each with its pictures and figures."""

from __future__ import annotations

import csv
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import typer

from greenhouse_gym.cli.demo_report import DemoSettings, Report
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.common.progress import progress

if TYPE_CHECKING:
    from greenhouse_gym.capture import Recording
    from greenhouse_gym.evaluation import Evaluation
    from greenhouse_gym.reconstruction import RowCloud
    from greenhouse_gym.scene import Scene, SceneBank, Target
    from greenhouse_gym.shapes import RowShapes


def build(
    out: Path, recording: Recording, cloud: RowCloud, shapes: RowShapes, demo_settings: DemoSettings, report: Report
) -> SceneBank:
    """Cut two scenes out of the row and certify their tomatoes; both are for training."""
    from greenhouse_gym.build.scenes import BuildSettings, cut_scenes
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


def plan_to_every_tomato(out: Path, bank: SceneBank, report: Report) -> None:
    """Plan to each tomato in the reconstruction, and follow each path there."""
    from greenhouse_gym.agents import PlannerAgent
    from greenhouse_gym.evaluation import evaluate

    with report.stage("plan to every tomato, follow each path") as results:
        problems = [(scene.name, k) for scene in bank for k in range(len(scene.tomatoes))]
        # the world it acts in is the reconstruction, in which nothing stands where nothing was seen
        planner = PlannerAgent("RRTConnect", unknown="free")
        evaluation = evaluate(planner, "train", problems=problems, bank=str(bank.path))
        with_goal = [r for r in evaluation.records if r.status != "no_goal"]
        reached = sum(r.success for r in with_goal)
        share = reached / max(len(with_goal), 1)
        results.append(f"{reached} of {len(with_goal)} tomatoes with a goal configuration reached ({share:.1%})")
        report.figures |= {"targets_with_goal": len(with_goal), "targets_reached": reached}


def follow_in_the_true_row(bank: SceneBank, settings: DemoSettings, report: Report) -> None:
    """Plan with unknown space closed, and follow some of the plans in the row that was grown."""
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


def draw_the_arm(out: Path, recording: Recording, cloud: RowCloud, bank: SceneBank, report: Report) -> None:
    """Draw the arm at the start and at the end of a witness, and the overview of the whole chain."""
    from greenhouse_gym.planning import resample
    from greenhouse_gym.rendering.task_pictures import picture_of_path
    from greenhouse_gym.reporting.pictures import overview, save, splat, upright
    from greenhouse_gym.robots import get_robot

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


def train(out: Path, seed: int, settings: DemoSettings, report: Report) -> list[dict[str, str]]:
    """Train the shipped policy on in the scenes; the lines of its learning curve."""
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


def compare_agents(out: Path, seed: int, settings: DemoSettings, report: Report) -> tuple[Evaluation, ...]:
    """Have a planner, the policy and a random agent play the same episodes."""
    from greenhouse_gym.agents import Agent, PlannerAgent, PolicyAgent, RandomAgent
    from greenhouse_gym.evaluation import compare, comparison_table

    with report.stage("planner, policy and random agent on the same episodes") as results:
        policy = PolicyAgent.load(out / "ppo" / "policy.json")
        agents: list[Agent] = [PlannerAgent("RRTConnect", unknown="free"), policy, RandomAgent()]
        evaluations = compare(agents, "train", settings.episodes, seed + 1_000_000, bank=str(out / "bank"))
        table = comparison_table(evaluations)
        typer.echo(table)
        write_atomically(out / "comparison.md", table)
        for name, evaluation in zip(("planner", "policy", "random"), evaluations, strict=True):
            results.append(f"{name} {evaluation.success_rate:.0%}")
            report.figures[f"{name}_success"] = evaluation.success_rate
            report.figures[f"{name}_collision"] = evaluation.collision_rate
    return evaluations
