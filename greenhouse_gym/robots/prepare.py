"""Preparation of an arm's MuJoCo specification for scenes, whatever its file contains.

Collision masks: bit 1 is "the arm", bit 2 is "the cup". Obstacles have both bits; the target lets the cup pass if its
bit 2 is cleared (`greenhouse_gym.scene.mjcf`). A file's own masks only distinguish colliding from visual geoms, and its
margins are dropped: a contact is a touch.
"""

from __future__ import annotations

from itertools import count

import mujoco

TIP_SITE, CUP_GEOM, PROBE_PREFIX = "tip", "cup", "probe_"

_LINK_MASKS, _CUP_MASKS = (1, 3), (2, 2)  # contype, conaffinity

_NEAR = 0.005  # metres, the margin of planning


def prepare_spec(spec: mujoco.MjSpec, tip: str) -> mujoco.MjSpec:
    """Prepare an arm for scenes: site ``tip``, probe sites, names and masks of colliding geoms, no gravity.

    Args:
        spec: The arm alone; it is modified.
        tip: Name of the site at the tip.
    """
    for body in spec.bodies[1:]:
        body.gravcomp = 1.0
    end = spec.site(tip)
    if not any(site.name.startswith(PROBE_PREFIX) for site in spec.sites):
        for i, joint in enumerate(spec.joints):
            if i:
                joint.parent.add_site(name=f"{PROBE_PREFIX}{i - 1}", pos=joint.pos)
        end.parent.add_site(name=f"{PROBE_PREFIX}{len(spec.joints) - 1}", pos=end.pos)
    _name_parts(spec)
    cups = cup_geoms(spec, end)
    for geom in colliding_geoms(spec):
        geom.contype, geom.conaffinity = _CUP_MASKS if geom.name in cups else _LINK_MASKS
    for part in (*spec.geoms, *spec.pairs):
        part.margin = part.gap = 0.0
    end.name = TIP_SITE
    _let_base_touch_first_link(spec)
    return spec


def colliding_geoms(spec: mujoco.MjSpec) -> list[mujoco.MjsGeom]:
    """Return the geoms that are not only visual."""
    return [geom for geom in spec.geoms if geom.contype or geom.conaffinity]


def cup_geoms(spec: mujoco.MjSpec, tip: mujoco.MjsSite) -> set[str]:
    """Return the names of the parts that may touch the target: the geom ``cup``, else the tip body's colliding geoms.

    If the tip's body has none, the nearest body towards the base that has some is used.
    """
    colliding = colliding_geoms(spec)
    if any(geom.name == CUP_GEOM for geom in colliding):
        return {CUP_GEOM}
    body = tip.parent
    while body.name != "world":
        parts = {geom.name for geom in colliding if geom.parent == body}
        if parts:
            return parts
        body = body.parent
    return set()


def _let_base_touch_first_link(spec: mujoco.MjSpec) -> None:
    """Exclude contacts between the fixed base and the first link, as MuJoCo does for other neighboring links."""
    excluded = {frozenset((pair.bodyname1, pair.bodyname2)) for pair in spec.excludes}
    model = spec.compile()
    bodies = {link: [b for b in range(1, model.nbody) if _link_of(model, b) == link] for link in (-1, 0)}
    for base in bodies[-1]:
        for first in bodies[0]:
            names = model.body(base).name, model.body(first).name
            if frozenset(names) not in excluded:
                spec.add_exclude(bodyname1=names[0], bodyname2=names[1])


def touching_bodies(model: mujoco.MjModel, configuration: list[float]) -> list[tuple[int, int]]:
    """Return the pairs of bodies of an arm that touch, or nearly touch, in a configuration."""
    data = mujoco.MjData(model)
    data.qpos[:] = configuration
    mujoco.mj_kinematics(model, data)
    model.geom_margin += _NEAR / 2
    model.body_margin += _NEAR / 2
    mujoco.mj_collision(model, data)
    model.geom_margin -= _NEAR / 2
    model.body_margin -= _NEAR / 2
    pairs = {tuple(sorted(int(model.geom_bodyid[g]) for g in geoms)) for geoms in data.contact.geom}
    return [(a, b) for a, b in sorted(pairs)]


def _link_of(model: mujoco.MjModel, body: int) -> int:
    """Return the index of the last joint that moves a body; -1 for the fixed base."""
    while body and model.body_jntnum[body] == 0:
        body = int(model.body_parentid[body])
    return -1 if body == 0 else int(model.body_jntadr[body] + model.body_jntnum[body] - 1)


def _name_parts(spec: mujoco.MjSpec) -> None:
    """Name unnamed bodies, and unnamed geoms after their body, so that contacts can be identified."""
    for i, body in enumerate(spec.bodies):
        body.name = body.name or f"body_{i}"
    taken = {geom.name for geom in spec.geoms}
    for geom in spec.geoms:
        if not geom.name:
            geom.name = next(name for k in count() if (name := f"{geom.parent.name}_{k}") not in taken)
            taken.add(geom.name)
