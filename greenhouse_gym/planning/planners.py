"""Planners by name: those of the installed OMPL, those of this package, and any that are registered.

OMPL is that of Sucan, Moll, Kavraki: The Open Motion Planning Library, 2012.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib.util import find_spec
from typing import Any

from greenhouse_gym.errors import InvalidValueError, UnknownNameError, require_choice
from greenhouse_gym.planning import planner_settings as settings
from greenhouse_gym.planning import roadmap_settings as roadmaps
from greenhouse_gym.planning.planner_settings import PlannerSettings
from greenhouse_gym.planning.registered import Solve
from greenhouse_gym.planning.shortcut_connect import ShortcutConnectSettings, shortcut_connect
from greenhouse_gym.planning.worker import shared_worker


@dataclass(frozen=True)
class PlannerInfo:
    """A planner.

    Attributes:
        name: OMPL's name, or the one it was registered by.
        description: What it does, in a line.
        settings: The settings used unless others are given: OMPL's own but for the range of some, where a shorter one
            made planning in dense rows cheaper by far; RRTConnect, for one, then needs 40 % of the checks.
        optimizing: Whether it goes on improving its path until the time or the checks are used up.
        single_goal: Whether it gets one of the goals instead of all, the one from which the straight way back to the
            start is free the longest: it works on several threads, of which only one may ask Python for a goal.
        reproducible: Whether the same seed and number of checks give the same path. Threads take turns as they like,
            LazyPRMstar checks so little that the time and not the checks end its search, and LBTRRT reads the lower
            bound of the start's cost from memory that OMPL 1.7.0 never writes.
        solve: The planner itself; None for OMPL's.
    """

    name: str
    description: str
    settings: PlannerSettings = field(default_factory=PlannerSettings)
    optimizing: bool = False
    single_goal: bool = False
    reproducible: bool = True
    solve: Solve | None = None

    def with_settings(self, **values: Any) -> PlannerSettings:
        """The planner's settings with some of them changed.

        Raises:
            UnknownNameError: The planner has no such setting; the message lists those it has.
            InvalidValueError: A value that makes no sense.
        """
        known = vars(self.settings)
        for name in values:
            require_choice(f"setting of {self.name}", name, known)
        return type(self.settings)(**{**known, **values})


_RANGE = 0.8  # radians

_KNOWN = (
    PlannerInfo("ABITstar", "advanced batch informed trees: truncated, inflated search over batches",
                roadmaps.ABITstarSettings(), optimizing=True),
    PlannerInfo("AITstar", "adaptively informed trees: a lazy reverse search guides the forward one",
                roadmaps.AITstarSettings(), optimizing=True),
    PlannerInfo("AORRTC", "asymptotically optimal RRTConnect", settings.RangeSettings(), optimizing=True),
    PlannerInfo("BFMT", "bidirectional fast marching trees over a fixed set of samples", roadmaps.BFMTSettings()),
    PlannerInfo("BITstar", "batch informed trees: an ordered search over growing batches of samples",
                roadmaps.BITstarSettings(), optimizing=True),
    PlannerInfo("BKPIECE1", "bidirectional KPIECE", settings.BKPIECESettings()),
    PlannerInfo("BiEST", "bidirectional expansive space trees", settings.RangeSettings()),
    PlannerInfo("BiTRRT", "bidirectional transition-based RRT: prefers cheap regions",
                settings.BiTRRTSettings(range=_RANGE)),
    PlannerInfo("CForest", "several RRT* side by side that share their best paths", settings.CForestSettings(),
                optimizing=True, single_goal=True, reproducible=False),
    PlannerInfo("EITstar", "effort informed trees: guided by estimates of cost and of the effort of checking",
                roadmaps.EITstarSettings(), optimizing=True),
    PlannerInfo("EST", "expansive space trees: grows where samples are sparse", settings.BiasedRangeSettings()),
    PlannerInfo("FMT", "fast marching tree over a fixed set of samples", roadmaps.FMTSettings()),
    PlannerInfo("InformedRRTstar", "RRT* that samples only where the path can still get shorter",
                settings.InformedRRTstarSettings(), optimizing=True),
    PlannerInfo("KPIECE1", "kinodynamic planning by interior-exterior cell exploration, one level of cells",
                settings.KPIECESettings()),
    PlannerInfo("LBKPIECE1", "lazy bidirectional KPIECE", settings.LBKPIECESettings(range=_RANGE)),
    PlannerInfo("LBTRRT", "lower bound tree RRT: near-optimal within a given factor", settings.LowerBoundTreeSettings(),
                optimizing=True, reproducible=False),
    PlannerInfo("LazyLBTRRT", "lower bound tree RRT with lazy collision checks (its paths are often not free)",
                settings.LowerBoundTreeSettings(), optimizing=True),
    PlannerInfo("LazyPRM", "probabilistic roadmap with lazy collision checks", roadmaps.LazyPRMSettings()),
    PlannerInfo("LazyPRMstar", "PRM* with lazy collision checks", optimizing=True, reproducible=False),
    PlannerInfo("LazyRRT", "RRT with lazy collision checks", settings.BiasedRangeSettings()),
    PlannerInfo("PDST", "path-directed subdivision tree", settings.GoalBiasSettings()),
    PlannerInfo("PRM", "probabilistic roadmap", roadmaps.RoadmapSettings(), single_goal=True, reproducible=False),
    PlannerInfo("PRMstar", "asymptotically optimal probabilistic roadmap",
                optimizing=True, single_goal=True, reproducible=False),
    PlannerInfo("ProjEST", "expansive space trees on a projection of the space", settings.BiasedRangeSettings()),
    PlannerInfo("RRT", "rapidly exploring random tree", settings.RRTSettings()),
    PlannerInfo("RRTConnect", "two rapidly exploring random trees that grow towards each other",
                settings.RRTConnectSettings(range=_RANGE)),
    PlannerInfo("RRTXstatic", "RRT* with a cascade of rewirings that keeps the tree consistent",
                settings.RRTXstaticSettings(), optimizing=True),
    PlannerInfo("RRTsharp", "RRT# : RRT* that keeps every promising vertex consistent", settings.RRTsharpSettings(),
                optimizing=True),
    PlannerInfo("RRTstar", "asymptotically optimal rapidly exploring random tree", settings.RRTstarSettings(),
                optimizing=True),
    PlannerInfo("SBL", "single-query bidirectional roadmap with lazy collision checks",
                settings.RangeSettings(range=_RANGE)),
    PlannerInfo("SORRTstar", "informed RRT* that takes its samples in order", settings.SORRTstarSettings(),
                optimizing=True),
    PlannerInfo("SPARS", "sparse roadmap spanner", roadmaps.SPARSSettings(),
                optimizing=True, single_goal=True, reproducible=False),
    PlannerInfo("SPARStwo", "sparse roadmap spanner without the dense roadmap", roadmaps.SPARStwoSettings(),
                optimizing=True, single_goal=True, reproducible=False),
    PlannerInfo("SST", "stable sparse RRT", settings.SSTSettings(), optimizing=True),
    PlannerInfo("STRIDE", "search tree with resolution-independent density estimation", settings.STRIDESettings()),
    PlannerInfo("STRRTstar", "space-time RRT*: needs a state space with time, so it fails here", optimizing=True),
    PlannerInfo("TRRT", "transition-based RRT: prefers cheap regions", settings.TRRTSettings()),
    PlannerInfo("pRRT", "RRT grown by several threads", settings.ParallelTreeSettings(),
                single_goal=True, reproducible=False),
    PlannerInfo("pSBL", "SBL grown by several threads", settings.ParallelSBLSettings(range=_RANGE),
                single_goal=True, reproducible=False),
)  # fmt: skip

PAPER_PLANNERS = (
    "BITstar", "BKPIECE1", "BiTRRT", "CForest", "EST", "FMT", "KPIECE1", "LBKPIECE1", "LBTRRT", "LazyPRM",
    "LazyPRMstar", "LazyRRT", "PDST", "PRM", "PRMstar", "RRT", "RRTConnect", "RRTstar", "SBL", "SPARS", "SPARStwo",
    "STRIDE", "TRRT", "pRRT", "pSBL",
)  # fmt: skip
"""The 25 planners of the paper: those that CoppeliaSim's plugin offers."""


