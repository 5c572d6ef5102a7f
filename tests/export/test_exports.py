from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Tree

import mujoco
import numpy as np
import pytest
from conftest import with_ellipsoids
from scipy.spatial.transform import Rotation

from greenhouse_gym.errors import InvalidValueError, MissingDependencyError, UnknownNameError
from greenhouse_gym.export import FORMATS, export_scene
from greenhouse_gym.export.primitives import Primitive, mesh_of, primitives, without_capsules
from greenhouse_gym.export.problems import FRAME
from greenhouse_gym.geometry import Array, Capsule, distance_to_shapes, transform
from greenhouse_gym.planning import CollisionChecker, certify_targets, planning_model
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene import Scene, compile_scene
from greenhouse_gym.scene.mjcf import arm_pose
from greenhouse_gym.scene.obstacles import ArmPlacement


@pytest.fixture(scope="module")
def turned(scene: Scene) -> Scene:
    """A scene whose arm stands elsewhere and faces another way, with round tomatoes."""
    capsules = (*scene.clutter, Capsule([0.5, 0.1, 1.0], [0.5, 0.1, 1.0], 0.02))
    few = scene.model_copy(update={"tomatoes": scene.tomatoes[:4], "targets": (), "clutter": capsules})
    targets = certify_targets(few)
    return few.model_copy(update={"targets": targets})


@pytest.fixture(scope="module")
def arm() -> Robot:
    return get_robot("ur5e")


def samples(arm: Robot, count: int) -> Array:
    return np.random.default_rng(3).uniform(arm.lower, arm.upper, (count, len(arm.joints)))


@pytest.mark.parametrize("name", ["ur5e", "iiwa14"])
def test_urdf_opens_in_mujoco_and_collides_where_the_scene_does(scene: Scene, name: str, tmp_path: Path) -> None:
    standing = scene.model_copy(update={"placement": ArmPlacement(position=[-0.1, 0.1, 0.0], yaw=0.3)})
    robot = get_robot(name)
    (path,) = export_scene(standing, "urdf", tmp_path, robot)
    theirs = mujoco.MjModel.from_xml_path(str(path))
    ours = compile_scene(standing, robot)
    assert [theirs.joint(j).name for j in range(theirs.njnt)] == list(robot.joints)
    np.testing.assert_allclose(theirs.jnt_range, np.stack([robot.lower, robot.upper], axis=-1), atol=1e-6)
    plants = sum(len(list(without_capsules(part))) for part in primitives(standing))  # they come first
    assert (theirs.geom_bodyid[:plants] == 0).all()
    a, b = mujoco.MjData(ours.model), mujoco.MjData(theirs)
    touching = 0
    for q in samples(robot, 250):
        a.qpos[:], b.qpos[:] = q, q
        for model, data in ((ours.model, a), (theirs, b)):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
        for body in range(1, theirs.nbody):  # bodies that cannot move are made one with the world
            np.testing.assert_allclose(b.xpos[body], a.body(theirs.body(body).name).xpos, atol=1e-6)
        names = {ours.model.geom(int(geom)).name for geom in a.contact.geom.flatten()}
        touched = any(name.startswith(("tomato_", "stem_", "clutter_")) for name in names)
        assert touched == bool((b.contact.geom < plants).any())
        touching += touched
    assert 2 < touching < 250


def test_sdf_holds_every_shape_as_it_is(scene: Scene, arm: Robot, tmp_path: Path) -> None:
    stretched = with_ellipsoids(scene, 1)
    (path,) = export_scene(stretched, "sdf", tmp_path, arm)
    world = Tree.parse(path).getroot().find("world")
    assert world is not None
    plants, model = world.findall("model")
    assert plants.findtext("static") == "true"
    found = {shape.get("name"): shape for shape in plants.iter("collision")}
    assert len(found) == len(stretched.obstacles)
    for part in primitives(stretched):
        geometry = found[part.name].find("geometry")
        assert geometry is not None
        assert geometry[0].tag == part.kind
        numbers = [float(text) for element in geometry[0] for text in (element.text or "").split()]
        size = [2 * half for half in part.size] if part.kind == "box" else list(part.size)
        np.testing.assert_allclose(numbers, size, atol=1e-6)
        pose = np.array([float(text) for text in (found[part.name].findtext("pose") or "").split()])
        np.testing.assert_allclose(pose[:3], part.position, atol=1e-6)
        rotation = Rotation.from_euler("xyz", pose[3:]).as_matrix()
        np.testing.assert_allclose(rotation, part.pose[:3, :3], atol=1e-6)
    moving = [joint.get("name") for joint in model.findall("joint") if joint.get("type") == "revolute"]
    assert moving == list(arm.joints)
    links = {link.get("name") for link in model.findall("link")}
    for joint in model.findall("joint"):
        assert joint.findtext("child") in links
        assert joint.findtext("parent") in links | {"world"}


