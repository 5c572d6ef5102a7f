"""The settings of OMPL's planners that grow trees: one dataclass each, with OMPL's names and values.

Those that sample first and search then have theirs in `greenhouse_gym.planning.roadmap_settings`.

Lengths and distances are radians, in the Euclidean norm over the joints. A ``range`` of 0 leaves the choice to OMPL: a
fifth of the space's diagonal, 3.1 rad for six joints with a turn each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

from greenhouse_gym.errors import InvalidValueError


@dataclass(frozen=True)
class PlannerSettings:
    """What can be set of a planner; the planners without settings have this one itself.

    Raises:
        InvalidValueError: A value is of the wrong kind, negative, infinite or, for a share, above 1.
    """

    def __post_init__(self) -> None:
        for field in fields(self):
            value, default = getattr(self, field.name), field.default
            share = field.name.endswith(("_bias", "_fraction"))
            number = isinstance(value, int) if isinstance(default, int) else isinstance(value, int | float)
            if isinstance(default, bool):
                good, expected = isinstance(value, bool), "True or False"
            elif isinstance(value, bool) or not number:
                good, expected = False, "a whole number" if isinstance(default, int) else "a number"
            else:
                good = 0 <= value <= (1 if share else math.inf) and (math.isfinite(value) or default == math.inf)
                expected = "a share from 0 to 1" if share else "a finite number from 0 on"
            if not good:
                raise InvalidValueError(f"{type(self).__name__}.{field.name}: expected {expected}, got {value!r}")

    def changed(self) -> dict[str, Any]:
        """The settings that are not OMPL's own."""
        return {f.name: value for f in fields(self) if (value := getattr(self, f.name)) != f.default}


@dataclass(frozen=True)
class RangeSettings(PlannerSettings):
    """BiEST, SBL."""

    range: float = 0.0  # longest motion by which a tree grows


@dataclass(frozen=True)
class GoalBiasSettings(PlannerSettings):
    """PDST."""

    goal_bias: float = 0.05  # share of the samples that are goals


@dataclass(frozen=True)
class BiasedRangeSettings(RangeSettings, GoalBiasSettings):
    """EST, LazyRRT, ProjEST."""


@dataclass(frozen=True)
class RRTSettings(BiasedRangeSettings):
    """RRT."""

    intermediate_states: bool = False  # keep the states along a motion, too


@dataclass(frozen=True)
class RRTConnectSettings(RangeSettings):
    """RRTConnect."""

    intermediate_states: bool = False  # keep the states along a motion, too


@dataclass(frozen=True)
class BiTRRTSettings(RangeSettings):
    """BiTRRT."""

    cost_threshold: float = math.inf  # states that cost more are refused
    frontier_node_ratio: float = 0.1  # ratio of frontier nodes to other nodes
    frontier_threshold: float = 0.0  # distance from which a node is at the frontier; 0: OMPL's choice
    init_temperature: float = 100.0  # higher lets more costly motions pass
    temp_change_factor: float = 0.1  # factor by which the temperature rises and falls


@dataclass(frozen=True)
class TRRTSettings(BiTRRTSettings, GoalBiasSettings):
    """TRRT."""


@dataclass(frozen=True)
class LowerBoundTreeSettings(BiasedRangeSettings):
    """LBTRRT, LazyLBTRRT."""

    epsilon: float = 0.4  # a path may be longer than the best by this share


@dataclass(frozen=True)
class RewiredTreeSettings(BiasedRangeSettings):
    """What the relatives of RRT* have in common."""

    number_sampling_attempts: int = 100  # to find an informed sample
    rewire_factor: float = 1.1  # multiple of the least number or radius of neighbors
    use_k_nearest: bool = True  # a number of neighbors instead of a radius


@dataclass(frozen=True)
class RRTsharpSettings(RewiredTreeSettings):
    """RRTsharp."""

    informed_sampling: bool = False  # only where the path can still get shorter
    rejection_variant: int = 0  # 0 to 3: how samples are refused
    rejection_variant_alpha: float = 1.0  # weight of the cost in refusing samples
    sample_rejection: bool = False  # refuse samples that cannot help
    update_children: bool = True  # pass improvements on at once