class _Planners(Mapping[str, PlannerInfo]):
    """The planners that are registered and those that the installed OMPL has; asks the planning process when needed."""

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
        if name in self.registered:
            return self.registered[name]
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


_LIMIT = 60.0  # seconds for the planning process to list its planners
_ALL = _Planners()

PLANNERS: Mapping[str, PlannerInfo] = _ALL
"""All geometric planners of the installed OMPL, 38 with OMPL 1.7.0, and all registered ones, sorted by name."""


def register_planner(
    name: str,
    solve: Solve,
    settings: PlannerSettings | None = None,
    description: str = "not described",
    optimizing: bool = False,
    replace: bool = False,
) -> PlannerInfo:
    """Make a planner one of `PLANNERS`: `plan`, the agents, the tables and the command line then know it by its name.

    It runs in the caller's process, within the budget of each query; see `PlanningProblem`. Its path counts only after
    it has been proven free, as those of all planners.

    Args:
        name: Its name.
        solve: Called with a `PlanningProblem` and the settings; returns a path (m, joints) from the problem's start to
            one of its goals, or None. An error it raises makes a plan "crashed".
        settings: Its usual settings, of a frozen dataclass derived from `PlannerSettings`; none when left out.
        description: What it does, in a line.
        optimizing: Whether it goes on improving its path; it is then asked to stop at the first one where the caller of
            `plan` wants that.
        replace: Whether it may take the place of a registered planner of that name.

    Raises:
        InvalidValueError: The name is taken or empty, or ``solve`` cannot be called.
    """
    taken = name in _ALL.registered or any(planner.name == name for planner in _KNOWN)
    if not name or not callable(solve) or (taken and not (replace and name in _ALL.registered)):
        raise InvalidValueError(
            f"planner {name!r}: expected a name that is free and a function, got {solve!r}; taken is {taken}"
        )
    info = PlannerInfo(name, description, settings or PlannerSettings(), optimizing=optimizing, solve=solve)
    _ALL.registered[name] = info
    return info


register_planner(
    "ShortcutConnect",
    shortcut_connect,
    ShortcutConnectSettings(),
    "RRTConnect to the nearest goals, again and again, each path cut short",
    optimizing=True,
)
