"""Episodes of an agent as a Minari data set: what planners and teachers do, for those who learn from data."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.agents.agent import Agent, Problem, check_agent
from greenhouse_gym.common.extras import needs
from greenhouse_gym.envs import GreenhouseEnv, make_env
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.scene import SceneBank

DATA_SET = "tomato-reach/{agent}-v0"
"""What a data set is called in its folder, by the agent's name."""


def record_demonstrations(
    agent: Agent,
    out: str | Path,
    episodes: int = 100,
    seed: int = 0,
    split: str = "train",
    successes_only: bool = True,
    tell: Callable[[int], None] = lambda done: None,
    **options: Any,
) -> str:
    """Let an agent act and keep its episodes, with rewards and infos, as a Minari data set.

    Args:
        agent: Who acts; its ``env_options`` say in which environment.
        out: Folder of data sets (``MINARI_DATASETS_PATH``).
        episodes: How many are played; episode i has the seed ``seed + i``.
        seed: Seed of the first episode.
        split: Split of the bank; the test split is not for learning.
        successes_only: Whether only episodes that ended in a success are kept.
        tell: Gets the number of episodes played so far.
        **options: Further keywords of the environment.

    Returns:
        The data set's name, with which ``minari.load_dataset`` reads it.

    Raises:
        InvalidValueError: The test split is asked for, no episode succeeded, or the data set is there already.
        MissingDependencyError: Minari is not installed.
    """
    with needs("data"):
        import minari
        from minari.data_collector import EpisodeBuffer
    check_agent(agent)
    if split == "test":
        raise InvalidValueError("split 'test' is for the end, not for learning: choose train or validation")
    env = make_env(split=split, **{**options, **agent.env_options})
    bank = SceneBank.open(env.settings.bank)
    name = DATA_SET.format(agent="".join(c if c.isalnum() else "-" for c in agent.name.lower()))
    buffers: list[Any] = []
    try:
        for i in range(episodes):
            buffer = EpisodeBuffer(id=len(buffers), seed=seed + i, **_played(agent, env, seed + i))
            if buffer.infos["is_success"][-1] or not successes_only:  # type: ignore[index]
                buffers.append(buffer)
            tell(i + 1)
    finally:
        env.close()
    if not buffers:
        raise InvalidValueError(
            f"agent {agent.name!r} reached nothing in {episodes} episodes: there is nothing to keep"
        )
    about = f"TomatoReach-v0, split {split} of bank {bank.manifest.name}, manifest sha256 {bank.sha256}"
    with _datasets_in(Path(out)):
        if name in minari.list_local_datasets():
            raise InvalidValueError(f"{out} holds a data set {name} already: choose another folder")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that there is no author, permalink or environment's entry
            minari.create_dataset_from_buffers(
                name,
                buffers,
                observation_space=env.observation_space,
                action_space=env.action_space,
                algorithm_name=agent.name,
                description=about,
                requirements=["greenhouse-gym"],
                code_permalink=None, author=None, author_email=None,
            )  # fmt: skip
    return name


@contextmanager
def _datasets_in(folder: Path) -> Iterator[None]:
    """Minari knows its folder by an environment variable."""
    folder.mkdir(parents=True, exist_ok=True)
    before = os.environ.get("MINARI_DATASETS_PATH")
    os.environ["MINARI_DATASETS_PATH"] = str(folder.resolve())
    try:
        yield
    finally:
        if before is None:
            del os.environ["MINARI_DATASETS_PATH"]
        else:
            os.environ["MINARI_DATASETS_PATH"] = before


def _played(agent: Agent, env: GreenhouseEnv, seed: int) -> dict[str, Any]:
    """An episode's columns."""
    observation, info = env.reset(seed=seed)
    rule, interval = env.simulation.action_rule, env.simulation.interval
    agent.reset(Problem(env.scene, env.target, env.robot, env.start, seed, rule, interval))
    columns: dict[str, list[Any]] = {
        "observations": [observation], "actions": [], "rewards": [], "terminations": [], "truncations": [],
    }  # fmt: skip
    infos = [_told(info)]
    over = False
    while not over:
        action = np.asarray(agent.act(observation), dtype=np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        over = terminated or truncated
        columns["observations"].append(observation)
        columns["actions"].append(action)
        columns["rewards"].append(float(reward))
        columns["terminations"].append(terminated)
        columns["truncations"].append(truncated)
        infos.append(_told(info))
    return {**columns, "observations": _by_key(columns["observations"]), "infos": _by_key(infos)}


def _by_key(rows: list[Any]) -> Any:
    """Dictionaries with the same keys as one of lists, as Minari takes them; anything else as it is."""
    return {key: [row[key] for row in rows] for key in rows[0]} if isinstance(rows[0], Mapping) else rows


def _told(info: Mapping[str, Any]) -> dict[str, Any]:
    """What of an info is the same kind of number at every step."""
    return {
        "is_success": bool(info["is_success"]), "collision": bool(info["collision"]),
        "distance": float(info["distance"]), "clearance": float(info["clearance"]), "target": int(info["target"]),
        "scene": str(info["scene"]),
    }  # fmt: skip
