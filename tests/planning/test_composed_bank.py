from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from greenhouse_gym.envs import GreenhouseVectorEnv
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Sphere
from greenhouse_gym.geometry.shapes import mirrored
from greenhouse_gym.planning import ComposedBank
from greenhouse_gym.planning.audit import witness_faults
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.composition import HALF_WIDTH, ROOM, composed_scene, plants_of
from greenhouse_gym.scene.obstacles import Shapes


@pytest.fixture(scope="module")
def composed() -> ComposedBank:
    return ComposedBank("mini", count=1000, seed=3, targets=1)


def same(a: Scene, b: Scene) -> bool:
    return a.model_dump() == b.model_dump() or a.model_dump_json() == b.model_dump_json()


def test_a_scene_depends_on_seed_and_index_alone(composed: ComposedBank) -> None:
    again = pickle.loads(pickle.dumps(composed))
    assert same(again[7], composed[7])
    assert not same(composed[7].model_copy(update={"name": "x"}), composed[8].model_copy(update={"name": "x"}))
    assert len(composed) == 1000
    assert composed.sha256 == again.sha256


def test_a_scene_is_one_of_a_bank(composed: ComposedBank) -> None:
    """Its witnesses hold, its starts are free, and it has the size and the reach of scenes of the bank."""
    source = SceneBank.open("mini").select(split="train")
    scene = composed[7]
    assert not list(witness_faults(scene))
    assert any(target.witness for target in scene.targets)
    assert scene.count <= max(s.count for s in source)
    middles = (scene.arrays.starts + scene.arrays.ends)[:, 1] / 2
    assert np.abs(middles).max() <= HALF_WIDTH + 0.1  # where plants moved a little
    trusses = {tomato.truss for tomato in scene.tomatoes}
    assert trusses <= set(range(1000))


def test_environments_draw_from_it(composed: ComposedBank) -> None:
    env = GreenhouseVectorEnv(2, bank=composed, difficulty=("easy", "medium", "hard"))
    assert env.reset(seed=0)[0].shape == env.observation_space.shape


def test_plants_make_up_their_scene() -> None:
    for scene in SceneBank.open("mini").select(split="train"):
        plants = plants_of(scene)
        assert all(abs(foot[1]) <= HALF_WIDTH - ROOM for foot, _ in plants)
        assert sum(len(plant.tomatoes) for _, plant in plants) <= len(scene.tomatoes)
        for foot, plant in plants:
            stems = [stem for stem in plant.stems if stem.kind == "main"]
            assert stems
            assert abs(np.mean([stem.start[1] for stem in stems]) - foot[1]) < 0.2
    bare = scene.model_copy(update={"stems": ()})
    assert plants_of(bare) == []
    empty = composed_scene(bare, lambda: (np.zeros(2), Shapes()), np.random.default_rng(0), "empty", 600)
    assert len(empty.tomatoes) == 0


def test_mirror_images_are_mirrored() -> None:
    sphere = mirrored(Sphere([1.0, 2.0, 3.0], 0.1), np.array([1.0, -1.0, 1.0]), np.array([0.0, 0.5, 0.0]))
    np.testing.assert_array_equal(sphere.center, [1.0, -1.5, 3.0])


def test_wrong_numbers_and_banks_without_plants(tmp_path) -> None:
    for wrong in ({"count": 0}, {"targets": 0}, {"seed": -1}):
        with pytest.raises(InvalidValueError):
            ComposedBank("mini", **wrong)
    with pytest.raises(InvalidValueError, match="no training scene with a complete plant"):
        ComposedBank(SceneBank.open("mini").select(split="test"))


def test_an_interrupted_bank_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bank = ComposedBank("mini", 2, targets=1)

    def interrupt(done: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        bank.write(tmp_path, interrupt)
    monkeypatch.setattr(bank, "scene", {name: bank.scene(name) for name in bank.names()[1:]}.get)
    written = bank.write(tmp_path)
    assert [scene.name for scene in written] == list(bank.names())
    again = ComposedBank("mini", 2, targets=2)
    monkeypatch.setattr(again, "scene", pytest.fail)
    with pytest.raises(pytest.fail.Exception, match=bank.names()[0]):
        again.write(tmp_path)
    with pytest.raises(InvalidValueError, match="another folder"):
        bank.write(SceneBank.open("mini").path)
