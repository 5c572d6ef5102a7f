"""Your own planner: back out of a goal step by step until the path to the start is free.

python examples/own_planner.py
"""

import numpy as np

from greenhouse_gym.planning import PlannerSettings, PlanningProblem, plan, register_planner
from greenhouse_gym.scene import SceneBank


def retreat(problem: PlanningProblem, settings: PlannerSettings) -> np.ndarray | None:
    """Return start, goal, and between them a configuration that blends the first joints of both."""
    for goal in problem.goals:
        for part in (0.0, 0.25, 0.5, 0.75):
            via = np.where(np.arange(len(goal)) < len(goal) // 2, part * problem.start + (1 - part) * goal, goal)
            if problem.is_free(via) and problem.path_is_free([problem.start, via, goal]):
                return np.stack([problem.start, via, goal])
    return None


if __name__ == "__main__":
    register_planner("retreat", retreat, description="backs out of a goal")
    scene = SceneBank.open("mini")[0]
    print([plan(scene, target, planner="retreat", max_checks=20_000).status for target in range(8)])
