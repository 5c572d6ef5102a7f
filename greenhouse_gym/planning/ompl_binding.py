"""OMPL as the planning process sees it: everything in which its versions differ is here.

Version 1 binds its classes with Boost.Python, version 2 with nanobind. This is the one module that imports OMPL, and
only the planning process imports this module. What one has to know of the two:

* The wheel of 1.7.0 carries libompl twice and loads both, after which the interpreter dies at exit.
* A space, a space information or a goal made in Python is called back by C++ whenever it needs a distance or a sample,
  without the interpreter's lock. A planner that works on two threads (PRM, SPARS) crashes or hangs on that. So
  problems are made of objects that C++ made: the space is taken out of a larger one, `SimpleSetup` makes the rest,
  and planners with threads get a single goal, for which `ProblemDefinition` makes its own object.
* Limits of time are OMPL's own, for the same reason; a limit of checks ends them from the collision check.
"""

from __future__ import annotations

import ctypes
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.planning.ompl_unbound import UNBOUND, UnboundPlanner

_NEVER_SET = ("LBTRRT", "LazyLBTRRT")  # the best cost that these tell is memory nobody wrote to
_NEVER_COUNTED = ("EITstar",)  # collecting its graph takes several times as long as a search of some seconds

IsFree = Callable[[Array | list[float]], bool]
"""Tells whether a configuration is free."""

FreeShare = Callable[[Array, Array, bool], float]
"""The share of a motion up to which it is free; the flag says whether anything but 1 may be given as 0."""


@dataclass(frozen=True)
class Ompl:
    """The installed OMPL.

    Attributes:
        base: Its module ``base``.
        geometric: Its module ``geometric``.
        util: Its module ``util``.
        library: The file of its C++ library where that is 1.7.0's, else None.
        version: 1 or 2.
    """

    base: ModuleType
    geometric: ModuleType
    util: ModuleType
    library: Path | None
    version: int


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
    """Names of the geometric planners of the installed OMPL, those without Python bindings among them."""
    members = inspect.getmembers(ompl.geometric, inspect.isclass)
    bound = [name for name, kind in members if issubclass(kind, ompl.base.Planner)]
    return tuple(sorted([*bound, *(UNBOUND if ompl.library else ())]))


def planner_parameters(ompl: Ompl, name: str) -> dict[str, str] | None:
    """A planner's parameters with OMPL's values as text; None where they cannot be read."""
    if ompl.version == 2 or name in UNBOUND:
        return None
    one = np.ones(3)
    problem = OmplProblem(ompl, -one, one, 0 * one, one[None], lambda _: True, lambda *_: 1.0, 0.1)
    names = ompl.util.vectorString()
    try:
        planner = getattr(ompl.geometric, name)(problem.information)  # its parameters read from it while they are asked
        parameters = planner.params()
    except RuntimeError:
        return None
    parameters.getParamNames(names)
    return {key: parameters.getParam(key).getValue() for key in names}


def set_seed(ompl: Ompl, seed: int) -> None:
    """Seed OMPL's random numbers; call it before anything else is made."""
    ompl.util.RNG.setSeed(seed % (2**31) + 1)  # 0 is not allowed


