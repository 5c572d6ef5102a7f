"""What a training by SAC tells while it goes on: judgments, TensorBoard and checkpoints."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.callbacks import BaseCallback

from greenhouse_gym.evaluation import Evaluation, evaluate
from greenhouse_gym.learning.checkpoints import save_checkpoint
from greenhouse_gym.learning.curves import VALIDATION, read_curve, write_curve
from greenhouse_gym.learning.sb3 import Sb3Agent
from greenhouse_gym.learning.sb3_steps import TERMS

if TYPE_CHECKING:
    from greenhouse_gym.learning.sac import SacSettings

COLUMNS = (
    "steps", "updates", "seconds", "success_rate", "collision_rate", "train_success_rate", "train_collision_rate",
)  # fmt: skip
"""What a judgment tells: of rows that are not trained on, then of those that are."""

_JUDGED_SEED = 10_000


@dataclass(frozen=True)
class SacProgress:
    """How far a training is, and how good the policy without its noise.

    Attributes:
        steps: Steps of all simulations together.
        updates: Gradient steps since the training began or was resumed.
        seconds: Processor time of the training, without that of the judging.
        train: Episodes of the training split.
        validation: Episodes of the validation split, whose rows are not trained on. The test split is for the end.
    """

    steps: int
    updates: int
    seconds: float
    train: Evaluation
    validation: Evaluation


class SacReport(BaseCallback):  # type: ignore[misc]
    """Judges the policy now and then, keeps checkpoints, and stops the training in time.

    Args:
        out: Folder of the training.
        settings: Its settings.
        env_options: Keywords of its environment.
        model: What is trained, at the beginning or as it was resumed.
        minutes: Processor time after which it stops, or None.
        checkpoint_seconds: Time between checkpoints.
        tell: Gets each judgment.
    """

    def __init__(
        self,
        out: Path,
        settings: SacSettings,
        env_options: Mapping[str, Any],
        model: Any,
        minutes: float | None,
        checkpoint_seconds: float,
        tell: Callable[[SacProgress], None],
    ):
        super().__init__()
        self.model, self._out, self._settings, self._options, self._tell = model, out, settings, env_options, tell
        self._limit = None if minutes is None else 60.0 * minutes
        self._every = settings.validation_steps
        self._next = (model.num_timesteps // self._every + 1) * self._every
        done = model.num_timesteps
        self._rows = [row for row in read_curve(out / VALIDATION) if row["steps"] <= done] if done else []
        self._before = self._rows[-1]["seconds"] if self._rows else 0.0
        self._checkpoint_seconds, self._saved = checkpoint_seconds, time.monotonic()
        self._began, self._judging = time.process_time(), 0.0

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                self.logger.record_mean("episodes/success_rate", float(info["is_success"]))
                self.logger.record_mean("episodes/collision_rate", float(info["collision"]))
                for name, value in info[TERMS].items():
                    self.logger.record_mean(f"reward/{name}", value)
        seconds = time.process_time() - self._began - self._judging
        if self.num_timesteps >= self._next:
            self._next += self._every
            self._judge(round(self._before + seconds, 1))
            self._judging = time.process_time() - self._began - seconds
        if time.monotonic() - self._saved > self._checkpoint_seconds:
            self._save()
        return self._limit is None or seconds < self._limit

    def _judge(self, seconds: float) -> None:
        """Play the same episodes of both splits each time, with the policy without its noise."""
        agent, episodes = Sb3Agent(self.model), self._settings.validation_episodes
        train, validation = (
            evaluate(agent, split, episodes, seed=_JUDGED_SEED, progress=False, num_envs=episodes, **self._options)
            for split in ("train", "validation")
        )
        told = SacProgress(self.num_timesteps, self.model._n_updates, seconds, train, validation)
        figures = [told.steps, told.updates, seconds, validation.success_rate, validation.collision_rate]
        self._rows.append(dict(zip(COLUMNS, [*figures, train.success_rate, train.collision_rate], strict=True)))
        for name in COLUMNS[3:]:
            self.logger.record(f"validation/{name}", self._rows[-1][name])
        write_curve(self._out / VALIDATION, COLUMNS, self._rows)
        self._tell(told)

    def finish(self) -> None:
        """Write what there is."""
        self._save()
        self.model.logger.close()

    def _save(self) -> None:
        self._saved = time.monotonic()
        save_checkpoint(self.model, self._out, {"settings": json.loads(json.dumps(asdict(self._settings)))})
