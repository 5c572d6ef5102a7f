from __future__ import annotations

import mujoco
import numpy as np

from greenhouse_gym.crops.parts import Stem
from greenhouse_gym.scene import Provenance, Scene, compile_scene


def test_capsules_lie_between_their_ends() -> None:
    random = np.random.default_rng(0)
    ends = [random.uniform(-1, 1, (2, 3)) for _ in range(20)]
    ends += [np.array([[0, 0, z], [0, 0, -z]]) for z in (1.0, -1.0)] + [np.array([[0.0, 0, 1], [1e-3, 0, -1]])]
    stems = tuple(Stem(a, b, 0.01, kind="main") for a, b in ends)
    compiled = compile_scene(Scene(name="s", stems=stems, provenance=Provenance(row="r")))
    data = mujoco.MjData(compiled.model)
    mujoco.mj_kinematics(compiled.model, data)
    for k, (start, end) in enumerate(ends):
        geom = compiled.obstacle_geoms.start + k
        axis = data.geom_xmat[geom].reshape(3, 3)[:, 2] * compiled.model.geom_size[geom, 1]
        np.testing.assert_allclose(data.geom_xpos[geom] - axis, start, atol=1e-9)
        np.testing.assert_allclose(data.geom_xpos[geom] + axis, end, atol=1e-9)
