"""Values of other types than a public function takes end in the package's own errors."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.agents import HybridAgent, PlannerAgent, RandomAgent, ShieldedAgent, WatchfulAgent, make_agent
from greenhouse_gym.envs import DepthCamera, make_env
from greenhouse_gym.errors import GreenhouseError
from greenhouse_gym.evaluation import compare, evaluate, retrace
from greenhouse_gym.planning import plan
from greenhouse_gym.robots import ROBOTS, get_robot, load_robot
from greenhouse_gym.scene import Scene, SceneBank

ODD: tuple[Any, ...] = (
    True, -1, 1.5, 2**70, float("nan"), 1j, "", "\0", "self", "num_envs", "1" * 5000, b"x", ["a"], {"a": 1}, object(),
    np.zeros((2, 2)), np.array("x"), np.datetime64("2020"), int, len,
)  # fmt: skip
SCENE = SceneBank.open("mini").scene("own-cluster-2000-w00-02")


class Optional(RandomAgent):
    """An agent with options."""

    def __init__(self, env_options: dict[Any, Any]):
        super().__init__()
        self.env_options = env_options


NAMES: dict[str, Callable[[Any], object]] = {
    "bank": SceneBank.open,
    "agent": make_agent,
    "robot": get_robot,
    "file of an arm": load_robot,
    "scene": Scene.load,
    "start": lambda odd: load_robot(ROBOTS["ur5e"], start=odd),
    "velocity limits": lambda odd: load_robot(ROBOTS["ur5e"], velocity_limits=odd),
    "split": lambda odd: make_env(bank="mini", split=odd),
    "difficulty": lambda odd: make_env(bank="mini", difficulty=odd),
    "start of episodes": lambda odd: make_env(bank="mini", start=odd),
    "episodes": lambda odd: evaluate(RandomAgent(), episodes=odd, bank="mini"),
    "problems": lambda odd: evaluate(RandomAgent(), problems=odd, bank="mini"),
    "executor": lambda odd: evaluate(RandomAgent(), executor=odd, bank="mini"),
    "journal": lambda odd: evaluate(RandomAgent(), journal=odd, bank="mini"),
    "progress": lambda odd: evaluate(RandomAgent(), episodes=1, progress=odd, bank="mini", step_limit=1),
    "agents": lambda odd: compare(odd, bank="mini", episodes=1),
    "planner": lambda odd: plan(SCENE, 0, "ur5e", planner=odd, max_checks=1),
    "start of a plan": lambda odd: plan(SCENE, 0, "ur5e", start=odd, max_checks=1),
    "goals of a plan": lambda odd: plan(SCENE, 0, "ur5e", goals=odd, max_checks=1),
    "collision pairs": lambda odd: plan(SCENE, 0, "ur5e", pairs=odd, max_checks=1),
    "checks of a plan": lambda odd: plan(SCENE, 0, "ur5e", max_checks=odd, time_limit=-1),
    "settings of a planner": lambda odd: plan(SCENE, 0, "ur5e", settings=odd, max_checks=1),
    "unknown space": lambda odd: plan(SCENE, 0, "ur5e", unknown=odd, max_checks=0),
    "unexplained surfaces": lambda odd: plan(SCENE, 0, "ur5e", unexplained=odd, max_checks=0),
    "first solution": lambda odd: plan(SCENE, 0, "ur5e", first_solution=odd, max_checks=1),
    "settings of a planning agent": lambda odd: PlannerAgent(settings=odd, unexplained=odd, fallback=odd),
    "depth of a watchful agent": lambda odd: WatchfulAgent(depth=odd),
    "image of a watchful agent": lambda odd: WatchfulAgent(image=odd),
    "noise of a watchful agent": lambda odd: WatchfulAgent(noisy=odd),
    "agent behind a shield": ShieldedAgent,
    "agent that rehearses": lambda odd: HybridAgent(odd, RandomAgent()),
    "width of a camera": lambda odd: DepthCamera(width=odd),
    "field of view": lambda odd: DepthCamera(field_of_view=odd),
    "agent's options": lambda odd: evaluate(Optional({odd: 1}), bank="mini") if isinstance(odd, Hashable) else None,
    "seeds": lambda odd: retrace(RandomAgent(), odd, bank="mini"),
}


@pytest.mark.parametrize("parameter", NAMES)
def test_odd_values_end_in_own_errors(parameter: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for odd in ODD:
        with suppress(GreenhouseError):
            NAMES[parameter](odd)
