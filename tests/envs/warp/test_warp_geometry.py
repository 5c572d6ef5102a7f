"""Distances of the kernels are those of MuJoCo."""

import mujoco
import numpy as np
import pytest

wp = pytest.importorskip("warp")

from greenhouse_gym.envs.warp.bank import ShapeTable  # noqa: E402
from greenhouse_gym.envs.warp.geometry import geometry  # noqa: E402
from greenhouse_gym.envs.warp.runtime import open_device, struct_of  # noqa: E402
from greenhouse_gym.geometry.shape_arrays import BOX, CAPSULE, ELLIPSOID, SPHERE  # noqa: E402

TYPES = {SPHERE: "sphere", CAPSULE: "capsule", ELLIPSOID: "ellipsoid", BOX: "box"}
TOLERANCE = {"float64": 2e-6, "float32": 2e-5}


def measure(real, table, starts, ends):
    """Return distances of segments to shapes, row by row."""
    g = geometry(real)

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(shapes: g.Shapes, start: wp.array(dtype=g.vec3), end: wp.array(dtype=g.vec3), out: wp.array(dtype=real)):
        i = wp.tid()
        out[i] = g.segment_distance(shapes, i, start[i], end[i] - start[i])

    out = wp.zeros(len(starts), dtype=real, device="cpu")
    arrays = [wp.array(x, dtype=g.vec3, device="cpu") for x in (starts, ends)]
    wp.launch(kernel, len(starts), [struct_of(g.Shapes, table, "cpu"), *arrays, out], device="cpu")
    return out.numpy()


def random_pairs(rng, count):
    """Return shapes with segments around them; some are parallel, degenerate, touching or crossing."""
    kind = rng.integers(4, size=count)
    size = rng.uniform(0.005, 0.15, (count, 3))
    size[kind == SPHERE, 1:] = 0
    size[kind == CAPSULE, 2] = 0
    size[(kind == BOX) & (rng.random(count) < 0.3), 2] = 0.0015
    rotation = np.zeros((count, 3, 3))
    for i, quaternion in enumerate(rng.standard_normal((count, 4))):
        flat = np.empty(9)
        mujoco.mju_quat2Mat(flat, quaternion / np.linalg.norm(quaternion))
        rotation[i] = flat.reshape(3, 3)
    center = rng.uniform(-0.1, 0.1, (count, 3))
    middle = center + rng.uniform(-0.4, 0.4, (count, 3))
    half = rng.standard_normal((count, 3)) * 0.1
    parallel = rng.random(count) < 0.2
    half[parallel] = rotation[parallel, :, 2] * 0.1
    half[rng.random(count) < 0.1] *= 1e-5
    bound = np.full(count, 1.0)
    first = np.zeros(1, dtype=np.int32)
    table = ShapeTable(first, np.array([count], np.int32), kind.astype(np.int32), center, rotation, size, bound)
    return table, middle - half, middle + half


def by_mujoco(table, starts, ends, radius):
    """Return MuJoCo's distances of capsules around the segments to the shapes."""
    spec = mujoco.MjSpec()
    for name in ("part", *TYPES.values()):
        body = spec.worldbody.add_body(name=name)
        geom_type = (
            mujoco.mjtGeom.mjGEOM_CAPSULE if name == "part" else getattr(mujoco.mjtGeom, f"mjGEOM_{name.upper()}")
        )
        body.add_geom(name=name, type=geom_type, size=[0.1, 0.1, 0.1])
    model = spec.compile()
    data = mujoco.MjData(model)
    distances = np.empty(len(starts))
    part = model.geom("part").id
    for i, (kind, start, end) in enumerate(zip(table.kind, starts, ends, strict=True)):
        shape = model.geom(TYPES[int(kind)]).id
        model.geom_size[part] = [radius, np.linalg.norm(end - start) / 2, 0]
        model.geom_size[shape] = table.size[i]
        quaternion = np.empty(4)
        mujoco.mju_quatZ2Vec(quaternion, end - start)
        model.body_pos[part + 1], model.body_quat[part + 1] = (start + end) / 2, quaternion
        mujoco.mju_mat2Quat(quaternion, table.rotation[i].reshape(-1))
        model.body_pos[shape + 1], model.body_quat[shape + 1] = table.center[i], quaternion
        mujoco.mj_kinematics(model, data)
        distances[i] = mujoco.mj_geomDistance(model, data, part, shape, 2.0, None)
    return distances


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_distances_are_those_of_mujoco(precision):
    open_device("cpu")
    table, starts, ends = random_pairs(np.random.default_rng(0), 1500)
    radius = 0.02
    own = measure(getattr(wp, precision), table, starts, ends) - radius
    theirs = by_mujoco(table, starts, ends, radius)
    apart = theirs > 1e-4
    assert apart.sum() > 700
    assert np.abs(own - theirs)[apart & (table.kind != ELLIPSOID)].max() < TOLERANCE[precision]
    # MuJoCo iterates for ellipsoids, to a coarser tolerance
    assert np.abs(own - theirs)[apart & (table.kind == ELLIPSOID)].max() < 2e-4
    touching = theirs < -1e-4
    assert (own[touching] < 1e-5).all()
