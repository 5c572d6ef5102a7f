"""The planners by name: those of the installed OMPL and those written in Python.

OMPL: Sucan, Moll, Kavraki: The Open Motion Planning Library, 2012.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib.util import find_spec
from types import MappingProxyType
from typing import Any

import numpy as np

from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.planning.own_planners import Solve
from greenhouse_gym.planning.parameters import Parameter, Value, require_valid
from greenhouse_gym.planning.shortcut_connect import ShortcutConnectSettings, shortcut_connect
from greenhouse_gym.planning.worker import shared_worker

_LIMIT = 60.0  # seconds for the planning process to answer
_SHORT_RANGE: Mapping[str, Value] = MappingProxyType({"range": 0.8})  # radians


@dataclass(frozen=True)
class PlannerInfo:
    """Name, origin and properties of a planner.

    BiTRRT, CForest, pRRT and pSBL have no Python bindings in OMPL 1.7.0. They are called by their C++ symbols and by
    the memory layout of that one wheel. With any other build they may crash, which ends the planning process, not the
    caller: the plan then has the status "crashed".

    Attributes:
        name: OMPL's name, or the one the planner was registered by.
        description: The method in one line.
        settings: Parameters that are set by default. For OMPL's planners all others keep OMPL's values; only the range
            of some is changed: in dense rows RRTConnect then needs 40 % of the checks.
        optimizing: True if the planner improves its path until the time or the checks are used up.
        single_goal: True if the planner gets one goal instead of all: it has several threads, and only one may ask
            Python for a goal. It gets the goal from which the straight motion to the start is free for longest.
        reproducible: True if the same seed and number of checks give the same path. Not so for planners with threads;
            for LazyPRMstar, whose search is ended by the time because it checks so little; and for LBTRRT, which in
            OMPL 1.7.0 reads its first bound of the cost from uninitialized memory.
        solve: The planner if it is written in Python; None for OMPL's planners.
    """

    name: str
    description: str
    settings: Mapping[str, Value] = field(default_factory=dict)
    optimizing: bool = False
    single_goal: bool = False
    reproducible: bool = True
    solve: Solve | None = None

    @cached_property
    def parameters(self) -> Mapping[str, Parameter]:
        """Parameters by name; for OMPL's planners as the installed OMPL names and limits them."""
        if self.solve is not None:
            return {name: Parameter(value) for name, value in self.settings.items()}
        parameters: dict[str, Parameter] = shared_worker().call("parameters", self.name, _LIMIT)
        return parameters

    def with_settings(self, values: Mapping[str, Value]) -> dict[str, Value]:
        """Return the default settings with some values changed or added.

        Raises:
            UnknownNameError: The planner has no such parameter; the message lists those it has.
            InvalidValueError: A value is of the wrong type or outside its range.
        """
        if not isinstance(values, Mapping):
            raise InvalidValueError(f"{self.name}: settings must map names to values, got {values!r}")
        values = {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}
        if values:
            require_valid(self.name, values, self.parameters)
        return {**self.settings, **values}


_COMPILED = PlannerInfo("RRTConnect", "two rapidly exploring random trees that grow towards each other", _SHORT_RANGE)

_KNOWN = (
    PlannerInfo("ABITstar", "advanced batch informed trees: truncated, inflated search over batches", optimizing=True),
    PlannerInfo("AITstar", "adaptively informed trees: a lazy reverse search guides the forward one", optimizing=True),
    PlannerInfo("AORRTC", "asymptotically optimal RRTConnect", optimizing=True),
    PlannerInfo("BFMT", "bidirectional fast marching trees over a fixed set of samples; one run in ten crashes unless "
                "extended_fmt=False (OMPL 1.7.0)"),
    PlannerInfo("BITstar", "batch informed trees: an ordered search over growing batches of samples", optimizing=True),
    PlannerInfo("BKPIECE1", "bidirectional KPIECE"),
    PlannerInfo("BiEST", "bidirectional expansive space trees"),
    PlannerInfo("BiTRRT", "bidirectional transition-based RRT: prefers cheap regions", _SHORT_RANGE),
    PlannerInfo("CForest", "several RRT* in parallel that share their best paths",
                optimizing=True, single_goal=True, reproducible=False),
    PlannerInfo("EITstar", "effort informed trees: guided by estimates of cost and of the effort of checking",
                optimizing=True),
    PlannerInfo("EST", "expansive space trees: grows where samples are sparse"),
    PlannerInfo("FMT", "fast marching tree over a fixed set of samples"),
    PlannerInfo("InformedRRTstar", "RRT* that samples only where the path can still get shorter", optimizing=True),
    PlannerInfo("KPIECE1", "kinodynamic planning by interior-exterior cell exploration, one level of cells"),
    PlannerInfo("LBKPIECE1", "lazy bidirectional KPIECE", _SHORT_RANGE),
    PlannerInfo("LBTRRT", "lower bound tree RRT: near-optimal within a given factor",
                optimizing=True, reproducible=False),
    PlannerInfo("LazyLBTRRT", "lower bound tree RRT with lazy collision checks; its paths are often not free",
                optimizing=True),
    PlannerInfo("LazyPRM", "probabilistic roadmap with lazy collision checks"),
    PlannerInfo("LazyPRMstar", "PRM* with lazy collision checks", optimizing=True, reproducible=False),
    PlannerInfo("LazyRRT", "RRT with lazy collision checks"),
    PlannerInfo("PDST", "path-directed subdivision tree"),
    PlannerInfo("PRM", "probabilistic roadmap", single_goal=True, reproducible=False),
    PlannerInfo("PRMstar", "asymptotically optimal probabilistic roadmap",
                optimizing=True, single_goal=True, reproducible=False),
    PlannerInfo("ProjEST", "expansive space trees on a projection of the space"),
    PlannerInfo("RRT", "rapidly exploring random tree"),
    _COMPILED,
    PlannerInfo("RRTXstatic", "RRT* with a cascade of rewirings that keeps the tree consistent", optimizing=True),
    PlannerInfo("RRTsharp", "RRT# : RRT* that keeps every promising vertex consistent", optimizing=True),
    PlannerInfo("RRTstar", "asymptotically optimal rapidly exploring random tree", optimizing=True),
    PlannerInfo("SBL", "single-query bidirectional roadmap with lazy collision checks", _SHORT_RANGE),
    PlannerInfo("SORRTstar", "informed RRT* that takes its samples in order", optimizing=True),
    PlannerInfo("SPARS", "sparse roadmap spanner", optimizing=True, single_goal=True, reproducible=False),
    PlannerInfo("SPARStwo", "sparse roadmap spanner without the dense roadmap",
                optimizing=True, single_goal=True, reproducible=False),
    PlannerInfo("SST", "stable sparse RRT", optimizing=True),
    PlannerInfo("STRIDE", "search tree with resolution-independent density estimation"),
    PlannerInfo("TRRT", "transition-based RRT: prefers cheap regions"),
    PlannerInfo("pRRT", "RRT grown by several threads", single_goal=True, reproducible=False),
    PlannerInfo("pSBL", "SBL grown by several threads", _SHORT_RANGE, single_goal=True, reproducible=False),
)  # fmt: skip

