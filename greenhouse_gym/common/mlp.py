"""Small multilayer perceptrons, evaluated in numpy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError

Array = npt.NDArray[Any]

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, np.float32(0.0)),
}
"""Activations of hidden layers by name."""

OUTPUTS: dict[str, Callable[[Array], Array]] = {
    "clip": lambda x: np.clip(x, -1.0, 1.0),
    "tanh": np.tanh,
    "logistic": lambda x: 1 / (1 + np.exp(-x)),
}
"""Activations of the last layer by name."""


@dataclass(frozen=True, eq=False)
class Mlp:
    """A multilayer perceptron on normalized inputs; it computes in the type of its weights.

    Attributes:
        weights: Per layer (outputs, inputs).
        biases: Per layer (outputs,).
        activation: One of `ACTIVATIONS`, for hidden layers.
        center: (size,) subtracted from the inputs.
        scale: (size,) that the centered inputs are divided by.
        output: One of `OUTPUTS`, for the last layer.
        max_deviation: Normalized inputs are clipped to this in both directions, if given.
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    activation: str
    center: Array
    scale: Array
    output: str = "clip"
    max_deviation: float | None = None

    def __call__(self, inputs: npt.ArrayLike) -> Array:
        """Return outputs (k,) or (n, k) for inputs (size,) or (n, size).

        The output for an input has the same bits alone and in a batch.

        Raises:
            InvalidValueError: The inputs have another size.
        """
        dtype = self.weights[0].dtype
        x = np.asarray(inputs, dtype=dtype)
        if x.shape[-1:] != self.center.shape:
            raise InvalidValueError(f"expected inputs of {len(self.center)} entries, got shape {x.shape}")
        x = (x - self.center) / self.scale
        if self.max_deviation is not None:
            x = np.clip(x, -self.max_deviation, self.max_deviation)
        x, activate = x[..., None], ACTIVATIONS[self.activation]
        # products with one vector each: a product of matrices rounds differently for another number of rows
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = activate(np.asarray(weight @ x + bias[:, None], dtype=dtype))
        return OUTPUTS[self.output]((self.weights[-1] @ x)[..., 0] + self.biases[-1]).astype(dtype)
