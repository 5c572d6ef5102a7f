"""Write an arm of capsules as a robot of VAMP, in C++, since VAMP plans only for robots that are compiled into it.

python -m benchmarks.planning.vamp_arm VAMP/src/impl/vamp/robots/ur5e.hh

Compile VAMP with ``VAMP_ROBOT_MODULES=ur5e`` and ``VAMP_ROBOT_STRUCTS=UR5E``.

Spheres cover the capsules of `greenhouse_gym.motion.kernel_checker`, in the frame of the arm's base; each capsule has
one sphere around it, which is checked first, and the pairs of capsules that may touch are those of MuJoCo.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.common import parser
from greenhouse_gym.geometry import Array, invert
from greenhouse_gym.motion.kernel_checker import kernel_world
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import compile_scene
from greenhouse_gym.scene.mjcf import arm_pose
from greenhouse_gym.scene.obstacles import Surroundings

EXCESS = 0.002
"""Largest distance from a covering sphere's surface to its capsule, metres."""

_HEAD = """#pragma once

#include <vamp/vector.hh>
#include <vamp/vector/math.hh>
#include <vamp/collision/environment.hh>
#include <vamp/collision/validity.hh>

namespace vamp::robots
{{
    struct {struct}
    {{
        static constexpr const char *name = "{name}";
        static constexpr std::size_t dimension = {joints};
        static constexpr std::size_t n_spheres = {spheres};
        static constexpr float min_radius = {smallest};
        static constexpr float max_radius = {largest};
        static constexpr std::size_t resolution = 32;
        static constexpr std::array<std::string_view, dimension> joint_names = {{{names}}};
        static constexpr const char *end_effector = "tip";
        using Configuration = FloatVector<dimension>;
        using ConfigurationArray = std::array<FloatT, dimension>;
        struct alignas(FloatVectorAlignment) ConfigurationBuffer
          : std::array<float, Configuration::num_scalars_rounded>
        {{
        }};
        template <std::size_t rake>
        using ConfigurationBlock = FloatVector<rake, dimension>;
        template <std::size_t rake>
        struct Spheres
        {{
            FloatVector<rake, n_spheres> x, y, z, r;
        }};
        alignas(Configuration::S::Alignment) static constexpr std::array<float, dimension> s_m{{{ranges}}};
        alignas(Configuration::S::Alignment) static constexpr std::array<float, dimension> s_a{{{lower}}};
        inline static void scale_configuration(Configuration &q) noexcept
        {{
            q = q * Configuration(s_m) + Configuration(s_a);
        }}
        inline static void descale_configuration(Configuration &q) noexcept
        {{
            q = (q - Configuration(s_a)) / Configuration(s_m);
        }}
        template <std::size_t rake>
        inline static void scale_configuration_block(ConfigurationBlock<rake> &q) noexcept
        {{
            for (auto i = 0U; i < dimension; ++i) {{ q[i] = s_a[i] + (q[i] * s_m[i]); }}
        }}
        template <std::size_t rake>
        inline static void descale_configuration_block(ConfigurationBlock<rake> &q) noexcept
        {{
            for (auto i = 0U; i < dimension; ++i) {{ q[i] = (q[i] - s_a[i]) * (1.F / s_m[i]); }}
        }}
        inline static auto space_measure() noexcept -> float {{ return {measure}; }}
"""

_TAIL = """
        template <std::size_t rake>
        inline static bool fkcc_attach(
            const vamp::collision::Environment<FloatVector<rake>> &environment,
            const ConfigurationBlock<rake> &x) noexcept
        {
            return fkcc<rake>(environment, x);
        }
        using Debug = std::
            pair<std::vector<std::vector<std::string>>, std::vector<std::pair<std::size_t, std::size_t>>>;
        template <std::size_t rake>
        inline static auto fkcc_debug(
            const vamp::collision::Environment<FloatVector<rake>> &, const ConfigurationBlock<rake> &) noexcept -> Debug
        {
            return {};
        }
        inline static auto eefk(const std::array<float, dimension> &) noexcept -> Eigen::Isometry3f
        {
            return Eigen::Isometry3f::Identity();
        }
    };
}  // namespace vamp::robots
"""

