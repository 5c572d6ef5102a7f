"""Arrays of fixed shapes as fields of dataclasses and JSON files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError

Array: TypeAlias = npt.NDArray[np.float64]


@dataclass(frozen=True)
class JsonArray:
    """Annotation by which pydantic reads a fixed-shape float array from nested lists and writes it as such."""

    shape: tuple[int, ...]

    def parse(self, value: Any) -> Array:
        """Convert nested sequences to a read-only float64 array of this shape with finite entries."""
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InvalidValueError(f"expected {self.shape} numbers, got {value!r}") from error
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
