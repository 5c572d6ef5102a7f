"""Learning curve, validations and checkpoints of a running training."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from stable_baselines3.common.callbacks import BaseCallback

from greenhouse_gym.common.progress import progress
from greenhouse_gym.common.progress import report as say
from greenhouse_gym.evaluation import Evaluation, evaluate
from greenhouse_gym.learning.policies import fits_policy_file, save_policy
from greenhouse_gym.learning.sb3 import TERMS, Sb3Agent
from greenhouse_gym.learning.training_files import (
    CHECKPOINT,
    CURVE,
    VALIDATION,
    algorithm_of,
    has_diverged,
    read_curve,
    read_notes,
    restart_episodes,
    save_checkpoint,
    write_curve,
)
from greenhouse_gym.scene import SceneBank

WINDOW = 10
"""Lines of the learning curve whose episodes each line averages over."""

COLUMNS = ("steps", "seconds", "success_rate", "collision_rate", "return", "length")
"""Columns of the learning curve."""

VALIDATION_SEED = 10_000
"""Seed of the first validation episode."""


class Totals(NamedTuple):
    """Number of the episodes that ended, and sums over them."""

    episodes: float = 0.0
    successes: float = 0.0
    collisions: float = 0.0
    returns: float = 0.0
    lengths: float = 0.0

    def means(self) -> dict[str, float]:
        """Return the means to five decimals; nan without episodes."""
        figures = dict(zip(COLUMNS[2:], self[1:], strict=True))
        return {name: round(total / self.episodes, 5) if self.episodes else math.nan for name, total in figures.items()}


def summed(totals: Iterable[Sequence[float]]) -> Totals:
    """Return the sum of totals."""
    return Totals(*(sum(column) for column in zip(Totals(), *totals, strict=True)))


class Validation(NamedTuple):
    """Episodes of the policy without its noise, the same ones every time.

    Attributes:
        steps: Environment steps of the training so far.
        updates: Gradient updates since the training began.
        seconds: Seconds of the training so far.
        results: The episodes by split.
    """

    steps: int
    updates: int
    seconds: float
    results: Mapping[str, Evaluation]

    def row(self) -> dict[str, float]:
        """Return the line of ``validation.csv``."""
        figures: dict[str, float] = {"steps": self.steps, "updates": self.updates, "seconds": self.seconds}
        for split, result in self.results.items():
            prefix = "" if split == "validation" else f"{split}_"
            figures[f"{prefix}success_rate"] = result.success_rate
            figures[f"{prefix}collision_rate"] = result.collision_rate
        return figures

    def __str__(self) -> str:
        figures = (
            f"{split}: success {result.success_rate:.0%}, collision {result.collision_rate:.0%}"
            for split, result in self.results.items()
        )
        return f"{self.steps:,} steps, {self.seconds:.0f} s; {'; '.join(figures)}"


class TrainingReport(BaseCallback):  # type: ignore[misc]
    """Record a training, save its checkpoints and stop it at its time limit.

    Args:
        out: Folder of the training.
        settings: Settings of the training, as `as_json` returns them.
        model: The model, untrained or resumed.
        curve_steps: Steps per line of the learning curve.
        splits: Splits to validate on, every ``validation_steps`` of the settings; never if these are 0.
        options: Keywords of `evaluate` for the validation.
        time_limit: Seconds after which the training stops, or None.
        checkpoint_seconds: Seconds between checkpoints.
        restart_steps: Steps of all simulations between the starts of rollouts at which all episodes and random numbers
            restart. Checkpoints are written there only, so that a training that is killed and resumed ends in the
            same policy. None, for trainings that a checkpoint does not hold whole: they are written at any time.
        on_progress: Called with each new line of the learning curve.
        on_validation: Called with each validation.
    """

    def __init__(
        self,
        out: Path,
        settings: Mapping[str, Any],
        model: Any,
        curve_steps: int,
        splits: Sequence[str],
        options: Mapping[str, Any],
        time_limit: float | None,
        checkpoint_seconds: float,
        restart_steps: int | None = None,
        on_progress: Callable[[Mapping[str, float]], None] = lambda line: None,
        on_validation: Callable[[Validation], None] = lambda validation: None,
    ):
        super().__init__()
        self.out, self.settings, self.model, self.splits, self.options = out, settings, model, splits, options
        self.time_limit, self.checkpoint_seconds, self.restart_steps = time_limit, checkpoint_seconds, restart_steps
        self.on_progress, self.on_validation = on_progress, on_validation
        self.curve_steps, self.validation_steps = curve_steps, settings["validation_steps"]
        done = model.num_timesteps
        self.rows, self.validations = (
            [row for row in read_curve(out / name) if row["steps"] <= done] if done else []
            for name in (CURVE, VALIDATION)
        )
        self.last_step, self.next_restart = done, self._restart_after(done)
        self.seconds_before = max((rows[-1]["seconds"] for rows in (self.rows, self.validations) if rows), default=0.0)
        self.began = self.saved = time.monotonic()
        self.lines = [*(Totals(*line) for line in read_notes(out)["lines"]), Totals()] if done else [Totals()]
        self.note = ""
        self.display = ExitStack()
        self.show = self.display.enter_context(progress("steps of training", settings["total_steps"]))

    def _on_rollout_start(self) -> None:
        if self.restart_steps and self.num_timesteps >= self.next_restart:
            if time.monotonic() - self.saved > self.checkpoint_seconds:
                self.save()
            restart_episodes(self.model, self.settings["seed"])
            self.next_restart = self._restart_after(self.num_timesteps)

    def _on_step(self) -> bool:
        self.show(self.num_timesteps, self.note)
        for info in self.locals["infos"]:
            if "episode" in info:
                figures = (1, info["is_success"], info["collision"], info["episode"]["r"], info["episode"]["l"])
                self.lines[-1] = summed([self.lines[-1], Totals(*map(float, figures))])
                self.logger.record_mean("episodes/success_rate", float(info["is_success"]))
                self.logger.record_mean("episodes/collision_rate", float(info["collision"]))
                for name, value in info[TERMS].items():
                    self.logger.record_mean(f"reward/{name}", value)
        if self.validation_steps and self._passed(self.validation_steps):
            self._validate()
        if self._passed(self.curve_steps):
            self._add_line()
        self.last_step = self.num_timesteps
        if self.restart_steps is None and time.monotonic() - self.saved > self.checkpoint_seconds:
            self.save()
        return self.time_limit is None or time.monotonic() - self.began < self.time_limit

    def _restart_after(self, steps: int) -> int:
        """Return the steps of the restart after one; early ones are closer, so that a short training is saved, too."""
        return steps + max(1, min(steps, self.restart_steps or 0))

    def _passed(self, interval: int) -> bool:
        """Return whether the last step has reached a multiple of an interval."""
        return bool(self.num_timesteps // interval > self.last_step // interval)

    def _seconds(self) -> float:
        return round(self.seconds_before + time.monotonic() - self.began, 2)

    def _add_line(self) -> None:
        """Add a line to the learning curve and show it."""
        self.lines = self.lines[-WINDOW:]
        totals = summed(self.lines)
        self.lines.append(Totals())
        row = {"steps": self.num_timesteps, "seconds": self._seconds(), **totals.means()}
        self.rows.append(row)
        if totals.episodes:
            self.note = f"success {row['success_rate']:.0%}, collision {row['collision_rate']:.0%}"
        self.on_progress(row)
        if has_diverged(self.model):
            self.save()

    def _validate(self) -> None:
        """Run the validation episodes with the policy without its noise."""
        agent, episodes = Sb3Agent(self.model), self.settings["validation_episodes"]
        results = {
            split: evaluate(agent, split, episodes, seed=VALIDATION_SEED, progress=False, **self.options)
            for split in self.splits
        }
        validation = Validation(self.num_timesteps, self.model._n_updates, self._seconds(), results)
        row = validation.row()
        self.validations.append(row)
        for name in list(row)[3:]:
            self.logger.record(f"validation/{name}", row[name])
        write_curve(self.out / VALIDATION, list(row), self.validations)
        say(str(validation))
        self.on_validation(validation)

    def save(self) -> None:
        """Write the checkpoint and the learning curve.

        Raises:
            DivergedError: The model has diverged; the last checkpoint is kept.
        """
        self.saved = time.monotonic()
        save_checkpoint(self.model, self.out, {"settings": dict(self.settings), "lines": self.lines[:-1]})
        write_curve(self.out / CURVE, COLUMNS, self.rows)

    def save_policy(self) -> Path:
        """Write the policy file and return its path, or the checkpoint's if a policy file cannot hold the network."""
        notes = {
            "algorithm": algorithm_of(self.model),
            "settings": dict(self.settings),
            "bank_sha256": SceneBank.open(self.settings["bank"]).sha256,
        }
        if fits_policy_file(self.model):
            return save_policy(self.model, self.out / "policy", notes)
        return self.out / CHECKPOINT

    def close(self) -> None:
        """Stop the progress display and close the log."""
        self.display.close()
        self.model.logger.close()
