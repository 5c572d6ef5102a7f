"""Reading of an arm's MJCF file: only the arm, without the file's settings for a whole world.

Limits of joints are those in the file, or defaults bounded by the force of the servos. MuJoCo's reader works without
limits on time and memory, so what could exhaust them is checked first.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from math import prod
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.files import MAX_BYTES, read_bytes
from greenhouse_gym.errors import FileFormatError, GreenhouseError, InvalidValueError
from greenhouse_gym.geometry import Array, numbers_of

_MAX_COPIES = 1000  # of an element by nested replication
_MAX_SIZE = 8192  # of a texture or height field in one direction, and of what else a file asks for by number
_MAX_FILES = 100  # that include each other

_COMMENT = re.compile(r"<!--.*?-->", re.S)
_INCLUDED = re.compile(r"<(?:include|model)\b[^>]*?\bfile\s*=\s*[\"']([^\"']*)")
_REPLICATE = re.compile(r"<replicate\b[^>]*?\bcount\s*=\s*[\"']\s*\+?(\d+)[^>]*|</replicate|<replicate\b")
_SIZE = re.compile(r"\b(width|height|nrow|ncol|nkey|nuser\w*|nsample)\s*=\s*[\"']\s*\+?(\d+)")
_NOT_RIGID = re.compile(r"<(flexcomp|composite)\b")

_SCENE_GEOMS = re.compile(r"floor|cart|cart below|(tomato|clutter|parked)_\d+|stem_\d+_\w+")
_SET_BY_SCENES = ("timestep", "integrator")  # of the options
_FLAGS = (("disableflags", mujoco.mjtDisableBit, "disable"), ("enableflags", mujoco.mjtEnableBit, "enable"))
_MEMORY = ("memory", "nstack", "njmax", "nconmax")
_NO_VALUES = ("name", "classname", "compiler", "signature", "id", "info")  # of a class, or of no element yet

DEFAULT_SPEED, DEFAULT_SLIDE_SPEED = 1.6, 0.4
"""Default speed limits, rad/s and m/s; a joint action of 1 requests them."""

DEFAULT_ACCELERATION, DEFAULT_SLIDE_ACCELERATION = 10.0, 2.0
"""Default acceleration limits, rad/s^2 and m/s^2."""

DAMPING_FRACTION = 0.8
"""Fraction of a servo's force that damping may use at the default speed limit; the rest is for acceleration."""


def read_arm(path: Path) -> mujoco.MjSpec:
    """Read the arm in an MJCF file: its bodies with their joints, actuators and assets.

    Options, flags, memory, visual settings, statistics, lights, cameras and defaults for later elements are the
    scene's; a warning names those that would have changed its physics. The base has a plain pose, without a frame.

    Raises:
        FileFormatError: The file is missing, no UTF-8 text or too large, MuJoCo cannot load it, or it holds something
            that no arm has.
    """
    for file, text in _texts(path):
        _check_sizes(file, text)
    with loading(path):
        spec = mujoco.MjSpec.from_file(str(path))
        _check_assets(path, spec)
        _drop_world_settings(path, spec)
        model = spec.compile()
        _check_alone(path, spec, model)
    _free_base(spec, model)
    return spec


@contextmanager
def loading(path: Path) -> Iterator[None]:
    """Turn MuJoCo's errors about an arm into a `FileFormatError`."""
    try:
        yield
    except GreenhouseError:
        raise
    except UnicodeDecodeError as error:
        raise FileFormatError(path, f"a name in it is no Unicode text ({error.reason})") from error
    except (ValueError, OSError, RuntimeError, MemoryError, mujoco.FatalError) as error:  # of failed allocations, too
        raise FileFormatError(path, f"MuJoCo cannot load it: {str(error) or 'it needs too much memory'}") from error


def fingerprint(path: Path) -> str:
    """Return a checksum of an MJCF file and its includes; an empty text if one cannot be read."""
    try:
        return sha256("".join(sha256(text.encode()).hexdigest() for _, text in _texts(path)).encode()).hexdigest()
    except FileFormatError:
        return ""


