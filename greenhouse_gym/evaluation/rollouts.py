"""Evaluation of agents over a split of a bank.

The same seed gives every agent the same episodes, whatever the number of parallel environments.
"""

from __future__ import annotations

import reprlib
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from greenhouse_gym.agents import Agent
from greenhouse_gym.agents.named import agent_of
from greenhouse_gym.common.executors import WorkerLostError
from greenhouse_gym.common.own_code import described, printable
from greenhouse_gym.common.progress import progress as progress_of
from greenhouse_gym.envs import EnvSettings, make_vec_env
from greenhouse_gym.envs.choices import make_task
from greenhouse_gym.errors import (
    InvalidValueError,
    UnknownKeywordError,
    check_flag,
    check_items,
    check_whole,
    require_seed,
)
from greenhouse_gym.evaluation.batches import Batch, run_by
from greenhouse_gym.evaluation.deadline import AgentError, AskedAgent, Deadline, never_acted
from greenhouse_gym.evaluation.journal import RecordJournal
from greenhouse_gym.evaluation.records import Evaluation, Evaluations, Record
from greenhouse_gym.evaluation.runner import EpisodeRunner
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot

AGENTS_CHOICE = ("observation", "action")
"""Settings of the environment that every agent may choose; the others are rules of the episodes."""

_SHOWN = reprlib.Repr()  # also of objects that cannot be printed
_SHOWN.maxother = _SHOWN.maxstring = 100

_MAX_EPISODES, _PAIRS = 10**7, "pairs of a scene's name and a target"


def evaluate(
    agent: Agent | str,
    split: str = "test",
    episodes: int = 200,
    seed: int = 0,
    progress: bool = True,
    problems: Sequence[tuple[str, int]] | None = None,
    num_envs: int = 1,
    timeout: float | None = None,
    executor: Executor | None = None,
    journal: RecordJournal | None = None,
    **options: Any,
) -> Evaluation:
    """Run an agent over episodes drawn from a split.

    An agent fails if it raises an error, returns an invalid action or times out. A failure before the first valid
    action raises an error, as any failure of its own observation or kind of action does; a later one ends the episode,
    which then counts as unsuccessful and records the reason.

    Args:
        agent: The agent, or a name that `greenhouse_gym.agents.make_agent` takes; its ``env_options`` are keywords of
            the environment. Records name those that change the rules.
        split: "train", "validation" or "test".
        episodes: Number of episodes.
        seed: Episode i has the seed ``seed + i``. With the same bank, split and difficulties, every agent gets the same
            scene and target.
        progress: Show the progress on standard error if the episodes take more than a few seconds.
        problems: Scene names and targets to run instead, one episode each, of any split and difficulty; ``episodes`` is
            then ignored.
        num_envs: Number of episodes run in parallel. Each runs a copy of the agent, unless the agent has ``act_many``.
            Only recorded times depend on it.
        timeout: Time limit in seconds for preparing an episode, for each action, and for each use of the agent's own
            observation or kind of action; None for no limit. After a timeout,
            the episode is lost and a copy of the agent continues, a few times at most and only if it can be copied.
        executor: Runs batches of episodes, each with a new copy of the agent; None runs all of them in this process.
            Only recorded times depend on it.
        journal: Receives each record as soon as its episode ends; episodes that it holds already are skipped.
        **options: Further keywords of the environment, such as ``bank``, ``task`` or ``difficulty``. They must agree
            with the agent's ``env_options``.

    Raises:
        InvalidValueError: An argument is invalid, an option contradicts the agent's ``env_options``, or the agent or an
            option cannot be sent to the executor's processes.
        AgentError: The agent failed before its first valid action (with an executor, in the first episode), or its own
            observation or kind of action did.
        WorkerLostError: A process of the executor died.
    """
    num_envs, progress = check_whole("num_envs", num_envs, 1), check_flag("progress", progress)
    for name, given, kind in (("executor", executor, Executor), ("journal", journal, RecordJournal)):
        if not isinstance(given, kind | None):
            raise InvalidValueError(f"{name} must be an object of {kind.__name__} or None, got {given!r}")
    Deadline(timeout)  # raises before anything is run
    asked, seed, chosen = AskedAgent.of(agent, options), require_seed(seed), _chosen(episodes, problems)
    own = asked.env_options
    changed = changed_rules(asked.name, own, {**options, "split": split})
    ended = {} if journal is None else {k: record for k, record in journal.records.items() if k < len(chosen)}
    left = tuple((k, where) for k, where in enumerate(chosen) if k not in ended)
    choice = {key: own[key] for key in AGENTS_CHOICE if key in own}
    keywords = {**choice, **changed, **options, "split": split}
    own_keys = tuple(own.keys() - options.keys())
    whole = Batch(asked, left, seed, num_envs, timeout, keywords, own_keys, proven=bool(ended))
    rules = shown_rules(changed, asked.knows_truth)
    results = whole.records() if executor is None else run_by(executor, whole)
    with progress_of(f"episodes of {asked.name}", len(chosen), progress) as on_progress:
        for k, record in results if left else ():
            ended[k] = replace(record, rules=rules)
            if journal is not None:
                journal.add(k, ended[k])
            on_progress(len(ended))
    records = tuple(ended[k] for k in sorted(ended))
    if executor is not None and records and records[0].failure and not records[0].steps:
        if journal is not None:
            journal.remove()  # the agent may be fixed before the next attempt
        raise never_acted(asked.name, records[0].seed, records[0].failure)
    return Evaluation(asked.name, records)


