"""Contacts have the names of the scene of the episode."""

from __future__ import annotations

import numpy as np

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.envs import GreenhouseEnv
from greenhouse_gym.geometry import Sphere
from greenhouse_gym.scene import Scene, SceneBank


def test_contacts_are_named_as_in_the_scene_of_the_episode(bank: SceneBank) -> None:
    env = GreenhouseEnv(bank=bank, start="upright")
    whole = bank.scene("made-up-0")
    leaf = Sphere([0.0, 0.0, 1.6], 0.05)  # where the upright arm is
    fewer = Scene(
        name="fewer",
        tomatoes=(Tomato(Sphere([0.6, 0.0, 1.2], 0.03), truss=0),),
        clutter=(leaf,),
        provenance=whole.provenance,
    )
    more = fewer.model_copy(update={"name": "more", "tomatoes": whole.tomatoes})
    env.reset(seed=0, options={"scene": whole, "target": 0})
    for scene in (fewer, more, fewer):
        _, info = env.reset(seed=0, options={"scene": scene, "target": 0})
        assert info["collision"]
        assert info["contact"].split(", ")[1] == "clutter_0", scene.name
    assert np.isfinite(info["distance"])
