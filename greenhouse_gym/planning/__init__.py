"""Motion planning: goal configurations, planners on the simulator's own collision model, commands in time."""

from greenhouse_gym.motion.clearance import path_clearance
from greenhouse_gym.motion.collision import COLLISION_PAIRS, CollisionChecker, planning_model
from greenhouse_gym.motion.goals import Goals, GoalStatistics, goal_configurations
from greenhouse_gym.motion.inverse_kinematics import Approach
from greenhouse_gym.motion.path import follow_path, path_length, resample
from greenhouse_gym.planning.certify import certify_target, certify_targets
from greenhouse_gym.planning.composed_bank import ComposedBank
from greenhouse_gym.planning.own_planners import OutOfBudget, PlanningProblem
from greenhouse_gym.planning.parameters import Parameter
from greenhouse_gym.planning.planners import PAPER_PLANNERS, PLANNERS, PlannerInfo, register_planner
from greenhouse_gym.planning.query import free_commands, plan
from greenhouse_gym.planning.result import PlanResult

__all__ = [
    "COLLISION_PAIRS",
    "PAPER_PLANNERS",
    "PLANNERS",
    "Approach",
    "CollisionChecker",
    "ComposedBank",
    "GoalStatistics",
    "Goals",
    "OutOfBudget",
    "Parameter",
    "PlanResult",
    "PlannerInfo",
    "PlanningProblem",
    "certify_target",
    "certify_targets",
    "follow_path",
    "free_commands",
    "goal_configurations",
    "path_clearance",
    "path_length",
    "plan",
    "planning_model",
    "register_planner",
    "resample",
]
