"""OMPL as the planning process uses it; all differences between its versions are in this module.

Version 1 binds its classes with Boost.Python, version 2 with nanobind. This is the only module that imports OMPL, and
only the planning process imports this module. Known traps:

* The wheel of 1.7.0 contains libompl twice and loads both; the interpreter then crashes at exit.
* C++ calls a space, a space information or a goal made in Python back for every distance or sample, without the
  interpreter's lock. A planner with two threads (PRM, SPARS) crashes or hangs on that. So problems consist of objects
  made by C++: the space is taken out of a larger one, `SimpleSetup` makes the rest, and planners with threads get a
  single goal, for which `ProblemDefinition` makes its own object.
* Time limits are OMPL's own for the same reason; a limit of checks ends the search from the collision check.
* Parameters accept almost any text ("-1" as a whole number, "foo" as True): values are checked by the caller.
"""

from __future__ import annotations

import ctypes
import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.planning.ompl_planners import UNBOUND, BoundPlanner, Ompl, Planner, UnboundPlanner
from greenhouse_gym.planning.parameters import Parameter, Value, ompl_parameter

_NOT_LISTED = ("STRRTstar",)  # needs a state space with time, so it always fails
_NEVER_COUNTED = ("EITstar",)  # collecting its graph takes several times as long as a search of some seconds

IsFree = Callable[[Array | list[float]], bool]
"""Return whether a configuration is free."""

FreeFraction = Callable[[Array, Array, bool], float]
"""Return the fraction of a motion up to which it is free; with the flag, 0 stands for any fraction below 1."""


def import_ompl() -> Ompl:
    """Import OMPL with one copy of its library, and silence it."""
    spec = find_spec("ompl")
    assert spec is not None
    assert spec.origin is not None
    vendored = sorted((Path(spec.origin).parents[1] / "ompl.libs").glob("libompl-*.so.1.7.0"))
    original = ctypes.CDLL

    def load(name: Any, *args: Any, **kwargs: Any) -> ctypes.CDLL:
        if vendored and name is not None and "libompl" in Path(name).name:
            name = str(vendored[0])
        return original(name, *args, **kwargs)

    ctypes.CDLL = load  # type: ignore[assignment,misc]
    try:
        from ompl import base, geometric, util
    finally:
        ctypes.CDLL = original  # type: ignore[misc]
    if hasattr(util, "noOutputHandler"):
        util.noOutputHandler()
    util.setLogLevel(util.LOG_NONE)
    version = 1 if hasattr(base, "StateValidityCheckerFn") else 2
    return Ompl(base, geometric, util, vendored[0] if vendored and version == 1 else None, version)


def planner_names(ompl: Ompl) -> tuple[str, ...]:
    """Return the names of the geometric planners of the installed OMPL, including those without Python bindings."""
    members = inspect.getmembers(ompl.geometric, inspect.isclass)
    bound = [name for name, kind in members if issubclass(kind, ompl.base.Planner) and name not in _NOT_LISTED]
    return tuple(sorted([*bound, *(UNBOUND if ompl.library else ())]))


def planner_parameters(ompl: Ompl, name: str) -> dict[str, Parameter]:
    """Return a planner's parameters; OMPL 2 reports their names only."""
    if name in UNBOUND:
        return UNBOUND[name]
    kind = getattr(ompl.geometric, name)
    if ompl.version == 2:
        setters = [method[3:] for method in set(dir(kind)) - set(dir(ompl.base.Planner)) if method.startswith("set")]
        return {re.sub("(?<!^)(?=[A-Z])", "_", setter).lower(): Parameter(None) for setter in sorted(setters)}
    one = np.ones(6)
    problem = OmplProblem(ompl, -one, one, 0 * one, one[None], lambda _: True, lambda *_: 1.0, 0.1)
    planner = kind(problem.information)  # the parameters belong to it
    parameters, names = planner.params(), ompl.util.vectorString()
    parameters.getParamNames(names)
    found = {key: parameters.getParam(key) for key in names}
    return {key: ompl_parameter(value.getValue(), value.getRangeSuggestion()) for key, value in found.items()}


def set_seed(ompl: Ompl, seed: int) -> None:
    """Seed OMPL's random numbers; call this before any of its objects is made."""
    ompl.util.RNG.setSeed(int(seed) % (2**31) + 1)  # 0 is not allowed


