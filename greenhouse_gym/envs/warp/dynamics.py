"""Kernel that begins episodes, and moves arms by one action: commands, servos and rigid-body dynamics.

It reproduces MuJoCo's integrator ``implicitfast`` for a chain of hinges without gravity and contact forces. Inertia
matrix and bias forces come from the recursive Newton-Euler equations (Featherstone, Rigid Body Dynamics Algorithms).
"""

from functools import lru_cache
from typing import Any

import warp as wp

from greenhouse_gym.envs.actions import DAMPING
from greenhouse_gym.envs.warp.structs import ACTING, FRESH, IDLE, NO_CONTACT, structs

_LIMIT_SWEEPS = 10
_EXCESS = {wp.float32: 1.00001, wp.float64: 1 + 1e-9}  # of a speed limit that counts as such


@lru_cache
def drive_kernel(real: Any, joints: int, substeps: int, moves_tip: bool, unrolled: int) -> wp.Kernel:
    """Return the kernel for arms with ``joints`` joints; ``moves_tip`` if actions are velocities of the tip."""
    t = structs(real)
    vec3, mat3, Arm, Scenes, Draws, State = t.vec3, t.mat3, t.Arm, t.Scenes, t.Draws, t.State
    n = joints
    vecn, matn, rows3 = wp.types.vector(n, real), wp.types.matrix((n, n), real), wp.types.matrix((n, 3), real)
    rows6 = wp.types.matrix((n, 6), real)
    vec6, mat6 = wp.types.vector(6, real), wp.types.matrix((6, 6), real)
    zero, one, over, damping = real(0.0), real(1.0), real(_EXCESS[real]), real(DAMPING**2)
    fresh, acting, idle, none, steps = FRESH, ACTING, IDLE, NO_CONTACT, real(float(substeps))
    limit_sweeps = _LIMIT_SWEEPS

    @wp.func
    def turned(axis: vec3, angle: real):
        """Return the rotation about an axis."""
        c = wp.cos(angle)
        s = wp.sin(angle)
        x = axis[0]
        y = axis[1]
        z = axis[2]
        t = one - c
        return mat3(
            t * x * x + c, t * x * y - s * z, t * x * z + s * y,
            t * x * y + s * z, t * y * y + c, t * y * z - s * x,
            t * x * z - s * y, t * y * z + s * x, t * z * z + c,
        )  # fmt: skip

    @wp.func
    def draw(draws: Draws, generator: wp.uint32):
        """Draw a tomato: an entry by its probability, then one of its rows."""
        chance = wp.randf(generator)
        low = int(0)
        high = draws.cumulative.shape[0] - 1
        while low < high:
            middle = (low + high) // 2
            if draws.cumulative[middle] > chance:
                high = middle
            else:
                low = middle + 1
        return draws.row[draws.first[low] + wp.randi(generator, 0, draws.count[low])]

    @wp.func
    def tip_change(levers: rows3, axes: rows3, tip: vec3, twist: vec6):
        """Return the change of the joints that approximates a motion of the tip, by damped least squares."""
        square = mat6()
        for i in range(6):
            square[i, i] = damping
        for j in range(n):
            linear = wp.cross(axes[j], tip) + levers[j]
            column = vec6(linear[0], linear[1], linear[2], axes[j][0], axes[j][1], axes[j][2])
            square += wp.outer(column, column)
        for j in range(6):
            for i in range(6):
                if i > j:
                    factor = square[i, j] / square[j, j]
                    twist[i] -= factor * twist[j]
                    for k in range(6):
                        if k > j:
                            square[i, k] -= factor * square[j, k]
        for jj in range(6):
            j = 5 - jj
            for k in range(6):
                if k > 5 - jj:
                    twist[j] -= square[j, k] * twist[k]
            twist[j] = twist[j] / square[j, j]
        change = vecn()
        force = vec3(twist[0], twist[1], twist[2])
        moment = vec3(twist[3], twist[4], twist[5])
        for j in range(n):
            change[j] = wp.dot(wp.cross(axes[j], tip) + levers[j], force) + wp.dot(axes[j], moment)
        return change

    @wp.func
    def decompose(matrix: matn):
        """Return the Cholesky factor of a symmetric matrix; only its lower half is read."""
        for j in range(n):
            x = matrix[j, j]
            for k in range(n):
                if k < j:
                    x -= matrix[j, k] * matrix[j, k]
            root = wp.sqrt(x)
            matrix[j, j] = root
            for i in range(n):
                if i > j:
                    y = matrix[i, j]
                    for k in range(n):
                        if k < j:
                            y -= matrix[i, k] * matrix[j, k]
                    matrix[i, j] = y / root
        return matrix

    @wp.func
    def solve(factor: matn, x: vecn):
        """Solve a system by the Cholesky factor of its matrix."""
        for i in range(n):
            y = x[i]
            for k in range(n):
                if k < i:
                    y -= factor[i, k] * x[k]
            x[i] = y / factor[i, i]
        for ii in range(n):
            i = n - 1 - ii
            y = x[i]
            for k in range(n):
                if k > i:
                    y -= factor[k, i] * x[k]
            x[i] = y / factor[i, i]
        return x

    @wp.func
    def limit_torques(arm: Arm, inertia: matn, torque: vecn, q: vecn, qd: vecn):
        """Return the torques of MuJoCo's soft joint limits, by projected Gauss-Seidel iterations."""
        factor = decompose(inertia)
        acceleration = solve(factor, torque)
        result = vecn()
        sweep = int(0)
        while sweep < limit_sweeps:
            j = int(0)
            while j < n:
                side = wp.where(q[j] < arm.range_low[j], one, -one)
                depth = wp.max(arm.range_low[j] - q[j], q[j] - arm.range_high[j])
                if depth > zero:
                    part = wp.min(depth / arm.impedance[j, 2], one)
                    middle = arm.impedance[j, 3]
                    power = arm.impedance[j, 4]
                    rise = wp.pow(part, power) / wp.pow(middle, power - one)
                    if part > middle:
                        rise = one - wp.pow(one - part, power) / wp.pow(one - middle, power - one)
                    strength = arm.impedance[j, 0] + rise * (arm.impedance[j, 1] - arm.impedance[j, 0])
                    softness = (one - strength) / strength * arm.limit_weight[j]
                    wanted = arm.limit_stiffness[j] * strength * depth - arm.limit_damping[j] * side * qd[j]
                    unit = vecn()
                    unit[j] = one
                    response = solve(factor, unit)
                    missing = wanted - side * acceleration[j] - softness * side * result[j]
                    push = wp.max(side * result[j] + missing / (response[j] + softness), zero) * side
                    acceleration += (push - result[j]) * response
                    result[j] = push
                j += 1
            sweep += 1
        return result

    @wp.kernel(module="unique", enable_backward=False, module_options={"max_unroll": unrolled})
    def drive(
        arm: Arm,
        scenes: Scenes,
        draws: Draws,
        s: State,
        action: wp.array2d(dtype=wp.float32),
        starts: wp.array2d(dtype=real),
        resets_only: wp.int32,
    ):
        """Begin episodes where the last one ended; elsewhere act, or do nothing if ``resets_only``."""
        w = wp.tid()
        phase = acting
        if s.ended[w] != 0:
            phase = fresh
        elif resets_only != 0:
            phase = idle
        s.phase[w] = phase
        if phase == idle:
            return
        q = vecn()
        qd = vecn()
        act = vecn()
        change = vecn()
        s.contact[w] = none
        if phase == fresh:
            row = s.wanted[w]
            if row < 0:
                row = draw(draws, wp.rand_init(s.seed[w], s.draws[w]))
                s.draws[w] = s.draws[w] + 1
            s.row[w] = row
            s.wanted[w] = -1
            s.steps[w] = 0
            s.speed_limited[w] = 0
            s.position_limited[w] = 0
            s.ended[w] = 0
            for i in range(n):
                q[i] = s.start[w, i]
                if wp.isnan(q[i]):
                    q[i] = starts[scenes.scene[row], i]
                act[i] = q[i]
                s.start[w, i] = real(wp.nan)
        else:
            effort = real(0.0)
            for i in range(action.shape[1]):
                u = wp.clamp(real(action[w, i]), -one, one)
                effort += u * u
            s.effort[w] = effort
            for i in range(n):
                q[i] = s.joints[w, i]
                qd[i] = s.velocities[w, i]
                act[i] = s.command[w, i]
                if wp.static(not moves_tip):
                    change[i] = arm.peak[i] * wp.clamp(real(action[w, i]), -one, one)
        scene = scenes.scene[s.row[w]]
        base = scenes.base[scene]
        h = arm.timestep
        parts = arm.part_link.shape[0]
        probes = arm.probe_link.shape[0]
        sub = int(0)
        while sub <= substeps:
            rotation = scenes.arm_rotation[scene]
            origin = vec3()  # of the link's frame, from the base
            spin = vec3()  # angular velocity of the link, and accelerations while the joints do not accelerate
            spin_rate = vec3()
            acceleration = vec3()
            axes = rows3()
            levers = rows3()  # origin x axis
            forces = rows3()
            moments = rows3()  # about the base, as all that follow
            firsts = rows3()
            seconds = rows6()
            part = int(0)
            probe = int(0)
            while part < parts and arm.part_link[part] < 0:
                if sub > 0:
                    s.part_start[w, sub - 1, part] = base + rotation * arm.part_start[part]
                    s.part_end[w, sub - 1, part] = base + rotation * arm.part_end[part]
                part += 1
            for i in range(n):
                step = rotation * arm.position[i]
                acceleration = acceleration + wp.cross(spin_rate, step) + wp.cross(spin, wp.cross(spin, step))
                origin = origin + step
                rotation = rotation * arm.rotation[i]
                axis = rotation * arm.axis[i]
                rotation = rotation * turned(arm.axis[i], q[i])
                spin_rate = spin_rate + wp.cross(spin, axis) * qd[i]
                spin = spin + axis * qd[i]
                offset = rotation * arm.center[i]
                center = origin + offset
                mass = arm.mass[i]
                own = rotation * arm.inertia[i] * wp.transpose(rotation)
                force = mass * (acceleration + wp.cross(spin_rate, offset) + wp.cross(spin, wp.cross(spin, offset)))
                moment = own * spin_rate + wp.cross(spin, own * spin) + wp.cross(center, force)
                lever = wp.cross(origin, axis)
                for d in range(3):
                    axes[i, d] = axis[d]
                    levers[i, d] = lever[d]
                    forces[i, d] = force[d]
                    moments[i, d] = moment[d]
                    firsts[i, d] = mass * center[d]
                    seconds[i, d] = own[d, d] + mass * (wp.dot(center, center) - center[d] * center[d])
                seconds[i, 3] = own[0, 1] - mass * center[0] * center[1]
                seconds[i, 4] = own[0, 2] - mass * center[0] * center[2]
                seconds[i, 5] = own[1, 2] - mass * center[1] * center[2]
                while part < parts and arm.part_link[part] == i:
                    if sub > 0:
                        s.part_start[w, sub - 1, part] = base + origin + rotation * arm.part_start[part]
                        s.part_end[w, sub - 1, part] = base + origin + rotation * arm.part_end[part]
                    part += 1
                if sub == substeps:
                    while probe < probes and arm.probe_link[probe] == i:
                        s.probe[w, probe] = base + origin + rotation * arm.probe_position[probe]
                        probe += 1
            tip = origin + rotation * arm.tip_position
            if sub == substeps:
                s.tip[w] = base + tip
                s.axis[w] = rotation * arm.tip_axis
            elif phase == acting:
                if sub == 0:
                    if wp.static(moves_tip):
                        heading = scenes.heading[scene]
                        twist = vec6()
                        for i in range(6):
                            twist[i] = arm.peak[i] * wp.clamp(real(action[w, i]), -one, one)
                        linear_part = heading * vec3(twist[0], twist[1], twist[2])
                        angular_part = heading * vec3(twist[3], twist[4], twist[5])
                        for d in range(3):
                            twist[d] = linear_part[d]
                            twist[3 + d] = angular_part[d]
                        change = tip_change(levers, axes, tip, twist)
                    excess = real(0.0)
                    for i in range(n):
                        excess = wp.max(excess, wp.abs(change[i]) / arm.max_change[i])
                    if excess > over:
                        s.speed_limited[w] = s.speed_limited[w] + 1
                    stopped = int(0)
                    for i in range(n):
                        moved = wp.clamp(
                            act[i] + change[i] / wp.max(excess, one), q[i] - arm.max_error, q[i] + arm.max_error
                        )
                        goal = wp.clamp(moved, arm.lower[i], arm.upper[i])
                        if goal != moved:
                            stopped += 1
                        change[i] = (goal - act[i]) / steps  # of each physics step from here on
                    s.position_limited[w] = s.position_limited[w] + stopped
                # inertia matrix of the composite bodies, and the torque that is left for acceleration
                inertia = matn()
                torque = vecn()
                force = vec3()
                moment = vec3()
                mass = real(0.0)
                first = vec3()
                second = vec6()
                for ii in range(n):
                    i = n - 1 - ii
                    mass += arm.mass[i]
                    for d in range(3):
                        force[d] = force[d] + forces[i, d]
                        moment[d] = moment[d] + moments[i, d]
                        first[d] = first[d] + firsts[i, d]
                    for d in range(6):
                        second[d] = second[d] + seconds[i, d]
                    axis = vec3(axes[i, 0], axes[i, 1], axes[i, 2])
                    lever = vec3(levers[i, 0], levers[i, 1], levers[i, 2])
                    act[i] = act[i] + change[i]
                    bias = wp.dot(axis, moment) + wp.dot(lever, force)
                    torque[i] = arm.stiffness[i] * (act[i] - q[i]) - arm.damping[i] * qd[i] - bias
                    turning = vec3(
                        second[0] * axis[0] + second[3] * axis[1] + second[4] * axis[2],
                        second[3] * axis[0] + second[1] * axis[1] + second[5] * axis[2],
                        second[4] * axis[0] + second[5] * axis[1] + second[2] * axis[2],
                    ) + wp.cross(first, lever)
                    pushing = mass * lever + wp.cross(axis, first)
                    for j in range(n):
                        if j <= n - 1 - ii:
                            inertia[i, j] = (
                                axes[j, 0] * turning[0] + axes[j, 1] * turning[1] + axes[j, 2] * turning[2]
                                + levers[j, 0] * pushing[0] + levers[j, 1] * pushing[1] + levers[j, 2] * pushing[2]
                            )  # fmt: skip
                    inertia[i, i] += arm.armature[i]
                beyond = int(0)
                for i in range(n):
                    if q[i] < arm.range_low[i] or q[i] > arm.range_high[i]:
                        beyond = 1
                if beyond != 0:
                    torque += limit_torques(arm, inertia, torque, q, qd)
                for i in range(n):
                    inertia[i, i] += h * arm.damping[i]
                qdd = solve(decompose(inertia), torque)
                for i in range(n):
                    qd[i] = qd[i] + h * qdd[i]
                    q[i] = q[i] + h * qd[i]
            sub += 1
        for i in range(n):
            s.joints[w, i] = q[i]
            s.velocities[w, i] = qd[i]
            s.command[w, i] = act[i]
        part = int(0)
        while part < parts:
            start = s.part_start[w, substeps - 1, part]
            end = s.part_end[w, substeps - 1, part]
            far = real(0.0)
            for k in range(substeps):
                far = wp.max(far, wp.length(s.part_start[w, k, part] - start))
                far = wp.max(far, wp.length(s.part_end[w, k, part] - end))
            s.travel[w, part] = far
            part += 1

    return drive
