from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from greenhouse_gym.cli import app
from greenhouse_gym.common.files import exclusive
from greenhouse_gym.envs import GreenhouseEnv
from greenhouse_gym.errors import FileWriteError, InvalidValueError
from greenhouse_gym.motion.collision import PROOF
from greenhouse_gym.planning import CollisionChecker, certify, plan, planning_model
from greenhouse_gym.planning.rated_banks import RATING, brush_bank, rate_bank
from greenhouse_gym.robots import get_robot, load_robot
from greenhouse_gym.scene import Scene, SceneBank, compile_scene
from greenhouse_gym.scene.bank import write_bank

sys.path.insert(0, str(Path(__file__).parents[1] / "robots"))
from conftest import make_scene
from foreign_arms import write_arm


def small(scene: Scene) -> Scene:
    """The scene with its first two trusses only."""
    return scene.model_copy(update={"tomatoes": scene.tomatoes[:6], "targets": scene.targets[:6]})


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> SceneBank:
    scenes = [(small(make_scene(0)), "train"), (small(make_scene(1)), "test")]
    return write_bank(tmp_path_factory.mktemp("few"), scenes, name="few")


@pytest.mark.parametrize("name", ["fr3", "ur10e", "gen3"])
def test_arms_from_elsewhere_go_through_rate_plan_and_train(name: str, few: SceneBank, tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    from greenhouse_gym.learning.ppo import PpoSettings, train_ppo

    bare, file = write_arm(name, tmp_path), tmp_path / "arm.xml"
    for command in (
        ["mount", str(bare), "--out", str(file)],
        ["rate", str(few.path), "--robot", str(file), "--out", str(tmp_path / "rated")],
    ):
        result = CliRunner().invoke(app, command, catch_exceptions=False)
        assert result.exit_code == 0, result.output
    rated, arm = SceneBank.open(tmp_path / "rated"), get_robot(file)
    assert rated.names() == few.names()
    assert [rated.split_of(n) for n in rated.names()] == ["train", "test"]
    witnesses = 0
    for scene in rated:
        mine = [target for target in scene.targets if target.robot == arm.name]
        assert [target.tomato for target in mine] == list(range(6))
        assert [target for target in scene.targets if target.robot == "ur5e"] == list(
            few.scene(scene.name).targets
        )  # those of the other arm stay
        for target in mine:
            if target.witness is not None:
                checker = CollisionChecker(planning_model(compile_scene(scene, arm), target.tomato))
                assert checker.path_is_free(np.array(target.witness), PROOF)
                assert np.allclose(target.witness[0], arm.start, atol=1e-6)
                witnesses += 1
    assert witnesses >= 6
    reachable = next(t for t in rated[0].targets if t.robot == arm.name and t.witness)
    assert plan(rated[0], reachable.tomato, arm, max_checks=50_000, time_limit=None).status == "solved"
    env = GreenhouseEnv(bank=rated, robot=arm, split="train")
    env.reset(seed=0)
    assert env.simulation.info()["difficulty"][0] in ("easy", "medium", "hard")
    env.close()
    settings = PpoSettings(
        bank=str(rated.path), robot=str(file), total_steps=64, num_envs=4, rollout_steps=8, batch_size=16, epochs=1,
        hidden=(16, 16),
    )  # fmt: skip
    assert train_ppo(settings, tmp_path / "run").exists()


def test_one_process_at_a_time_writes_a_rated_bank(few: SceneBank, tmp_path: Path) -> None:
    with exclusive(tmp_path):
        for write in (lambda: rate_bank(few, "iiwa14", tmp_path), lambda: brush_bank(few, tmp_path)):
            with pytest.raises(FileWriteError, match="another process is at work in this folder"):
                write()


def test_rating_goes_on_where_it_was_interrupted(
    few: SceneBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def stop_in_the_second(done: int) -> None:
        asked.append(done)
        if done == 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rate_bank(few, "iiwa14", tmp_path / "out", on_progress=stop_in_the_second)
    assert not (tmp_path / "out" / "manifest.json").exists()
    assert asked == [1, 2, 3, 4, 5, 6, 7, 8]
    asked.clear()
    rated = rate_bank(few, "iiwa14", tmp_path / "out", on_progress=asked.append)
    assert asked == [7, 8, 9, 10, 11, 12]
    again = rate_bank(few, "iiwa14", tmp_path / "again")
    for name in few.names():
        assert (tmp_path / "again" / f"{name}.json").read_bytes() == (tmp_path / "out" / f"{name}.json").read_bytes()
    assert rated.scene("made-up-0").provenance.settings[RATING]["robot"] == "iiwa14"
    assert len(again) == 2
    # another seed, and another arm of the same name, are rated anew
    monkeypatch.setattr(certify, "certify_target", lambda compiled, tomato, seed: again[0].targets[0])
    counted: list[int] = []
    rate_bank(few, "iiwa14", tmp_path / "out", seed=1, on_progress=counted.append)
    assert counted


def test_a_bank_is_not_rated_onto_itself(few: SceneBank) -> None:
    with pytest.raises(InvalidValueError, match="needs another folder"):
        rate_bank(few, "ur5e", few.path)


def test_an_arm_that_starts_in_the_plants_is_named(few: SceneBank, tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"at its start the arm reaches.*start=\"ready\""):
        arm = load_robot(write_arm("fr3", tmp_path))
    reach = make_scene(0).tomatoes[0].center
    scene = small(make_scene(0)).model_copy(
        update={"tomatoes": tuple(t for t in make_scene(0).tomatoes[:1]), "targets": ()}
    )
    assert reach[0] > 0.4
    blocked = scene.model_copy(update={"clutter": (*scene.clutter, scene.clutter[0].__class__(
        [0.45, 0.0, 1.3], [0.2, 0.3, 0.3], np.eye(3)
    ))})  # fmt: skip
    bank = write_bank(tmp_path / "bank", [(blocked, "train")], name="blocked")
    with pytest.raises(InvalidValueError, match=r"fr3 touches something at its start in every scene: made-up-0 \("):
        rate_bank(bank, arm, tmp_path / "out")
