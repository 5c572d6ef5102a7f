from __future__ import annotations

import copy
import gc
import json
import weakref
from pathlib import Path

import mujoco
import numpy as np
import pytest

from greenhouse_gym.envs import GreenhouseEnv, GreenhouseVectorEnv, world, worlds
from greenhouse_gym.envs.world import capacity_of
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Box, pose
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank, Shapes
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.geom_order import put_arm_first
from greenhouse_gym.scene.mjcf import name_of


def test_old_worlds_make_room_unless_somebody_is_in_them(bank: SceneBank, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worlds, "CACHED", 2)
    kept = worlds.Worlds(get_robot("ur5e"), "reconstruction", 300)
    in_use = kept.world(bank[0])
    for scene in bank:
        kept.world(scene)
    gc.collect()
    assert len(kept.fields) == 3  # the last two, and the one in use
    assert kept.world(bank[0]) is in_use
    again = kept.world(bank[1])
    assert again.scene is bank[1]
    del in_use, again
    kept.world(bank[2]), kept.world(bank[3])
    gc.collect()
    assert len(kept.fields) == 2


def test_a_scene_with_more_obstacles_than_fit_names_both_numbers(bank: SceneBank) -> None:
    env = GreenhouseVectorEnv(2, bank=bank, capacity=5)
    with pytest.raises(InvalidValueError, match="more than the 5 allowed"):
        env.reset(seed=0)
    roomy = GreenhouseVectorEnv(2, bank=bank, capacity=50)
    usual = GreenhouseVectorEnv(2, bank=bank)
    np.testing.assert_array_equal(roomy.reset(seed=0)[0], usual.reset(seed=0)[0])


def test_truth_chooses_its_capacity_from_the_bank(bank: SceneBank, tmp_path: Path) -> None:
    crowd = tuple(Box([2.0, 0.01 * k, 1.0], [0.01, 0.001, 0.01], np.eye(3)) for k in range(633))
    scenes = [scene.model_copy(update={"truth": Shapes(tomatoes=scene.tomatoes, clutter=crowd)}) for scene in bank]
    true = write_bank(tmp_path, [(scene, bank.split_of(scene.name)) for scene in scenes], name="true")
    assert true.largest_truth() == 633 + 12
    env = GreenhouseVectorEnv(2, bank=true, physics="truth")
    env.reset(seed=0)
    assert env.simulation.worlds.capacity == 700
    assert capacity_of(true, "reconstruction") == capacity_of(bank, "truth") == 600
    with pytest.raises(InvalidValueError, match=r"made-up-\d.*no truth.*simulated"):
        GreenhouseVectorEnv(2, bank=bank, physics="truth").reset(seed=0)


