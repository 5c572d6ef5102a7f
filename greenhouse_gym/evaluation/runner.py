"""An agent plays episodes in the simulations of a vector environment, and what happened is recorded."""

from __future__ import annotations

import copy
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from greenhouse_gym.agents.agent import Agent, Problem
from greenhouse_gym.envs import TomatoReachVectorEnv
from greenhouse_gym.envs.actions import check_actions
from greenhouse_gym.envs.observations import Observed, select
from greenhouse_gym.envs.simulation import ReachSimulation
from greenhouse_gym.errors import GreenhouseError, InvalidValueError
from greenhouse_gym.evaluation.deadline import Patience
from greenhouse_gym.evaluation.records import Record
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import smallest_clearance
from greenhouse_gym.planning import path_length
from greenhouse_gym.robots.kinematics import tool_chain, tool_state

MAX_REPLACED = 3
"""How many agents that ran out of patience are replaced by a copy at most; each may go on working beside the others."""


class AgentError(GreenhouseError, RuntimeError):
    """An agent cannot be evaluated: it failed before it gave a single valid action."""


def never_acted(agent: Agent, seed: int, failure: str) -> AgentError:
    """The error of an agent that failed before its first action."""
    return AgentError(f"agent {agent.name!r} failed before its first action (seed {seed}): {failure}")


class Played(NamedTuple):
    """An episode that is over.

    Attributes:
        place: Which of the episodes it is.
        record: What happened.
        joints: (steps + 1, joints) true positions at the start and after each action, radians.
    """

    place: int
    record: Record
    joints: Array


class _Player(NamedTuple):
    """Who plays in a simulation.

    Attributes:
        agent: The agent.
        patience: Makes its calls.
    """

    agent: Agent
    patience: Patience


@dataclass
class _Run:
    """An episode that is being played.

    Attributes:
        place: Which of the episodes it is.
        problem: What the agent was told.
        player: Who plays.
        planning_time: Seconds the agent took to prepare.
        action_time: Seconds it took to act so far.
        total_reward: Sum of the rewards so far.
        joints: True joint positions so far, (joints,) each.
        failure: Why the agent gave no valid action.
    """

    place: int
    problem: Problem
    player: _Player
    planning_time: float = 0.0
    action_time: float = 0.0
    total_reward: float = 0.0
    joints: list[Array] = field(default_factory=list)
    failure: str = ""


