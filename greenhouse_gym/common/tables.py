"""Tables of text: Markdown for files and pipes, boxes on a terminal."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

from rich import table as rich_table
from rich.markup import escape

from greenhouse_gym.common.progress import CONSOLE, say


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

    def as_markdown(self) -> str:
        """Return the table as Markdown, its columns padded to one width."""
        from tabulate import tabulate

        sides = ["left" if k in self.words else "right" for k in range(len(self.heads))]
        return tabulate(self.rows, self.heads, tablefmt="pipe", colalign=sides, disable_numparse=True) + "\n"

    def as_html(self) -> str:
        """Return the table as HTML, its texts escaped."""
        from tabulate import tabulate

        sides = ["left" if k in self.words else "right" for k in range(len(self.heads))]
        return str(tabulate(self.rows, self.heads, tablefmt="html", colalign=sides, disable_numparse=True))

    def show(self, title: str | None = None) -> None:
        """Print the table with a frame on a terminal, and as Markdown elsewhere."""
        if not CONSOLE.is_terminal:
            say(self.as_markdown().rstrip())
            return
        framed = rich_table.Table(title=title)
        for k, head in enumerate(self.heads):
            framed.add_column(head, justify="left" if k in self.words else "right")
        for row in self.rows:
            framed.add_row(*map(escape, row))
        CONSOLE.print(framed, highlight=False)
