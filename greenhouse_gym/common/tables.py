"""Tables of text: Markdown for files and pipes, boxes on a terminal."""

from __future__ import annotations

import html
import math
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

from rich import table as rich_table
from rich.markup import escape

from greenhouse_gym.common.progress import CONSOLE, say


def number(value: float, form: str) -> str:
    """Return a number as text; empty for NaN."""
    return "" if math.isnan(value) else format(value, form)


class Table(NamedTuple):
    """Rows of text under their heads.

    Attributes:
        heads: Head of each column.
        rows: Cells of each row.
        words: Columns that hold words, flush left; all others hold numbers, flush right.
    """

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    words: Collection[int] = (0,)

    def only(self, *heads: str) -> Table:
        """Return the table without the columns that have none of the given heads."""
        return self._columns([k for k, head in enumerate(self.heads) if head in heads])

    def as_markdown(self) -> str:
        """Return the table as Markdown, its columns padded to one width."""
        sizes = [max(3, *map(len, column)) for column in zip(self.heads, *self.rows, strict=True)]
        rule = [f":{'-' * (n - 1)}" if k in self.words else f"{'-' * (n - 1)}:" for k, n in enumerate(sizes)]

        def line(cells: Sequence[str]) -> str:
            padded = (
                c.ljust(n) if k in self.words else c.rjust(n) for k, (c, n) in enumerate(zip(cells, sizes, strict=True))
            )
            return f"| {' | '.join(padded)} |\n"

        return "".join(map(line, (self.heads, rule, *self.rows)))

    def as_html(self) -> str:
        """Return the table as HTML, its texts escaped."""

        def line(tag: str, cells: Sequence[str]) -> str:
            sides = ("left" if k in self.words else "right" for k in range(len(cells)))
            padded = zip(sides, map(html.escape, cells), strict=True)
            return "".join(f'<{tag} style="text-align: {side}">{cell}</{tag}>' for side, cell in padded)

        lines = [line("th", self.heads), *(line("td", row) for row in self.rows)]
        return f"<table>{''.join(f'<tr>{cells}</tr>' for cells in lines)}</table>"

    def show(self, title: str | None = None) -> None:
        """Print the table: on a terminal with a frame, in parts if it is too wide, and as Markdown elsewhere."""
        if not CONSOLE.is_terminal:
            say(self.as_markdown().rstrip())
            return
        for part in self._fitting(CONSOLE.width):
            framed = rich_table.Table(title=title)
            for k, head in enumerate(part.heads):
                framed.add_column(head, justify="left" if k in part.words else "right")
            for row in part.rows:
                framed.add_row(*map(escape, row))
            CONSOLE.print(framed, highlight=False)

    def _fitting(self, width: int) -> Iterator[Table]:
        """Yield parts that fit a width, each with the first column; words can be wrapped, columns of numbers cannot."""
        if any(k > 0 for k in self.words):
            yield self
            return
        sizes = [3 + max(map(len, column)) for column in zip(self.heads, *self.rows, strict=True)]
        part = [0]
        for k in range(1, len(sizes)):
            if len(part) > 1 and 1 + sum(sizes[i] for i in (*part, k)) > width:
                yield self._columns(part)
                part = [0]
            part.append(k)
        yield self._columns(part)

    def _columns(self, chosen: Sequence[int]) -> Table:
        rows = [[row[k] for k in chosen] for row in self.rows]
        return Table([self.heads[k] for k in chosen], rows, [i for i, k in enumerate(chosen) if k in self.words])
