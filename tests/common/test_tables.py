"""Tables: Markdown in a pipe, parts that fit on a terminal, no NaN."""

from __future__ import annotations

import io
import math

import pytest
from rich.console import Console

from greenhouse_gym.common import tables
from greenhouse_gym.common.tables import Table, number

WIDE = Table(("agent", *(f"number {k}" for k in range(9))), [("ppo", *"123456789"), ("random", *"987654321")])


def test_markdown_is_as_wide_as_its_cells() -> None:
    table = Table(("agent", "x"), [("a", "1.5"), ("bc", "")])
    assert table.as_markdown() == "| agent |   x |\n| :---- | --: |\n| a     | 1.5 |\n| bc    |     |\n"
    assert WIDE.only("agent", "number 3", "missing").as_markdown().splitlines()[2] == "| ppo    |        4 |"


@pytest.mark.parametrize("width", [40, 80, 200])
def test_a_terminal_gets_parts_that_fit(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=width, color_system=None)
    monkeypatch.setattr(tables, "CONSOLE", console)
    WIDE.show()
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    assert max(map(len, printed.splitlines())) <= width
    assert all(head in printed for head in WIDE.heads), "no head is cut or wrapped"
    assert (printed.count("agent") == 1) == (width == 200)


def test_no_number_is_an_empty_cell() -> None:
    assert number(math.nan, ".1%") == ""
    assert number(0.5, ".0%") == "50%"


def test_html_is_escaped() -> None:
    assert "&lt;b&gt;" in Table(("<b>",), [("x",)]).as_html()