def _texts(path: Path) -> Iterator[tuple[Path, str]]:
    """Yield an MJCF file and those that it includes, without comments.

    Raises:
        FileFormatError: One cannot be read, is too large, or no UTF-8 text, or they are too many.
    """
    waiting, done = [path], set[Path]()
    while waiting:
        file = waiting.pop()
        if file in done:
            continue
        done.add(file)
        if len(done) > _MAX_FILES:
            raise FileFormatError(path, f"includes more than {_MAX_FILES} files")
        if not file.is_file():
            raise FileFormatError(file, "no such file; expected an arm's MJCF file")
        try:
            text = _COMMENT.sub("", read_bytes(file, "robot").decode())
        except UnicodeDecodeError as error:
            raise FileFormatError(file, f"no UTF-8 text, as MJCF is ({error.reason} at {error.start})") from error
        if "<!DOCTYPE" in text:
            raise FileFormatError(file, "declares a document type or entities, which MuJoCo does not read")
        yield file, text
        waiting += [path.parent / name for name in _INCLUDED.findall(text)]


def _check_sizes(path: Path, text: str) -> None:
    if found := _NOT_RIGID.search(text):
        raise FileFormatError(path, f"has a {found[1]}: an arm consists of rigid bodies")
    for attribute, size in _SIZE.findall(text):
        if len(size) > 9 or int(size) > _MAX_SIZE:
            raise FileFormatError(path, f"{attribute}={size}: at most {_MAX_SIZE} are read")
    counts: list[int] = []
    for found in _REPLICATE.finditer(text):
        if found[0].startswith("</"):
            del counts[-1:]
        elif not found[0].endswith("/"):
            counts.append(max(1, int((found[1] or "1")[:9])))
        if prod(counts) > _MAX_COPIES:
            raise FileFormatError(path, f"replicates an element {prod(counts)} times, at most {_MAX_COPIES} are read")


def _check_assets(path: Path, spec: mujoco.MjSpec) -> None:
    if len(spec.flexes) or len(spec.skins) or len(spec.hfields):  # a damaged height field ends the process
        raise FileFormatError(path, "has a flex, a skin or a height field: an arm consists of rigid bodies")
    meshes = [(each.file, spec.meshdir) for each in spec.meshes]
    textures = [(name, spec.texturedir) for each in spec.textures for name in (each.file, *each.cubefiles)]
    for name, folder in (*meshes, *textures):
        file = path.parent / folder / (Path(name).name if spec.strippath else name)
        if not name or not file.exists():
            continue
        if not (file.is_file() and file.stat().st_size <= MAX_BYTES["robot asset"]):
            raise FileFormatError(path, f"the asset {file} is no regular file, or too large")
        if (name, folder) in textures and not _is_small_png(file):
            raise FileFormatError(path, f"the texture {file} is no PNG file of up to {_MAX_SIZE} pixels each way")


def _is_small_png(file: Path) -> bool:
    """Return whether a file is a PNG image, by its name and its header, with up to `_MAX_SIZE` pixels each way."""
    with file.open("rb") as opened:
        head = opened.read(24)
    sizes = (int.from_bytes(head[at : at + 4], "big") for at in (16, 20))
    return file.suffix.lower() == ".png" and head[:4] == b"\x89PNG" and all(0 < size <= _MAX_SIZE for size in sizes)


def _drop_world_settings(path: Path, spec: mujoco.MjSpec) -> None:
    """Reset the settings of a whole world, and warn of those that would have changed its physics."""
    own = mujoco.MjSpec()
    dropped = list(_changed_options(spec.option, own.option))
    dropped += [f"size {name}={getattr(spec, name)}" for name in _MEMORY if getattr(spec, name) != getattr(own, name)]
    if dropped:
        warnings.warn(f"{path}: the scene's own settings hold; ignored: {', '.join(dropped)}", stacklevel=4)
    spec.option, spec.visual, spec.stat = own.option, own.visual, own.stat
    for name in _MEMORY:
        setattr(spec, name, getattr(own, name))
    spec.compiler.fusestatic = spec.compiler.discardvisual = False  # they would merge the base with the world
    for kind in ("geom", "joint", "site", "camera", "light"):
        _reset(getattr(spec.default, kind), getattr(own.default, kind))
    for element in (*spec.worldbody.lights, *spec.worldbody.cameras):
        spec.delete(element)


def _changed_options(option: Any, own: Any) -> Iterator[str]:
    for name, kind, word in _FLAGS:
        bits = getattr(option, name)
        for flag, value in kind.__members__.items():
            if not flag.startswith("mjN") and bits & int(value):
                yield f"flag {flag.rpartition('_')[2].lower()}={word}"
    for name in dir(own):
        if name[0] == "_" or name in (*_SET_BY_SCENES, "disableflags", "enableflags"):
            continue
        if not np.array_equal(value := getattr(option, name), getattr(own, name)):
            yield f"option {name}={' '.join(f'{x:g}' for x in np.ravel(value))}"


