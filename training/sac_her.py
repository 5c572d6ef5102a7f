"""Train SAC with hindsight experience replay on the goal environment and tell how it gets on.

python training/sac_her.py --bank mini --minutes 10

Prints, every so many steps, the shares of success and collision over episodes of the training and the test split, with
the processor time spent. It stops after so many minutes of processor time.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback

from greenhouse_gym.integrations.sb3 import make_sb3_vec_env
from greenhouse_gym.integrations.sb3_her import GoalFeatures, GoalReplayBuffer
from greenhouse_gym.learning import score


class Report(BaseCallback):
    """Judges the policy now and then, and stops the training in time.

    Args:
        options: Keywords of the environment.
        every: Steps from one judgement to the next.
        minutes: Of processor time.
        episodes: Per split.
    """

    def __init__(self, options: dict[str, Any], every: int, minutes: float, episodes: int):
        super().__init__()
        self._options, self._every, self._minutes, self._episodes = options, every, minutes, episodes
        self._next = every

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next += self._every
            told = f"{self.num_timesteps} steps, {time.process_time():.0f} s of processor time"
            for split in ("train", "test"):
                result = score(
                    lambda seen: self.model.predict(seen, deterministic=True)[0],
                    self._episodes, seed=10_000, split=split, **self._options,
                )  # fmt: skip
                told += f"; {split}: success {result.success:.1%}, collision {result.collision:.1%}"
            print(told, flush=True)
        return time.process_time() < 60 * self._minutes


def main() -> None:
    """Train until the time is over."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bank", default="mini")
    parser.add_argument("--difficulty", default="easy")
    parser.add_argument("--reward", default="sparse")
    parser.add_argument("--num-envs", type=int, default=32)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--every", type=int, default=20_000)
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    options: dict[str, Any] = {
        "bank": arguments.bank,
        "observation": "goal",
        "reward": arguments.reward,
        "difficulty": arguments.difficulty,
    }
    model = SAC(
        "MultiInputPolicy",
        make_sb3_vec_env(arguments.num_envs, seed=arguments.seed, **options),
        replay_buffer_class=GoalReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4},
        learning_starts=200 * arguments.num_envs,
        gradient_steps=arguments.num_envs // 4,
        batch_size=256,
        gamma=0.97,
        tau=0.01,
        learning_rate=7e-4,
        ent_coef="auto_0.05",
        buffer_size=400_000,
        policy_kwargs={"net_arch": [256, 256], "features_extractor_class": GoalFeatures},
        seed=arguments.seed,
        device="cpu",
    )
    report = Report(options, arguments.every, arguments.minutes, arguments.episodes)
    model.learn(10_000_000, callback=report)


if __name__ == "__main__":
    main()