def test_truth_of_more_shapes_than_are_allowed_names_the_scene_and_the_remedy(
    bank: SceneBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (world, worlds):
        monkeypatch.setattr(module, "MAX_CAPACITY", 640)
    crowd = tuple(Box([2.0, 0.01 * k, 1.0], [0.01, 0.001, 0.01], np.eye(3)) for k in range(633))
    scenes = [scene.model_copy(update={"truth": Shapes(tomatoes=scene.tomatoes, clutter=crowd)}) for scene in bank]
    crowded = write_bank(tmp_path, [(scene, bank.split_of(scene.name)) for scene in scenes], name="crowded")
    assert capacity_of(crowded, "truth") == 640
    with pytest.raises(InvalidValueError, match=r"made-up-\d.* has 645 obstacles, more than the 640.*larger .*leaves"):
        GreenhouseVectorEnv(2, bank=crowded, physics="truth").reset(seed=0)


def test_an_environment_has_room_for_the_largest_scene_of_its_bank(bank: SceneBank, tmp_path: Path) -> None:
    crowd = tuple(Box([2.0, 0.01 * k, 1.0], [0.01, 0.001, 0.01], np.eye(3)) for k in range(633))
    scenes = [scene.model_copy(update={"clutter": crowd}) for scene in bank]
    large = write_bank(tmp_path, [(scene, bank.split_of(scene.name)) for scene in scenes], name="large")
    largest = max(len(scene.obstacles) for scene in large)
    assert large.largest_scene() == SceneBank.open(tmp_path).largest_scene() == largest
    env = GreenhouseVectorEnv(2, bank=large)
    env.reset(seed=0)
    assert env.simulation.worlds.capacity == 700


def test_a_bank_whose_manifest_does_not_tell_how_large_its_scenes_are_gets_the_usual_room(
    bank: SceneBank, tmp_path: Path
) -> None:
    written = write_bank(tmp_path, [(scene, bank.split_of(scene.name)) for scene in bank], name="earlier")
    manifest = json.loads((written.path / "manifest.json").read_text())
    for entry in manifest["scenes"]:
        del entry["shapes"]
    (written.path / "manifest.json").write_text(json.dumps(manifest))
    earlier = SceneBank.open(tmp_path)
    assert earlier.largest_scene() is None
    assert capacity_of(earlier, "reconstruction") == 600


def test_a_bank_that_is_written_anew_gives_its_new_scenes(scene: Scene, tmp_path: Path) -> None:
    def first_target(x: float) -> np.ndarray:
        moved = [t.transformed(pose(translation=[x, 0.0, 0.0])) for t in scene.tomatoes]
        placed = scene.model_copy(update={"tomatoes": tuple(moved)})
        write_bank(tmp_path, [(placed, "train")], name="same")
        env = GreenhouseEnv(bank=tmp_path)
        env.reset(seed=0, options={"scene": scene.name, "target": 0})
        bodies = env.model_and_data()[0].geom_pos
        assert np.abs(bodies - moved[0].center).max(axis=1).min() < 1e-7
        return env.simulation.state.target[0]

    before, after = first_target(0.0), first_target(0.05)
    np.testing.assert_allclose(after - before, [0.05, 0.0, 0.0], atol=1e-6)


def test_kinds_of_worlds_are_kept_only_so_long(bank: SceneBank) -> None:
    robot = get_robot("ur5e")
    kept = worlds.shared_worlds(robot, "reconstruction", 300)
    assert worlds.shared_worlds(robot, "reconstruction", 300) is kept
    assert worlds.shared_worlds(robot, "reconstruction", 300, substeps=2) is not kept
    last = [weakref.ref(worlds.shared_worlds(robot, "reconstruction", 301 + k)) for k in range(worlds.CACHED_KINDS + 1)]
    gc.collect()
    assert last[0]() is None
    assert last[1]() is not None


def test_parts_without_a_name_are_told_by_their_body() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom size='1'/><body name='link'><geom size='1'/><geom name='cup' size='1'/></body>"
        "<body><geom size='1'/></body></worldbody></mujoco>"
    )
    assert [name_of(model, geom) for geom in range(4)] == ["world", "link", "cup", "geom 3"]


def test_what_is_parked_twice_need_not_be_copied() -> None:
    bank = SceneBank.open("mini")
    kept = worlds.shared_worlds(get_robot("ur5e"), "reconstruction", 600)
    made = sorted((kept.world(bank.scene(name)) for name in bank.names()[:3]), key=lambda world: world.used)
    assert len({world.used for world in made}) == 3
    least, _, most = made
    for before, after in ((least, most), (most, least)):
        model, whole = copy.copy(before.compiled.model), copy.copy(after.compiled.model)
        put_arm_first(model)
        put_arm_first(whole)
        after.load(model, last=before)
        after.tree.load(whole)
        nodes = len(after.tree.geom)
        for name in dir(model):
            if name.startswith(("geom_", "bvh_", "body_")) and name != "bvh_depth":  # which drawings alone use
                found, expected = getattr(model, name), getattr(whole, name)
                if name.startswith("bvh_"):
                    found, expected = found[:nodes], expected[:nodes]
                np.testing.assert_array_equal(found, expected, err_msg=name)
