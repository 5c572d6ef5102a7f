"""Runs any agent over a split of a bank and records what happened.

The same seed gives every agent the same episodes.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import mean, median
from typing import Any

import gymnasium
import mujoco
import numpy as np
from rich.progress import track

from greenhouse_gym.agents import Agent, Problem
from greenhouse_gym.envs.tomato_reach import TomatoReachEnv
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.planning import CollisionChecker, path_length
from greenhouse_gym.planning.collision import set_margin
from greenhouse_gym.planning.kinematics import tool_chain, tool_state
from greenhouse_gym.robots.robot import TIP_SITE
from greenhouse_gym.scene import DIFFICULTIES
from greenhouse_gym.scene.mjcf import ARM_ONLY

ENV_ID = "TomatoReach-v0"

CLEARANCE_RANGE = 0.1
"""Clearances beyond this are recorded as this, metres."""


@dataclass(frozen=True)
class Record:
    """One episode.

    Attributes:
        seed: Seed of the episode.
        scene: Name of the scene.
        target: Index of the target tomato.
        difficulty: Its rating.
        success: The target was reached and nothing was touched.
        collision: Something was touched.
        contact: Names of the geoms that touched, the arm's first; empty without a collision.
        steps: Actions taken, 20 a second.
        planning_time: Seconds the agent took at the episode's start.
        action_time: Seconds the agent took per action, on average.
        joint_length: Way of the joints, radians (Euclidean norm).
        tip_length: Way of the tip, metres.
        clearance: Smallest distance of the arm to any obstacle but the target, metres, at the ends of the actions;
            at most `CLEARANCE_RANGE`.
        jerkiness: Mean norm of the change of the joint steps from action to action, radians; 0 is smoothest.
        total_reward: Sum of the rewards.
        distance: From the grasp point to the target's center at the end, metres.
        status: What the agent says of its plan; empty for agents that do not plan.
    """

    seed: int
    scene: str
    target: int
    difficulty: str
    success: bool
    collision: bool
    contact: tuple[str, ...]
    steps: int
    planning_time: float
    action_time: float
    joint_length: float
    tip_length: float
    clearance: float
    jerkiness: float
    total_reward: float
    distance: float
    status: str = ""


@dataclass(frozen=True)
class Evaluation:
    """An agent's episodes.

    Attributes:
        agent: The agent's name.
        records: One per episode.
    """

    agent: str
    records: tuple[Record, ...]

    @property
    def success_rate(self) -> float:
        """Share of successful episodes; nan without episodes."""
        return mean(r.success for r in self.records) if self.records else math.nan

    @property
    def collision_rate(self) -> float:
        """Share of episodes that ended with a collision; nan without episodes."""
        return mean(r.collision for r in self.records) if self.records else math.nan

    @property
    def success_interval(self) -> tuple[float, float]:
        """95 % interval of the success rate (Wilson)."""
        return wilson_interval(sum(r.success for r in self.records), len(self.records))

    def of(self, difficulty: str) -> Evaluation:
        """The episodes of one difficulty."""
        return Evaluation(self.agent, tuple(r for r in self.records if r.difficulty == difficulty))

    def median(self, field: str, solved_only: bool = False) -> float:
        """Median of a number of the records, over all episodes or the successful ones; nan where there are none."""
        values = [float(getattr(r, field)) for r in self.records if r.success or not solved_only]
        return median(values) if values else math.nan


def evaluate(
    agent: Agent,
    split: str = "test",
    episodes: int = 200,
    seed: int = 0,
    progress: bool | None = None,
    problems: Sequence[tuple[str, int]] | None = None,
    **options: Any,
) -> Evaluation:
    """Run an agent over episodes drawn from a split.

    Args:
        agent: The agent; its ``env_options`` say which environment it needs.
        split: "train", "validation" or "test".
        episodes: How many.
        seed: Episode i has the seed ``seed + i``: with the same bank, split and difficulties, the same scene and target
            for every agent.
        progress: Whether to show a bar; None shows it on a terminal.
        problems: Names of scenes with targets to run instead, one episode each: of any split and difficulty, and
            whatever ``episodes`` says.
        **options: Further keywords of the environment, such as ``bank`` or ``difficulty``; those the agent needs cannot
            be changed.

    Raises:
        InvalidValueError: No episodes, or an option that contradicts what the agent needs.
    """
    if episodes < 1:
        raise InvalidValueError(f"episodes must be at least 1, got {episodes!r}")
    for key, value in agent.env_options.items():
        if key in options and options[key] != value:
            raise InvalidValueError(f"agent {agent.name!r} needs {key}={value!r}, got {options[key]!r}")
    env = gymnasium.make(ENV_ID, split=split, **{**options, **agent.env_options})
    show = sys.stderr.isatty() if progress is None else progress
    try:
        chosen = [{}] * episodes if problems is None else [{"scene": name, "target": k} for name, k in problems]
        runs = track(list(enumerate(chosen, start=seed)), description=agent.name, disable=not show)
        return Evaluation(agent.name, tuple(_episode(env, agent, s, where) for s, where in runs))
    finally:
        env.close()


def compare(
    agents: Iterable[Agent], split: str = "test", episodes: int = 200, seed: int = 0, **options: Any
) -> tuple[Evaluation, ...]:
    """Run several agents on the same episodes; see `evaluate`."""
    return tuple(evaluate(agent, split, episodes, seed, **options) for agent in agents)


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """95 % confidence interval of a rate (Wilson, 1927); (0, 1) without trials."""
    if trials == 0:
        return 0.0, 1.0
    z = 1.959964
    rate = successes / trials
    center = (rate + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z / (1 + z * z / trials) * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    return max(0.0, center - half), min(1.0, center + half)


def comparison_table(evaluations: Sequence[Evaluation]) -> str:
    """A Markdown table, a row per agent; ways, steps and clearances are medians over the successful episodes."""
    present = {r.difficulty for e in evaluations for r in e.records}
    difficulties = [d for d in DIFFICULTIES if d in present]
    heads = ["agent", "episodes", "success [95 %]", *difficulties, "collision", "planning s", "steps"]
    heads += ["joints rad", "tip m", "clearance mm", "jerkiness rad"]
    rows = [heads, ["---"] + ["---:"] * (len(heads) - 1)]
    for e in evaluations:
        low, high = e.success_interval
        rows.append(
            [
                e.agent,
                str(len(e.records)),
                f"{e.success_rate:.1%} [{low:.1%}, {high:.1%}]",
                *(f"{e.of(difficulty).success_rate:.1%}" for difficulty in difficulties),
                f"{e.collision_rate:.1%}",
                f"{e.median('planning_time'):.3f}",
                f"{e.median('steps', solved_only=True):.0f}",
                f"{e.median('joint_length', solved_only=True):.2f}",
                f"{e.median('tip_length', solved_only=True):.2f}",
                f"{1000 * e.median('clearance', solved_only=True):.1f}",
                f"{e.median('jerkiness', solved_only=True):.4f}",
            ]
        )
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"


def _episode(env: gymnasium.Env[Any, Any], agent: Agent, seed: int, where: dict[str, Any]) -> Record:
    reach = env.unwrapped
    assert isinstance(reach, TomatoReachEnv)
    observation, info = env.reset(seed=seed, options=where)
    began = time.perf_counter()
    agent.reset(Problem(reach.scene, reach.target, reach.robot, reach.start, seed))
    planning_time = time.perf_counter() - began
    joints, total_reward, action_time, over = [reach.start], 0.0, 0.0, False
    while not over:
        began = time.perf_counter()
        action = agent.act(observation)
        action_time += time.perf_counter() - began
        observation, reward, terminated, truncated, info = env.step(action)
        total_reward += float(reward)
        joints.append(_joints(reach))
        over = terminated or truncated
    steps = len(joints) - 1
    way = np.array(joints)
    model, _ = reach.model_and_data()
    tips = tool_state(tool_chain(model, model.site(TIP_SITE).id), way).point
    return Record(
        seed=seed,
        scene=info["scene"],
        target=info["target"],
        difficulty=info["difficulty"],
        success=info["is_success"],
        collision=info["collision"],
        contact=tuple(info["contact"]),
        steps=steps,
        planning_time=planning_time,
        action_time=action_time / steps,
        joint_length=path_length(way),
        tip_length=path_length(tips),
        clearance=_clearance(model, way),
        jerkiness=float(np.linalg.norm(np.diff(way, n=2, axis=0), axis=-1).mean()) if steps > 1 else 0.0,
        total_reward=total_reward,
        distance=info["distance"],
        status=str(getattr(agent, "status", "")),
    )


def _joints(env: TomatoReachEnv) -> Array:
    situation = env.simulation.situation
    assert situation is not None
    return situation.joints[0]


def _clearance(model: mujoco.MjModel, joints: Array) -> float:
    """Smallest distance between arm and obstacles over configurations (k, joints), up to `CLEARANCE_RANGE`."""
    world = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] == 0]
    obstacles = [geom for geom in world if model.geom(geom).name not in ("floor", "cart")]
    set_margin(model, np.array(obstacles), CLEARANCE_RANGE)
    targets = [geom for geom in obstacles if model.geom_contype[geom] == ARM_ONLY]
    model.geom_contype[targets] = model.geom_conaffinity[targets] = 0
    checker = CollisionChecker(model)
    return min(CLEARANCE_RANGE, min(checker.clearance(configuration) for configuration in joints))
