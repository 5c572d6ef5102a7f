"""Hide organs at rest that the arm cannot reach from MuJoCo's search for contacts.

In each physics step MuJoCo computes the boxes around all geoms, also those of bodies that sleep. It leaves out bodies
without collision masks. An arm among organs that all sleep touches none that is farther away than the arm moves, so
these have no masks meanwhile. Results stay equal bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.arm_spheres import arm_spheres
from greenhouse_gym.scene.plants.layout import SlotIds

_GAP = 1e-3  # metres: for rounding
_LAG = 0.005  # radians or metres: an arm that stops turns on a little


class Organs:
    """Organs in the slots of a simulation, with boxes around them, that can be hidden from the search for contacts.

    Args:
        model: The model of the simulation.
        data: Its state.
        ids: Ids of the slots.
        joints: Number of the arm's joints.

    Attributes:
        arm: Spheres around the arm.
        hidden: True while some organs are hidden.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, ids: SlotIds, joints: int):
        self._model, self._data, self.hidden = model, data, False
        self.arm = arm_spheres(model, joints)
        slots = np.concatenate([ids.truss, ids.fruit.ravel(), ids.leaf, ids.loose, ids.cut, ids.cut_fruit.ravel()])
        slides = model.body_treeid[ids.crate] >= 0  # the crate, with the arm
        self._bodies = np.sort(np.append(slots, [] if slides else [ids.crate]).astype(np.int64))
        self.boxes = np.empty((2, len(self._bodies), 3))
        # views, which take a while to make
        self._qpos, self.anchors = data.qpos[:joints], data.xanchor[:joints]
        self.positions, self.rotations = data.xpos[self.arm.frames], data.xmat[self.arm.frames]
        self._masks = model.body_conaffinity
        self.refresh()

    def refresh(self) -> None:
        """Compute the boxes around the organs as they are, with current kinematics."""
        model, first = self._model, self._model.body_geomadr[self._bodies]
        own = slice(int(first[0]), int(first[-1] + model.body_geomnum[self._bodies[-1]]))
        solid = (model.geom_contype[own] | model.geom_conaffinity[own]) != 0
        around = np.where(solid, model.geom_rbound[own] + model.geom_margin[own] + _GAP, -np.inf)[:, None]
        middles = self._data.geom_xpos[own]
        np.minimum.reduceat(middles - around, first - own.start, out=self.boxes[0])
        np.maximum.reduceat(middles + around, first - own.start, out=self.boxes[1])
        self._shown = self._masks.copy()

    def hide(self, far: npt.NDArray[np.bool_], turns: list[float]) -> None:
        """Hide organs that the arm cannot reach as long as each joint has turned by no more than (joints,)."""
        self._masks[self._bodies[far]] = 0  # their other masks are 0, as they touch only what moves by itself
        self._limits = [(q - turn, q + turn) for q, turn in zip(self._qpos.tolist(), turns, strict=True)]
        self.hidden = True

    def check(self) -> None:
        """Show all organs again if the arm has turned farther than was foreseen."""
        for q, (low, high) in zip(self._qpos.tolist(), self._limits, strict=True):
            if not low <= q <= high:
                self.show()
                break

    def show(self) -> None:
        """Show all organs."""
        self._masks[:] = self._shown
        self.hidden = False


def hide_out_of_reach(chosen: Sequence[Organs], turns: Array) -> None:
    """Hide the organs of n simulations that their arms cannot reach.

    Args:
        chosen: Organs, all asleep.
        turns: (n, joints) how far the joints are to turn, radians or metres.
    """
    if not chosen:
        return
    from greenhouse_gym.scene.reach_kernels import mark_far

    arm, allowed = chosen[0].arm, np.abs(turns) + _LAG
    far = np.empty((len(chosen), chosen[0].boxes.shape[1]), dtype=np.bool_)
    positions, rotations, anchors, boxes = (
        np.array([getattr(one, name) for one in chosen]) for name in ("positions", "rotations", "anchors", "boxes")
    )
    mark_far(positions, rotations, *arm[:5], anchors, allowed, boxes, far)
    for one, beyond, each in zip(chosen, far, allowed.tolist(), strict=True):
        one.hide(beyond, each)