@dataclass(frozen=True)
class RRTXstaticSettings(RRTsharpSettings):
    """RRTXstatic."""

    epsilon: float = 0.0  # improvements smaller than this are not passed on


@dataclass(frozen=True)
class InformedRRTstarSettings(RewiredTreeSettings):
    """InformedRRTstar."""

    delay_collision_checking: bool = True  # check the cheapest parent first
    ordered_sampling: bool = False  # samples in order of what they promise
    ordering_batch_size: int = 1  # samples put in order at once
    prune_threshold: float = 0.05  # improvement from which the tree is pruned


@dataclass(frozen=True)
class SORRTstarSettings(InformedRRTstarSettings):
    """SORRTstar."""

    ordered_sampling: bool = True  # samples in order of what they promise
    ordering_batch_size: int = 100  # samples put in order at once


@dataclass(frozen=True)
class RRTstarSettings(InformedRRTstarSettings):
    """RRTstar."""

    focus_search: bool = False  # informed sampling, pruning and rejection together
    informed_sampling: bool = False  # only where the path can still get shorter
    new_state_rejection: bool = False  # refuse states that cannot help
    pruned_measure: bool = False  # count neighbors by the pruned space
    sample_rejection: bool = False  # refuse samples that cannot help
    tree_pruning: bool = False  # remove what cannot help
    use_admissible_heuristic: bool = True  # prune by a heuristic that never overestimates


@dataclass(frozen=True)
class SSTSettings(GoalBiasSettings):
    """SST."""

    range: float = 5.0  # longest motion by which the tree grows
    pruning_radius: float = 3.0  # one node of the tree in a ball of this radius
    selection_radius: float = 5.0  # the cheapest node within this radius grows


@dataclass(frozen=True)
class KPIECESettings(BiasedRangeSettings):
    """KPIECE1."""

    border_fraction: float = 0.9  # share of the growth that starts at border cells
    failed_expansion_score_factor: float = 0.5  # factor by which a cell's score falls after a failure
    min_valid_path_fraction: float = 0.2  # share of a motion that must be free to be kept in part


@dataclass(frozen=True)
class LBKPIECESettings(RangeSettings):
    """LBKPIECE1."""

    border_fraction: float = 0.9  # share of the growth that starts at border cells
    min_valid_path_fraction: float = 0.5  # share of a motion that must be free to be kept in part


@dataclass(frozen=True)
class BKPIECESettings(LBKPIECESettings):
    """BKPIECE1."""

    failed_expansion_score_factor: float = 0.5  # factor by which a cell's score falls after a failure


@dataclass(frozen=True)
class STRIDESettings(BiasedRangeSettings):
    """STRIDE."""

    degree: int = 16  # children of a node of the neighbor structure
    estimated_dimension: float = 6.0  # dimension of the free space
    max_degree: int = 18  # most children of such a node
    max_pts_per_leaf: int = 6  # most points in a leaf of that structure
    min_degree: int = 12  # fewest children of such a node
    min_valid_path_fraction: float = 0.2  # share of a motion that must be free to be kept in part
    use_projected_distance: bool = False  # distances in a projection


@dataclass(frozen=True)
class ParallelTreeSettings(BiasedRangeSettings):
    """pRRT."""

    thread_count: int = 2  # OMPL's threads; they take turns at checking


@dataclass(frozen=True)
class ParallelSBLSettings(RangeSettings):
    """pSBL."""

    thread_count: int = 2  # OMPL's threads; they take turns at checking


@dataclass(frozen=True)
class CForestSettings(PlannerSettings):
    """CForest."""

    num_threads: int = 2  # OMPL's threads, one RRT* each; they take turns at checking
    focus_search: bool = True  # RRT*'s informed sampling and pruning
