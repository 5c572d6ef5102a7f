"""Batches of an evaluation's episodes, run in this process or by an executor's workers."""

from __future__ import annotations

import math
import pickle
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

from greenhouse_gym.common.executors import WorkerLostError, completed, portable, workers_of
from greenhouse_gym.envs import GreenhouseVectorEnv, make_vec_env
from greenhouse_gym.errors import GreenhouseError, InvalidValueError
from greenhouse_gym.evaluation.deadline import AgentError, AskedAgent, Deadline, Watchdog
from greenhouse_gym.evaluation.records import Record
from greenhouse_gym.evaluation.runner import GRACE, EpisodeRunner

_BATCHES = 16  # per worker, so that all workers finish at about the same time and an interruption loses little


@dataclass(frozen=True)
class Batch:
    """Some of an evaluation's episodes, which can be sent to another process.

    Attributes:
        asked: The agent.
        chosen: Index and reset options of each episode.
        seed: Seed of episode 0.
        num_envs: Number of episodes run in parallel.
        timeout: See `evaluate`.
        keywords: Keywords of the environment.
        own: Those of them that are the agent's.
        proven: The agent is known to give valid actions.
        workers: Number of processes that run such batches; zero in this one.
    """

    asked: AskedAgent
    chosen: tuple[tuple[int, dict[str, Any]], ...]
    seed: int
    num_envs: int
    timeout: float | None
    keywords: dict[str, Any]
    own: tuple[str, ...]
    proven: bool = False
    workers: int = 0

    def records(self) -> Iterator[tuple[int, Record]]:
        """Yield indices and records of the episodes in the order in which they end."""
        env = self._environment(min(self.num_envs, max(1, len(self.chosen))))
        try:
            runner = EpisodeRunner(
                self.asked, env, deque(self.chosen), self.seed, self.timeout, self.proven, self.workers
            )
            yield from ((result.episode_index, result.record) for result in runner.run())
        finally:
            env.close()

    def _environment(self, count: int) -> GreenhouseVectorEnv:
        try:
            return make_vec_env(count, **self.keywords)
        except GreenhouseError as error:
            others = {name: value for name, value in self.keywords.items() if name not in self.own}
            make_vec_env(count, **others).close()  # fails if it is not the agent's fault
            shown = ", ".join(sorted(self.own))
            raise AgentError(f"agent {self.asked.name!r}: its env_options ({shown}) cannot be used: {error}") from error

    def run(self) -> list[tuple[int, Record]]:
        """Return all indices and records."""
        return list(self.records())


@dataclass(frozen=True)
class _Packed:
    """Pickled batch; unpickling runs the agent's code, so that it has a time limit.

    Attributes:
        whole: The pickled `Batch`, of no episodes.
        chosen: See `Batch`.
        timeout: See `evaluate`.
    """

    whole: bytes
    chosen: tuple[tuple[int, dict[str, Any]], ...]
    timeout: float | None

    def run(self) -> list[tuple[int, Record]]:
        """Return all indices and records."""
        with nullcontext() if self.timeout is None else Watchdog(self.timeout + GRACE):
            whole: Batch = pickle.loads(self.whole)
        return replace(whole, chosen=self.chosen).run()


def run_by(executor: Executor, whole: Batch) -> Iterator[tuple[int, Record]]:
    """Yield indices and records of all episodes, run in batches by an executor's workers."""
    name, chosen, workers = whole.asked.name, whole.chosen, workers_of(executor)
    size = max(whole.num_envs, math.ceil(len(chosen) / (_BATCHES * workers)))
    whole = replace(whole, chosen=(), proven=True, workers=0 if isinstance(executor, ThreadPoolExecutor) else workers)
    try:
        packed = Deadline(whole.timeout).call(portable, executor, "with its options it", whole)
    except (InvalidValueError, TimeoutError) as error:
        raise AgentError(f"agent {name!r} cannot be sent to another process: {error}") from error
    batches = (chosen[k : k + size] for k in range(0, len(chosen), size))
    parts = (_Packed(packed, part, whole.timeout) if packed else replace(whole, chosen=part) for part in batches)
    try:
        for records in completed(_run, parts, executor):
            yield from records
    except WorkerLostError as error:
        raise WorkerLostError(f"agent {name!r}: {error}") from error


def _run(part: Batch | _Packed) -> list[tuple[int, Record]]:
    return part.run()