def read_moveit(text: str) -> dict[str, list[tuple[str, Array, Array, Array]]]:
    """MoveIt's own way to read its first format: words, one after the other."""
    name, rest = text.split("\n", 1)
    words = iter(rest.split())
    assert name
    objects: dict[str, list[tuple[str, Array, Array, Array]]] = {}
    while (marker := next(words)) == "*":
        own = objects.setdefault(next(words), [])
        for _ in range(int(next(words))):
            kind = next(words)
            size = np.array([float(next(words)) for _ in range({"sphere": 1, "cylinder": 2, "box": 3}[kind])])
            place = np.array([float(next(words)) for _ in range(3)])
            turn = np.array([float(next(words)) for _ in range(4)])
            assert all(0 <= float(next(words)) <= 1 for _ in range(4))
            own.append((kind, size, place, turn))
    assert marker == "."
    assert next(words, None) is None
    return objects


def test_moveit_reads_the_scene_back(scene: Scene, tmp_path: Path) -> None:
    (path,) = export_scene(scene, "moveit", tmp_path)
    objects = read_moveit(path.read_text())
    assert list(objects) == [part.name for part in primitives(scene)]
    for part in primitives(scene):
        pieces = objects[part.name]
        assert len(pieces) == (3 if part.kind == "capsule" else 1)
        np.testing.assert_allclose(pieces[0][2], part.position, atol=1e-4)
        turn = Rotation.from_quat(pieces[0][3]).as_matrix()
        np.testing.assert_allclose(turn, part.pose[:3, :3], atol=1e-4)
        if part.kind == "box":
            np.testing.assert_allclose(pieces[0][1], 2 * np.array(part.size), atol=1e-5)


def test_capsules_without_capsules_are_the_same_space(scene: Scene) -> None:
    points = np.random.default_rng(0).uniform([0.4, -0.7, 0.3], [0.8, 0.7, 2.3], (400, 3))
    for part, shape in zip(primitives(scene), scene.obstacles, strict=True):
        if part.kind != "capsule":
            continue
        near = transform(np.linalg.inv(part.pose), points)
        radius, length = part.size
        cylinder = (np.hypot(near[:, 0], near[:, 1]) <= radius) & (np.abs(near[:, 2]) <= length / 2)
        pieces = list(without_capsules(part))
        assert [piece.kind for piece in pieces] == ["cylinder", "sphere", "sphere"]
        spheres = [np.linalg.norm(points - piece.position, axis=1) <= radius for piece in pieces[1:]]
        inside = cylinder | spheres[0] | spheres[1]
        np.testing.assert_array_equal(inside, distance_to_shapes(points, [shape])[:, 0] <= 0)


@pytest.mark.parametrize(
    ("kind", "size", "volume"),
    [
        ("sphere", (0.5,), 4 / 3 * np.pi * 0.125),
        ("ellipsoid", (0.5, 0.2, 0.3), 4 / 3 * np.pi * 0.03),
        ("capsule", (0.1, 0.8), np.pi * 0.01 * 0.8 + 4 / 3 * np.pi * 0.001),
        ("cylinder", (0.1, 0.8), np.pi * 0.01 * 0.8),
        ("box", (0.1, 0.2, 0.3), 8 * 0.006),
    ],
)
def test_meshes_are_closed_face_outwards_and_keep_the_volume(kind: Any, size: tuple[float, ...], volume: float) -> None:
    turn = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, [1.0, 2.0, 3.0]
    mesh = mesh_of(Primitive("one", kind, size, pose, (1.0, 0.0, 0.0)), fineness=4)
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    assert {tuple(edge) for edge in edges.tolist()} == {tuple(edge[::-1]) for edge in edges.tolist()}
    a, b, c = (np.asarray(mesh.vertices)[mesh.faces] - pose[:3, 3]).transpose(1, 0, 2)
    assert float((a * np.cross(b, c)).sum() / 6) == pytest.approx(volume, rel=0.01)


