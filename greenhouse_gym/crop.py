"""What a tomato row is made of, shared by truth, extraction and scenes: tomatoes and stems."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.geometry import Capsule, Sphere

StemKind = Literal["main", "peduncle", "pedicel", "string", "pipe"]
STEM_KINDS: tuple[str, ...] = get_args(StemKind)


@dataclass(frozen=True, eq=False)
class Tomato(Sphere):
    """A tomato: a sphere with the number of its truss and its ripeness.

    Attributes:
        truss: Number of the truss it hangs on, unique within a row or scene.
        ripeness: 0 (green) to 1 (red), or None when unknown.
    """

    truss: int
    ripeness: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ripeness is not None and not 0.0 <= self.ripeness <= 1.0:
            raise InvalidValueError(f"ripeness must be between 0 and 1, got {self.ripeness!r}")


@dataclass(frozen=True, eq=False)
class Stem(Capsule):
    """A straight piece of stem: a capsule with its kind, one of `STEM_KINDS`."""

    kind: StemKind

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice("stem kind", self.kind, STEM_KINDS)
