"""Draws the house of CONTRIBUTING.md, docs/house.svg, from the import contracts in pyproject.toml.

    python docs/house.py

Each floor may import what is below it, never what is above. Rooms of one floor do not know each other.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from html import escape
from pathlib import Path

ROOT = Path(__file__).parent.parent
WIDTH, FLOOR, ROOM, GAP, TOP = 400, 40, 30, 40, 56
SHARED = "both sides"
COLORS = {"sensing": "#cfe6cf", "acting": "#cfdcf2", SHARED: "#efe3c8"}


def floors(name: str) -> list[list[str]]:
    """Rooms of each floor of a side, the highest first."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (layers,) = (contract["layers"] for contract in contracts if contract["name"].startswith(f"The {name} side, in"))
    return [[room.strip().removeprefix("greenhouse_gym.") for room in layer.split("|")] for layer in layers]


def side(name: str, left: int, shared: Sequence[str]) -> list[str]:
    """A side of the house, as SVG elements."""
    parts = [_text(left + WIDTH / 2, TOP - 18, f"the {name} side", bold=True)]
    for k, rooms in enumerate(floors(name)):
        width = (WIDTH - 8 * (len(rooms) - 1)) / len(rooms)
        for i, room in enumerate(rooms):
            x, y = left + i * (width + 8), TOP + k * FLOOR
            color = COLORS[SHARED if room in shared else name]
            parts.append(f'<rect x="{x:.0f}" y="{y}" width="{width:.0f}" height="{ROOM}" rx="5" fill="{color}"/>')
            parts.append(_text(x + width / 2, y + 20, room))
    return parts


def _text(x: float, y: float, text: str, bold: bool = False) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="middle"{weight}>{escape(text)}</text>'


def house() -> str:
    """The whole house, as an SVG file."""
    sides = ("sensing", "acting")
    rooms = [{room for floor in floors(name) for room in floor} for name in sides]
    shared = sorted(rooms[0] & rooms[1])
    height = TOP + max(len(floors(name)) for name in sides) * FLOOR + 40
    width = 2 * WIDTH + GAP + 40
    parts = [line for i, name in enumerate(sides) for line in side(name, 20 + i * (WIDTH + GAP), shared)]
    note = (
        "Each floor imports only what is below it. The sides never import each other; what is on both is sand-colored."
    )
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
            'font-family="sans-serif" font-size="14" fill="#222">',
            f'<rect width="{width}" height="{height}" fill="white"/>',
            *parts,
            _text(width / 2, height - 18, note),
            "</svg>",
            "",
        ]
    )


if __name__ == "__main__":
    (ROOT / "docs" / "house.svg").write_text(house())
