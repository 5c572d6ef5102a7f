"""Films of an agent's episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from greenhouse_gym.agents import Agent, Problem
from greenhouse_gym.agents.agent import knows_truth, options_for
from greenhouse_gym.agents.named import agent_of
from greenhouse_gym.envs import make_env
from greenhouse_gym.envs.actions import check_actions
from greenhouse_gym.envs.contacts import NAME_SEPARATOR
from greenhouse_gym.envs.environment import GreenhouseEnv
from greenhouse_gym.errors import InvalidValueError, check_whole, require_seed
from greenhouse_gym.evaluation.deadline import never_acted
from greenhouse_gym.geometry import Array
from greenhouse_gym.rendering.picture_files import FILMS, require_picture, with_caption, write_film
from greenhouse_gym.rendering.renderer import Image
from greenhouse_gym.rendering.viewer import Picture, Viewer

_HOLD = 1.0  # seconds for which the last image of an episode stays


class FilmedEpisode(NamedTuple):
    """An episode of a film.

    Attributes:
        title: Agent, scene and target.
        success: The episode ended with success.
        outcome: How it ended.
    """

    title: str
    success: bool
    outcome: str


def film(
    agent: Agent | str,
    out: str | Path,
    seed: int = 0,
    *,
    episodes: int = 1,
    fps: float | None = None,
    picture: Picture | None = None,
    on_progress: Callable[[int], None] = lambda steps: None,
    **options: Any,
) -> list[FilmedEpisode]:
    """Film episodes of an agent in real time, as MP4, GIF or WebP; each ends with a caption of its outcome.

    Args:
        agent: The agent, or a name that `greenhouse_gym.agents.make_agent` takes; its ``env_options`` choose the
            environment.
        out: The file; its suffix, .mp4, .gif or .webp, chooses the format.
        seed: Seed of the first episode, as in `greenhouse_gym.evaluation.evaluate`; each further episode adds one.
        episodes: Number of episodes.
        fps: Images per second, at most one for each action, which is the default.
        picture: Size and camera of the images.
        on_progress: Called with the number of actions so far.
        **options: Further keywords of the environment, such as ``scene`` and ``target``. They must agree with the
            agent's ``env_options``.

    Raises:
        InvalidValueError: An argument is invalid, or an option contradicts the agent's ``env_options``.
        MissingDependencyError: The film is an MP4 file, and the extra ``viz`` is not installed.
        AgentError: The agent failed before its first action.
    """
    require_picture(out, FILMS)
    agent = agent_of(agent)
    require_seed(seed)
    check_whole("episodes", episodes, 1)
    env = make_env(**options_for(agent, options))
    rate = 1.0 / env.simulation.interval
    fps = rate if fps is None else fps
    if not 0 < fps <= rate:
        raise InvalidValueError(f"fps must be above 0 and at most {rate:g}, the number of actions a second, got {fps}")
    viewer, filmed = Viewer("rgb_array", picture), list[FilmedEpisode]()
    steps = count(1)

    def images() -> Iterator[Image]:
        for k in range(episodes):
            yield from _Take(agent, env, viewer, fps, lambda: on_progress(next(steps))).images(seed + k, filmed)

    try:
        write_film(images(), out, fps)
    finally:
        viewer.close()
        env.close()
    return filmed


class _Take(NamedTuple):
    agent: Agent
    env: GreenhouseEnv
    viewer: Viewer
    fps: float
    on_step: Callable[[], None]

    def images(self, seed: int, filmed: list[FilmedEpisode]) -> Iterator[Image]:
        """Run an episode; yield its images, and append it to the filmed ones."""
        env, simulation = self.env, self.env.simulation
        observation, info = env.reset(seed=seed)
        title = f"{self.agent.name}: {info['scene']}, tomato {info['target']} ({info['difficulty']})"
        problem = Problem.of(simulation, 0, seed, knows_truth(self.agent))
        trace, failure, over = [simulation.tip(0)], "", False
        yield self._image(trace, title)
        try:
            self.agent.reset(problem)
        except Exception as error:
            raise never_acted(self.agent.name, seed, f"{type(error).__name__}: {error}") from error
        while not over:
            try:
                answer = np.asarray(self.agent.act(observation))
                action = check_actions(answer[None], 1, simulation.action_space)[0]
            except Exception as error:
                failure = f"{type(error).__name__}: {error}"
                if not info["steps"] and not filmed:
                    raise never_acted(self.agent.name, seed, failure) from error
                break
            observation, _, terminated, truncated, info = env.step(action)
            self.on_step()
            trace.append(simulation.tip(0))
            over = terminated or truncated
            if not over and self._is_due(info["steps"]):
                yield self._image(trace, title)
        contact = info["contact"].split(NAME_SEPARATOR)
        measures = {name: float(info[name]) for name in simulation.measures}
        ended = outcome(
            info["is_success"], info["collision"], contact, info["steps"], info["distance"], failure, measures
        )
        last = self._image(trace, f"{title}\n{ended}")
        for _ in range(max(1, round(self.fps * _HOLD))):
            yield last
        filmed.append(FilmedEpisode(title, bool(info["is_success"]) and not failure, ended))

    def _is_due(self, steps: int) -> bool:
        """Return whether an image is due after an action."""
        per_step = self.fps * self.env.simulation.interval
        return int(steps * per_step + 1e-6) > int((steps - 1) * per_step + 1e-6)

    def _image(self, trace: list[Array], caption: str) -> Image:
        env = self.env
        image = self.viewer.draw(
            *env.model_and_data(), env.scene.placement, trace[-1], env.simulation.goal(0), trace
        )  # fmt: skip
        assert image is not None
        return with_caption(image, caption)


def outcome(
    success: bool,
    collision: bool,
    contact: Sequence[str],
    steps: int,
    distance: float,
    failure: str = "",
    measures: Mapping[str, float] = MappingProxyType({}),
) -> str:
    """Describe how an episode ended; the values are those of `greenhouse_gym.evaluation.Record`."""
    crated = f"{measures['crated']:.0f} of {measures['wanted']:.0f} in the crate" if "crated" in measures else ""
    if failure:
        return f"gave up after {steps} actions: {failure}"
    if collision:
        return f"hit {contact[-1]} with its {contact[0]} after {steps} actions" + (f", {crated}" if crated else "")
    if crated:
        return f"{crated} after {steps} actions"
    if success:
        return f"reached it after {steps} actions"
    return f"ended {100 * distance:.0f} cm from it after {steps} actions"
