"""Play the same episodes on both backends."""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

import numpy as np

from greenhouse_gym.envs import GreenhouseVectorEnv
from greenhouse_gym.envs.contacts import NAME_SEPARATOR
from greenhouse_gym.envs.features import feature_slices
from greenhouse_gym.envs.warp.environment import WarpVectorEnv
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import SceneBank


class Comparison(NamedTuple):
    """Outcomes of the same episodes on two backends.

    Attributes:
        outcomes: Number of episodes by their outcomes in MuJoCo and in Warp.
        different: Episode, step, both outcomes and the contact in MuJoCo, where they differ.
        deviation: Largest deviation by feature, while both go on.
        reward: Largest deviation of a reward.
        contacts: Collisions whose names agree, and all.
    """

    outcomes: Counter[tuple[str, str]]
    different: list[tuple[int, int, str, str, Any]]
    deviation: dict[str, float]
    reward: float
    contacts: tuple[int, int]


def compare(count: int, steps: int, seed: int = 0, precision: str | None = None, **settings: Any) -> Comparison:
    """Play ``count`` episodes with random, slow and purposeful actions on both backends."""
    settings = {"bank": "mini", "split": "train", "robot": "ur5e", "action": "joint"} | settings
    rng = np.random.default_rng(seed)
    bank = SceneBank.open(settings["bank"])
    names = bank.names(settings["split"])
    robot = get_robot(settings["robot"])
    options: list[dict[str, Any]] = []
    goals = []
    for _ in range(count):
        name = names[int(rng.integers(len(names)))]
        targets = [t for t in bank.scene(name).targets if t.robot == robot.name] or list(bank.scene(name).targets)
        reachable = [t for t in targets if t.witness] or targets
        target = reachable[int(rng.integers(len(reachable)))]
        options.append({"scene": name, "target": target.tomato})
        mine = target.witness is not None and target.robot == robot.name
        goals.append(np.array(target.witness[-1]) if mine else rng.uniform(robot.lower, robot.upper) * 0.7)
    mujoco = GreenhouseVectorEnv(count, threads=1, **settings)
    warp = WarpVectorEnv(count, precision=precision, **settings)
    ours, theirs = warp.reset(options=options)[0], mujoco.reset(options=options)[0]
    layout = feature_slices(mujoco.simulation.observe.layout)
    size = mujoco.single_action_space.shape[0]
    alive, hold, kind = np.ones(count, dtype=bool), rng.uniform(-1, 1, (count, size)), np.arange(count) % 3
    outcomes: Counter[tuple[str, str]] = Counter()
    different, deviation, reward_deviation, agree, collisions = [], dict.fromkeys(layout, 0.0), 0.0, 0, 0

    def record(rows: Any) -> None:
        for name, columns in layout.items():
            a, b = (o["observation"] if isinstance(o, dict) else o for o in (ours, theirs))
            if rows.any():
                deviation[name] = max(deviation[name], float(np.abs(a[rows][:, columns] - b[rows][:, columns]).max()))

    record(alive)
    for step in range(steps):
        action = rng.uniform(-1, 1, (count, size))
        renew = rng.random(count) < 0.1
        hold[renew] = rng.uniform(-1, 1, (int(renew.sum()), size))
        action[kind == 1] = hold[kind == 1]
        if size == len(robot.joints):
            action[kind == 2] = np.clip((np.array(goals) - mujoco.simulation.command)[kind == 2] / 0.08, -1, 1)
        action = action.astype(np.float32)
        theirs, r, terminated, tr, info = mujoco.step(action)
        ours, r2, te2, tr2, info2 = warp.step(action)
        going = alive & ~(terminated | tr | te2 | tr2)
        record(going)
        if going.any():
            reward_deviation = max(reward_deviation, float(np.abs(r - r2)[going].max()))
        for i in np.flatnonzero(alive & ~going):
            results = (
                _outcome(terminated[i], tr[i], info["is_success"][i]),
                _outcome(te2[i], tr2[i], info2["is_success"][i]),
            )
            outcomes[results] += 1
            if results[0] != results[1]:
                different.append((int(i), step, *results, info["contact"][i] or warp.contact_names(i)))
            elif results[0] == "collision":
                agree, collisions = (
                    agree + (info["contact"][i] == NAME_SEPARATOR.join(warp.contact_names(i))),
                    collisions + 1,
                )
            alive[i] = False
    mujoco.close()
    return Comparison(outcomes, different, deviation, reward_deviation, (agree, collisions))


def _outcome(terminated: bool, truncated: bool, success: bool) -> str:
    return "success" if success else "collision" if terminated else "truncated" if truncated else "goes on"
