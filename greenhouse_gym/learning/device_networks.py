"""Networks of PPO on a device."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from greenhouse_gym.common.extras import needs
from greenhouse_gym.learning.settings import DevicePpoSettings

with needs("train"):
    import torch
    from torch import Tensor, nn

    from greenhouse_gym.learning.sb3_features import CENTERS_AND_SCALES


class Networks(nn.Module):
    """Actor and critic on observations of a layout, scaled to about one.

    Args:
        size: Size of the observation.
        actions: Size of the action.
        settings: Sizes of the hidden layers, and the noise.
        layout: Name and size of each feature.
    """

    center: Tensor
    scale: Tensor

    def __init__(self, size: int, actions: int, settings: DevicePpoSettings, layout: tuple[tuple[str, int], ...]):
        super().__init__()
        self.actor = _perceptron((size, *settings.hidden, actions), 0.01)
        self.critic = _perceptron((size, *settings.hidden, 1), 1.0)
        self.log_std = nn.Parameter(torch.full((actions,), settings.log_std))
        pairs = np.concatenate(
            [np.tile(CENTERS_AND_SCALES.get(name, (0.0, 1.0)), (width, 1)) for name, width in layout]
        )
        self.register_buffer("center", torch.tensor(pairs[:, 0], dtype=torch.float32))
        self.register_buffer("scale", torch.tensor(pairs[:, 1], dtype=torch.float32))

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean actions (n, size) and values (n,)."""
        scaled = (observations - self.center) / self.scale
        return self.actor(scaled), self.critic(scaled).squeeze(1)


def _perceptron(sizes: tuple[int, ...], last_gain: float) -> nn.Sequential:
    layers: list[nn.Module] = []
    for k, (inputs, outputs) in enumerate(pairwise(sizes)):
        layer = nn.Linear(inputs, outputs)
        is_last = k == len(sizes) - 2
        nn.init.orthogonal_(layer.weight, last_gain if is_last else math.sqrt(2))
        nn.init.zeros_(layer.bias)
        layers += [layer] if is_last else [layer, nn.ReLU()]
    return nn.Sequential(*layers)
