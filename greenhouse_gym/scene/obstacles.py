"""Obstacles around an arm and its placement: the part of a scene from which a collision model is made."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import cached_property
from typing import Annotated, Any, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_serializer,
    model_validator,
)

from greenhouse_gym.common.files import checked_name, parsing
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.crops.shape_columns import ShapeColumns, joined
from greenhouse_gym.crops.shape_tables import columns_of_tables
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Box, Capsule, Shape, ShapeArrays, Sphere, Vector
from greenhouse_gym.scene.shape_lists import in_bulk, pack, read_clutter, read_stems, read_tomatoes, unpack

SceneName = Annotated[str, AfterValidator(lambda name: checked_name("a scene", name))]

MAX_TOMATOES, MAX_SHAPES = 2000, 50_000
"""Maximum number of tomatoes, and of stems and pieces of clutter each, in a scene."""

MAX_SIZE = 100.0
"""Maximum coordinate or size in a scene, metres: single precision still resolves a hundredth of a millimetre."""


def is_none(value: object) -> bool:
    """Return whether a value is None; scene files omit such fields."""
    return value is None


def _check_version(version: Any) -> Any:
    if isinstance(version, int) and version > 1:
        raise InvalidValueError(
            f"written by a newer version of greenhouse-gym, in schema {version}; this one reads schema 1: update it"
        )
    return version


SchemaVersion = Annotated[Literal[1], BeforeValidator(_check_version)]
"""Schema version of scene files and manifests."""


class Part(BaseModel):
    """Base of all parts of a scene file: immutable, finite, without unknown fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ArmPlacement(Part):
    """Position of the arm in the scene frame.

    Attributes:
        position: (3,) point on the floor below the base axis, metres.
        yaw: Heading about z, radians; 0 faces the plants (+x).
        shoulder_height: Height of the shoulder joint above that point, metres.
    """

    position: Vector = Field(default_factory=lambda: [0.0, 0.0, 0.0], validate_default=True)
    yaw: float = Field(default=0.0, ge=-100, le=100)
    shoulder_height: float = Field(default=1.1, gt=0, le=10)

    @model_validator(mode="after")
    def _within_bounds(self) -> ArmPlacement:
        if np.abs(self.position).max() > MAX_SIZE:
            raise InvalidValueError(f"position {self.position.tolist()} is farther than {MAX_SIZE:g} m from the origin")
        return self


_PARTS = ("tomatoes", "stems", "clutter")


