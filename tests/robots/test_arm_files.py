"""An arm's file gives the arm alone: what it says about the world is the scene's, and what no arm has is refused."""

from __future__ import annotations

import os
import pickle
import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import make_scene

from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.robots import ROBOTS, get_robot, load, load_robot, mount_tool
from greenhouse_gym.scene import compile_scene

LINKS = [
    ("0 0 0.09", "0 0 1", 0.05), ("0 0.1 0", "0 1 0", 0.4), ("0 0 0.4", "0 1 0", 0.35), ("0 0 0.35", "0 1 0", 0.08),
    ("0 0.1 0", "0 0 1", 0.06), ("0 0 0.09", "0 1 0", 0.04),
]  # fmt: skip


def arm_text(
    head: str = "", world: str = "", base: str = "", inside: str = "", tail: str = "", compiler: str = "",
    around: tuple[str, str] = ("", ""), geom: str = "",
) -> str:  # fmt: skip
    """A made-up arm of six joints, with additions in the places of an MJCF file."""
    links = ""
    for i, (pos, axis, length) in enumerate(LINKS):
        ends = f"0 0 0.03 0 0 {max(length - 0.05, 0.04)}"
        links += f'<body name="l{i}" pos="{pos}"><joint name="j{i}" axis="{axis}" range="-2.8 2.8" damping="1"/>'
        links += f'<geom name="g{i}" type="capsule" size="0.03" fromto="{ends}" mass="2" {geom}/>'
    servos = "".join(f'<position name="a{i}" joint="j{i}" kp="2000" kv="200" ctrlrange="-2.8 2.8"/>' for i in range(6))
    return (
        f'<mujoco model="arm"><compiler angle="radian" {compiler}/>{head}<worldbody>{world}{around[0]}'
        f'<body name="base" {base}><geom name="b" type="cylinder" size="0.05 0.03"/>{inside}{links}'
        f'<site name="tip" pos="0 0 0.05"/>{"</body>" * 6}</body>{around[1]}</worldbody>'
        f"<actuator>{servos}</actuator>{tail}"
        '<keyframe><key name="start" qpos="0 -0.6 1.8 -0.3 0 1.2"/></keyframe></mujoco>'
    )


