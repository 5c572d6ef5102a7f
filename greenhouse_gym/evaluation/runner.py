"""Runner of an agent's episodes in the simulations of a vector environment."""

from __future__ import annotations

import copy
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from greenhouse_gym.agents.agent import Agent, Problem, reads_images
from greenhouse_gym.common.isolation import MemoryLimit
from greenhouse_gym.common.own_code import describe, printable
from greenhouse_gym.envs import GreenhouseVectorEnv
from greenhouse_gym.envs.actions import check_actions
from greenhouse_gym.envs.checked_parts import OwnPart
from greenhouse_gym.envs.contacts import NAME_SEPARATOR
from greenhouse_gym.envs.observations import Observed, select
from greenhouse_gym.envs.simulation import Simulation
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation.deadline import AgentError, AskedAgent, Deadline, Watchdog, never_acted
from greenhouse_gym.evaluation.records import Record
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.clearance import smallest_clearance
from greenhouse_gym.planning import path_length
from greenhouse_gym.robots.kinematics import tool_chain, tool_state

MAX_REPLACEMENTS = 3
"""Maximum number of timed-out agents that are replaced by a copy; each may keep a thread busy."""

GRACE = 10.0  # seconds beyond twice the time limit until a process that no longer answers is ended; or for a copy


class EpisodeResult(NamedTuple):
    """Result of a finished episode.

    Attributes:
        episode_index: Index of the episode.
        record: Its record.
        joints: (steps + 1, joints) true joint positions at the start and after each action, radians.
    """

    episode_index: int
    record: Record
    joints: Array


class _Player(NamedTuple):
    """Agent of a simulation.

    Attributes:
        agent: The agent.
        deadline: Runs its calls with a time limit.
    """

    agent: Agent
    deadline: Deadline


@dataclass
class _Run:
    """Episode in progress.

    Attributes:
        index: Index of the episode.
        problem: The problem given to the agent.
        player: The agent.
        planning_time: Time that the agent took to prepare, seconds.
        action_time: Time that it took for its actions so far, seconds.
        total_reward: Sum of the rewards so far.
        joints: True joint positions so far, (joints,) each.
        failure: Reason why the agent gave no valid action.
    """

    index: int
    problem: Problem
    player: _Player
    planning_time: float = 0.0
    action_time: float = 0.0
    total_reward: float = 0.0
    joints: list[Array] = field(default_factory=list)
    failure: str = ""


