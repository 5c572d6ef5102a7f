"""The planners that OMPL's Python wheel carries in its library, but does not bind: BiTRRT, CForest, pRRT and pSBL.

The library of the 1.7.0 wheel exports their C++ constructors and methods, so they are called there, through `ctypes`,
on the problem that the bindings made. Three of them check from threads of their own. They are called with the
interpreter's lock released; the state checks of OMPL 1.7.0 take it, so the threads take turns at checking.

What this relies on is fixed by that one binary: names of functions (the C++ ABI of GCC), where a Boost.Python object
holds its C++ object, and that a problem definition begins with its virtual table and its space information.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import Any

_SETTERS: dict[str, dict[str, tuple[str, Any]]] = {
    "BiTRRT": {
        "range": ("8setRangeEd", ctypes.c_double),
        "cost_threshold": ("16setCostThresholdEd", ctypes.c_double),
        "frontier_node_ratio": ("20setFrontierNodeRatioEd", ctypes.c_double),
        "frontier_threshold": ("20setFrontierThresholdEd", ctypes.c_double),
        "init_temperature": ("18setInitTemperatureEd", ctypes.c_double),
        "temp_change_factor": ("19setTempChangeFactorEd", ctypes.c_double),
    },
    "CForest": {
        "num_threads": ("13setNumThreadsEj", ctypes.c_uint),
        "focus_search": ("14setFocusSearchEb", ctypes.c_bool),
    },
    "pRRT": {
        "range": ("8setRangeEd", ctypes.c_double),
        "goal_bias": ("11setGoalBiasEd", ctypes.c_double),
        "thread_count": ("14setThreadCountEj", ctypes.c_uint),
    },
    "pSBL": {
        "range": ("8setRangeEd", ctypes.c_double),
        "thread_count": ("14setThreadCountEj", ctypes.c_uint),
    },
}

UNBOUND = tuple(_SETTERS)
"""Names of the planners that are called here."""

THREADED = ("CForest", "pRRT", "pSBL")
"""The ones of them that check from threads of their own."""

JOINING = {"BiTRRT": 0.08}
"""Fineness (radians) to give a planner that joins its trees only over ten times that, whatever is free beyond."""

_SIZE = 1 << 16  # bytes, far more than any of these objects takes
_INSTANCE = 40  # offset of the pointer to the holder in a Boost.Python object
_HELD = 16  # offset of what a holder holds: the object itself, or the shared pointer to it
_INFORMATION = 8  # offset of the shared pointer to the space information in a problem definition
_POINTER = ctypes.c_void_p


class UnboundPlanner:
    """A planner without Python bindings; the same methods as `BoundPlanner`.

    Args:
        library: OMPL's library.
        timed: Makes OMPL's termination condition for a number of seconds.
        name: One of `UNBOUND`.
        definition: OMPL's problem definition.
        settings: Its settings, by OMPL's names.

    Raises:
        ValueError: The planner does not know a setting.
    """

    def __init__(
        self, library: Path, timed: Callable[[float], Any], name: str, definition: Any, settings: dict[str, Any]
    ):
        self._built = False
        self._name, self._timed = name, timed
        self._locked, self._unlocked = ctypes.PyDLL(str(library)), ctypes.CDLL(str(library))
        self._memory = ctypes.create_string_buffer(_SIZE)
        self._address = ctypes.addressof(self._memory)
        self._termination: Any = None
        shared_definition = _held(definition)
        information = ctypes.c_size_t.from_address(shared_definition).value + _INFORMATION
        self._method("C1ERKSt10shared_ptrINS_4base16SpaceInformationEE", _POINTER)(information)
        self._built = True
        function = self._locked._ZN4ompl4base7Planner20setProblemDefinitionERKSt10shared_ptrINS0_17ProblemDefinitionEE
        function.argtypes, function.restype = [_POINTER, _POINTER], None
        function(self._address, shared_definition)
        for key, value in settings.items():
            if key not in _SETTERS[name]:
                raise ValueError(f"this OMPL does not take {key} = {value!r}")
            symbol, kind = _SETTERS[name][key]
            self._method(symbol, kind)(value)
        self._method("5setupEv")()

    def _method(self, symbol: str, *types: Any, const: bool = False, unlocked: bool = False) -> Callable[..., Any]:
        """A method of the planner by the rest of its symbol."""
        prefix = f"_ZN{'K' * const}4ompl9geometric{len(self._name)}{self._name}"
        function = getattr(self._unlocked if unlocked else self._locked, prefix + symbol)
        function.argtypes, function.restype = [_POINTER, *types], ctypes.c_int
        return lambda *arguments: function(self._address, *arguments)

    def solve(self, seconds: float, exhausted: Callable[[], bool]) -> None:
        """Search until solved, or for so many seconds."""
        self._termination = self._timed(seconds)
        solve = self._method(
            "5solveERKNS_4base27PlannerTerminationConditionE", _POINTER, unlocked=self._name in THREADED
        )
        solve(_held(self._termination))

    def stop(self) -> None:
        """End a search that is under way; called from within a collision check."""
        if self._termination is not None:
            self._termination.terminate()

    def best_cost(self) -> None:
        """None, since these planners do not tell it."""

    def read_data(self, data: Any) -> None:
        """Fill OMPL's planner data."""
        self._method("14getPlannerDataERNS_4base11PlannerDataE", _POINTER, const=True)(_held(data))

    def __del__(self) -> None:
        if self._built:
            self._method("D1Ev")()


def _held(instance: Any) -> int:
    """Address of what a Boost.Python object holds."""
    return ctypes.c_size_t.from_address(id(instance) + _INSTANCE).value + _HELD
