"""Arrays of fixed shapes as fields of dataclasses and JSON files."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError

Array: TypeAlias = npt.NDArray[np.float64]


def numbers_of(value: Any) -> Array:
    """Return a float64 copy of an array of real numbers, or of nested sequences; an empty array of anything else."""
    try:
        array = np.array(value)
        return array.astype(np.float64, copy=False) if array.dtype.kind in "iuf" else np.empty(0)
    except (TypeError, ValueError, OverflowError):  # of different lengths, or not of numbers
        return np.empty(0)


@dataclass(frozen=True)
class JsonArray:
    """Annotation by which pydantic reads a fixed-shape float array from nested lists and writes it as such."""

    shape: tuple[int, ...]

    def parse(self, value: Any) -> Array:
        """Convert nested sequences to a read-only float64 array of this shape with finite entries."""
        array = numbers_of(value)
        if not array.size:
            raise InvalidValueError(f"expected {self.shape} numbers, got {reprlib.repr(value)}")
        if array.shape != self.shape:
            raise InvalidValueError(f"expected an array of shape {self.shape}, got shape {array.shape}")
        if not np.isfinite(array).all():
            raise InvalidValueError(f"expected finite numbers, got {array.tolist()}")
        array.setflags(write=False)
        return array

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema

        return core_schema.no_info_plain_validator_function(
            self.parse, serialization=core_schema.plain_serializer_function_ser_schema(lambda array: array.tolist())
        )


VECTOR, MATRIX = JsonArray((3,)), JsonArray((3, 3))
Vector: TypeAlias = Annotated[Array, VECTOR]
Rotation: TypeAlias = Annotated[Array, MATRIX]