class Shapes(Part):
    """Tomatoes, stems and clutter around an arm, in the scene frame.

    Those of files are arrays (`columns`); the objects are made when they are first used.
    """

    model_config = ConfigDict(ignored_types=(cached_property,))

    tomatoes: Annotated[tuple[Tomato, ...], in_bulk(read_tomatoes, MAX_TOMATOES)] = Field(
        default=(), max_length=MAX_TOMATOES
    )
    stems: Annotated[tuple[Stem, ...], in_bulk(read_stems, MAX_SHAPES)] = Field(default=(), max_length=MAX_SHAPES)
    clutter: Annotated[tuple[Sphere | Capsule | Box, ...], in_bulk(read_clutter, MAX_SHAPES)] = Field(
        default=(), max_length=MAX_SHAPES
    )

    @model_validator(mode="after")
    def _within_bounds(self) -> Self:
        fields = vars(self)
        if any(isinstance(fields.get(name), ShapeColumns) for name in _PARTS):
            parts = ((name, fields.pop(name)) for name in _PARTS)
            fields["columns"] = joined(
                *(part if isinstance(part, ShapeColumns) else ShapeColumns.of(**{name: part}) for name, part in parts)
            )
        self.check_bounds()
        return self

    @model_serializer(mode="wrap")
    def _whole(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Write all fields in their order."""
        whole = super().model_copy()
        fields = {name: getattr(self, name) for name in type(self).model_fields}
        vars(whole).clear()
        vars(whole).update(fields)
        written: dict[str, Any] = write(whole)
        return written

    def __getattr__(self, name: str) -> Any:  # of parts whose objects were not made yet
        if name not in _PARTS:
            return super().__getattr__(name)  # type: ignore[misc]
        made = vars(self)[name] = getattr(self.columns, name)()
        return made

    def check_bounds(self) -> None:
        """Check that no shape is too large or too far away.

        Raises:
            InvalidValueError: One is.
        """
        numbers = np.hstack([self.arrays.starts, self.arrays.ends, self.arrays.sizes])
        outside = np.flatnonzero((np.abs(numbers) > MAX_SIZE).any(axis=1))
        if len(outside):
            index, shape = int(outside[0]), self.obstacles[outside[0]]
            for name, count in zip(_PARTS, self.counts, strict=True):
                if index < count:
                    raise InvalidValueError(f"{name}.{index} is larger, or farther away, than {MAX_SIZE:g} m: {shape}")
                index -= count

    @cached_property
    def columns(self) -> ShapeColumns:
        """All shapes as arrays; do not change them."""
        return ShapeColumns.of(self.tomatoes, self.stems, self.clutter)

    @property
    def arrays(self) -> ShapeArrays:
        """`obstacles` as arrays; do not change them."""
        return self.columns.arrays

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Copy the model with some fields changed, which are not validated."""
        if set(_PARTS).isdisjoint(update or ()):
            return super().model_copy(update=update, deep=deep)
        parts = {name: getattr(self, name) for name in _PARTS}
        copied = super().model_copy(update={**parts, **(update or {})}, deep=deep)
        vars(copied).pop("columns", None)
        return copied

    def with_columns(self, columns: ShapeColumns, changed: Collection[str] = _PARTS) -> Self:
        """Copy the model with other shapes; ``changed`` names the parts that differ."""
        copied = super().model_copy()
        for name in changed:
            vars(copied).pop(name, None)
        vars(copied)["columns"] = columns
        return copied

    def with_space(self, boxes: ShapeArrays) -> Self:
        """Copy the model with more boxes of clutter, as `SpaceBox`."""
        return self.with_columns(self.columns.with_space(boxes), changed=("clutter",))

    @property
    def leaves(self) -> npt.NDArray[np.int64]:
        """(k,) indices into `obstacles` of the pieces of leaves; see `greenhouse_gym.crops.parts.is_leaf`."""
        return self.columns.leaves

    @property
    def obstacles(self) -> tuple[Shape, ...]:
        """All shapes in this order: tomatoes, stems, clutter."""
        return (*(tomato.shape for tomato in self.tomatoes), *self.stems, *self.clutter)

    @property
    def counts(self) -> tuple[int, int, int]:
        """Numbers of tomatoes, stems and pieces of clutter."""
        return self.columns.counts

    @property
    def count(self) -> int:
        """Number of shapes."""
        return sum(self.counts)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self._summary())})"

    __str__ = __repr__

    def _summary(self) -> list[str]:
        """Return the parts of its text."""
        names = ("tomatoes", "stems", "pieces of clutter")
        return [f"{count} {name}" for name, count in zip(names, self.counts, strict=True)]

    def compact(self) -> Shapes:
        """Return the shapes as a scene file stores its truth: rounded to 0.1 mm, clutter sorted by type."""
        return _unpacked(_packed(self))


class DeferredShapes(Shapes):
    """Packed shapes of a file with a checked checksum, unpacked when one of them is first used.

    Raises:
        FileFormatError: On first use, if the file is damaged.
    """

    @classmethod
    def of(cls, packed: dict[str, Any], path: object) -> DeferredShapes:
        """Return the shapes that are packed in a file."""
        deferred = cls.model_construct()
        vars(deferred).clear()
        vars(deferred).update(_packed=packed, _path=path)
        return deferred

    @cached_property
    def columns(self) -> ShapeColumns:
        """See `Shapes.columns`."""
        with parsing(vars(self)["_path"], "scene"):
            return _unpacked(vars(self)["_packed"]).columns


def _packed(shapes: Shapes) -> dict[str, Any]:
    known: dict[str, Any] | None = vars(shapes).get("_packed")
    return pack(shapes.tomatoes, shapes.stems, shapes.clutter) if known is None else known


def _unpacked(packed: dict[str, Any]) -> Shapes:
    columns = columns_of_tables(unpack(packed))
    tomatoes, stems, clutter = columns.counts
    if tomatoes > MAX_TOMATOES or max(stems, clutter) > MAX_SHAPES:
        raise InvalidValueError(f"more than {MAX_TOMATOES} tomatoes, or {MAX_SHAPES} stems or pieces of clutter")
    shapes = Shapes().with_columns(columns)
    shapes.check_bounds()
    return shapes


def _validated(value: Any, validate: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
    if not (isinstance(value, dict) and "rows" in value):
        return validate(value)
    return DeferredShapes.of(value, info.context["path"]) if info.context else _unpacked(value)


PackedShapes = Annotated[
    Shapes,
    WrapValidator(_validated),
    PlainSerializer(_packed, return_type=dict[str, Any], when_used="json"),
]
"""Shapes that files store as compressed tables (`greenhouse_gym.scene.shape_lists`), rounded to 0.1 mm."""


class Surroundings(Shapes):
    """Named obstacles and the arm's placement among them, from which collision models are compiled."""

    name: SceneName
    placement: ArmPlacement = Field(default_factory=ArmPlacement)

    def _summary(self) -> list[str]:
        return [repr(self.name), *super()._summary()]
