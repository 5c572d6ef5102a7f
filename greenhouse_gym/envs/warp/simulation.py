"""Simulations on a device: bank, state and outputs as device arrays, and the launches of a step."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import warp as wp

from greenhouse_gym.envs.actions import TipVelocity
from greenhouse_gym.envs.choices import make_action, make_observation, step_limit_of
from greenhouse_gym.envs.episodes import EpisodeSampler
from greenhouse_gym.envs.observations import ObservationSpec
from greenhouse_gym.envs.randomization import NO_RANDOMIZATION
from greenhouse_gym.envs.rewards import DenseReward, SparseReward
from greenhouse_gym.envs.settings import EnvSettings
from greenhouse_gym.envs.state import control_timing
from greenhouse_gym.envs.tasks import TomatoReach
from greenhouse_gym.envs.warp.arm import ArmArrays, arm_arrays, colliding_parts, unsupported
from greenhouse_gym.envs.warp.bank import DrawTable, draw_table
from greenhouse_gym.envs.warp.cells import reach_of
from greenhouse_gym.envs.warp.contacts import FLOOR, MAX_SHAPES, collide_kernel
from greenhouse_gym.envs.warp.device_bank import BYTES_PER_SCENE, device_bank
from greenhouse_gym.envs.warp.dynamics import drive_kernel
from greenhouse_gym.envs.warp.outcome import FEATURES, Layout, Output, Rules, observe_kernel
from greenhouse_gym.envs.warp.runtime import BLOCK_SIZE, PRECISIONS, check_memory, load_kernels, open_device, struct_of
from greenhouse_gym.envs.warp.structs import structs
from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import compile_scene

ACTIONS = ("joint", "joint_velocity", "tip_velocity")
OBSERVATIONS = ("state", "goal")
REWARDS: Mapping[str, DenseReward | SparseReward] = {"dense": DenseReward(), "sparse": SparseReward()}
TERMS = ("success", "collision", "progress", "time", "effort")
"""Terms of the reward, in the order of their sum."""

_CPU_UNROLLED, _GPU_UNROLLED = 0, 16  # rounds of loops: unrolled loops take long to compile, but run in registers
_LANES = {True: (32, 2), False: (1, 1)}  # threads of a simulation and of a part, on a GPU and on a CPU


class WarpSimulation:
    """Batch of n simulations of the task "reach" on a device.

    Args:
        count: Number of simulations n.
        settings: The settings.
        device: Name of the device.
        precision: "float32" or "float64"; by default double precision on a CPU, where it costs nothing.

    Attributes:
        robot: The arm.
        sampler: Sampler of the episodes, for `draw_table` and the options of a reset.
        observe: The observation, with its space and layout.
        action_rule: The kind of action, with its space.
        bank: Scenes of the split on the device.
        state: State of the simulations.
        out: Outputs of the last step.
        action: (n, size) actions of the next step, float32.

    Raises:
        InvalidValueError: A setting is not supported, or the device lacks memory.
    """

    def __init__(self, count: int, settings: EnvSettings, device: str = "cpu", precision: str | None = None):
        self.count, self.settings, self.device = count, settings, open_device(device)
        check_settings(settings)
        self.precision = precision or ("float32" if self.device.is_cuda else "float64")
        self.real = real = PRECISIONS[require_choice("precision", self.precision, PRECISIONS)]
        self.robot = robot = get_robot(settings.robot)
        self.sampler = EpisodeSampler(settings.bank, settings.split, robot, settings.difficulty, settings.start)
        timing = control_timing(settings.rate)
        self.action_rule = make_action(str(settings.action), robot, timing.interval)
        self.observe = make_observation(str(settings.observation), robot, TomatoReach(settings.success_radius))
        self.structs = structs(real)
        names = self.sampler.bank.names(settings.split)
        first = compile_scene(self.sampler.bank.scene(names[0]), robot)
        self.part_names = [first.model.geom(int(geom)).name for geom in colliding_parts(first.model)]
        self.arm_arrays = arm_arrays(first, self.action_rule, timing)
        sizes = self._sizes(self.arm_arrays, timing.substeps)
        self._check_memory(sizes, len(names))
        moves_tip = isinstance(self.action_rule, TipVelocity)
        unrolled = _GPU_UNROLLED if self.device.is_cuda else _CPU_UNROLLED
        self._lanes, part_threads = _LANES[self.device.is_cuda]
        self._drive = drive_kernel(real, len(robot.joints), timing.substeps, moves_tip, unrolled)
        self._collide, self._observe = collide_kernel(real, self._lanes, part_threads), observe_kernel(real)
        load_kernels((self._drive, self._collide, self._observe), self.device)
        self.arm = struct_of(self.structs.Arm, self.arm_arrays, self.device)
        self.bank = device_bank(self.sampler, settings.physics, reach_of(self.arm_arrays), self.device.alias, real)
        self.state = self._allocate(self.structs.State, sizes)
        self.out = self._allocate(Output, sizes)
        self.rules = _rules(settings, self.observe)
        self.layout = layout_of(self.observe)
        space: Any = self.observe.space["observation"] if self.observe.has_goals else self.observe.space  # type: ignore[index]
        self.low, self.high = (wp.array(side, dtype=wp.float32, device=self.device) for side in (space.low, space.high))
        self.action = wp.zeros((count, self.action_rule.space.shape[0]), dtype=wp.float32, device=self.device)
        own, start = self.bank.arrays.start, self.sampler.draw(np.random.default_rng(0)).start
        starts = own if np.array_equal(start, robot.start) else np.broadcast_to(start, own.shape)
        self.starts = wp.array(starts, dtype=real, device=self.device)
        self.state.start.fill_(np.nan)
        for array in (self.state.ended, self.state.wanted):
            array.fill_(1 if array is self.state.ended else -1)
        self.set_draws()

    def set_draws(self) -> None:
        """Adopt the difficulties of the sampler from the next episodes on."""
        scene, target, bank = self.settings.scene, self.settings.target, self.bank
        if scene is None:
            table = draw_table(bank.scenes, self.sampler, bank.arrays.tomato_first)
        else:
            index = bank.index_of(scene, self.settings.split)
            first = bank.arrays.tomato_first[index : index + 1]
            table = draw_table([bank.scenes[index]], self.sampler, first)
            if target is not None:
                episode = self.sampler.draw(np.random.default_rng(), {"scene": bank.scenes[index], "target": target})
                table = DrawTable.of([1.0], [[int(first[0]) + episode.targets[0]]])
        self.draws = struct_of(self.structs.Draws, table, self.device)

    def launch(self, resets_only: bool = False, stream: Any = None) -> None:
        """Advance all simulations by their actions and begin episodes where the last ended, or only the latter."""
        for kernel, dim, arguments in self.launches(int(resets_only)):
            wp.launch(kernel, dim, arguments, device=self.device, stream=stream, block_dim=BLOCK_SIZE)

    def launches(self, resets_only: int) -> Iterator[tuple[Any, tuple[int, ...], list[Any]]]:
        """Yield kernels with their dimensions and arguments, in their order."""
        n, arm, bank, s = self.count, self.arm, self.bank, self.state
        yield self._drive, (n,), [arm, bank.placements, self.draws, s, self.action, self.starts, resets_only]
        yield self._collide, (n, self._lanes), [arm, bank.placements, bank.shapes, bank.cells, s]
        yield self._observe, (n,), [
            arm, bank.placements, bank.fields, s, self.rules, self.layout, self.low, self.high, resets_only, self.out
        ]  # fmt: skip

    def contact_names(self, part: int, counterpart: int, scene: int) -> tuple[str, str]:
        """Return the names of the geoms of a contact, the arm's first; empty without a contact."""
        if part < 0:
            return "", ""
        if counterpart == FLOOR:
            return self.part_names[part], "floor"
        if counterpart >= MAX_SHAPES:
            return self.part_names[part], self.part_names[counterpart - MAX_SHAPES]
        index = counterpart - int(self.bank.arrays.fixtures[scene])
        if index < 0:
            return self.part_names[part], "cart"
        known = self.bank.scenes[scene]
        shapes = known if self.settings.physics == "reconstruction" else known.truth
        assert shapes is not None
        for name, parts in (("tomato", shapes.tomatoes), ("stem", shapes.stems), ("clutter", shapes.clutter)):
            if index < len(parts):
                kind = f"_{shapes.stems[index].kind}" if name == "stem" else ""
                return self.part_names[part], f"{name}_{index}{kind}"
            index -= len(parts)
        raise AssertionError(counterpart)

    def _sizes(self, arm: ArmArrays, substeps: int) -> dict[str, tuple[int, ...]]:
        """Return the shape of one simulation's entry in each array that is no number."""
        joints, parts, probes = len(arm.axis), len(arm.part_link), len(arm.probe_link)
        observed = sum(size for _, size in self.observe.layout)
        return {
            **dict.fromkeys(("joints", "velocities", "command", "start"), (joints,)),
            **dict.fromkeys(("part_start", "part_end"), (substeps, parts)),
            **dict.fromkeys(("travel",), (parts,)),
            "probe": (probes,), "observation": (observed,), "achieved": (3,), "desired": (3,), "terms": (len(TERMS),),
            "contact_parts": (2,),
        }  # fmt: skip

    def _check_memory(self, sizes: Mapping[str, tuple[int, ...]], scenes: int) -> None:
        item = 4 if self.real is wp.float32 else 8
        world = sum(
            (12 * item // 4 if name in ("part_start", "part_end", "probe") else item) * math.prod(size)
            for name, size in sizes.items()
        )
        advice = f"choose fewer simulations than {self.count:,}"
        advice += (
            f", or a split with fewer scenes than {scenes:,}"
            if BYTES_PER_SCENE * scenes > 0.2 * world * self.count
            else ""
        )
        check_memory(self.device, (world + 200) * self.count + BYTES_PER_SCENE * scenes, advice)

    def _allocate(self, kind: Any, sizes: Mapping[str, tuple[int, ...]]) -> Any:
        result = kind()
        for name, variable in kind.vars.items():
            size = sizes["contact_parts"] if kind is Output and name == "contact" else sizes.get(name, ())
            setattr(result, name, wp.zeros((self.count, *size), dtype=variable.type.dtype, device=self.device))
        return result


def check_settings(settings: EnvSettings) -> None:
    """Raise an error for a setting that the kernels do not support.

    Raises:
        InvalidValueError: The message lists what they support.
    """
    if settings.observation not in OBSERVATIONS:
        raise unsupported("observation", settings.observation, " or ".join(OBSERVATIONS))
    if settings.action not in ACTIONS:
        raise unsupported("action", settings.action, ", ".join(ACTIONS))
    if not isinstance(settings.reward, (DenseReward, SparseReward)) and settings.reward not in REWARDS:
        raise unsupported("reward", settings.reward, "dense, sparse, a DenseReward or SparseReward")
    if isinstance(settings.reward, DenseReward) and type(settings.reward) is not DenseReward:
        raise unsupported("reward", settings.reward, "dense, sparse, a DenseReward or SparseReward")
    if settings.task != "reach":
        raise unsupported("task", settings.task, '"reach"')
    if settings.plants != "rigid":
        raise unsupported("plants", settings.plants, '"rigid"')
    if settings.randomization != NO_RANDOMIZATION:
        raise unsupported("randomization", settings.randomization, "none")


def layout_of(observation: ObservationSpec) -> Any:
    """Return the first column of each feature of an observation.

    Raises:
        InvalidValueError: The kernels do not compute a feature.
    """
    result, column = Layout(), 0
    for name in FEATURES:
        setattr(result, name, -1)
    for name, size in observation.layout:
        if name not in FEATURES:
            raise InvalidValueError(f'backend="warp" does not compute the feature {name!r}; choose backend="mujoco"')
        setattr(result, name, column)
        column += size
    return result


def _rules(settings: EnvSettings, observation: ObservationSpec) -> Any:
    result = Rules()
    reward = REWARDS[settings.reward] if isinstance(settings.reward, str) else settings.reward
    result.success_radius, result.step_limit = settings.success_radius, step_limit_of(settings)
    for term in TERMS:
        setattr(result, term, getattr(reward, term, 0.0))
    result.target_is_obstacle = int(observation.target_is_obstacle)
    return result
