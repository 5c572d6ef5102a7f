"""Runs any agent over a split of a bank and records what happened.

The same seed gives every agent the same episodes, however many are played side by side.
"""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.progress import track

from greenhouse_gym.agents import Agent
from greenhouse_gym.agents.agent import check_agent
from greenhouse_gym.common.executors import completed, require_portable, workers_of
from greenhouse_gym.envs import TomatoReachVectorEnv
from greenhouse_gym.errors import InvalidValueError, require_seed
from greenhouse_gym.evaluation.journal import RecordJournal
from greenhouse_gym.evaluation.records import Evaluation, Record
from greenhouse_gym.evaluation.runner import AgentError, EpisodeRunner, never_acted
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot

_PARTS = 16  # of an evaluation per worker: many enough that all end at about the same time, and little is lost


def evaluate(
    agent: Agent,
    split: str = "test",
    episodes: int = 200,
    seed: int = 0,
    progress: bool | None = None,
    problems: Sequence[tuple[str, int]] | None = None,
    num_envs: int = 1,
    timeout: float | None = None,
    executor: Executor | None = None,
    journal: RecordJournal | None = None,
    **options: Any,
) -> Evaluation:
    """Run an agent over episodes drawn from a split.

    An agent that raises an error, gives an action of the wrong shape or not a number, or times out, fails: at
    its first action that is an error, later it ends the episode, whose record says why, and counts as no success.

    Args:
        agent: The agent; its ``env_options`` say which environment it needs.
        split: "train", "validation" or "test".
        episodes: How many.
        seed: Episode i has the seed ``seed + i``: with the same bank, split and difficulties, the same scene and target
            for every agent.
        progress: Whether to show a bar; None shows it on a terminal.
        problems: Names of scenes with targets to run instead, one episode each: of any split and difficulty, and
            whatever ``episodes`` says.
        num_envs: Episodes that are played side by side. Each gets a copy of the agent, unless that has ``act_many``;
            the records are the same, but for times.
        timeout: Seconds the agent may take to prepare for an episode or to act; None waits for ever. One that takes
            longer loses the episode, and a copy of it plays on: a few times, if the agent can be copied.
        executor: Where the episodes are played, some at a time, each time by a new copy of the agent; None plays all of
            them here. The records are the same, but for times.
        journal: Receives each record as soon as its episode ends; episodes that it holds already are skipped.
        **options: Further keywords of the environment, such as ``bank`` or ``difficulty``; those the agent needs cannot
            be changed.

    Raises:
        InvalidValueError: No episodes, no agent, no time, a negative seed, an option that contradicts what the
            agent needs, or an agent or option that cannot be sent to the executor's processes.
        AgentError: The agent failed before it gave a single valid action; with an executor, in the first episode.
        WorkerLostError: A process of the executor died.
    """
    for name, number in (("episodes", episodes), ("num_envs", num_envs)):
        if isinstance(number, bool) or not isinstance(number, (int, np.integer)) or number < 1:
            raise InvalidValueError(f"{name} must be a whole number from 1 up, got {number!r}")
    if timeout is not None and not timeout > 0:
        raise InvalidValueError(f"timeout must be a positive number of seconds, or None, got {timeout!r}")
    check_agent(agent)
    require_seed(seed)
    for key, value in agent.env_options.items():
        if key in options and options[key] != value:
            raise InvalidValueError(f"agent {agent.name!r} needs {key}={value!r}, got {options[key]!r}")
    chosen: list[dict[str, Any]] = [{}] * episodes
    if problems is not None:
        chosen = [{"scene": name, "target": k} for name, k in problems]
    show = sys.stderr.isatty() if progress is None else progress
    ended = {} if journal is None else {k: record for k, record in journal.records.items() if k < len(chosen)}
    left = tuple((k, where) for k, where in enumerate(chosen) if k not in ended)
    whole = _Part(agent, split, left, seed, num_envs, timeout, options, proven=bool(ended))
    played = whole.records() if executor is None else _played_by(executor, whole)
    for k, record in track(played if left else (), description=agent.name, disable=not show, total=len(left)):
        ended[k] = record
        if journal is not None:
            journal.add(k, record)
    records = tuple(ended[k] for k in sorted(ended))
    if executor is not None and records and records[0].failure and not records[0].steps:
        if journal is not None:
            journal.remove()  # what was wrong may be mended before the next try
        raise never_acted(agent, records[0].seed, records[0].failure)
    return Evaluation(agent.name, records)


