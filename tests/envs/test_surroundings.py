"""The clearances around the target in ``observation="clearance_rays"``."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.envs import GreenhouseEnv
from greenhouse_gym.envs.state import State
from greenhouse_gym.envs.surroundings import AZIMUTHS, ELEVATIONS, FAR, NEAR, NUM_CLEARANCES, POINTS
from greenhouse_gym.geometry import Sphere
from greenhouse_gym.motion.distance_field import MAX_DISTANCE
from greenhouse_gym.scene import Provenance, Scene, SceneBank, Target
from greenhouse_gym.scene.mjcf import base_position

TARGET = np.array([0.55, 0.1, 1.3])


def seen(*clutter: Sphere) -> np.ndarray:
    scene = Scene(
        name="one-tomato", tomatoes=(Tomato(Sphere(TARGET, 0.03), truss=0),), clutter=clutter,
        targets=(Target(tomato=0, difficulty="easy"),), provenance=Provenance(row="made-up"),
    )  # fmt: skip
    env = GreenhouseEnv(bank="mini", observation="clearance_rays")
    observation, _ = env.reset(options={"scene": scene, "target": 0})
    assert env.observation_space.contains(observation)
    assert base_position(scene, env.unwrapped.simulation.robot)[1] == 0  # type: ignore[attr-defined]
    env.close()
    return np.asarray(observation[-NUM_CLEARANCES:].reshape(len(AZIMUTHS), len(ELEVATIONS), 2))


def test_there_is_room_all_round_where_nothing_stands() -> None:
    assert (seen() == MAX_DISTANCE).all(), "the target is no obstacle to itself"


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 1), (5, 2)])
@pytest.mark.parametrize(("part", "distances"), [(0, NEAR), (1, FAR)])
def test_what_stands_on_a_ray_is_seen_on_that_ray(
    azimuth: int, elevation: int, part: int, distances: tuple[float, ...]
) -> None:
    a, e = AZIMUTHS[azimuth], ELEVATIONS[elevation]
    ray = np.array([-np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    clearances = seen(Sphere(TARGET + distances[1] * ray, 0.02))
    assert np.unravel_index(clearances[..., part].argmin(), clearances.shape[:2]) == (azimuth, elevation)
    assert clearances[azimuth, elevation, part] < 0.0, "within the obstacle, as far as a grid of 2 cm resolves"


def test_it_begins_as_the_state_does(bank: SceneBank) -> None:
    state, rays = (GreenhouseEnv(bank=bank, observation=kind).reset(seed=4)[0] for kind in ("state", "clearance_rays"))
    np.testing.assert_array_equal(rays[: len(state)], state)


@pytest.mark.parametrize(("asks", "numbers"), [(True, len(POINTS)), (False, 0)])
def test_the_room_is_looked_at_where_it_is_asked_for(asks: bool, numbers: int) -> None:
    class Wide:
        space = gymnasium.spaces.Box(0.0, 1000.0, (1,), dtype=np.float32)
        requires_surroundings = asks

        def __call__(self, state: State) -> np.ndarray:
            return np.full((len(state.joints), 1), state.surroundings.shape[1], dtype=np.float32)

    env = GreenhouseEnv(bank="mini", observation=Wide())
    assert env.reset(seed=0)[0].tolist() == [numbers]
    assert env.step(env.action_space.sample())[0].tolist() == [numbers]
    env.close()