class OmplProblem:
    """A problem as OMPL's objects.

    Args:
        ompl: The installed OMPL.
        lower: (joints,) lower limits, radians.
        upper: (joints,) upper limits, radians.
        start: (joints,) start, radians.
        goals: (k, joints) goals, radians; several cannot be had with ``threads``.
        is_free: Called with each configuration to check.
        free_share: Called with each motion to check.
        fineness: Joint distance at which states along a motion are checked by planners that do that on their own, rad.
        threads: Whether the planner checks from threads of its own: OMPL then checks motions state by state.
    """

    def __init__(
        self, ompl: Ompl, lower: Array, upper: Array, start: Array, goals: Array, is_free: IsFree,
        free_share: FreeShare, fineness: float, threads: bool = False,
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
        # what OMPL calls must not know this object, or C++ and Python would keep each other alive
        self._callbacks = _set_checks(ompl, self.information, joints, is_free, free_share, threads)
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

    def planner(self, name: str, settings: dict[str, Any]) -> Planner:
        """Make a planner for this problem.

        Raises:
            ValueError: The installed OMPL does not know the setting, or refuses its value.
        """
        if name in UNBOUND:
            assert self._ompl.library is not None
            timed = self._ompl.base.timedPlannerTerminationCondition
            return UnboundPlanner(self._ompl.library, timed, name, self.definition, settings)
        return BoundPlanner(self._ompl, name, self, settings)

    def take_solution(self) -> Array | None:
        """The configurations (k, joints) of the exact solution, or None; OMPL then forgets it.

        CForest dies if its paths outlive it.
        """
        path = None
        if self.definition.hasExactSolution():
            path = _configurations(self.definition.getSolutionPath(), self._joints)
        self.definition.clearSolutionPaths()
        return path

    def tree_size(self, planner: Planner) -> int:
        """Number of nodes in a planner's trees or roadmap; 0 where counting them takes longer than searching."""
        if isinstance(planner, BoundPlanner) and planner.name in _NEVER_COUNTED:
            return 0
        data = self._ompl.base.PlannerData(self.information)
        planner.read_data(data)
        return int(data.numVertices())

    def shortened(self, configurations: Array) -> Array:
        """A path (k, joints) made shorter."""
        geometric = self._ompl.geometric
        path = geometric.PathGeometric(self.information)
        for configuration in configurations:
            state = self._state(configuration)  # must live until it is copied
            path.append(state() if self._ompl.version == 1 else state)
        simplifier = geometric.PathSimplifier(self.information)
        simplifier.reduceVertices(path)
        simplifier.partialShortcutPath(path)
        simplifier.reduceVertices(path)
        simplifier.collapseCloseVertices(path)
        return _configurations(path, self._joints)


class BoundPlanner:
    """A planner with Python bindings."""

    def __init__(self, ompl: Ompl, name: str, problem: OmplProblem, settings: dict[str, Any]):
        self._ompl, self.name = ompl, name
        self._planner = getattr(ompl.geometric, name)(problem.information)
        self._planner.setProblemDefinition(problem.definition)
        for key, value in settings.items():
            if not self._set(key, value):
                raise ValueError(f"this OMPL does not take {key} = {value!r}")
        self._planner.setup()
        self._termination: Any = None

    def _set(self, key: str, value: Any) -> bool:
        if self._ompl.version == 1:
            return bool(self._planner.params().setParam(key, str(int(value) if isinstance(value, bool) else value)))
        setter = getattr(self._planner, "set" + "".join(word.capitalize() for word in key.split("_")), None)
        if setter is None:
            return False
        setter(value)
        return True

    def solve(self, seconds: float, exhausted: Callable[[], bool]) -> None:
        """Search until solved, or for so many seconds; also until exhausted, where the planner runs on one thread."""
        if self._ompl.version == 1:
            self._termination = self._ompl.base.timedPlannerTerminationCondition(seconds)
            self._planner.solve(self._termination)
        elif self.name in ("PRM", "PRMstar"):
            self._planner.solve(seconds)  # a second thread waits for the limit: it must not ask Python
        else:
            self._planner.solve(self._ompl.base.PlannerTerminationCondition(exhausted))

    def stop(self) -> None:
        """End a search that is under way; called from within a collision check."""
        if self._termination is not None:
            self._termination.terminate()

    def best_cost(self) -> Callable[[], str] | None:
        """What gives the cost of the best path so far as text; None where the planner does not tell."""
        if self._ompl.version == 2 or self.name in _NEVER_SET:
            return None
        properties = self._planner.getPlannerProgressProperties()
        for key in ("best cost REAL", "best cost DOUBLE"):
            if properties.has_key(key):
                found: Callable[[], str] = properties[key]
                return found
        return None

    def read_data(self, data: Any) -> None:
        """Fill OMPL's planner data."""
        self._planner.getPlannerData(data)


def _set(state: Any, configuration: Array) -> None:
    for j, angle in enumerate(configuration.tolist()):
        state[j] = angle


def _configurations(path: Any, joints: int) -> Array:
    return np.array([[state[j] for j in range(joints)] for state in path.getStates()])


Planner = BoundPlanner | UnboundPlanner


def _space(ompl: Ompl, joints: int) -> Any:
    if ompl.version == 2:
        return ompl.base.RealVectorStateSpace(joints)
    space = ompl.base.SE3StateSpace().getSubspace(0)  # three coordinates, made by C++
    for _ in range(joints - 3):
        space.addDimension()
    return space


def _set_checks(
    ompl: Ompl, information: Any, joints: int, is_free: IsFree, free_share: FreeShare, threads: bool
) -> Sequence[Any]:
    """Have OMPL call Python for states and motions; the callbacks must be kept alive by the caller."""
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
        """Whole motions per call from C++, checked exactly as the finished path will be."""

        def checkMotion(self, first: Any, second: Any, last_valid: Any = None) -> bool:  # noqa: N802
            a = np.array([first[j] for j in range(joints)])
            b = np.array([second[j] for j in range(joints)])
            share = free_share(a, b, last_valid is None)
            if share < 1.0 and last_valid is not None:
                # the state that receives the last free configuration may be the motion's end itself
                last_valid.second = share
                if last_valid.first is not None:
                    _set(last_valid.first, a + share * (b - a))
            return share == 1.0

    motions = Motions(information)
    information.setMotionValidator(motions)
    return state_check, motions