PAPER_PLANNERS = (
    "BITstar", "BKPIECE1", "BiTRRT", "CForest", "EST", "FMT", "KPIECE1", "LBKPIECE1", "LBTRRT", "LazyPRM",
    "LazyPRMstar", "LazyRRT", "PDST", "PRM", "PRMstar", "RRT", "RRTConnect", "RRTstar", "SBL", "SPARS", "SPARStwo",
    "STRIDE", "TRRT", "pRRT", "pSBL",
)  # fmt: skip
"""The 25 planners of the paper, which are those of CoppeliaSim's plugin."""


class _Planners(Mapping[str, PlannerInfo]):
    """Registered planners and those of the installed OMPL, which the planning process lists on first use."""

    def __init__(self) -> None:
        self.registered: dict[str, PlannerInfo] = {}

    @cached_property
    def _of_ompl(self) -> dict[str, PlannerInfo]:
        known = {planner.name: planner for planner in _KNOWN}
        names: tuple[str, ...] = shared_worker().call("planners", None, _LIMIT)
        return {name: known.get(name, PlannerInfo(name, "not described")) for name in names}

    @property
    def _all(self) -> dict[str, PlannerInfo]:
        of_ompl = {} if find_spec("ompl") is None else self._of_ompl
        return dict(sorted({**of_ompl, **self.registered}.items()))

    def __getitem__(self, name: str) -> PlannerInfo:
        if not isinstance(name, str):
            raise UnknownNameError("planner", name, PAPER_PLANNERS)
        if name in self.registered:
            return self.registered[name]
        if name == _COMPILED.name and find_spec("ompl") is not None:
            return _COMPILED  # needs no planning process
        try:
            return self._of_ompl[name]
        except KeyError:
            raise UnknownNameError("planner", name, self._all) from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._all)

    def __len__(self) -> int:
        return len(self._all)

    def __repr__(self) -> str:
        return f"PLANNERS({', '.join(self)})"


_ALL = _Planners()

PLANNERS: Mapping[str, PlannerInfo] = _ALL
"""All planners by name: the 37 geometric ones of OMPL 1.7.0 (fewer with other versions), and those registered.

Four of OMPL's, BiTRRT, CForest, pRRT and pSBL, are called without Python bindings and may crash with another build of
OMPL 1.7.0; see `PlannerInfo`. STRRTstar is left out: it needs a state space with time."""


def register_planner(
    name: str,
    solve: Solve,
    settings: Any = None,
    description: str = "not described",
    optimizing: bool = False,
    replace: bool = False,
) -> PlannerInfo:
    """Add a planner written in Python to `PLANNERS`, for `plan`, the agents, the tables and the command line.

    It runs in the caller's process within the budget of each query; see `PlanningProblem`. Like that of any planner,
    its path counts only after it has been proven free.

    Args:
        name: Its name.
        solve: Called with a `PlanningProblem` and the settings; returns a path (m, joints) from the problem's start to
            one of its goals, or None. An error that it raises gives a plan the status "crashed".
        settings: Its default settings, an instance of a dataclass of numbers and truth values; None for no settings.
        description: The method in one line.
        optimizing: True if it improves its path; `PlanningProblem.first_solution` then says when it should not.
        replace: Whether it may replace a registered planner of that name.

    Raises:
        InvalidValueError: The name is taken or empty, or ``solve`` cannot be called.
    """
    taken = name in _ALL.registered or any(planner.name == name for planner in _KNOWN)
    if not name or not callable(solve) or (taken and not (replace and name in _ALL.registered)):
        raise InvalidValueError(
            f"planner {name!r}: expected a name that is not taken and a function, got {solve!r}; taken is {taken}"
        )

    def with_values(problem: Any, values: Mapping[str, Value]) -> Any:
        return solve(problem, None if settings is None else type(settings)(**values))

    values = MappingProxyType({} if settings is None else vars(settings))
    info = PlannerInfo(name, description, values, optimizing=optimizing, solve=with_values)
    _ALL.registered[name] = info
    return info


register_planner(
    "ShortcutConnect",
    shortcut_connect,
    ShortcutConnectSettings(),
    "RRTConnect to the nearest goals, repeated, with each path cut short",
    optimizing=True,
)
