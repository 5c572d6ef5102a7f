"""Episodes as films."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from gymnasium.wrappers import RecordVideo

from greenhouse_gym.agents import Agent, Problem
from greenhouse_gym.agents.named import agent_of
from greenhouse_gym.common.extras import require_extras
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.envs import make_env


def film(agent: Agent | str, out: str | Path, seed: int = 0, **options: Any) -> bool:
    """Film an episode of an agent as MP4.

    Args:
        agent: The agent, or a name that `greenhouse_gym.agents.make_agent` takes; its ``env_options`` choose the
            environment.
        out: The file.
        seed: Seed of the episode, as in `greenhouse_gym.evaluation.evaluate`.
        **options: Further keywords of the environment.

    Returns:
        True if the episode ended in success.

    Raises:
        MissingDependencyError: The extra ``viz`` is not installed.
    """
    require_extras("viz")
    agent = agent_of(agent)
    env = make_env(render_mode="rgb_array", **{**options, **agent.env_options})
    with tempfile.TemporaryDirectory() as folder:
        recorder: Any = RecordVideo(env, str(Path(folder) / "films"), name_prefix="film", disable_logger=True)
        try:
            observation, info = recorder.reset(seed=seed)
            agent.reset(Problem.of(env.simulation, 0, seed))
            over = False
            while not over:
                observation, _, terminated, truncated, info = recorder.step(agent.act(observation))
                over = terminated or truncated
        finally:
            recorder.close()
        [made] = Path(folder).rglob("*.mp4")
        write_atomically(out, made.read_bytes())
    return bool(info["is_success"])
