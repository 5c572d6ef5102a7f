"""Imitation of a teacher that knows the scenes, then PPO: what is learned in minutes instead of hours."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from greenhouse_gym.envs import make_vec_env
from greenhouse_gym.learning.imitation import ImitationSettings, follow_waypoint, imitate
from greenhouse_gym.learning.ppo import PpoSettings, train_ppo
from greenhouse_gym.learning.sb3 import make_sb3_vec_env
from greenhouse_gym.learning.variation import varied_bank
from greenhouse_gym.scene import SceneBank

FINE_TUNING = PpoSettings(
    reward="dense", log_std=-2.5, learning_rate=5e-5, critic_rollouts=8, epochs=4,
)  # fmt: skip
"""PPO that goes on from a policy that can do something already: little noise, small steps, the critic first."""


@dataclass(frozen=True)
class BcThenPpoSettings:
    """Settings of a training.

    Attributes:
        variations: Scenes that are made out of the bank's training scenes, beside them.
        imitation: Settings of the first part; with no steps there is none, and PPO goes on from how the network began.
        ppo: Settings of the second part, and of the network; with no steps there is no second part.
        from_rule: Whether the network begins as the rule that follows waypoints, and not with random weights.
    """

    variations: int = 0
    imitation: ImitationSettings = field(default_factory=ImitationSettings)
    ppo: PpoSettings = FINE_TUNING
    from_rule: bool = True


def train_bc_then_ppo(
    settings: BcThenPpoSettings,
    out: str | Path,
    *,
    resume: bool = False,
    tell: Callable[[int, dict[str, float]], None] = lambda steps, figures: None,
    make_env: Callable[..., Any] = make_sb3_vec_env,
) -> Path:
    """Train a policy; ``out`` gets what `greenhouse_gym.learning.train_ppo` leaves, and the varied scenes.

    Args:
        settings: The settings.
        out: Folder for the results.
        resume: Go on from the checkpoint in ``out``, with PPO.
        tell: Gets steps and figures of the imitation after each round.
        make_env: Makes the environment of PPO, as in `greenhouse_gym.learning.train_ppo`.

    Returns:
        The path of the policy's JSON file.
    """
    out, ppo = Path(out), settings.ppo
    if settings.variations:
        bank = varied_bank(SceneBank.open(ppo.bank), out / "bank", settings.variations, ppo.seed)
        ppo = replace(ppo, bank=str(bank.path))

    def teach(model: Any) -> None:
        options = {
            name: getattr(ppo, name)
            for name in ("bank", "split", "robot", "observation", "difficulty", "threads")
        }  # fmt: skip
        if settings.from_rule:
            follow_waypoint(model.policy)
        if not settings.imitation.steps:
            return
        env = make_vec_env(settings.imitation.num_envs, autoreset_mode="SameStep", **options)
        with closing(env):
            imitate(model.policy, env, settings.imitation, ppo.seed, tell)

    return train_ppo(ppo, out, resume=resume, prepare=teach, make_env=make_env)
