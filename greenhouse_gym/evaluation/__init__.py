"""Evaluation of agents: episode runner, records, comparison and leaderboard."""

from greenhouse_gym.evaluation.deadline import AgentError
from greenhouse_gym.evaluation.records import Evaluation, Evaluations, Record, comparison_table, wilson_interval
from greenhouse_gym.evaluation.rollouts import Trace, compare, evaluate, retrace
from greenhouse_gym.motion.clearance import CLEARANCE_RANGE

__all__ = [
    "CLEARANCE_RANGE",
    "AgentError",
    "Evaluation",
    "Evaluations",
    "Record",
    "Trace",
    "compare",
    "comparison_table",
    "evaluate",
    "retrace",
    "wilson_interval",
]
