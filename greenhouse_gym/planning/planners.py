"""The planners of the installed OMPL by name (Sucan, Moll, Kavraki: The Open Motion Planning Library, 2012)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from greenhouse_gym.errors import UnknownNameError, require_choice
from greenhouse_gym.planning import planner_settings as settings
from greenhouse_gym.planning.planner_settings import PlannerSettings
from greenhouse_gym.planning.worker import shared_worker


@dataclass(frozen=True)
class PlannerInfo:
    """A planner.

    Attributes:
        name: OMPL's name.
        description: What it does, in a line.
        settings: The settings used unless others are given: OMPL's own but for the range of some, where a shorter one
            made planning in dense rows cheaper by far; RRTConnect, for one, then needs 40 % of the checks.
        optimizing: Whether it goes on improving its path until the time or the checks are used up.
        single_goal: Whether it gets one of the goals instead of all, the one from which the straight way back to the
            start is free the longest: it works on several threads, of which only one may ask Python for a goal.
        reproducible: Whether the same seed and number of checks give the same path. Threads take turns as they like,
            and LazyPRMstar checks so little that the time and not the checks end its search.
    """

    name: str
    description: str
    settings: PlannerSettings = field(default_factory=PlannerSettings)
    optimizing: bool = False
    single_goal: bool = False
    reproducible: bool = True

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
                settings.ABITstarSettings(), optimizing=True),
    PlannerInfo("AITstar", "adaptively informed trees: a lazy reverse search guides the forward one",
                settings.AITstarSettings(), optimizing=True),
    PlannerInfo("AORRTC", "asymptotically optimal RRTConnect", settings.RangeSettings(), optimizing=True),
    PlannerInfo("BFMT", "bidirectional fast marching trees over a fixed set of samples", settings.BFMTSettings()),
    PlannerInfo("BITstar", "batch informed trees: an ordered search over growing batches of samples",
                settings.BITstarSettings(), optimizing=True),
    PlannerInfo("BKPIECE1", "bidirectional KPIECE", settings.BKPIECESettings()),
    PlannerInfo("BiEST", "bidirectional expansive space trees", settings.RangeSettings()),
    PlannerInfo("BiTRRT", "bidirectional transition-based RRT: prefers cheap regions",
                settings.BiTRRTSettings(range=_RANGE)),
    PlannerInfo("CForest", "several RRT* side by side that share their best paths", settings.CForestSettings(),
                optimizing=True, single_goal=True, reproducible=False),
    PlannerInfo("EITstar", "effort informed trees: guided by estimates of cost and of the effort of checking",
                settings.EITstarSettings(), optimizing=True),
    PlannerInfo("EST", "expansive space trees: grows where samples are sparse", settings.BiasedRangeSettings()),
    PlannerInfo("FMT", "fast marching tree over a fixed set of samples", settings.FMTSettings()),
    PlannerInfo("InformedRRTstar", "RRT* that samples only where the path can still get shorter",
                settings.InformedRRTstarSettings(), optimizing=True),
    PlannerInfo("KPIECE1", "kinodynamic planning by interior-exterior cell exploration, one level of cells",
                settings.KPIECESettings()),
    PlannerInfo("LBKPIECE1", "lazy bidirectional KPIECE", settings.LBKPIECESettings(range=_RANGE)),
    PlannerInfo("LBTRRT", "lower bound tree RRT: near-optimal within a given factor", settings.LowerBoundTreeSettings(),
                optimizing=True),
    PlannerInfo("LazyLBTRRT", "lower bound tree RRT with lazy collision checks (its paths are often not free)",
                settings.LowerBoundTreeSettings(), optimizing=True),
    PlannerInfo("LazyPRM", "probabilistic roadmap with lazy collision checks", settings.LazyPRMSettings()),
    PlannerInfo("LazyPRMstar", "PRM* with lazy collision checks", optimizing=True, reproducible=False),
    PlannerInfo("LazyRRT", "RRT with lazy collision checks", settings.BiasedRangeSettings()),
    PlannerInfo("PDST", "path-directed subdivision tree", settings.GoalBiasSettings()),
    PlannerInfo("PRM", "probabilistic roadmap", settings.RoadmapSettings(), single_goal=True, reproducible=False),
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
    PlannerInfo("SPARS", "sparse roadmap spanner", settings.SPARSSettings(),
                optimizing=True, single_goal=True, reproducible=False),
    PlannerInfo("SPARStwo", "sparse roadmap spanner without the dense roadmap", settings.SPARStwoSettings(),
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


class _Installed(Mapping[str, PlannerInfo]):
    """The planners that the installed OMPL has; asks the planning process when first used."""

    @cached_property
    def _planners(self) -> dict[str, PlannerInfo]:
        known = {planner.name: planner for planner in _KNOWN}
        names: tuple[str, ...] = shared_worker().call("planners", None, _LIMIT)
        return {name: known.get(name, PlannerInfo(name, "not described")) for name in names}

    def __getitem__(self, name: str) -> PlannerInfo:
        try:
            return self._planners[name]
        except KeyError:
            raise UnknownNameError("planner", name, self._planners) from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._planners)

    def __len__(self) -> int:
        return len(self._planners)

    def __repr__(self) -> str:
        return f"PLANNERS({', '.join(self)})"


_LIMIT = 60.0  # seconds for the planning process to list its planners

PLANNERS: Mapping[str, PlannerInfo] = _Installed()
"""All geometric planners of the installed OMPL, sorted by name: 38 with OMPL 1.7.0."""
