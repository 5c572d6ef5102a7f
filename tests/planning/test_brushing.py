"""Plans, roadmaps and ratings with leaves that give way: around them where possible, through few where not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from greenhouse_gym.agents import PlannerAgent, WaypointAgent
from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.geometry import Box, Sphere
from greenhouse_gym.motion.caution import with_margin
from greenhouse_gym.motion.goals import GoalSampler
from greenhouse_gym.motion.leaf_contacts import LeafContacts
from greenhouse_gym.motion.proof import ProvingChecker
from greenhouse_gym.motion.roadmap import SceneRoadmaps
from greenhouse_gym.planning import goal_configurations, plan, planning_model
from greenhouse_gym.planning.audit import witness_faults
from greenhouse_gym.planning.certify import certify_targets
from greenhouse_gym.planning.rated_banks import brush_bank, with_brush_certificates
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Provenance, Scene, Target, compile_scene
from greenhouse_gym.scene.bank import write_bank

CENTER = np.array([0.6, 0.0, 1.2])


def curtain(half: float, leaf: float = 0.1) -> Scene:
    """A tomato behind a curtain of leaves of a width and height (half of it, metres), and one in front of it."""
    steps = np.arange(-half + leaf, half, 2 * leaf)
    leaves = [Box([0.5, y, 1.2 + z], [0.002, leaf, leaf], np.eye(3)) for y in steps for z in steps]
    behind, front = Tomato(Sphere(CENTER, 0.03), truss=0), Tomato(Sphere([0.42, 0.0, 1.25], 0.03), truss=1)
    return Scene(name="curtain", tomatoes=(behind, front), clutter=tuple(leaves), provenance=Provenance(row="made up"))


@pytest.fixture(scope="module")
def closed() -> Scene:
    """Leaves to all sides, so that there is no path around them."""
    walls = [
        Box(CENTER + offset, half, np.eye(3))
        for offset, half in (
            ([0.0, 0.12, 0.0], [0.1, 0.002, 0.12]), ([0.0, -0.12, 0.0], [0.1, 0.002, 0.12]),
            ([0.0, 0.0, 0.12], [0.1, 0.12, 0.002]), ([0.0, 0.0, -0.12], [0.1, 0.12, 0.002]),
            ([0.1, 0.0, 0.0], [0.002, 0.12, 0.12]), ([-0.1, 0.0, 0.0], [0.002, 0.12, 0.12]),
        )
    ]  # fmt: skip
    scene = curtain(0.1)
    return scene.model_copy(update={"clutter": tuple(walls)})


def test_a_plan_leads_around_leaves_if_it_can() -> None:
    scene = curtain(0.1)
    rigid, brush = (plan(scene, 1, time_limit=None, max_checks=20_000, leaves=leaves) for leaves in ("rigid", "brush"))
    assert rigid.path is not None
    assert brush.path is not None
    assert brush.brushed_leaves == rigid.brushed_leaves == 0
    assert ProvingChecker(planning_model(compile_scene(scene), 1)).path_is_free(brush.path, 0.01)


def test_a_plan_leads_through_leaves_if_it_must(closed: Scene) -> None:
    rigid = plan(closed, 0, time_limit=None, max_checks=5_000)
    assert rigid.path is None
    found = [plan(closed, 0, time_limit=None, max_checks=5_000, leaves="brush", seed=3) for _ in range(2)]
    result = found[0]
    assert result.path is not None
    np.testing.assert_array_equal(result.path, found[1].path)
    compiled = compile_scene(closed, "ur5e")
    brushed = LeafContacts(compiled).brushed(result.path)
    assert result.brushed_leaves == len(brushed) >= 1
    assert result.clearance > 0.0
    free = ProvingChecker(planning_model(compiled, 0, leaves=brushed))
    assert free.path_is_free(result.path, 0.01), "all other leaves are kept clear of"
    assert goal_configurations(closed, 0, count=3, leaves="brush").configurations.shape == (3, 6)


def test_few_leaves_are_brushed_where_many_hang(closed: Scene) -> None:
    """Among many small leaves, fewer are brushed than by the path that ignores all."""
    many = curtain(0.4, 0.05)
    scene = many.model_copy(update={"clutter": (*many.clutter, *closed.clutter)})
    every = np.arange(len(scene.leaves))
    saved = []
    for seed in range(2):
        through = plan(scene, 0, time_limit=None, max_checks=2_000, leaves=every, seed=seed)
        few = plan(scene, 0, time_limit=None, max_checks=2_000, leaves="brush", seed=seed)
        assert through.path is not None
        assert few.path is not None
        saved.append(through.brushed_leaves - few.brushed_leaves)
    assert sum(saved) > 0


def test_what_is_no_leaf_stays_in_the_way(closed: Scene) -> None:
    gutters = [Box(box.center, np.where(box.half_extents > 0.01, 0.16, 0.002), box.rotation) for box in closed.clutter]
    scene = closed.model_copy(update={"clutter": tuple(gutters)})
    assert plan(scene, 0, time_limit=None, max_checks=2_000, leaves="brush").path is None


def test_a_margin_leaves_brushed_leaves_as_they_are(closed: Scene) -> None:
    arm = get_robot("ur5e")
    wide = with_margin(closed, arm, arm.start, 0.05, "brush")
    np.testing.assert_array_equal(wide.arrays.sizes, closed.arrays.sizes)
    assert (with_margin(closed, arm, arm.start, 0.05).arrays.sizes > closed.arrays.sizes).any()


def test_wrong_leaves_are_refused(closed: Scene) -> None:
    with pytest.raises(UnknownNameError, match="leaves"):
        plan(closed, 0, leaves="soft")
    for wrong in ([6], [-1], [0.5], ["a"], 3):
        with pytest.raises(InvalidValueError, match=r"leaves .*: scene 'curtain' has leaves 0 to 5"):
            plan(closed, 0, leaves=np.array(wrong))
    with pytest.raises(UnknownNameError, match="leaves"):
        PlannerAgent(leaves="soft")
    with pytest.raises(UnknownNameError, match="leaves"):
        SceneRoadmaps(compile_scene(closed, "ur5e"), "soft")


def test_a_roadmap_leads_through_leaves_where_it_must(closed: Scene) -> None:
    compiled, arm = compile_scene(closed, "ur5e"), get_robot("ur5e")
    connected = {
        leaves: SceneRoadmaps(compiled, leaves).roadmap(GoalSampler(compiled, 0, arm.start)).nodes.connected
        for leaves in ("rigid", "brush")
    }
    assert connected == {"rigid": False, "brush": True}


@pytest.mark.parametrize("agent", [PlannerAgent(max_checks=5_000, attempts=1), WaypointAgent()])
def test_agents_reach_through_leaves(closed: Scene, agent: PlannerAgent, tmp_path: Path) -> None:
    scene = closed.model_copy(update={"targets": (Target(tomato=0, difficulty="unreachable"),)})
    bank = write_bank(tmp_path / "bank", [(scene, "test")], "bank")
    options = {"bank": bank, "difficulty": "unreachable", "split": "test", "progress": False}
    (brush,) = evaluate(agent, episodes=1, plants="brush", **options).records
    assert brush.success, brush.status
    assert brush.measures["brushed_leaves"] >= 1
    assert brush.measures["brushed_time"] > 0
    (rigid,) = evaluate(agent, episodes=1, **options).records
    assert not rigid.success
    assert not rigid.measures


def test_targets_are_rated_both_ways(closed: Scene, tmp_path: Path) -> None:
    targets = certify_targets(closed)
    assert [target.difficulty for target in targets] == ["unreachable", "easy"]
    scene = closed.model_copy(update={"targets": targets})
    rated = with_brush_certificates(scene)
    behind, front = (target.brush for target in rated.targets)
    assert behind is not None
    assert front is not None
    assert behind.difficulty in ("easy", "medium", "hard")
    assert behind.leaves >= 1
    assert (front.difficulty, front.witness, front.leaves) == ("easy", None, 0)
    assert list(witness_faults(rated)) == []
    wrong = behind.model_copy(update={"witness": ((0.0,) * 6, *behind.witness)})  # type: ignore[misc]
    spoiled = rated.model_copy(update={"targets": (rated.targets[0].model_copy(update={"brush": wrong}),)})
    assert len(list(witness_faults(spoiled))) == 1
    bank = write_bank(tmp_path / "bank", [(scene, "train")], "bank")
    with pytest.raises(InvalidValueError, match="another folder"):
        brush_bank(bank, bank.path)
    again = brush_bank(brush_bank(bank, tmp_path / "rated").path, tmp_path / "twice")
    assert again[0].targets == rated.targets
    assert "brush" not in (bank.path / "curtain.json").read_text(), "scenes without the ratings are written as before"
