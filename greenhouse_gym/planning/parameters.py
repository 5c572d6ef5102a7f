"""Parameters of planners: their defaults and valid values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from greenhouse_gym.errors import InvalidValueError, require_choice

Value = bool | int | float
"""Value of a parameter."""


@dataclass(frozen=True)
class Parameter:
    """A parameter of a planner.

    Attributes:
        default: The default, whose type is that of every value; None if the installed OMPL does not report it.
        low: Smallest valid number.
        high: Largest valid number.
    """

    default: Value | None
    low: float = 0.0
    high: float = math.inf

    @property
    def expected(self) -> str:
        """The valid values in words."""
        if isinstance(self.default, bool):
            return "True or False"
        number = "a whole number" if isinstance(self.default, int) else "a finite number"
        return (
            f"{number} from {self.low:g} to {self.high:g}" if math.isfinite(self.high) else f"{number} >= {self.low:g}"
        )

    def allows(self, value: object) -> bool:
        """Return whether a value is valid; the default always is."""
        value = value.item() if isinstance(value, np.generic) else value
        if self.default is None:
            return isinstance(value, Value)
        if isinstance(self.default, bool) or isinstance(value, bool):
            return isinstance(self.default, bool) and isinstance(value, bool)
        if not isinstance(value, int if isinstance(self.default, int) else int | float):
            return False
        return value == self.default or (math.isfinite(value) and self.low <= value <= self.high)


def ompl_parameter(default: str, suggestion: str) -> Parameter:
    """Read a parameter from OMPL's texts.

    Args:
        default: Its value.
        suggestion: OMPL's range: "0,1", "low:high", "low:step:high" or "". A default outside it widens it: 0 often
            leaves the choice to OMPL.
    """
    if suggestion == "0,1":
        return Parameter(default == "1")
    value = int(default) if suggestion and "." not in suggestion else float(default)
    ends = [float(end) for end in suggestion.split(":")] if suggestion else [0.0, math.inf]
    return Parameter(value, min(ends[0], value), max(ends[-1], value))


def require_valid(planner: str, values: Mapping[str, Value], parameters: Mapping[str, Parameter]) -> None:
    """Check values for parameters of a planner.

    Raises:
        UnknownNameError: The planner has no such parameter; the message lists those it has.
        InvalidValueError: A value is of the wrong type or outside its range.
    """
    for name, value in values.items():
        parameter = parameters[require_choice(f"setting of {planner}", name, parameters)]
        if not parameter.allows(value):
            raise InvalidValueError(f"{planner}: {name} must be {parameter.expected}, got {value!r}")
