"""Draw the layout of the package, docs/house.svg, from the import contracts in pyproject.toml.

python docs/house.py
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from html import escape
from pathlib import Path

ROOT = Path(__file__).parent.parent
WIDTH, LAYER, BOX, GAP, TOP = 400, 40, 30, 40, 56
SHARED = "both sides"
COLORS = {"sensing": "#cfe6cf", "acting": "#cfdcf2", SHARED: "#efe3c8"}


def layers(side: str) -> list[list[str]]:
    """Return the packages of each layer of a side, the highest layer first."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (found,) = (contract["layers"] for contract in contracts if contract["name"].startswith(f"The {side} side, in"))
    return [[package.strip().removeprefix("greenhouse_gym.") for package in layer.split("|")] for layer in found]


def drawn(side: str, left: int, bottom: int, shared: Sequence[str]) -> list[str]:
    """Return a side as SVG elements; the lowest layers of both sides are at the same height."""
    parts = [_text(left + WIDTH / 2, TOP - 18, f"the {side} side", bold=True)]
    for k, packages in enumerate(reversed(layers(side))):
        width = (WIDTH - 8 * (len(packages) - 1)) / len(packages)
        for i, package in enumerate(packages):
            x, y = left + i * (width + 8), bottom - (k + 1) * LAYER
            color = COLORS[SHARED if package in shared else side]
            parts.append(f'<rect x="{x:.0f}" y="{y}" width="{width:.0f}" height="{BOX}" rx="5" fill="{color}"/>')
            parts.append(_text(x + width / 2, y + 20, package))
    return parts


def _text(x: float, y: float, text: str, bold: bool = False) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="middle"{weight}>{escape(text)}</text>'


def picture() -> str:
    """Return the picture as an SVG file."""
    sides = ("sensing", "acting")
    packages = [{package for layer in layers(side) for package in layer} for side in sides]
    shared = sorted(packages[0] & packages[1])
    bottom = TOP + max(len(layers(side)) for side in sides) * LAYER
    height, width = bottom + 40, 2 * WIDTH + GAP + 40
    parts = [line for i, side in enumerate(sides) for line in drawn(side, 20 + i * (WIDTH + GAP), bottom, shared)]
    note = (
        "A package imports only those below it. The sides do not import each other; sand-colored packages are shared."
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
    (ROOT / "docs" / "house.svg").write_text(picture())
