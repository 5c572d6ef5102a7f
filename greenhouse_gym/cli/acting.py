"""Commands on scenes: plan, train, compare, render."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from greenhouse_gym.progress import CONSOLE

Bank = Annotated[str, typer.Option(help="A shipped bank's name or a bank's folder.")]


def plan(
    scene: Annotated[str, typer.Option(help="Name of the scene in the bank.")],
    target: Annotated[int, typer.Option(help="Index of the tomato in the scene.")],
    planner: Annotated[str, typer.Option(help="A planner's name.")] = "RRTConnect",
    bank: Bank = "default",
    time_limit: Annotated[float, typer.Option(help="Seconds.")] = 5.0,
    seed: int = 0,
    picture: Annotated[Path | None, typer.Option(help="PNG file for a picture of the path.")] = None,
) -> None:
    """Plan a path to a tomato."""
    from greenhouse_gym.planning import plan as plan_path
    from greenhouse_gym.planning import resample
    from greenhouse_gym.scene import SceneBank
    from greenhouse_gym.scene.render import picture_of_path

    chosen = SceneBank.open(bank).scene(scene)
    result = plan_path(chosen, target, planner=planner, time_limit=time_limit, seed=seed)
    CONSOLE.print(f"{planner}: {result.status}, {result.planning_time:.3f} s, {result.checks} checks", highlight=False)
    if result.path is None:
        raise typer.Exit(2)
    if picture is not None:
        from greenhouse_gym.cli.pictures import save

        save(picture_of_path(chosen, "ur5e", target, resample(result.path, 0.03)), picture)
        CONSOLE.print(f"picture in {picture}")


def train(
    algorithm: Annotated[str, typer.Argument(help="ppo")],
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("runs/ppo"),
    bank: Bank = "default",
    steps: Annotated[int, typer.Option(help="Environment steps.")] = 2_000_000,
    seed: int = 0,
    resume: Annotated[bool, typer.Option(help="Go on from the checkpoint in the folder.")] = False,
) -> None:
    """Train a policy."""
    from greenhouse_gym.errors import require_choice
    from greenhouse_gym.learning import PpoSettings, train_ppo

    require_choice("algorithm", algorithm, ["ppo"])
    policy = train_ppo(PpoSettings(bank=bank, total_steps=steps, seed=seed), out, resume=resume)
    CONSOLE.print(f"policy in {policy}")


def compare(
    agents: Annotated[
        list[str] | None, typer.Argument(help="Planner names, policy names or files, 'random', 'still'.")
    ] = None,
    bank: Bank = "default",
    split: Annotated[str, typer.Option(help="train, validation or test.")] = "test",
    episodes: int = 100,
    seed: int = 0,
) -> None:
    """Run agents on the same episodes and print one table; by default a planner, the shipped policy and chance."""
    from greenhouse_gym.agents import Agent, PlannerAgent, PolicyAgent, RandomAgent, StillAgent
    from greenhouse_gym.evaluation import compare as run
    from greenhouse_gym.evaluation import comparison_table
    from greenhouse_gym.planning import PLANNERS

    def agent(name: str) -> Agent:
        if name == "random":
            return RandomAgent()
        if name == "still":
            return StillAgent()
        return PlannerAgent(name) if name in PLANNERS else PolicyAgent.load(name)

    chosen = [agent(name) for name in agents or ("RRTConnect", "ppo-ur5e", "random")]
    table = comparison_table(run(chosen, split, episodes, seed, bank=bank))
    typer.echo(table, nl=False)


def render(
    scene: Annotated[str, typer.Option(help="Name of the scene in the bank; its first one by default.")] = "",
    out: Annotated[Path, typer.Option(help="PNG file.")] = Path("scene.png"),
    target: Annotated[int, typer.Option(help="Index of the tomato the red line goes to.")] = 0,
    bank: Bank = "default",
) -> None:
    """Draw a scene with the arm at its start."""
    from greenhouse_gym.cli.pictures import save
    from greenhouse_gym.robots import get_robot
    from greenhouse_gym.scene import SceneBank
    from greenhouse_gym.scene.render import picture_of_path

    arm = get_robot("ur5e")
    opened = SceneBank.open(bank)
    save(picture_of_path(opened.scene(scene) if scene else opened[0], arm, target, arm.start[None]), out)
    CONSOLE.print(f"picture in {out}")