_SELF = """            if (sphere_sphere_self_collision<decltype(x[0])>({}, {}))
            {{
{}            }}
"""


def main() -> None:
    """Write the header."""
    command = parser(__doc__)
    command.add_argument("path", type=Path, help="file of the header")
    command.add_argument("--robot", default="ur5e")
    a = command.parse_args()
    a.path.write_text(header(a.robot))


class _Code:
    """Statements in C++ for products and sums, of numbers, which are computed here, and of names of variables."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._count = 0

    def sum_of_products(self, pairs: list[tuple[float | str, float | str]]) -> float | str:
        """Return the value of a sum of products: a number, or the name of a new variable."""
        constant, terms = 0.0, []
        for a, b in pairs:
            if isinstance(a, float) and isinstance(b, float):
                constant += a * b
                continue
            a, b = (b, a) if isinstance(b, float) else (a, b)
            if isinstance(a, float) and abs(a) < 1e-9:
                continue
            terms.append(f"{b}" if isinstance(a, float) and abs(a - 1) < 1e-9 else f"{_text(a)} * {b}")
        if not terms:
            return constant
        if abs(constant) > 1e-9:
            terms.insert(0, _text(constant))
        if len(terms) == 1 and "*" not in terms[0]:
            return terms[0]
        return self.variable(" + ".join(terms))

    def variable(self, expression: str) -> str:
        """Return the name of a new variable."""
        name = f"t{self._count}"
        self._count += 1
        self.lines.append(f"            const FloatVector<rake, 1> {name} = {expression};")
        return name


def header(name: str) -> str:
    """Return the header of a robot for VAMP, whose struct has the arm's name in capitals."""
    arm, empty = get_robot(name), Surroundings(name="alone")
    world = kernel_world(compile_scene(empty, arm).model)
    if world is None:
        raise SystemExit(f"{name} does not consist of capsules and spheres")
    table, capsules, pairs = world[:3]
    to_base = invert(arm_pose(empty, arm))
    code = _Code()
    frames = _frames(code, table, to_base)
    rows = [_covering(row) for row in capsules]
    placed, hulls = [], []
    for row, (points, radius) in zip(capsules, rows, strict=True):
        owner = int(row[0])
        around = (points[0] + points[-1]) / 2
        hull = float(np.linalg.norm(points[0] - points[-1])) / 2 + radius
        frame = frames[owner] if owner >= 0 else _constant(to_base)
        placed.append([f"{_at(code, frame, point)}, {_text(radius)}" for point in points])
        hulls.append(f"{_at(code, frame, around)}, {_text(hull)}")
    body = _checks(placed, hulls, capsules[:, 0] >= 0, pairs)
    spheres = [sphere for row in placed for sphere in row]
    fk = "".join(
        f"            out.{axis}[{k}] = {value};\n"
        for k, sphere in enumerate(spheres)
        for axis, value in zip("xyzr", sphere.split(", "), strict=True)
    )
    radii = [radius for _, radius in rows]
    head = _HEAD.format(
        struct=arm.name.upper(), name=arm.name, joints=len(arm.joints), spheres=len(spheres), smallest=min(radii),
        largest=max(radii), names=", ".join(f'"{joint}"' for joint in arm.joints),
        ranges=", ".join(map(_text, arm.upper - arm.lower)), lower=", ".join(map(_text, arm.lower)),
        measure=float(np.prod(arm.upper - arm.lower)),
    )  # fmt: skip
    kinematics = "\n".join(code.lines) + "\n"
    return (
        head
        + "        template <std::size_t rake>\n        inline static void sphere_fk("
        + "const ConfigurationBlock<rake> &x, Spheres<rake> &out) noexcept\n        {\n"
        + kinematics + fk + "        }\n"
        + "        template <std::size_t rake>\n        inline static bool fkcc("
        + "const vamp::collision::Environment<FloatVector<rake>> &environment, "
        + "const ConfigurationBlock<rake> &x) noexcept\n        {\n"
        + kinematics + body + "            return true;\n        }\n"
        + _TAIL
    )  # fmt: skip