class Match:
    """An agent's episodes in the simulations of a vector environment, each begun as soon as one is free.

    Args:
        agent: Who plays.
        env: The environment that it plays in.
        chosen: Place and reset options of the episodes.
        seed: Seed of the episode in place 0.
        patience: Seconds it may take for each answer; None waits for ever. After an answer that took longer, a copy of
            the agent plays the next episode, `MAX_REPLACED` times at most; then they all fail.
        proven: Whether the agent ever gave a valid action.
    """

    def __init__(
        self,
        agent: Agent,
        env: TomatoReachVectorEnv,
        chosen: deque[tuple[int, dict[str, Any]]],
        seed: int,
        patience: float | None,
        proven: bool = False,
    ):
        self._agent, self._env, self._chosen, self._seed = agent, env, chosen, seed
        self._simulation: ReachSimulation = env.simulation
        self._space = env.simulation.action_rule.space
        self._shared = hasattr(agent, "act_many")
        self._seconds, self._replaced = patience, 0
        self._players = [_Player(agent, Patience(patience))] * env.num_envs
        self._fresh: Agent | None = None  # an agent that plays, or hangs, is not to be copied
        if env.num_envs > 1 and not self._shared:
            self._fresh = agent
            self._players = [_Player(_copy(agent), Patience(patience)) for _ in self._players]
        elif patience is not None:
            with suppress(Exception):
                self._fresh = copy.deepcopy(agent)
        self._proven = proven

    def played(self) -> Iterator[Played]:
        """All episodes, in the order in which they end."""
        env, ids = self._env, range(self._env.num_envs)
        if env.num_envs > 1:
            env.reset(seed=self._seed)  # simulations can only be reset singly when all have been
        runs: list[_Run | None] = [None] * env.num_envs
        actions = np.zeros((env.num_envs, *self._space.shape))
        while True:
            for i in ids:
                while runs[i] is None and self._chosen:
                    runs[i] = self._begin(i)
                    yield from self._ended(runs, i)
            observations = self._simulation.observation()
            self._act(runs, observations, actions)
            for i in ids:
                yield from self._ended(runs, i)
            playing = [i for i in ids if runs[i] is not None]
            if not playing:
                if self._chosen:
                    continue
                return
            _, rewards, terminated, truncated, _ = env.step(actions)
            for i in playing:
                run = runs[i]
                assert run is not None
                run.total_reward += float(rewards[i])
                run.joints.append(self._simulation.joints[i].copy())
                if terminated[i] or truncated[i]:
                    yield self._played(i, run)
                    runs[i] = None

    def _begin(self, i: int) -> _Run:
        place, where = self._chosen.popleft()
        env, seed = self._env, self._seed + place
        alone = np.arange(env.num_envs) == i
        env.reset(seed=[seed if mine else None for mine in alone], options={**where, "reset_mask": alone})
        episode = self._simulation.episode(i)
        simulation = self._simulation
        problem = Problem(
            episode.scene, episode.target, simulation.robot, episode.start, seed, simulation.action_rule,
            simulation.interval,
        )  # fmt: skip
        run = _Run(place, problem, self._player(i), joints=[self._simulation.joints[i].copy()])
        began = time.perf_counter()
        try:
            run.player.patience.call(run.player.agent.reset, problem)
        except Exception as error:
            self._fail(run, error)
        run.planning_time = time.perf_counter() - began
        return run

    def _player(self, i: int) -> _Player:
        """Who begins an episode in a simulation."""
        player = self._players[i]
        if not player.patience.over or self._fresh is None or self._replaced == MAX_REPLACED:
            return player
        self._replaced += 1
        other = _Player(_copy(self._fresh), Patience(self._seconds))
        self._players = [other if each is player else each for each in self._players]
        return other

    def _act(self, runs: Sequence[_Run | None], observations: Observed, actions: Array) -> None:
        """Ask for the actions of all runs; those of others are zero."""
        actions[:] = 0.0
        playing = [(i, run) for i, run in enumerate(runs) if run is not None]
        if not playing:
            return
        if not self._shared:
            for i, run in playing:
                self._ask(run, run.player.agent.act, select(observations, i), actions[i : i + 1])
            return
        agent, patience = self._players[0]
        began = time.perf_counter()
        try:
            seen = select(observations, [i for i, _ in playing])
            together = np.asarray(patience.call(agent.act_many, seen))  # type: ignore[attr-defined]
            if together.shape[:1] != (len(playing),):
                raise InvalidValueError(f"act_many must give {len(playing)} actions, got shape {together.shape}")
        except Exception as error:
            for _, run in playing:
                self._fail(run, error)
            return
        spent = (time.perf_counter() - began) / len(playing)
        for (i, run), action in zip(playing, together, strict=True):
            self._ask(run, np.asarray, action, actions[i : i + 1])
            run.action_time += spent

    def _ask(self, run: _Run, act: Callable[[Any], Any], observation: Any, action: Array) -> None:
        """Fill in a run's next action (1, size)."""
        began = time.perf_counter()
        try:
            answer = run.player.patience.call(act, observation)
            action[:] = check_actions(np.asarray(answer)[None], 1, self._space)
        except Exception as error:
            self._fail(run, error)
        else:
            self._proven = True
        run.action_time += time.perf_counter() - began

    def _fail(self, run: _Run, error: Exception) -> None:
        run.failure = f"{type(error).__name__}: {error}"
        if not self._proven:
            raise never_acted(self._agent, run.problem.seed, run.failure) from error

    def _ended(self, runs: list[_Run | None], i: int) -> Iterator[Played]:
        """A run whose agent failed."""
        run = runs[i]
        if run is not None and run.failure:
            runs[i] = None
            yield self._played(i, run)

    def _played(self, i: int, run: _Run) -> Played:
        simulation = self._simulation
        info = {key: values[i] for key, values in simulation.info().items()}
        steps = len(run.joints) - 1
        way = np.array(run.joints)
        model, _ = simulation.model_and_data(i)
        compiled, target = simulation.physical(i)
        tips = tool_state(tool_chain(model, compiled.tip_site), way).point
        record = Record(
            seed=run.problem.seed,
            scene=info["scene"],
            target=int(info["target"]),
            difficulty=info["difficulty"],
            success=bool(info["is_success"]) and not run.failure,
            collision=bool(info["collision"]),
            contact=tuple(info["contact"]),
            steps=steps,
            planning_time=run.planning_time,
            action_time=run.action_time / max(1, steps),
            joint_length=path_length(way),
            tip_length=path_length(tips),
            clearance=smallest_clearance(compiled, model, target, way),
            roughness=float(np.linalg.norm(np.diff(way, n=2, axis=0), axis=-1).mean()) if steps > 1 else 0.0,
            total_reward=run.total_reward,
            distance=float(info["distance"]),
            status=str(getattr(run.player.agent, "status", "")),
            failure=run.failure,
        )
        return Played(run.place, record, way)


def _copy(agent: Agent) -> Agent:
    try:
        return copy.deepcopy(agent)
    except Exception as error:
        raise InvalidValueError(
            f"agent {agent.name!r} cannot be copied for each of several simulations ({error}); "
            "give it a method act_many(observations), or leave num_envs at 1"
        ) from error