class EpisodeRunner:
    """Runner of an agent's episodes in a vector environment; each starts as soon as a simulation is free.

    Args:
        asked: The agent.
        env: The environment.
        chosen: Index and reset options of each episode.
        seed: Seed of episode 0.
        timeout: Time limit of each call of the agent, seconds; None for no limit. After a timeout, a copy of the agent
            runs the next episode, at most `MAX_REPLACEMENTS` times; after that, all remaining episodes fail.
        proven: The agent is known to give valid actions.
        workers: Number of processes like this one, which end if the agent hangs; zero for a process that must not.
    """

    def __init__(
        self,
        asked: AskedAgent,
        env: GreenhouseVectorEnv,
        chosen: deque[tuple[int, dict[str, Any]]],
        seed: int,
        timeout: float | None,
        proven: bool = False,
        workers: int = 0,
    ):
        agent = asked.agent
        self._asked, self._env, self._chosen, self._seed = asked, env, chosen, seed
        self._simulation: Simulation = env.simulation
        self._space = env.simulation.action_space
        self._shared = asked.acts_on_many
        self._memory = MemoryLimit(1 / max(1, workers))
        self._copying = None if timeout is None else max(timeout, GRACE)
        self._limited = partial(Deadline, timeout, self._memory)
        if timeout is not None and workers:
            self._limited = partial(self._limited, watchdog=Watchdog(2 * timeout + GRACE))
        self._replaced = 0
        self._players = [_Player(agent, self._limited())] * env.num_envs
        self._fresh: Agent | None = None  # copied after a timeout; an agent in use or hanging must not be
        if env.num_envs > 1 and not self._shared:
            self._fresh = agent
            self._players = [_Player(self._copy(agent), self._limited()) for _ in self._players]
        elif timeout is not None:
            with suppress(InvalidValueError):
                self._fresh = self._copy(agent)
        self._proven = proven
        parts, self._spent = self._limited(), 0.0
        for part in (self._simulation.observe, self._simulation.action_rule):
            if isinstance(part, OwnPart):
                part.run = partial(self._run_part, parts)

    def run(self) -> Iterator[EpisodeResult]:
        """Yield the results of all episodes in the order in which they end."""
        try:
            yield from self._run()
        finally:
            self._memory.lift()

    def _run(self) -> Iterator[EpisodeResult]:
        env, ids = self._env, range(self._env.num_envs)
        if env.num_envs > 1:
            env.reset(seed=self._seed)  # single simulations can be reset only after the first reset of all
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
            spent, self._spent = self._spent / len(playing), 0.0
            for i in playing:
                run = runs[i]
                assert run is not None
                run.action_time += spent
                run.total_reward += float(rewards[i])
                run.joints.append(self._simulation.joints[i].copy())
                if terminated[i] or truncated[i]:
                    yield self._result(i, run)
                    runs[i] = None

    def _begin(self, i: int) -> _Run:
        index, where = self._chosen.popleft()
        env, seed = self._env, self._seed + index
        alone = np.arange(env.num_envs) == i
        self._simulation.set_images_due(i, True)
        env.reset(seed=[seed if mine else None for mine in alone], options={**where, "reset_mask": alone})
        player = self._player(i)
        problem = Problem.of(self._simulation, i, seed, self._asked.knows_truth)
        run = _Run(index, problem, player, joints=[self._simulation.joints[i].copy()])
        began = time.perf_counter()
        try:
            run.player.deadline.call(run.player.agent.reset, problem)
        except Exception as error:
            self._fail(run, error)
        run.planning_time = time.perf_counter() - began
        return run

    def _player(self, i: int) -> _Player:
        """Return the agent for the next episode of a simulation."""
        player = self._players[i]
        if not player.deadline.expired or self._fresh is None or self._replaced == MAX_REPLACEMENTS:
            return player
        self._replaced += 1
        other = _Player(self._copy(self._fresh), self._limited())
        self._players = [other if each is player else each for each in self._players]
        return other

    def _act(self, runs: Sequence[_Run | None], observations: Observed, actions: Array) -> None:
        """Fill in the actions of all runs; those of idle simulations are zero."""
        actions[:] = 0.0
        playing = [(i, run) for i, run in enumerate(runs) if run is not None]
        if not playing:
            return
        if not self._shared:
            for i, run in playing:
                images_due = self._ask(run, run.player.agent, select(observations, i), actions[i : i + 1])
                self._simulation.set_images_due(i, images_due)
            return
        agent, deadline = self._players[0]
        began = time.perf_counter()
        try:
            batch = select(observations, [i for i, _ in playing])
            together = deadline.call(lambda: np.asarray(agent.act_many(batch)))  # type: ignore[attr-defined]
            if together.shape[:1] != (len(playing),):
                raise InvalidValueError(f"act_many must return {len(playing)} actions, got shape {together.shape}")
        except Exception as error:
            for _, run in playing:
                self._fail(run, error)
            return
        spent = (time.perf_counter() - began) / len(playing)
        for (i, run), action in zip(playing, together, strict=True):
            self._fill(run, partial(np.asarray, action), actions[i : i + 1])
            run.action_time += spent

    def _ask(self, run: _Run, agent: Agent, observation: Any, action: Array) -> bool:
        """Fill in the next action (1, size) of a run; return whether its agent reads the next images."""
        due = True

        def act() -> Any:
            nonlocal due
            chosen = agent.act(observation)
            due = reads_images(agent)
            return chosen

        self._fill(run, act, action)
        return due

    def _fill(self, run: _Run, act: Callable[[], Any], action: Array) -> None:
        """Fill in the next action (1, size) of a run by a function, within the agent's time."""
        began = time.perf_counter()
        try:
            action[:] = run.player.deadline.call(lambda: check_actions(np.asarray(act())[None], 1, self._space))
        except Exception as error:
            self._fail(run, error)
        else:
            self._proven = True
        run.action_time += time.perf_counter() - began

    def _copy(self, agent: Agent) -> Agent:
        try:
            return Deadline(self._copying).call(copy.deepcopy, agent)
        except Exception as error:
            raise AgentError(
                f"agent {self._asked.name!r} cannot be copied for each simulation ({describe(error)}); "
                "give it a method act_many(observations), or use num_envs=1"
            ) from error

    def _run_part(self, deadline: Deadline, function: Callable[..., Any], *arguments: Any) -> Any:
        """Run the agent's own observation or action, without which no episode can go on, at the expense of its time."""
        began = time.perf_counter()
        try:
            return deadline.call(function, *arguments)
        except Exception as error:
            what = "its own observation or action failed"
            raise AgentError(f"agent {self._asked.name!r}: {what}: {describe(error)}") from error
        finally:
            self._spent += time.perf_counter() - began

    def _fail(self, run: _Run, error: Exception) -> None:
        run.failure = describe(error)
        if not self._proven:
            raise never_acted(self._asked.name, run.problem.seed, run.failure) from error

    def _ended(self, runs: list[_Run | None], i: int) -> Iterator[EpisodeResult]:
        """Yield the result of a run whose agent failed."""
        run = runs[i]
        if run is not None and run.failure:
            runs[i] = None
            yield self._result(i, run)

    def _result(self, i: int, run: _Run) -> EpisodeResult:
        simulation = self._simulation
        info = {key: values[i] for key, values in simulation.info().items()}
        steps = len(run.joints) - 1
        path = np.array(run.joints)
        model, _ = simulation.model_and_data(i)
        compiled, target = simulation.physical(i)
        if model.nq > compiled.model.nq:  # clearance is that to the plants as they hung at the start
            model = compiled.model
        tips = tool_state(tool_chain(model, compiled.tip_site), path).point
        record = Record(
            seed=run.problem.seed,
            scene=info["scene"],
            target=int(info["target"]),
            difficulty=info["difficulty"],
            success=bool(info["is_success"]) and not run.failure,
            collision=bool(info["collision"]),
            contact=tuple(filter(None, info["contact"].split(NAME_SEPARATOR))),
            steps=steps,
            planning_time=run.planning_time,
            action_time=run.action_time / max(1, steps),
            joint_length=path_length(path),
            tip_length=path_length(tips),
            clearance=smallest_clearance(compiled, model, target, path, simulation.worlds.leaves),
            roughness=float(np.linalg.norm(np.diff(path, n=2, axis=0), axis=-1).mean()) if steps > 1 else 0.0,
            total_reward=run.total_reward,
            distance=float(info["distance"]),
            status=_status(run.player),
            failure=run.failure,
            measures={name: float(info[name]) for name in simulation.measures},
        )
        return EpisodeResult(run.index, record, path)


def _status(player: _Player) -> str:
    """Return the agent's status of its plan, or an empty text if it has none that can be printed."""
    try:
        return printable(player.deadline.call(lambda: str(getattr(player.agent, "status", ""))))
    except Exception:
        return ""
