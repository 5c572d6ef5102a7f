"""Training by PPO on a device, with its folder: settings, curve and policy."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path

from greenhouse_gym.common.extras import needs
from greenhouse_gym.common.files import exclusive, write_atomically
from greenhouse_gym.common.progress import say
from greenhouse_gym.errors import check_whole, require_seed
from greenhouse_gym.learning.settings import DevicePpoSettings

with needs("train"):
    import torch

    from greenhouse_gym.learning.device_ppo import DevicePpo
    from greenhouse_gym.learning.training_files import CHECKPOINT, CURVE, check_folder, write_curve

COLUMNS = ("steps", "seconds", "success_rate", "collision_rate", "return", "length", "learning_rate", "kl")
"""Columns of the learning curve."""

_SECONDS_BETWEEN_LINES = 10.0


def train_ppo_on_device(
    settings: DevicePpoSettings,
    out: str | Path,
    *,
    time_limit: float | None = None,
    on_progress: Callable[[Mapping[str, float]], None] = lambda line: None,
) -> Path:
    """Train a policy on the Warp environment.

    ``out`` gets ``settings.json``, ``curve.csv`` (one line per report), and ``policy.json`` with
    ``policy.safetensors``, written with each line, also when the training is interrupted.

    Args:
        settings: The settings.
        out: Folder for the results, which must not hold a training.
        time_limit: Seconds after which the training stops.
        on_progress: Called with each new line of ``curve.csv``.

    Returns:
        The path of the policy's JSON file.

    Raises:
        InvalidValueError: The folder holds a training, or the device is missing or lacks memory.
        FileWriteError: The folder cannot be written, or another training is at work in it.
        DivergedError: The weights are no longer finite, or explode; the last policy before that is kept.
        KeyboardInterrupt: The training was interrupted; its results are written.
    """
    require_seed(settings.seed)
    out = Path(out)
    check_whole("minibatches", settings.minibatches, 1, settings.num_envs * settings.rollout_steps)
    torch.set_float32_matmul_precision("high")  # TF32 on a GPU
    with exclusive(out):
        check_folder(out / CHECKPOINT, dict, {}, "", resume=False)
        training = DevicePpo(settings)
        write_atomically(out / "settings.json", json.dumps(asdict(settings), indent=1) + "\n")
        rows: list[dict[str, float]] = []
        began = shown = time.monotonic()
        try:
            over = False
            while not over:
                now = time.monotonic()
                passed = max(training.steps / settings.total_steps, (now - began) / (time_limit or math.inf))
                kl = training.iterate(max(0.0, 1 - passed))
                now = time.monotonic()
                over = training.steps >= settings.total_steps or (time_limit is not None and now - began > time_limit)
                if over or now - shown > _SECONDS_BETWEEN_LINES:
                    shown = now
                    figures = {"steps": training.steps, "seconds": round(now - began, 2), **training.figures()}
                    rows.append({**figures, "learning_rate": training.learning_rate, "kl": kl})
                    training.save(out)  # a process that is killed leaves it
                    write_curve(out / CURVE, COLUMNS, rows)
                    say(
                        f"{training.steps:,} steps, {now - began:.0f} s: success {figures['success_rate']:.0%}, "
                        f"collision {figures['collision_rate']:.0%}, return {figures['return']:.2f}"
                    )
                    on_progress(rows[-1])
        finally:
            try:
                path = training.save(out)
            finally:
                training.env.close()
    return path
