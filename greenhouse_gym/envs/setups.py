"""Setups of episodes: the episode drawn at a reset and its world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from greenhouse_gym.envs.episodes import Episode, EpisodeSampler
from greenhouse_gym.envs.randomization import Disturbance, Randomization, draw_disturbance
from greenhouse_gym.envs.task import Task
from greenhouse_gym.envs.world import World
from greenhouse_gym.envs.worlds import Worlds
from greenhouse_gym.scene.occupancy import require_occupancy
from greenhouse_gym.scene.plants.slots import Planted, choose_organs


class Setup(NamedTuple):
    """Setup of an episode.

    Attributes:
        episode: Scene, targets and start.
        world: World of the scene, after its plants moved if they are randomized.
        disturbance: Randomization of the episode.
        planted: Organs that give way and push back; None if there are none.
    """

    episode: Episode
    world: World
    disturbance: Disturbance
    planted: Planted | None


def draw_setup(
    task: Task,
    sampler: EpisodeSampler,
    worlds: Worlds,
    randomization: Randomization,
    requires_occupancy: bool,
    rng: np.random.Generator,
    options: Mapping[str, Any] | None,
) -> Setup:
    """Draw the setup of an episode.

    Args:
        task: The task, which draws scene and targets.
        sampler: Source of scenes and targets.
        worlds: Cache of worlds.
        randomization: Ranges of the randomization.
        requires_occupancy: The scene must have an occupancy grid.
        rng: Generator of the simulation.
        options: Options of the reset.
    """
    episode = task.sample(sampler, rng, options)
    scene = episode.scene
    if requires_occupancy:
        require_occupancy(scene.occupancy, scene.name, "the observation", 'observe the "state" alone')
    disturbance = draw_disturbance(randomization, len(sampler.robot.joints), rng)
    world = worlds.world(scene, sampler.at_a_time)
    if randomization.plants is not None and disturbance.plants is not None:
        world = worlds.moved(world, randomization.plants, disturbance.plants)
    planted = None
    if worlds.layout is not None:
        fruit = episode.fruit or tuple(dict.fromkeys(world.bodies[list(episode.targets)].tolist()))
        planted = choose_organs(
            world.compiled,
            world.slots,
            world.topology,
            fruit,
            worlds.layout,
            task.mechanics.scaled(disturbance.mechanics),
            world.filled,
        )
    asked = options is not None and options.get("start") is not None
    if not asked and np.array_equal(episode.start, sampler.robot.start):
        episode = replace(episode, start=world.start)
    return Setup(episode, world, disturbance, planted)