class OmplProblem:
    """A planning problem made of OMPL's objects.

    Args:
        ompl: The installed OMPL.
        lower: (joints,) lower limits, radians.
        upper: (joints,) upper limits, radians.
        start: (joints,) start, radians.
        goals: (k, joints) goals, radians; only one with ``threads``.
        is_free: Called with each configuration to check.
        free_fraction: Called with each motion to check.
        fineness: Joint distance between the states that planners check on their own along a motion, rad.
        threads: True if the planner checks from threads of its own; OMPL then checks motions state by state.
    """

    def __init__(
        self, ompl: Ompl, lower: Array, upper: Array, start: Array, goals: Array, is_free: IsFree,
        free_fraction: FreeFraction, fineness: float, threads: bool = False,
    ):  # fmt: skip
        base, joints = ompl.base, len(start)
        bounds = base.RealVectorBounds(joints)
        for j in range(joints):
            bounds.setLow(j, float(lower[j]))
            bounds.setHigh(j, float(upper[j]))
        self._ompl, self._joints = ompl, joints
        self.space = _space(ompl, joints)
        self.space.setBounds(bounds)
        self._setup = ompl.geometric.SimpleSetup(self.space)
        self.information = self._setup.getSpaceInformation()
        # the callbacks must not refer to this object, or C++ and Python would keep each other alive
        self._callbacks = _set_checks(ompl, self.information, joints, is_free, free_fraction, threads)
        self.information.setStateValidityCheckingResolution(fineness / self.space.getMaximumExtent())
        self.information.setup()
        self.definition = self._setup.getProblemDefinition()
        self.definition.addStartState(self._state(start))
        if len(goals) == 1:
            self.definition.setGoalState(self._state(goals[0]))
        else:
            several, state = base.GoalStates(self.information), self._state(goals[0])
            for goal in goals:
                _set(state, goal)
                several.addState(state)  # a copy
            self.definition.setGoal(several)

    def _state(self, configuration: Array) -> Any:
        state = self._ompl.base.State(self.space) if self._ompl.version == 1 else self.information.allocState()
        _set(state, configuration)
        return state

    def planner(self, name: str, settings: Mapping[str, Value]) -> Planner:
        """Make a planner for this problem.

        Raises:
            ValueError: OMPL refuses a value.
        """
        if name in UNBOUND:
            assert self._ompl.library is not None
            timed = self._ompl.base.timedPlannerTerminationCondition
            return UnboundPlanner(self._ompl.library, timed, name, self.definition, settings)
        return BoundPlanner(self._ompl, name, self.information, self.definition, settings)

    def take_solution(self) -> Array | None:
        """Return the exact solution (k, joints), or None, and clear it: CForest crashes if its paths outlive it."""
        path = None
        if self.definition.hasExactSolution():
            path = _configurations(self.definition.getSolutionPath(), self._joints)
        self.definition.clearSolutionPaths()
        return path

    def tree_size(self, planner: Planner) -> int:
        """Return the number of nodes in a planner's trees or roadmap; 0 if counting takes longer than searching."""
        if isinstance(planner, BoundPlanner) and planner.name in _NEVER_COUNTED:
            return 0
        data = self._ompl.base.PlannerData(self.information)
        planner.read_data(data)
        return int(data.numVertices())

    def shortened(self, configurations: Array) -> Array:
        """Return a shortened path (k, joints)."""
        geometric = self._ompl.geometric
        path = geometric.PathGeometric(self.information)
        for configuration in configurations:
            state = self._state(configuration)  # must live until append has copied it
            path.append(state() if self._ompl.version == 1 else state)
        simplifier = geometric.PathSimplifier(self.information)
        simplifier.reduceVertices(path)
        simplifier.partialShortcutPath(path)
        simplifier.reduceVertices(path)
        simplifier.collapseCloseVertices(path)
        return _configurations(path, self._joints)


def _set(state: Any, configuration: Array) -> None:
    for j, angle in enumerate(configuration.tolist()):
        state[j] = angle


def _configurations(path: Any, joints: int) -> Array:
    return np.array([[state[j] for j in range(joints)] for state in path.getStates()])


def _space(ompl: Ompl, joints: int) -> Any:
    if ompl.version == 2:
        return ompl.base.RealVectorStateSpace(joints)
    space = ompl.base.SE3StateSpace().getSubspace(0)  # three coordinates, made by C++
    for _ in range(joints - 3):
        space.addDimension()
    return space


def _set_checks(
    ompl: Ompl, information: Any, joints: int, is_free: IsFree, free_fraction: FreeFraction, threads: bool
) -> Sequence[Any]:
    """Register Python's checks of states and motions with OMPL; the caller must keep the returned callbacks alive."""
    base = ompl.base
    if ompl.version == 2:

        class States(base.StateValidityChecker):  # type: ignore[misc,name-defined]
            def isValid(self, state: Any) -> bool:  # noqa: N802
                return is_free(state[0:joints])

        states = States(information)
        information.setStateValidityChecker(states)
        return (states,)

    state_check = base.StateValidityCheckerFn(lambda state: is_free([state[j] for j in range(joints)]))
    information.setStateValidityChecker(state_check)
    if threads:
        return (state_check,)

    class Motions(base.MotionValidator):  # type: ignore[misc,name-defined]
        """Motion validator that checks whole motions per call from C++, exactly as the finished path is checked."""

        def checkMotion(self, first: Any, second: Any, last_valid: Any = None) -> bool:  # noqa: N802
            a = np.array([first[j] for j in range(joints)])
            b = np.array([second[j] for j in range(joints)])
            fraction = free_fraction(a, b, last_valid is None)
            if fraction < 1.0 and last_valid is not None:
                # the state that receives the last free configuration may be the motion's end itself
                last_valid.second = fraction
                if last_valid.first is not None:
                    _set(last_valid.first, a + fraction * (b - a))
            return fraction == 1.0

    motions = Motions(information)
    information.setMotionValidator(motions)
    return state_check, motions
