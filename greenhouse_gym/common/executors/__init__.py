"""Executors that spread work over the cores of one machine or of a cluster, with the same results as on one core."""

from greenhouse_gym.common.executors.ray_executor import RayExecutor
from greenhouse_gym.common.executors.spreading import (
    BACKENDS,
    WorkerLostError,
    completed,
    executor_for,
    idle_cores,
    portable,
    processes,
    usable_cores,
    workers_of,
)

__all__ = [
    "BACKENDS",
    "RayExecutor",
    "WorkerLostError",
    "completed",
    "executor_for",
    "idle_cores",
    "portable",
    "processes",
    "usable_cores",
    "workers_of",
]