@pytest.mark.parametrize("format", ["ply", "obj", "stl"])
def test_meshes_open_in_open3d(scene: Scene, format: str, tmp_path: Path) -> None:
    open3d_loader = pytest.importorskip("greenhouse_gym.common.open3d_loader")
    try:
        open3d = open3d_loader.open3d()
    except MissingDependencyError:
        pytest.skip("needs open3d")
    (path,) = export_scene(scene, format, tmp_path)
    mesh = open3d.io.read_triangle_mesh(str(path))
    expected = [mesh_of(part) for part in primitives(scene)]
    assert len(mesh.triangles) == sum(len(one.faces) for one in expected)
    vertices = np.concatenate([one.vertices for one in expected])
    np.testing.assert_allclose(np.asarray(mesh.get_min_bound()), vertices.min(axis=0), atol=1e-4)
    np.testing.assert_allclose(np.asarray(mesh.get_max_bound()), vertices.max(axis=0), atol=1e-4)
    assert mesh.has_vertex_colors() == (format == "ply")
    (again,) = export_scene(scene, format, tmp_path / "again")
    assert again.read_bytes() == path.read_bytes()
    names = re.findall(r"^o (.*)$", path.read_text(), re.M) if format == "obj" else None
    assert names in (None, [part.name for part in primitives(scene)])


def vamp_capsules(problem: dict[str, Any]) -> list[tuple[Array, Array, float]]:
    """The ends and radius that VAMP makes of a cylinder: its axis is z, turned about the fixed x, y and z axes."""
    found = []
    for item in problem["cylinder"]:
        turn = Rotation.from_euler("xyz", item["orientation_euler_xyz"]).as_matrix()
        half = turn @ [0.0, 0.0, item["length"] / 2]
        found.append((np.array(item["position"]) + half, np.array(item["position"]) - half, item["radius"]))
    return found


def test_vamps_problems_are_the_scene_in_the_arms_frame(turned: Scene, arm: Robot, tmp_path: Path) -> None:
    (path,) = export_scene(turned, "vamp", tmp_path, arm)
    data = json.loads(path.read_text())
    sets = data["problems"][turned.name]
    assert data["joints"] == list(arm.joints)
    assert [problem["difficulty"] for problem in sets] == [target.difficulty for target in turned.targets]
    scene_from_base = arm_pose(turned, arm)
    compiled = compile_scene(turned, arm)
    for problem, target in zip(sets, turned.targets, strict=True):
        shapes = len(problem["sphere"]) + len(problem["cylinder"]) + len(problem["box"])
        assert shapes == len(turned.obstacles) - 1
        assert f"tomato_{target.tomato}" not in {item["name"] for item in problem["sphere"]}
        for (a, b, radius), stem in zip(vamp_capsules(problem), turned.stems, strict=True):
            ends = transform(scene_from_base, np.array([b, a]))
            np.testing.assert_allclose(ends, [stem.start, stem.end], atol=1e-6)
            assert radius == stem.radius
        assert problem["valid"] == (target.witness is not None)
        checker = CollisionChecker(planning_model(compiled, target.tomato))
        assert all(checker.is_free(goal) for goal in problem["goals"])
        if target.witness is not None:
            np.testing.assert_allclose(problem["goals"][0], target.witness[-1])


def test_robometrics_problems_enclose_the_scene(turned: Scene, arm: Robot, tmp_path: Path) -> None:
    yaml = pytest.importorskip("yaml")
    (path,) = export_scene(turned, "robometrics", tmp_path, arm)
    (sets,) = yaml.safe_load(path.read_text()).values()
    assert len(sets) == sum(target.witness is not None for target in turned.targets)
    for problem in sets:
        assert set(problem) == {"collision_buffer_ik", "goal_ik", "goal_pose", "obstacles", "start", "world_frame"}
        assert set(problem["obstacles"]) == {"cuboid", "cylinder"}
        assert problem["world_frame"] == FRAME
        for obstacle in problem["obstacles"]["cylinder"].values():
            assert np.linalg.norm(obstacle["pose"][3:]) == pytest.approx(1.0)
            assert obstacle["height"] >= 2 * obstacle["radius"]
        assert len(problem["obstacles"]["cuboid"]) + len(problem["obstacles"]["cylinder"]) == len(turned.obstacles) - 1


