from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.envs.stepping import drive_and_record
from greenhouse_gym.geometry import Box, Capsule, Ellipsoid, Sphere, rotation_about
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import ArmPlacement, Provenance, Scene, SceneBank, compile_scene, scene_spec
from greenhouse_gym.scene.plant_motion import move_plants
from greenhouse_gym.scene.truth import true_scene

NAMES = {"names", "names_map"}
EDIT = partial(drive_and_record, substeps=5)


def random_scene(seed: int, count: int) -> Scene:
    rng = np.random.default_rng(seed)

    def turn() -> np.ndarray:
        return rotation_about(rng.normal(size=3), float(rng.choice([0.0, 1e-8, 1.9e-6, 1e-5, 1.0, np.pi])))

    def point() -> np.ndarray:
        # many equal coordinates, so that the tree has ties
        return np.round(rng.uniform(-1.5, 1.5, 3), int(rng.integers(0, 4)))

    def stem() -> np.ndarray:
        start = point()
        return np.array([start, start + [[0, 0, 0], [0, 0, 0.3], [0, 0, -0.2], rng.normal(size=3)][rng.integers(4)]])

    tomatoes = [Tomato(Sphere(point(), rng.uniform(0.01, 0.05)), 0, 0.5) for _ in range(count)]
    tomatoes += [Tomato(Ellipsoid(point(), rng.uniform(0.01, 0.05, 3), turn()), 1) for _ in range(count)]
    return Scene(
        name="random",
        tomatoes=tuple(tomatoes),
        stems=tuple(Stem(*stem(), rng.uniform(0.001, 0.02), kind="main") for _ in range(count)),
        clutter=(
            *(Box(point(), rng.uniform(0.001, 0.2, 3), turn()) for _ in range(2 * count)),
            *(Capsule(*stem(), 0.01) for _ in range(count)),
            *(Sphere(point(), 0.1) for _ in range(count // 2)),
        ),
        placement=ArmPlacement(position=[0.05, 0.1, 0.0], yaw=0.3, shoulder_height=1.2),
        provenance=Provenance(row="r"),
    )


def differences(scene: Scene, capacity: int, robot: str = "ur5e") -> list[str]:
    """Names of the arrays that differ from those that MuJoCo compiles."""
    filled = compile_scene(scene, robot, capacity, EDIT).model
    spec = scene_spec(scene, robot, capacity)
    EDIT(spec)
    compiled = spec.compile()
    arrays = {
        n for n in dir(compiled) if isinstance(getattr(compiled, n), np.ndarray) and not n.startswith(("name_", "_"))
    }
    arrays = {name for name in arrays - NAMES if not name.startswith(("name_", "_"))}
    return [name for name in sorted(arrays) if not np.array_equal(getattr(filled, name), getattr(compiled, name))]


@pytest.mark.parametrize(("seed", "count"), [(0, 0), (1, 1), (2, 2), (3, 17), (4, 60)])
def test_slots_are_filled_as_mujoco_compiles_them(seed: int, count: int) -> None:
    assert differences(random_scene(seed, count), 6 * count + count // 2 + 3) == []


@pytest.mark.parametrize("robot", ["ur5e", "iiwa14"])
def test_shipped_scenes_and_true_rows_are_filled_as_mujoco_compiles_them(robot: str) -> None:
    for scene in SceneBank.open("mini")[:3]:
        assert differences(scene, 600, robot) == []
    true = true_scene(SceneBank.open("mini")[0])
    assert differences(true, true.count, robot) == []


@pytest.mark.parametrize("robot", ["ur5e", "iiwa14"])
def test_arms_at_other_places_are_those_that_mujoco_compiles(robot: str) -> None:
    scene, low = random_scene(0, 3), get_robot(robot).shoulder_height
    for height, yaw in ((low + 0.3, 0.4), (low, -0.2), (low + 0.55, 0.0), (low + 0.3, 0.4), (low, 1.0)):
        placement = ArmPlacement(position=np.array([0.3 * yaw, -0.2, height / 9]), yaw=yaw, shoulder_height=height)
        assert differences(scene.model_copy(update={"placement": placement}), 25, robot) == []


def test_moved_plants_are_compiled_anew_and_leave_the_model_before() -> None:
    true = true_scene(SceneBank.open("mini")[0])
    before = compile_scene(true, "ur5e", 5000)
    kept = before.model.geom_pos.copy()
    motion = PlantMotion(truss_turn=0.5, truss_swing=0.3, stem_shift=0.2, leaf_shift=0.3)
    plants = move_plants(true, motion, np.random.default_rng(5))
    moved = true.model_copy(update={name: getattr(plants, name) for name in ("tomatoes", "stems", "clutter")})
    assert differences(moved, 5000) == []
    np.testing.assert_array_equal(before.model.geom_pos, kept)
    assert not np.array_equal(compile_scene(moved, "ur5e", 5000).model.geom_pos, kept)


def test_names_of_slots_are_those_of_the_obstacles_in_them() -> None:
    scene = random_scene(0, 2)
    plain, padded = compile_scene(scene), compile_scene(scene, capacity=20)
    for geom in range(plain.model.ngeom):
        slot = geom >= plain.obstacle_geoms.stop
        assert padded.geom_name(geom + (20 - scene.count) * slot) == plain.geom_name(geom)
    assert (
        plain.geom_name(plain.obstacle_geoms.start) == plain.model.geom(plain.obstacle_geoms.start).name == "tomato_0"
    )
    assert padded.robot is get_robot("ur5e")
