"""Stages of the demo from the shapes to agents that reach tomatoes, each with its pictures and figures."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from greenhouse_gym.cli.demo import DemoReport, DemoSettings
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.common.progress import progress

if TYPE_CHECKING:
    from greenhouse_gym.capture import Recording
    from greenhouse_gym.evaluation import Evaluation
    from greenhouse_gym.reconstruction import RowCloud
    from greenhouse_gym.scene import Scene, SceneBank, Target
    from greenhouse_gym.shapes import RowShapes


def build(
    out: Path, recording: Recording, cloud: RowCloud, shapes: RowShapes, demo_settings: DemoSettings, report: DemoReport
) -> SceneBank:
    """Cut two scenes out of the row and certify their tomatoes; nothing is trained on them."""
    from greenhouse_gym.build.scenes import BuildSettings, cut_scenes
    from greenhouse_gym.planning import certify_targets
    from greenhouse_gym.scene.bank import write_bank

    with report.stage("build a bank of two scenes") as results:
        walked = np.ptp(cloud.world_from_station[cloud.registered][:, 1, 3])
        settings = BuildSettings(spacing=float(walked) / 2.01, width=demo_settings.scene_width)  # two stands
        scenes = cut_scenes(cloud, shapes, recording, 0, settings)
        certified = []
        with progress("scenes certified", len(scenes)) as on_progress:
            for scene in scenes:
                certified.append(scene.model_copy(update={"targets": certify_targets(scene)}))
                on_progress(len(certified))
        bank = write_bank(out / "bank", [(scene, "test") for scene in certified], name="demo")
        counts = {d: sum(t.difficulty == d for s in bank for t in s.targets) for d in ("easy", "medium", "hard")}
        targets = sum(len(scene.targets) for scene in bank)
        results += [f"{targets} targets", *(f"{count} {difficulty}" for difficulty, count in counts.items())]
        report.figures |= {"scenes": len(bank), "targets": targets, **counts}
    return bank


def plan_to_every_tomato(bank: SceneBank, report: DemoReport) -> None:
    """Plan to each tomato in the reconstruction, and follow each path."""
    from greenhouse_gym.agents import PlannerAgent
    from greenhouse_gym.evaluation import evaluate

    with report.stage("plan to every tomato, follow each path") as results:
        problems = [(scene.name, k) for scene in bank for k in range(len(scene.tomatoes))]
        # the plan is followed in the reconstruction, where unknown space is empty
        planner = PlannerAgent("RRTConnect", unknown="free")
        evaluation = evaluate(planner, "test", problems=problems, bank=str(bank.path))
        with_goal = [r for r in evaluation.records if r.status != "no_goal"]
        reached = sum(r.success for r in with_goal)
        rate = reached / max(len(with_goal), 1)
        results.append(f"{reached} of {len(with_goal)} tomatoes with a goal configuration reached ({rate:.1%})")
        report.figures |= {"targets_with_goal": len(with_goal), "targets_reached": reached}


def follow_in_the_true_row(bank: SceneBank, settings: DemoSettings, report: DemoReport) -> None:
    """Plan with unknown space closed, and follow some of the plans in the true row."""
    from greenhouse_gym.agents import PlannerAgent
    from greenhouse_gym.evaluation import evaluate

    with report.stage("plan around unknown space, follow in the true row") as results:
        problems = [(scene.name, target.tomato) for scene in bank for target in scene.targets if target.witness]
        chosen = np.linspace(0, len(problems) - 1, min(settings.followed, len(problems))).round().astype(int)
        planner = PlannerAgent("RRTConnect", time_limit=None, max_checks=10_000)
        selected = [problems[k] for k in chosen]
        evaluation = evaluate(planner, "test", problems=selected, bank=str(bank.path), physics="truth", start="folded")
        planned = [r for r in evaluation.records if r.status == "solved"]
        succeeded, refused = sum(r.success for r in planned), len(evaluation.records) - len(planned)
        results.append(f"{succeeded} of {len(planned)} succeeded in the true row, {refused} refused")
        report.figures |= {"plans_followed_in_truth": len(planned), "held_in_truth": succeeded, "refused": refused}


def draw_the_arm(out: Path, recording: Recording, cloud: RowCloud, bank: SceneBank, report: DemoReport) -> None:
    """Draw the arm at the start and at the end of a witness, and the whole pipeline in one picture."""
    from greenhouse_gym.planning import resample
    from greenhouse_gym.rendering.picture_files import write_picture
    from greenhouse_gym.rendering.task_pictures import picture_of_path
    from greenhouse_gym.reporting.pictures import save_pipeline, splat, upright
    from greenhouse_gym.robots import get_robot

    with report.stage("pictures of the arm") as results:
        scene, target = _showpiece(bank)
        path = np.array(scene.targets[target].witness or [get_robot("ur5e").start])
        pictures = {"9-arm-at-start": path[:1], "10-arm-at-target": resample(path, 0.03)}
        for name, joints in pictures.items():
            image = picture_of_path(scene, "ur5e", target, joints, width=960, height=720)
            write_picture(image, out / f"{name}.png")
        station = recording[scene.provenance.station or 0]
        photograph = upright(station.frames[recording.rig.reference].color)
        save_pipeline(photograph, splat(cloud.points, cloud.colors), image, out / "0-overview.png")
        results.append(f"{scene.name}, tomato {target}")


def _showpiece(bank: SceneBank) -> tuple[Scene, int]:
    """Choose a scene and a target for a picture: the ripest reachable tomato that the arm does not hide."""

    def rank(pair: tuple[Scene, Target]) -> tuple[bool, bool, float]:
        scene, target = pair
        tomato = scene.tomatoes[target.tomato]
        camera_side = bool(tomato.center[1] < -0.2)
        return target.witness is not None, camera_side, tomato.ripeness or 0.0

    scene, target = max(((scene, target) for scene in bank for target in scene.targets), key=rank)
    return scene, target.tomato


def train(out: Path, seed: int, settings: DemoSettings, report: DemoReport) -> list[dict[str, str]]:
    """Train a policy from nothing on shipped rows, the demo's row excepted; return the rows of its learning curve."""
    from greenhouse_gym.learning import DevicePpoSettings, train_ppo_on_device

    with report.stage("train a policy from random weights with PPO, on shipped rows") as results:
        shutil.rmtree(out / "ppo", ignore_errors=True)  # of an earlier demo
        # limited by steps, not seconds, so that a busy machine trains the same policy
        ppo = DevicePpoSettings(
            bank=settings.training_bank, sources=("own",), difficulty=("easy",),
            total_steps=settings.training_steps, seed=seed,
        )  # fmt: skip
        train_ppo_on_device(ppo, out / "ppo")
        curve = list(csv.DictReader((out / "ppo" / "curve.csv").read_text().splitlines()))
        results.append(f"{int(float(curve[-1]['steps'])):,} steps")
        report.figures["training_steps"] = int(float(curve[-1]["steps"]))
    return curve


