"""OMPL's planners: those with Python bindings, and four that the wheel contains but does not bind.

The library of the 1.7.0 wheel exports the C++ constructors and methods of BiTRRT, CForest, pRRT and pSBL. They are
called there through `ctypes`, on the problem that the bindings made. Three of them check from threads of their own;
they are called without the interpreter's lock, and the state checks of OMPL 1.7.0 take it, so the threads take turns.

This depends on that one binary: the names of its functions (the C++ ABI of GCC), the place of the C++ object in a
Boost.Python object, and a problem definition that begins with its virtual table and its space information.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from greenhouse_gym.planning.parameters import Parameter, Value

_NEVER_SET = ("LBTRRT", "LazyLBTRRT")  # the best cost that these report is uninitialized memory

_RANGE = ("8setRangeEd", Parameter(0.0, 0.0, 10_000.0))
_THREADS = ("14setThreadCountEj", Parameter(2, 1, 64))

_SETTERS: dict[str, dict[str, tuple[str, Parameter]]] = {
    "BiTRRT": {
        "range": _RANGE,
        "cost_threshold": ("16setCostThresholdEd", Parameter(float("inf"))),
        "frontier_node_ratio": ("20setFrontierNodeRatioEd", Parameter(0.1)),
        "frontier_threshold": ("20setFrontierThresholdEd", Parameter(0.0)),
        "init_temperature": ("18setInitTemperatureEd", Parameter(100.0)),
        "temp_change_factor": ("19setTempChangeFactorEd", Parameter(0.1, 0.0, 1.0)),
    },
    "CForest": {
        "num_threads": ("13setNumThreadsEj", Parameter(2, 1, 64)),
        "focus_search": ("14setFocusSearchEb", Parameter(True)),
    },
    "pRRT": {"range": _RANGE, "goal_bias": ("11setGoalBiasEd", Parameter(0.05, 0.0, 1.0)), "thread_count": _THREADS},
    "pSBL": {"range": _RANGE, "thread_count": _THREADS},
}

_TYPES = {bool: ctypes.c_bool, int: ctypes.c_uint, float: ctypes.c_double}

UNBOUND = {name: {key: parameter for key, (_, parameter) in setters.items()} for name, setters in _SETTERS.items()}
"""The planners of this module, each with its parameters."""

THREADED = ("CForest", "pRRT", "pSBL")
"""Those that check from threads of their own."""

JOINING = {"BiTRRT": 0.08}
"""Fineness (radians) for a planner that joins its trees only over more than ten times that distance."""

_SIZE = 1 << 16  # bytes, far more than any of these objects needs
_INSTANCE = 40  # offset of the pointer to the holder in a Boost.Python object
_CONTENT = 16  # offset of the content of a holder: the object itself, or the shared pointer to it
_INFORMATION = 8  # offset of the shared pointer to the space information in a problem definition
_POINTER = ctypes.c_void_p


@dataclass(frozen=True)
class Ompl:
    """Modules and planners of the installed OMPL.

    Attributes:
        base: Its module ``base``.
        geometric: Its module ``geometric``.
        util: Its module ``util``.
        library: File of its C++ library if that is 1.7.0's, else None.
        version: 1 or 2.
    """

    base: ModuleType
    geometric: ModuleType
    util: ModuleType
    library: Path | None
    version: int


class BoundPlanner:
    """A planner with Python bindings."""

    def __init__(self, ompl: Ompl, name: str, information: Any, definition: Any, settings: Mapping[str, Value]):
        self._ompl, self.name = ompl, name
        self._planner = getattr(ompl.geometric, name)(information)
        self._planner.setProblemDefinition(definition)
        for key, value in settings.items():
            if not self._set(key, value):
                raise ValueError(f"OMPL refuses {key} = {value!r}")
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
        """Search until solved or the time is up; planners with one thread also stop when ``exhausted`` returns True."""
        if self._ompl.version == 1:
            self._termination = self._ompl.base.timedPlannerTerminationCondition(seconds)
            self._planner.solve(self._termination)
        elif self.name in ("PRM", "PRMstar"):
            self._planner.solve(seconds)  # a second thread waits for the limit and must not call Python
        else:
            self._planner.solve(self._ompl.base.PlannerTerminationCondition(exhausted))

    def stop(self) -> None:
        """End the running search; called from a collision check."""
        if self._termination is not None:
            self._termination.terminate()

    def best_cost(self) -> Callable[[], str] | None:
        """Return a function that reports the cost of the best path so far as text; None if the planner has none."""
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


class UnboundPlanner:
    """A planner without Python bindings, with the methods of `BoundPlanner`.

    Args:
        library: OMPL's library.
        timed: Returns OMPL's termination condition for a number of seconds.
        name: One of `UNBOUND`.
        definition: OMPL's problem definition.
        settings: Valid values of its parameters.
    """

    def __init__(
        self, library: Path, timed: Callable[[float], Any], name: str, definition: Any, settings: Mapping[str, Value]
    ):
        self._built = False
        self._name, self._timed = name, timed
        self._locked, self._unlocked = ctypes.PyDLL(str(library)), ctypes.CDLL(str(library))
        self._memory = ctypes.create_string_buffer(_SIZE)
        self._address = ctypes.addressof(self._memory)
        self._termination: Any = None
        shared_definition = _content(definition)
        information = ctypes.c_size_t.from_address(shared_definition).value + _INFORMATION
        self._method("C1ERKSt10shared_ptrINS_4base16SpaceInformationEE", _POINTER)(information)
        self._built = True
        function = self._locked._ZN4ompl4base7Planner20setProblemDefinitionERKSt10shared_ptrINS0_17ProblemDefinitionEE
        function.argtypes, function.restype = [_POINTER, _POINTER], None
        function(self._address, shared_definition)
        for key, value in settings.items():
            symbol, parameter = _SETTERS[name][key]
            self._method(symbol, _TYPES[type(parameter.default)])(value)
        self._method("5setupEv")()

    def _method(self, symbol: str, *types: Any, const: bool = False, unlocked: bool = False) -> Callable[..., Any]:
        """Return a method of the planner, given the end of its symbol."""
        prefix = f"_ZN{'K' * const}4ompl9geometric{len(self._name)}{self._name}"
        function = getattr(self._unlocked if unlocked else self._locked, prefix + symbol)
        function.argtypes, function.restype = [_POINTER, *types], ctypes.c_int
        return lambda *arguments: function(self._address, *arguments)

    def solve(self, seconds: float, exhausted: Callable[[], bool]) -> None:
        """Search until solved or the time is up."""
        self._termination = self._timed(seconds)
        solve = self._method(
            "5solveERKNS_4base27PlannerTerminationConditionE", _POINTER, unlocked=self._name in THREADED
        )
        solve(_content(self._termination))

    def stop(self) -> None:
        """End the running search; called from a collision check."""
        if self._termination is not None:
            self._termination.terminate()

    def best_cost(self) -> None:
        """Return None: these planners do not report the cost of their best path."""

    def read_data(self, data: Any) -> None:
        """Fill OMPL's planner data."""
        self._method("14getPlannerDataERNS_4base11PlannerDataE", _POINTER, const=True)(_content(data))

    def __del__(self) -> None:
        if self._built:
            self._method("D1Ev")()


Planner = BoundPlanner | UnboundPlanner


def _content(instance: Any) -> int:
    """Return the address of the content of a Boost.Python object."""
    return ctypes.c_size_t.from_address(id(instance) + _INSTANCE).value + _CONTENT
