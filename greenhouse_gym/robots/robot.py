"""`Robot`: an arm with its start, limits, tip and probe points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots.arm_file import read_arm
from greenhouse_gym.robots.kinematics import tool_chain
from greenhouse_gym.robots.prepare import CUP_GEOM, TIP_SITE, prepare_spec

__all__ = ["CUP_GEOM", "TIP_SITE", "Robot"]

_ALIGNED = 1e-6  # largest sine of an angle between two axes, and largest distance (m) from one, that count as zero


@dataclass(frozen=True, eq=False)
class Robot:
    """Robot arm, read from an MJCF file.

    A joint turns (a hinge, radians) or slides (a rail or a lift, metres); "radians" below means either unit.

    Attributes:
        name: Short name, the stem of its file.
        path: The MJCF file.
        joints: Names of the n joints, in order.
        start: (n,) start configuration of an episode, radians.
        starts: Start configurations by name, (n,) radians each: all key frames of the file. The shipped arms have
            ``ready`` (the default: bent, the tool forward), ``upright`` and ``folded`` (over the aisle).
        lower: (n,) lower joint limits, radians.
        upper: (n,) upper joint limits, radians.
        velocity_limits: (n,) rad/s.
        acceleration_limits: (n,) rad/s^2.
        shoulder_height: Height of the shoulder above the base, metres.
        probes: Names of the k sites at which clearance is observed.
        probe_radii: (k,) radius of the arm at those sites, metres.
        specification: The arm as scenes need it; `spec` returns copies.
        tip: Name of the tip's site in the file; `spec` names it ``tip``.
        sliding: (n,) True for joints that slide.
        lag: Time by which the arm lags behind its commands, seconds.
        foot: Depth of base and first link below the origin of the base, metres.
    """

    name: str
    path: Path
    joints: tuple[str, ...]
    start: Array
    starts: Mapping[str, Array]
    lower: Array
    upper: Array
    velocity_limits: Array
    acceleration_limits: Array
    shoulder_height: float
    probes: tuple[str, ...]
    probe_radii: Array
    specification: mujoco.MjSpec = field(repr=False)
    tip: str
    sliding: npt.NDArray[np.bool_]
    lag: float
    foot: float

    def __post_init__(self) -> None:
        # arms are shared by everything that uses them
        for array in (*vars(self).values(), *self.starts.values()):
            if isinstance(array, np.ndarray):
                array.setflags(write=False)

    def configuration(self, start: str | npt.ArrayLike | None) -> npt.ArrayLike:
        """Return a start by its name in ``starts``, or the arm's own for None; a configuration is returned unchanged.

        Raises:
            UnknownNameError: No key frame of that name.
        """
        if start is None:
            return self.start
        return self.starts[require_choice("start", start, self.starts)] if isinstance(start, str) else start

    @property
    def rating_start(self) -> Array:
        """(n,) start from which targets are rated and witnesses lead: ``ready`` if the arm has it, else its own."""
        return self.starts.get("ready", self.start)

    @property
    def upright_start(self) -> Array:
        """(n,) start that keeps away from plants: ``upright`` if the arm has it, else its own."""
        return self.starts.get("upright", self.start)

    @cached_property
    def on_rail(self) -> bool:
        """True if the base slides, with the cart that it stands on, see `greenhouse_gym.robots.mount_on_rail`."""
        return slides(self.specification)

    @cached_property
    def rolls_tool(self) -> bool:
        """True if the last joint turns the tool about its own axis, which moves nothing if the tool is round."""
        model = self.spec().compile()
        chain = tool_chain(model, model.site(TIP_SITE).id)
        axis, tip = chain.axes[-1], chain.offsets[-1]
        off_axis = np.linalg.norm(np.cross(axis, tip[:3, 2:].T), axis=1)  # of the tool's axis and of the tip
        return not chain.sliding[-1] and bool((off_axis < _ALIGNED).all())

    def keep_tool_roll(self, configurations: Array, reference: Array) -> None:
        """Give configurations (..., n) the tool roll of a reference (n,), in place; no effect on arms without one.

        The reference may have more axes, as long as it can be broadcast.
        """
        if self.rolls_tool:
            configurations[..., -1] = reference[..., -1]

    def spec(self) -> mujoco.MjSpec:
        """Return a new, editable MuJoCo specification of only the arm."""
        return self.specification.copy()

    def __deepcopy__(self, memo: dict[int, Any]) -> Robot:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without MuJoCo's specification, which cannot be pickled; unpickling reads the file again."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "specification"}
        return _restore, ({**values, "starts": dict(self.starts)},)


def slides(spec: mujoco.MjSpec) -> bool:
    """Return whether the base of an arm slides horizontally."""
    joints = spec.worldbody.first_body().joints
    slide = mujoco.mjtJoint.mjJNT_SLIDE
    return len(joints) == 1 and joints[0].type == slide and abs(float(joints[0].axis[2])) < _ALIGNED


def _restore(values: dict[str, Any]) -> Robot:
    specification = prepare_spec(read_arm(values["path"]), values["tip"])
    return Robot(**{**values, "starts": MappingProxyType(values["starts"])}, specification=specification)