def compare_agents(out: Path, seed: int, settings: DemoSettings, report: DemoReport) -> tuple[Evaluation, ...]:
    """Run a planner, the policy and a random agent on the same easy episodes of the row, and film the policy."""
    from greenhouse_gym.agents import Agent, PlannerAgent, PolicyAgent, RandomAgent
    from greenhouse_gym.cli.comparison_commands import print_comparison
    from greenhouse_gym.evaluation import compare, comparison_table
    from greenhouse_gym.reporting.film import film

    with report.stage("planner, policy and random agent reach for the easy tomatoes of the row") as results:
        policy = PolicyAgent.load(out / "ppo" / "policy.json")
        agents: list[Agent] = [PlannerAgent("RRTConnect", unknown="free"), policy, RandomAgent()]
        first = seed + 1_000_000
        row: dict[str, Any] = {"bank": str(out / "bank"), "split": "test", "difficulty": "easy"}
        row |= {} if settings.step_limit is None else {"step_limit": settings.step_limit}
        evaluations = compare(agents, episodes=settings.episodes, seed=first, **row)
        print_comparison(evaluations)
        write_atomically(out / "comparison.md", comparison_table(evaluations))
        for name, evaluation in zip(("planner", "policy", "random"), evaluations, strict=True):
            results.append(f"{name} {evaluation.success_rate:.0%}")
            report.figures[f"{name}_success"] = evaluation.success_rate
            report.figures[f"{name}_collision"] = evaluation.collision_rate
        reached = [record.seed for record in evaluations[1].records if record.success]
        film(policy, out / "13-policy.mp4", (reached or [first])[0], **row)
        results.append(f"film in {out / '13-policy.mp4'}")
    return evaluations