_Frame = list[list[float | str]]  # (3, 4) rotation and position


def _frames(code: _Code, table: Array, to_base: Array) -> list[_Frame]:
    """Return the frames after each joint."""
    frames, frame = [], _constant(to_base)
    for j, row in enumerate(table):
        offset, axis = row[:12].reshape(3, 4), row[12:15]
        frame = _product(code, frame, _constant(offset))
        turn = int(np.argmax(np.abs(axis)))
        if row[15] or not np.isclose(abs(axis[turn]), 1.0):
            raise SystemExit("expected hinges about the axes of their frames")
        sine, cosine = code.variable(f"sin(x[{j}])"), code.variable(f"cos(x[{j}])")
        if axis[turn] < 0:
            sine = code.variable(f"-{sine}")
        minus = code.variable(f"-{sine}")
        rotation = _constant(np.eye(3, 4))
        b, c = (turn + 1) % 3, (turn + 2) % 3
        rotation[b][b], rotation[b][c], rotation[c][b], rotation[c][c] = cosine, minus, sine, cosine
        frame = _product(code, frame, rotation)
        frames.append(frame)
    return frames


def _constant(matrix: Array) -> _Frame:
    return [[float(value) for value in row] for row in matrix[:3]]


def _product(code: _Code, a: _Frame, b: _Frame) -> _Frame:
    result: _Frame = []
    for row in a:
        turned = [code.sum_of_products([(row[k], b[k][j]) for k in range(3)]) for j in range(3)]
        moved = code.sum_of_products([*((row[k], b[k][3]) for k in range(3)), (1.0, row[3])])
        result.append([*turned, moved])
    return result


def _at(code: _Code, frame: _Frame, point: Array) -> str:
    """Return the coordinates of a point in a frame."""
    values = [code.sum_of_products([*zip(row[:3], map(float, point), strict=True), (1.0, row[3])]) for row in frame]
    return ", ".join(map(_text, values))


def _text(value: float | str | np.floating) -> str:
    return (
        value
        if isinstance(value, str)
        else f"{float(value):.9g}F"
        if "." in f"{float(value):.9g}"
        else f"{float(value):.1f}F"
    )


def _covering(row: Array) -> tuple[Array, float]:
    """Return centers (k, 3) and the radius of spheres that cover a capsule."""
    start, end, radius = row[1:4], row[4:7], float(row[7])
    outer = radius + EXCESS
    length = float(np.linalg.norm(end - start))
    count = 1 + int(np.ceil(length / (2 * np.sqrt(outer**2 - radius**2))))
    if count == 1:
        return start[None], radius
    return start + np.linspace(0.0, 1.0, count)[:, None] * (end - start), outer


def _checks(placed: list[list[str]], hulls: list[str], moving: npt.NDArray[np.bool_], pairs: Array) -> str:
    """Return statements that end the function with false at a collision; what does not move stands on the scene."""
    lines = []
    for k in np.flatnonzero(moving).tolist():
        spheres, hull = placed[k], hulls[k]
        inner = "".join(
            f"                if (sphere_environment_in_collision(environment, {sphere})) {{ return false; }}\n"
            for sphere in spheres
        )
        around = f"            if (sphere_environment_in_collision(environment, {hull}))\n"
        lines.append(f"{around}            {{\n{inner}            }}\n")
    for a, b in pairs.tolist():
        inner = "".join(
            f"                if (sphere_sphere_self_collision<decltype(x[0])>({one}, {other})) {{ return false; }}\n"
            for one in placed[a]
            for other in placed[b]
        )
        lines.append(_SELF.format(hulls[a], hulls[b], inner))
    return "".join(lines)


if __name__ == "__main__":
    main()