def test_motion_bench_makers_files_come_in_pairs(turned: Scene, arm: Robot, tmp_path: Path) -> None:
    yaml = pytest.importorskip("yaml")
    files = export_scene(turned, "motionbenchmaker", tmp_path, arm)
    reachable = sum(target.witness is not None for target in turned.targets)
    assert len(files) == 2 * reachable > 0
    scene, request = (yaml.safe_load(file.read_text()) for file in files[:2])
    assert request["start_state"]["joint_state"]["position"] == pytest.approx(arm.rating_start.tolist())
    constraints = request["goal_constraints"][0]["joint_constraints"]
    assert [constraint["joint_name"] for constraint in constraints] == list(arm.joints)
    kinds = {piece["type"] for item in scene["world"]["collision_objects"] for piece in item["primitives"]}
    assert kinds == {"sphere", "cylinder", "box"}
    for item in scene["world"]["collision_objects"]:
        assert len(item["primitives"]) == len(item["primitive_poses"])


def test_small_numbers_stay_numbers_in_yaml(scene: Scene, tmp_path: Path) -> None:
    yaml = pytest.importorskip("yaml")
    from greenhouse_gym.export.problems import _yaml

    assert yaml.safe_load(_yaml({"a": [1e-5, -2.5e-7, 3.0], "b": 1e-05})) == {"a": [1e-5, -2.5e-7, 3.0], "b": 1e-5}
    assert yaml.safe_load(_yaml([1e-300, 1e16, -1e22, 12])) == [0.0, 1e16, -1e22, 12]


@pytest.mark.parametrize(
    "name", ["\U0001f345", "row-1e-05", 'a"\\ud83c\\"b', "\u6eab\u5ba4 \u00e9", "\u2028\x7f\ufeff", "\U0010ffff\u0301"]
)
def test_names_are_the_same_in_yaml(name: str) -> None:
    yaml = pytest.importorskip("yaml")
    from greenhouse_gym.export.problems import _yaml

    assert yaml.safe_load(_yaml({name: [name, 1e-05]}).decode()) == {name: [name, 1e-05]}


def test_a_scene_may_be_named_by_an_emoji(turned: Scene, tmp_path: Path) -> None:
    yaml = pytest.importorskip("yaml")
    named = turned.model_copy(update={"name": "\U0001f345 1e5"})
    (path,) = export_scene(named, "robometrics", tmp_path)
    assert list(yaml.safe_load(path.read_bytes())) == [named.name]
    for file in export_scene(named, "motionbenchmaker", tmp_path):
        yaml.safe_load(file.read_bytes())


@pytest.mark.parametrize("format", FORMATS)
def test_every_format_names_its_file_after_the_scene(turned: Scene, format: str, tmp_path: Path) -> None:
    (path,) = export_scene(turned, format, tmp_path)
    assert path.name == turned.name + FORMATS[format].suffix
    assert not re.search(rb"\bnan\b|\binf\b", path.read_bytes()[:200_000] if format not in ("ply", "stl") else b"")


def test_mjcf_is_what_the_scene_gives(turned: Scene, tmp_path: Path) -> None:
    (path,) = export_scene(turned, "mjcf", tmp_path)
    assert mujoco.MjModel.from_xml_path(str(path)).njnt == 6


def test_the_truth_goes_where_it_can(turned: Scene, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="has no truth"):
        export_scene(turned, "ply", tmp_path, truth=True)
    true = turned.model_copy(update={"truth": turned.compact()})
    (path,) = export_scene(true, "moveit", tmp_path, truth=True)
    assert path.name == f"{turned.name}-truth.scene"
    with pytest.raises(InvalidValueError, match="expected one of moveit, ply, obj, stl"):
        export_scene(true, "urdf", tmp_path, truth=True)
    with pytest.raises(UnknownNameError, match="unknown export format 'usd'"):
        export_scene(true, "usd", tmp_path)