def compare(
    agents: Iterable[Agent], split: str = "test", episodes: int = 200, seed: int = 0, **options: Any
) -> tuple[Evaluation, ...]:
    """Run several agents on the same episodes, one agent after the other; see `evaluate`.

    An agent that cannot be evaluated gets an evaluation without records, with the error, and the others go on.
    """

    def one(agent: Agent) -> Evaluation:
        try:
            return evaluate(agent, split, episodes, seed, **options)
        except AgentError as error:
            return Evaluation(agent.name, (), str(error))

    return tuple(one(agent) for agent in agents)


@dataclass(frozen=True, eq=False)
class Trace:
    """An episode with the way that the arm took.

    Attributes:
        record: What happened.
        robot: The arm.
        joints: (steps + 1, joints) its positions at the start and after each action, radians.
    """

    record: Record
    robot: Robot
    joints: Array


def retrace(
    agent: Agent, seeds: Sequence[int], split: str = "test", timeout: float | None = None, **options: Any
) -> tuple[Trace, ...]:
    """Play some episodes of an evaluation again and keep the ways that the arm took.

    They end as they did then, but for agents whose answers depend on the time they have.

    Args:
        agent: The agent.
        seeds: Seeds of the episodes, as their records tell them.
        split: See `evaluate`.
        timeout: See `evaluate`.
        **options: See `evaluate`; ``num_envs`` and ``executor`` are not among them.
    """
    env = TomatoReachVectorEnv(1, split=split, **{**options, **agent.env_options})
    try:
        runner = EpisodeRunner(agent, env, deque((require_seed(seed), {}) for seed in seeds), 0, timeout, proven=True)
        return tuple(Trace(result.record, env.simulation.robot, result.joints) for result in runner.run())
    finally:
        env.close()


@dataclass(frozen=True)
class _Part:
    """Some of an evaluation's episodes; a part can travel.

    Attributes:
        agent: Who plays.
        split: Where the episodes are drawn from.
        chosen: Place and reset options of the episodes.
        seed: Seed of the episode in place 0.
        num_envs: Episodes that are played side by side.
        timeout: See `evaluate`.
        options: Further keywords of the environment.
        proven: Whether the agent is known to give valid actions.
    """

    agent: Agent
    split: str
    chosen: tuple[tuple[int, dict[str, Any]], ...]
    seed: int
    num_envs: int
    timeout: float | None
    options: dict[str, Any]
    proven: bool = False

    def records(self) -> Iterator[tuple[int, Record]]:
        """Places and records of the episodes, in the order in which they end."""
        count = min(self.num_envs, max(1, len(self.chosen)))
        env = TomatoReachVectorEnv(count, split=self.split, **{**self.options, **self.agent.env_options})
        try:
            runner = EpisodeRunner(self.agent, env, deque(self.chosen), self.seed, self.timeout, self.proven)
            yield from ((result.episode_index, result.record) for result in runner.run())
        finally:
            env.close()

    def played(self) -> list[tuple[int, Record]]:
        """All places and records at once."""
        return list(self.records())


def _played_by(executor: Executor, whole: _Part) -> Iterator[tuple[int, Record]]:
    """Places and records of all episodes, played some at a time by an executor's workers."""
    require_portable(executor, f"agent {whole.agent.name!r} with its options", whole)
    chosen = whole.chosen
    size = max(whole.num_envs, math.ceil(len(chosen) / (_PARTS * workers_of(executor))))
    parts = (replace(whole, chosen=chosen[k : k + size], proven=True) for k in range(0, len(chosen), size))
    for records in completed(_Part.played, parts, executor):
        yield from records