def _reset(element: Any, own: Any) -> None:
    """Give a class of defaults the values of another; elements that exist already keep theirs."""
    for name in dir(own):
        if name[0] != "_" and name not in _NO_VALUES:
            value = getattr(own, name)
            if isinstance(value, int | float | str | np.ndarray):
                setattr(element, name, value)
    if hasattr(own, "alt"):
        element.alt.type = own.alt.type


def _check_alone(path: Path, spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    reserved = [geom.name for geom in spec.geoms if _SCENE_GEOMS.fullmatch(geom.name)]
    if reserved:
        raise FileFormatError(path, f"its geom {reserved[0]!r} has the name of a part of the scenes: rename it")
    roots = [body.name or "without a name" for body in spec.worldbody.bodies]
    if (model.geom_bodyid == 0).any():
        raise FileFormatError(path, "the world has geoms of its own (a floor?); expected the arm alone")
    if len(roots) != 1:
        raise FileFormatError(path, f"the world has {len(roots)} bodies ({', '.join(roots)}); expected the arm alone")
    if any(each.active for each in spec.equalities):
        raise FileFormatError(path, "has equality constraints: the joints of an arm move independently")
    for name in dir(model):
        values = getattr(model, name) if name[0] != "_" else None
        if isinstance(values, np.ndarray) and values.dtype.kind == "f" and np.isnan(values).any():
            raise FileFormatError(path, f"holds NaN instead of a number (it reaches {name})")


def _free_base(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Give the base its pose in the world as position and quaternion, whatever frames and angles it is written in."""
    base = spec.worldbody.first_body()
    base.set_frame(spec.worldbody.add_frame())
    base.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    base.pos, base.quat = model.body_pos[1], model.body_quat[1]


def joint_limits(model: mujoco.MjModel, start: Array) -> tuple[Array, Array]:
    """Return the limits that both joints and actuators allow; one turn around the start if neither has limits."""
    commanded = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-np.inf, np.inf])
    allowed = np.where(model.jnt_limited[:, None], model.jnt_range, [-np.inf, np.inf])
    lower: Array = np.maximum(allowed[:, 0], commanded[:, 0])
    upper: Array = np.minimum(allowed[:, 1], commanded[:, 1])
    return (
        np.where(np.isfinite(lower), lower, np.minimum(start, upper) - np.pi),
        np.where(np.isfinite(upper), upper, np.maximum(start, lower) + np.pi),
    )


def motion_limits(path: Path, model: mujoco.MjModel, name: str, given: npt.ArrayLike | None, default: Array) -> Array:
    """Return limits (n,): the given ones, else those in the file, else the default."""
    if given is not None:
        limits = numbers_of(given)
        if limits.shape != (model.njnt,) or not (limits > 0).all():
            raise InvalidValueError(f"{name} must be {model.njnt} positive numbers, got {given!r}")
        return limits
    in_file = numeric(path, model, name, model.njnt)
    if in_file is not None and not (in_file > 0).all():
        raise FileFormatError(path, f"custom numeric {name!r} must be positive numbers, got {in_file.tolist()}")
    return default if in_file is None else in_file


def numeric(path: Path, model: mujoco.MjModel, name: str, size: int) -> Array | None:
    """Return the numbers (``size``,) of a custom numeric of a file; None if it has none of that name."""
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    if index < 0:
        return None
    first, count = model.numeric_adr[index], model.numeric_size[index]
    if count != size:
        raise FileFormatError(path, f"custom numeric {name!r} has {count} numbers, expected {size}")
    return np.array(model.numeric_data[first : first + count])


def attainable_speeds(model: mujoco.MjModel) -> Array:
    """Return the speeds at which damping uses `DAMPING_FRACTION` of the servos' force; inf without a limit."""
    force = np.where(model.actuator_forcelimited, model.actuator_forcerange[:, 1], np.inf)
    at_joint = np.where(model.jnt_actfrclimited, model.jnt_actfrcrange[:, 1], np.inf)
    return DAMPING_FRACTION * np.minimum(force, at_joint) / np.maximum(model.dof_damping, 1e-9)


def servo_lag(model: mujoco.MjModel) -> float:
    """Return the lag of the slowest joint behind its command, seconds: its damping over its servo's stiffness."""
    damping = np.maximum(-model.actuator_biasprm[:, 2], model.dof_damping)
    return float((damping / model.actuator_gainprm[:, 0]).max())
