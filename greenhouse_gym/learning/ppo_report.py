"""What a training by PPO tells while it goes on: curves, TensorBoard, checkpoints and a progress bar."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TimeRemainingColumn
from stable_baselines3.common.callbacks import BaseCallback

from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.learning.checkpoints import save_checkpoint
from greenhouse_gym.learning.curves import CURVE, VALIDATION, read_curve, write_curve
from greenhouse_gym.learning.sb3 import Sb3Agent
from greenhouse_gym.learning.sb3_steps import TERMS

if TYPE_CHECKING:
    from greenhouse_gym.learning.ppo import PpoSettings

WINDOW = 10
"""Rollouts that a point of the learning curve averages over."""

COLUMNS = ("steps", "seconds", "success_rate", "collision_rate", "return", "length")
"""What a line of the learning curve tells."""

JUDGED = ("steps", "success_rate", "collision_rate")
"""What a judgment on rows that are not trained on tells."""

JUDGED_SPLIT = "validation"
"""Where those rows are."""

_JUDGED_SEED = 10_000


class Report(BaseCallback):  # type: ignore[misc]
    """Keeps the learning curve, the judgments, the checkpoints and the progress display, and the time limit.

    Args:
        out: Folder of the training.
        settings: Its settings.
        model: What is trained, at the beginning or as it was resumed.
        time_limit: Seconds after which it stops, or None.
        checkpoint_seconds: Time between checkpoints.
        on_line: Told each new line of the learning curve.
    """

    def __init__(
        self,
        out: Path,
        settings: PpoSettings,
        model: Any,
        time_limit: float | None,
        checkpoint_seconds: float,
        on_line: Callable[[Mapping[str, float]], None],
    ):
        super().__init__()
        self.out, self.settings, self.model, self.on_line = out, settings, model, on_line
        self.time_limit, self.checkpoint_seconds = time_limit, checkpoint_seconds
        done = model.num_timesteps
        self.rows, self.judged = (
            [row for row in read_curve(out / name) if row["steps"] <= done] if done else []
            for name in (CURVE, VALIDATION)
        )
        self.before = self.rows[-1]["seconds"] if self.rows else 0.0
        self.began = self.saved = self.spoke = time.monotonic()
        self.episodes: list[list[dict[str, Any]]] = [[]]
        self.console = Console(stderr=True)
        self.progress = Progress(
            "PPO", BarColumn(), "{task.completed:,.0f} steps", TimeRemainingColumn(), "{task.fields[note]}",
            console=self.console,
        )  # fmt: skip
        self.task = self.progress.add_task("", total=settings.total_steps, note="")
        if self.console.is_terminal:
            self.progress.start()

    def say(self, text: str) -> None:
        """Print a line, above the progress bar if there is one."""
        self.console.print(text, highlight=False)

    def _on_step(self) -> bool:
        self.episodes[-1] += [info for info in self.locals["infos"] if "episode" in info]
        return self.time_limit is None or time.monotonic() - self.began < self.time_limit

    def _on_rollout_end(self) -> None:
        now = time.monotonic()
        self.episodes = self.episodes[-WINDOW:]
        infos = [info for rollout in self.episodes for info in rollout]
        self.episodes.append([])
        row = {
            "steps": self.num_timesteps,
            "seconds": round(self.before + now - self.began, 2),
            "success_rate": _mean([info["is_success"] for info in infos]),
            "collision_rate": _mean([info["collision"] for info in infos]),
            "return": _mean([info["episode"]["r"] for info in infos]),
            "length": _mean([info["episode"]["l"] for info in infos]),
        }
        self.rows.append(row)
        for name in COLUMNS[2:]:
            self.logger.record(f"episodes/{name}", row[name])
        for name in infos[-1][TERMS] if infos else ():
            self.logger.record(f"reward/{name}", _mean([info[TERMS][name] for info in infos]))
        note = f"success {row['success_rate']:.0%}, collision {row['collision_rate']:.0%}"
        if self.console.is_terminal:
            self.progress.update(self.task, completed=self.num_timesteps, note=note)
        elif now - self.spoke > 20:
            self.spoke = now
            self.say(f"{self.num_timesteps:,} steps, {row['seconds']:.0f} s: {note}, return {row['return']:.2f}")
        self._judge_in_turn()
        if now - self.saved > self.checkpoint_seconds:
            self.saved = now
            self._save()
        self.on_line(row)

    def _judge_in_turn(self) -> None:
        """Play the validation episodes with the policy without its noise, when that is due."""
        every, settings = self.settings.validation_steps, self.settings
        last = self.judged[-1]["steps"] if self.judged else 0
        if not every or self.num_timesteps // every <= last // every:
            return
        found = evaluate(
            Sb3Agent(self.model), JUDGED_SPLIT, settings.validation_episodes, seed=_JUDGED_SEED, progress=False,
            num_envs=min(settings.num_envs, settings.validation_episodes), bank=settings.bank, robot=settings.robot,
            difficulty=settings.difficulty, threads=settings.threads,
        )  # fmt: skip
        figures = {"success_rate": found.success_rate, "collision_rate": found.collision_rate}
        self.judged.append({"steps": self.num_timesteps, **figures})
        for name, value in figures.items():
            self.logger.record(f"validation/{name}", value)
        self.say(
            f"{self.num_timesteps:,} steps, validation: success {found.success_rate:.0%}, "
            f"collision {found.collision_rate:.0%} of {settings.validation_episodes}"
        )

    def finish(self) -> None:
        """Write what there is and stop the progress display."""
        self.progress.stop()
        self._save()
        self.model.logger.close()

    def _save(self) -> None:
        save_checkpoint(self.model, self.out, {"settings": json.loads(json.dumps(asdict(self.settings)))})
        write_curve(self.out / CURVE, COLUMNS, self.rows)
        if self.judged:
            write_curve(self.out / VALIDATION, JUDGED, self.judged)


class CriticFirst(BaseCallback):  # type: ignore[misc]
    """Keeps the actor as it is during the first rollouts.

    Args:
        rollouts: How many.
    """

    def __init__(self, rollouts: int):
        super().__init__()
        self.left = rollouts

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        for name, parameter in self.model.policy.named_parameters():
            if "value" not in name:
                parameter.requires_grad = self.left <= 0
        self.left -= 1


def _mean(values: Sequence[float]) -> float:
    """To five decimals; nan of none."""
    return round(float(np.mean(values)), 5) if values else float("nan")
