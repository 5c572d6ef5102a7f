"""The planners of OMPL 1.7.0 by name (Sucan, Moll, Kavraki: The Open Motion Planning Library, 2012)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class PlannerInfo:
    """A planner.

    Attributes:
        name: OMPL's name.
        description: What it does, in a line.
        optimizing: Whether it goes on improving its path until the time or the checks are used up.
        step: Longest motion by which a tree grows, radians; None keeps OMPL's own (a fifth of the space's diagonal,
            3.1 rad for six joints with a turn each). Set where that made planning in dense rows cheaper by far:
            RRTConnect, for one, then needs 40 % of the checks.
    """

    name: str
    description: str
    optimizing: bool = False
    step: float | None = None


def _table(*planners: PlannerInfo) -> Mapping[str, PlannerInfo]:
    return MappingProxyType({planner.name: planner for planner in planners})


PLANNERS: Mapping[str, PlannerInfo] = _table(
    PlannerInfo("ABITstar", "advanced batch informed trees: truncated, inflated search over batches", True),
    PlannerInfo("AITstar", "adaptively informed trees: a lazy reverse search guides the forward one", True),
    PlannerInfo("BFMT", "bidirectional fast marching trees over a fixed set of samples"),
    PlannerInfo("BITstar", "batch informed trees: an ordered search over growing batches of samples", True),
    PlannerInfo("BKPIECE1", "bidirectional KPIECE"),
    PlannerInfo("BiEST", "bidirectional expansive space trees"),
    PlannerInfo("EITstar", "effort informed trees: guided by estimates of cost and of the effort of checking", True),
    PlannerInfo("EST", "expansive space trees: grows where samples are sparse"),
    PlannerInfo("FMT", "fast marching tree over a fixed set of samples"),
    PlannerInfo("InformedRRTstar", "RRT* that samples only where the path can still get shorter", True),
    PlannerInfo("KPIECE1", "kinodynamic planning by interior-exterior cell exploration, one level of cells"),
    PlannerInfo("LBKPIECE1", "lazy bidirectional KPIECE", step=0.8),
    PlannerInfo("LBTRRT", "lower bound tree RRT: near-optimal within a given factor", True),
    PlannerInfo("LazyLBTRRT", "lower bound tree RRT with lazy collision checks (its paths are often not free)", True),
    PlannerInfo("LazyPRM", "probabilistic roadmap with lazy collision checks"),
    PlannerInfo("LazyPRMstar", "PRM* with lazy collision checks", True),
    PlannerInfo("LazyRRT", "RRT with lazy collision checks"),
    PlannerInfo("PDST", "path-directed subdivision tree"),
    PlannerInfo("PRM", "probabilistic roadmap"),
    PlannerInfo("PRMstar", "asymptotically optimal probabilistic roadmap", True),
    PlannerInfo("ProjEST", "expansive space trees on a projection of the space"),
    PlannerInfo("RRT", "rapidly exploring random tree"),
    PlannerInfo("RRTConnect", "two rapidly exploring random trees that grow towards each other", step=0.8),
    PlannerInfo("RRTXstatic", "RRT* with a cascade of rewirings that keeps the tree consistent", True),
    PlannerInfo("RRTsharp", "RRT# : RRT* that keeps every promising vertex consistent", True),
    PlannerInfo("RRTstar", "asymptotically optimal rapidly exploring random tree", True),
    PlannerInfo("SBL", "single-query bidirectional roadmap with lazy collision checks", step=0.8),
    PlannerInfo("SORRTstar", "informed RRT* that takes its samples in order", True),
    PlannerInfo("SPARS", "sparse roadmap spanner (OMPL 1.7.0 crashes)", True),
    PlannerInfo("SPARStwo", "sparse roadmap spanner without the dense roadmap (OMPL 1.7.0 crashes)", True),
    PlannerInfo("SST", "stable sparse RRT", True),
    PlannerInfo("STRIDE", "search tree with resolution-independent density estimation"),
    PlannerInfo("STRRTstar", "space-time RRT*: needs a state space with time, so it fails here", True),
    PlannerInfo("TRRT", "transition-based RRT: prefers cheap regions"),
)
"""All geometric planners of OMPL 1.7.0, sorted by name."""