def _chosen(episodes: int, problems: Sequence[tuple[str, int]] | None) -> list[dict[str, Any]]:
    """Return the reset options of all episodes.

    Raises:
        InvalidValueError: The problems are no pairs, or the number of episodes is invalid.
    """
    episodes = check_whole("episodes", episodes, 1, _MAX_EPISODES)
    if problems is None:
        return [{}] * episodes
    pairs = [check_items("problems", pair, _PAIRS) for pair in check_items("problems", problems, _PAIRS)]
    if any(len(pair) != 2 for pair in pairs):
        raise InvalidValueError(f"problems must be {_PAIRS}, got {_SHOWN.repr(problems)}")
    return [{"scene": name, "target": k} for name, k in pairs]


def changed_rules(agent: str, own: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keywords by which an agent's ``env_options`` change the rules of the episodes.

    An agent may choose its observation and action; all else is a rule.

    Args:
        agent: Name of the agent.
        own: Its ``env_options``.
        options: Keywords of the episodes; those left out have their defaults.

    Raises:
        InvalidValueError: The agent's ``env_options`` contradict the keywords of the episodes.
        UnknownKeywordError: They have a key that is no keyword of an environment.
    """
    for key, value in own.items():
        if not isinstance(key, str) or key in ("self", "num_envs"):
            raise UnknownKeywordError(
                f"agent {agent!r}: its env_options have {key!r}, which is no keyword of gymnasium.make"
            )
        if key in options and not _same(value, options[key]):
            raise InvalidValueError(f"agent {agent!r} needs {key}={_SHOWN.repr(value)}, got {options[key]!r}")
    plain = EnvSettings()
    rules = {field.name: getattr(plain, field.name) for field in fields(plain)} | dict(options)
    task = make_task(rules["task"], plain.success_radius, rules["size"])
    rules["step_limit"] = rules["step_limit"] or task.step_limit
    return {
        key: value
        for key, value in own.items()
        if key not in AGENTS_CHOICE and not (key in rules and _same(value, rules[key]))
    }


def shown_rules(changed: Mapping[str, Any], truth: bool) -> str:
    """Return changed rules as text, such as "success_radius=1.0", including knowledge of the truth."""
    changed = {**changed, "knows_truth": True} if truth else changed
    return printable(", ".join(f"{key}={_SHOWN.repr(value)}" for key, value in changed.items()))


def _same(a: Any, b: Any) -> bool:
    try:
        return a is b or bool(np.all(a == b)) or bool(described(a) == described(b))
    except Exception:  # arrays of different shapes, or an object of the agent
        return False


def compare(
    agents: Iterable[Agent | str], split: str = "test", episodes: int = 200, seed: int = 0, **options: Any
) -> Evaluations:
    """Evaluate several agents, or agents by name, on the same episodes, one after the other; see `evaluate`.

    An agent that cannot be evaluated, or that ends the process of an executor in which it runs, gets an evaluation with
    an error and no records; the others continue.
    """

    def one(agent: Agent) -> Evaluation:
        name = type(agent).__name__
        try:
            name = AskedAgent.of(agent).name
            return evaluate(agent, split, episodes, seed, **options)
        except (AgentError, WorkerLostError) as error:
            return Evaluation(name, (), str(error))

    several = (agents,) if isinstance(agents, str) else check_items("agents", agents, "agents or their names")
    return Evaluations([one(agent) for agent in [agent_of(agent) for agent in several]])


@dataclass(frozen=True, eq=False)
class Trace:
    """Record and joint path of an episode.

    Attributes:
        record: The record.
        robot: The arm.
        joints: (steps + 1, joints) joint positions at the start and after each action, radians.
    """

    record: Record
    robot: Robot
    joints: Array


def retrace(
    agent: Agent | str, seeds: Sequence[int], split: str = "test", timeout: float | None = None, **options: Any
) -> tuple[Trace, ...]:
    """Repeat episodes of an evaluation and return their joint paths.

    The outcomes are the same, unless the agent's actions depend on the time it takes.

    Args:
        agent: The agent, or its name.
        seeds: Seeds of the episodes, from their records.
        split: See `evaluate`.
        timeout: See `evaluate`.
        **options: Keywords of the environment; see `evaluate`.
    """
    Deadline(timeout)  # raises before anything is run
    asked = AskedAgent.of(agent)
    env = make_vec_env(1, **{**asked.env_options, **options, "split": split})
    try:
        numbers = check_items("seeds", seeds, "whole numbers")
        chosen = deque((require_seed(seed), dict[str, Any]()) for seed in numbers)
        runner = EpisodeRunner(asked, env, chosen, 0, timeout, proven=True)
        return tuple(Trace(result.record, env.simulation.robot, result.joints) for result in runner.run())
    finally:
        env.close()