def write(folder: Path, text: str | bytes, name: str = "arm.xml") -> Path:
    (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder / name


def scene_bytes(file: Path) -> bytes:
    """The whole compiled model of a scene with an arm."""
    model = compile_scene(make_scene(0), get_robot(file)).model
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return content.tobytes()


OPTIONS = {
    '<flag contact="disable" constraint="disable"/>': "flag contact=disable",
    '<flag actuation="disable" filterparent="disable"/>': "flag actuation=disable",
    '<flag override="enable"/>': "flag override=enable",
    '<flag gravity="disable" limit="disable" clampctrl="disable"/>': "flag limit=disable",
}
ATTRIBUTES = {
    'gravity="0 0 5"': "option gravity=0 0 5",
    'viscosity="100" density="500" wind="9 0 0"': "option viscosity=100",
    'o_margin="0.3" o_solref="0.5 1"': "option o_margin=0.3",
    'actuatorgroupdisable="0"': "option disableactuator=1",
    'iterations="1" tolerance="1" cone="elliptic" impratio="10"': "option iterations=1",
}
WARNED = (
    [(f"<option>{inner}</option>", said) for inner, said in OPTIONS.items()]
    + [(f"<option {attributes}/>", said) for attributes, said in ATTRIBUTES.items()]
    + [('<size memory="2K"/>', "size memory=2048"), ('<size nconmax="1" njmax="5"/>', "size nconmax=1")]
)


@pytest.mark.parametrize(("head", "said"), WARNED)
def test_options_of_an_arms_file_are_not_those_of_the_world(tmp_path: Path, head: str, said: str) -> None:
    plain = scene_bytes(write(tmp_path, arm_text()))
    file = write(tmp_path, arm_text(head))
    with pytest.warns(UserWarning, match=said):
        found = scene_bytes(file)
    assert found == plain


SILENT: list[dict[str, str | tuple[str, str]]] = [
    {"head": '<option timestep="0.1" integrator="RK4"/>'},
    {"head": '<visual><map znear="0.5" zfar="1"/><global offwidth="9000"/></visual><statistic extent="0.01"/>'},
    {"world": '<light pos="0 0 3"/><camera name="c" pos="0 0 2"/>'},
    {"geom": 'margin="0.1" gap="0.05"'},
    {"base": 'euler="0 0 0"'},
    {"around": ('<frame pos="0 0 0">', "</frame>")},
    {"compiler": 'fusestatic="true" discardvisual="true"'},
    {"head": "<!-- a -- b -->"},
]


@pytest.mark.parametrize("parts", SILENT)
def test_what_else_an_arms_file_says_of_the_world_is_left_out(tmp_path: Path, parts: dict[str, str]) -> None:
    plain = scene_bytes(write(tmp_path, arm_text()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        file = write(tmp_path, arm_text(**parts))
        assert scene_bytes(file) == plain


@pytest.mark.parametrize(
    "defaults", ['margin="0.2" gap="0.1"', 'contype="0" conaffinity="0"', 'euler="0.3 0.4 0.5"',
                 'friction="0 0 0" solref="0.5 1" priority="5" condim="1" solmix="9"', 'rgba="1 0 0 0.2" group="4"'],
)  # fmt: skip
def test_defaults_of_an_arms_file_do_not_reach_the_scene(tmp_path: Path, defaults: str) -> None:
    def obstacles(file: Path) -> list[np.ndarray]:
        model = compile_scene(make_scene(0), get_robot(file), capacity=60).model
        names = ("pos", "quat", "size", "margin", "gap", "contype", "conaffinity", "friction", "solref", "priority",
                 "condim", "solmix", "rgba", "group")  # fmt: skip
        kept = (model.geom_bodyid == 0) & (np.arange(model.ngeom) != model.geom("cart").id)  # as high as the arm's foot
        return [getattr(model, f"geom_{name}")[kept] for name in names]

    geom = 'contype="1" conaffinity="1"'
    plain = obstacles(write(tmp_path, arm_text(geom=geom)))
    found = obstacles(write(tmp_path, arm_text(head=f"<default><geom {defaults}/></default>", geom=geom)))
    for one, other in zip(plain, found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_mounted_arm_and_an_unpickled_one_have_no_options_either(tmp_path: Path) -> None:
    text = arm_text('<option gravity="0 0 5"><flag contact="disable"/></option><default><geom margin="0.2"/></default>')
    file = write(tmp_path, text.replace('name="tip"', 'name="attachment_site"'))
    with pytest.warns(UserWarning, match=r"arm\.xml.*contact=disable"):
        mounted = mount_tool(file, tmp_path / "mounted.xml", start=[0, -0.6, 1.8, -0.3, 0, 1.2])
    own = mujoco.MjModel.from_xml_path(str(mounted))
    assert own.opt.disableflags == 0
    assert own.opt.gravity[2] == -9.81
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_robot(mounted)
    write(tmp_path, text)
    with pytest.warns(UserWarning, match="contact=disable"):
        robot = load_robot(file)
    with pytest.warns(UserWarning, match="contact=disable"):
        again = pickle.loads(pickle.dumps(robot))
    assert again.spec().compile().opt.disableflags == 0


@pytest.mark.parametrize(
    ("base", "around"),
    [('euler="0 0 1.5"', ("", "")), ('xyaxes="0 1 0 -1 0 0"', ("", "")), ("", ('<frame euler="0 0 1.5">', "</frame>")),
     ('pos="1 2 3"', ('<frame pos="3 2 1"><frame pos="1 1 1">', "</frame></frame>"))],
)  # fmt: skip
def test_the_base_stands_where_the_scene_puts_it(tmp_path: Path, base: str, around: tuple[str, str]) -> None:
    """However the file gives its pose."""
    robot = get_robot(write(tmp_path, arm_text(base=base, around=around)))
    alone = mujoco.MjModel.from_xml_path(str(robot.path))
    scene = make_scene(0)
    scene = scene.model_copy(update={"placement": scene.placement.model_copy(update={"yaw": 0.7})})
    compiled = compile_scene(scene, robot)
    base_id = compiled.model.body("base").id
    np.testing.assert_allclose(compiled.model.body_pos[base_id][:2], scene.placement.position[:2], atol=1e-9)
    expected, half = np.empty(4), scene.placement.yaw / 2
    mujoco.mju_mulQuat(expected, np.array([np.cos(half), 0, 0, np.sin(half)]), alone.body_quat[1])
    np.testing.assert_allclose(compiled.model.body_quat[base_id], expected, atol=1e-9)


TEXTS: dict[str, tuple[str | bytes, str]] = {
    "a byte that is no UTF-8": (arm_text().replace("g1", "\xff").encode("latin-1"), "no UTF-8 text"),
    "another encoding": (b'<?xml encoding="latin1"?>' + arm_text("<!--\xe9-->").encode("latin-1"), "UTF-8"),
    "UTF-16": (arm_text().encode("utf-16"), "no UTF-8 text"),
    "half a character": (arm_text().replace("g1", "&#xD800;"), "no Unicode text"),
    "a zero byte": (arm_text().replace("g1", "\0"), "cannot load"),
    "nothing": ("", "empty"),
    "entities": ('<!DOCTYPE m [<!ENTITY a "b">]>' + arm_text(), "entities"),
    "deep nesting": ("<mujoco>" + "<body>" * 100_000, "too deep"),
    "an include of itself": (arm_text('<include file="arm.xml"/>'), "already included"),
    "an include that is missing": (arm_text('<include file="none.xml"/>'), "none.xml: no such file"),
    "an include of a pipe": (arm_text('<include file="pipe"/>'), "pipe: no such file"),
    "a mesh in a pipe": (arm_text('<asset><mesh name="m" file="pipe"/></asset>'), "no regular file"),
    "a mesh that is missing": (arm_text('<asset><mesh name="m" file="none.stl"/></asset>'), "none.stl"),
    "too many copies": (
        arm_text(inside='<replicate count="999"><replicate count="999"><geom size="1"/></replicate></replicate>'),
        "replicates an element 998001 times",
    ),
    "a huge texture": (arm_text('<asset><texture type="2d" builtin="flat" width="9999" height="1"/></asset>'), "wid"),
    "a huge height field": (arm_text('<asset><hfield nrow="2" ncol="99999" size="1 1 1 1"/></asset>'), "ncol=99999"),
    "a small height field": (arm_text('<asset><hfield nrow="2" ncol="2" size="1 1 1 1"/></asset>'), "a height field"),
    "a side of a texture in a pipe": (
        arm_text('<asset><texture type="cube" fileright="pipe"/></asset>'), "pipe is no regular file",
    ),
    "a texture that unpacks to much": (
        arm_text('<asset><texture type="2d" name="t" file="large.png"/></asset>'), "no PNG file of up to 8192 pixels",
    ),
    "a texture of another kind": (
        arm_text('<asset><texture type="2d" name="t" file="raw.bin"/></asset>'), "no PNG file of up to 8192 pixels",
    ),
    "many keys": (arm_text('<size nkey="2000000000"/>'), "nkey"),
    "a cloth": (arm_text(inside='<flexcomp name="f" type="grid" count="9 9 9"/>'), "rigid bodies"),
    "a second body": (arm_text(world='<body name="table"><geom size="1"/></body>'), "table, base"),
    "a floor": (arm_text(world='<geom type="plane" size="1 1 1"/>'), "a floor"),
    "coupled joints": (arm_text(tail='<equality><joint joint1="j1" joint2="j2"/></equality>'), "equality"),
    "a tip that no joint moves": (
        arm_text(world='<site name="tip"/>').replace('<site name="tip" p', '<site name="other" p'), "no joint moves",
    ),
    "a part named as the scene's": (arm_text(inside='<geom name="floor" size="0.01"/>'), "'floor'"),
    "a position that is no number": (arm_text().replace('pos="0 0 0.4"', 'pos="0 0 nan"'), "NaN"),
    "limits below zero": (arm_text('<custom><numeric name="velocity_limits" data="0 1 1 1 1 1"/></custom>'), "positi"),
}  # fmt: skip


@pytest.mark.parametrize("kind", TEXTS)
@pytest.mark.filterwarnings("ignore")
def test_a_file_that_is_no_arms_is_refused_by_name(tmp_path: Path, kind: str) -> None:
    content, problem = TEXTS[kind]
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "large.png").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + 2 * (20_000).to_bytes(4, "big"))
    (tmp_path / "raw.bin").write_bytes((2**14).to_bytes(4, "little") * 2)
    with pytest.raises(FileFormatError, match=problem) as caught:
        get_robot(write(tmp_path, content))
    assert str(tmp_path) in str(caught.value)
    assert len(str(caught.value)) < 2000


@pytest.mark.parametrize("place", ["folder", "pipe", "missing", "huge"])
def test_what_is_no_file_is_refused(tmp_path: Path, place: str) -> None:
    path = tmp_path / "arm.xml"
    if place == "folder":
        path.mkdir()
    elif place == "pipe":
        os.mkfifo(path)
    elif place == "huge":
        with path.open("wb") as file:
            file.truncate(10**9)
    with pytest.raises(FileFormatError, match=r"arm\.xml: (no such file|too large)"):
        get_robot(path)


def test_a_changed_include_is_read_again(tmp_path: Path) -> None:
    """Even in a file that only MuJoCo's reader takes, as one with -- in a comment."""
    inner = write(tmp_path, '<mujoco><default><position kp="3"/></default></mujoco>', "inner.xml")
    file = write(tmp_path, arm_text('<!-- a -- b --><include file="inner.xml"/>').replace('kp="2000"', ""))
    stiffness = get_robot(file).spec().compile().actuator_gainprm[0, 0]
    inner.write_text('<mujoco><default><position kp="7"/></default></mujoco>')
    assert (stiffness, get_robot(file).spec().compile().actuator_gainprm[0, 0]) == (3, 7)


def test_the_shipped_arms_have_no_settings_for_the_world() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for path in ROBOTS.values():
            load_robot(path)


@pytest.mark.parametrize("error", [ValueError("engine error: Could not allocate memory"), MemoryError()], ids=str)
def test_memory_that_runs_out_late_is_reported_with_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(load, "prepare_spec", fail)
    (tmp_path / "arm.xml").write_text(arm_text())
    with pytest.raises(FileFormatError, match=r"arm\.xml: MuJoCo cannot load it: .*memory"):
        load_robot(tmp_path / "arm.xml")


def test_a_loop_of_links_is_no_arm(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").symlink_to(tmp_path / "arm.xml")
    for read in (load_robot, get_robot):
        with pytest.raises(FileFormatError, match=r"arm\.xml: no such file"):
            read(tmp_path / "arm.xml")
