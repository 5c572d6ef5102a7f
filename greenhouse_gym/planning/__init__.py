"""Motion planning: goal configurations, OMPL's planners on the simulator's own collision model, commands in time."""

from greenhouse_gym.planning.certify import certify_target, certify_targets
from greenhouse_gym.planning.collision import CollisionChecker, planning_model
from greenhouse_gym.planning.goals import Goals, GoalStatistics, goal_configurations
from greenhouse_gym.planning.path import follow_path, path_length, resample
from greenhouse_gym.planning.planners import PLANNERS, PlannerInfo
from greenhouse_gym.planning.query import PlanResult, plan

__all__ = [
    "PLANNERS",
    "CollisionChecker",
    "GoalStatistics",
    "Goals",
    "PlanResult",
    "PlannerInfo",
    "certify_target",
    "certify_targets",
    "follow_path",
    "goal_configurations",
    "path_length",
    "plan",
    "planning_model",
    "resample",
]
