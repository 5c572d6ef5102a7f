"""The settings of OMPL's planners that sample first and search then: roadmaps, FMT*, BIT* and their relatives.

There is one dataclass each, with OMPL's names and values; lengths are as in
`greenhouse_gym.planning.planner_settings`.
"""

from __future__ import annotations

from dataclasses import dataclass

from greenhouse_gym.planning.planner_settings import PlannerSettings, RangeSettings


@dataclass(frozen=True)
class RoadmapSettings(PlannerSettings):
    """PRM."""

    max_nearest_neighbors: int = 0  # nodes that a node is joined to; 0: OMPL's choice


@dataclass(frozen=True)
class LazyPRMSettings(RoadmapSettings, RangeSettings):
    """LazyPRM."""


@dataclass(frozen=True)
class SPARSSettings(PlannerSettings):
    """SPARS."""

    dense_delta_fraction: float = 0.001  # distance of interfaces, as a share of the space
    max_failures: int = 1000  # failures in a row after which the roadmap counts as complete
    sparse_delta_fraction: float = 0.25  # distance that a guard sees, as a share of the space
    stretch_factor: float = 3.0  # factor by which paths may be longer than in the dense roadmap


@dataclass(frozen=True)
class SPARStwoSettings(SPARSSettings):
    """SPARStwo."""

    max_failures: int = 5000  # failures in a row after which the roadmap counts as complete


@dataclass(frozen=True)
class FMTSettings(PlannerSettings):
    """FMT."""

    cache_cc: bool = True  # remember collision checks
    extended_fmt: bool = True  # more samples where the first do not do
    heuristics: bool = False  # prefer what is near the goal
    num_samples: int = 1000  # samples in the first batch
    radius_multiplier: float = 1.1  # multiple of the least radius of neighbors
    use_k_nearest: bool = True  # a number of neighbors instead of a radius


@dataclass(frozen=True)
class BFMTSettings(PlannerSettings):
    """BFMT."""

    balanced: bool = False  # the smaller tree grows
    cache_cc: bool = True  # remember collision checks
    extended_fmt: bool = True  # more samples where the first do not do; OMPL 1.7.0 dies of that in a run out of ten
    heuristics: bool = True  # prefer what is near the other tree
    nearest_k: bool = True  # a number of neighbors instead of a radius
    num_samples: int = 1000  # samples in the first batch
    optimality: bool = True  # end at the best meeting of the trees, not at the first
    radius_multiplier: float = 1.0  # multiple of the least radius of neighbors


@dataclass(frozen=True)
class BatchSettings(PlannerSettings):
    """What the planners that search batches of samples have in common."""

    rewire_factor: float = 1.1  # multiple of the least number or radius of neighbors
    use_graph_pruning: bool = True  # remove what cannot help
    use_k_nearest: bool = True  # a number of neighbors instead of a radius


@dataclass(frozen=True)
class BITstarSettings(BatchSettings):
    """BITstar."""

    delay_rewiring_to_first_solution: bool = False  # improve the tree only once there is a path
    drop_unconnected_samples_on_prune: bool = False  # forget samples without a connection when pruning
    find_approximate_solutions: bool = False  # ends near a goal count, too
    prune_threshold_as_fractional_cost_change: float = 0.05  # improvement from which samples are pruned
    samples_per_batch: int = 100  # samples drawn at once
    stop_on_each_solution_improvement: bool = False  # return from the search at each better path
    use_just_in_time_sampling: bool = False  # samples only where the search gets
    use_strict_queue_ordering: bool = True  # keep the queue exact


@dataclass(frozen=True)
class ABITstarSettings(BITstarSettings):
    """ABITstar."""

    inflation_scaling_parameter: float = 10.0  # how fast the inflation falls
    initial_inflation_factor: float = 1_000_000.0  # factor of the heuristic at first
    truncation_scaling_parameter: float = 5.0  # how fast the truncation falls


@dataclass(frozen=True)
class AITstarSettings(BatchSettings):
    """AITstar."""

    rewire_factor: float = 1.0  # multiple of the least number or radius of neighbors
    find_approximate_solutions: bool = True  # ends near a goal count, too
    samples_per_batch: int = 100  # samples drawn at once
    set_max_num_goals: int = 10  # goals looked at


@dataclass(frozen=True)
class EITstarSettings(BatchSettings):
    """EITstar."""

    rewire_factor: float = 1.001  # multiple of the least number or radius of neighbors
    batch_size: int = 100  # samples drawn at once
    find_approximate_solutions: bool = True  # ends near a goal count, too
    set_max_num_goals: int = 1  # goals looked at
