"""Commands on single agents: demonstrations, watch, policy list and export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from greenhouse_gym.cli.options import (
    AgentArgument,
    AgentRobot,
    Bank,
    Difficulty,
    OneScene,
    OneTarget,
    Seed,
    Split,
    comma_separated,
    given,
    whole_pair,
)
from greenhouse_gym.common.progress import progress, say

policy_app = typer.Typer(help="List trained policies, and write them for other programs.", no_args_is_help=True)


def demonstrations(
    agent: AgentArgument = "roadmap",
    out: Annotated[Path, typer.Option(resolve_path=True, help="Folder of Minari data sets.")] = Path("demonstrations"),
    bank: Bank = "default",
    split: Split = "train",
    observation: Annotated[str, typer.Option(help="Observation to record, unless the agent needs another.")] = "state",
    episodes: Annotated[int, typer.Option(min=1, help="Episodes to run; the successful ones are kept.")] = 100,
    seed: Seed = 0,
    robot: AgentRobot = "",
) -> None:
    """Run an agent and keep its successful episodes as a Minari data set."""
    from greenhouse_gym.agents.agent import options_for
    from greenhouse_gym.agents.demonstrations import record_demonstrations
    from greenhouse_gym.agents.named import make_agent

    player = make_agent(agent)
    observed = {} if "observation" in player.env_options else {"observation": observation}
    options = options_for(player, {"bank": bank, **observed, **given(robot=robot)})
    with progress("episodes", episodes) as on_progress:
        name = record_demonstrations(player, out, episodes, seed, split, on_progress=on_progress, **options)
    say(f"data set {name} in {out}: MINARI_DATASETS_PATH={out} and minari.load_dataset({name!r})")


def watch(
    agent: AgentArgument = "ppo-roadmap-ur5e",
    out: Annotated[
        Path | None,
        typer.Option(
            resolve_path=True,
            help="File to write, .mp4, .gif or .webp; episode.mp4 by default, or episode.gif without the extra viz.",
            show_default=False,
        ),
    ] = None,
    episodes: Annotated[int, typer.Option(min=1, help="Number of episodes, one after the other.")] = 1,
    scene: OneScene = None,
    target: OneTarget = None,
    bank: Bank = "default",
    split: Split = "validation",
    seed: Seed = 0,
    difficulty: Difficulty = "",
    track: Annotated[
        str, typer.Option(help="World of the contacts and of the film: reconstruction, truth, moved or brush.")
    ] = "reconstruction",
    task: Annotated[str, typer.Option(help="Task: look, or your own as file.py:Class or module:Class.")] = "",
    robot: AgentRobot = "",
    fps: Annotated[
        float | None, typer.Option(help="Images per second; one for each action by default.", show_default=False)
    ] = None,
    size: Annotated[str, typer.Option(help="Width and height of the film, pixels.")] = "640x480",
    camera: Annotated[str, typer.Option(help="Camera: aisle, behind, side or top.")] = "aisle",
) -> None:
    """Film episodes of an agent in real time, with a caption of the outcome at the end of each."""
    from importlib.util import find_spec

    from greenhouse_gym.agents.named import make_agent
    from greenhouse_gym.errors import require_choice
    from greenhouse_gym.evaluation.leaderboard import TRACKS
    from greenhouse_gym.rendering.picture_files import FILMS, require_picture
    from greenhouse_gym.rendering.viewer import Picture
    from greenhouse_gym.reporting.film import film

    if out is None:
        out = Path("episode.mp4" if find_spec("imageio_ffmpeg") else "episode.gif")
    require_picture(out, FILMS)
    options = {"bank": bank, "split": split, **TRACKS[require_choice("track", track, TRACKS)]}
    options |= given(robot=robot, task=task, difficulty=comma_separated(difficulty), scene=scene, target=target)
    picture = Picture(*whole_pair("--size", size, "640x480"), camera)
    with progress("actions") as on_progress:
        filmed = film(
            make_agent(agent), out, seed, episodes=episodes, fps=fps, picture=picture, on_progress=on_progress,
            **options,
        )  # fmt: skip
    for episode in filmed:
        say(f"{episode.title}: {episode.outcome}")
    say(f"{len(filmed)} {'episode' if len(filmed) == 1 else 'episodes'} in {out}")


@policy_app.command("list")
def list_policies() -> None:
    """List the shipped policies."""
    from greenhouse_gym.cli.doctor import policy_table

    policy_table().show()


@policy_app.command("export")
def export_policy(
    policy: Annotated[str, typer.Argument(help="Name of a shipped policy, or file of a policy.")],
    out: Annotated[Path, typer.Option(help="ONNX file to write.")] = Path("policy.onnx"),
) -> None:
    """Write a policy as one ONNX file: observation in, action out, for runtimes without this package."""
    from greenhouse_gym.agents import load_policy
    from greenhouse_gym.common.extras import require_extras
    from greenhouse_gym.export import onnx_model

    require_extras("onnx")
    agent = load_policy(policy)
    onnx_model.export_policy(agent.policy, out, agent.name)
    say(f"{agent.name} in {out}")
