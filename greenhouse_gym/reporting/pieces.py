"""Pieces of HTML for pages that open anywhere; each escapes what it is given."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from html import escape

STYLE = """\
* { box-sizing: border-box }
body { max-width: 72rem; margin: 2rem auto; padding: 0 1.5rem; color: #222; background: #fff;
  font: 16px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif }
h1 { font-size: 1.7rem; line-height: 1.2; overflow-wrap: anywhere }
h2 { font-size: 1.2rem; margin: 2.5rem 0 .75rem; padding-bottom: .25rem; border-bottom: 1px solid #ccc }
h3 { font-size: 1rem; margin: 1.5rem 0 .5rem }
.figures { display: flex; flex-wrap: wrap; gap: 1rem 2.5rem; margin: 1rem 0 }
.figures div { display: flex; flex-direction: column-reverse }
.figures dd { margin: 0; font-size: 1.7rem; font-weight: 600; line-height: 1.2 }
.figures dt, figcaption, footer { color: #555; font-size: .875rem }
.warning { color: #b3261e; font-weight: 600; margin: .25rem 0 }
.scroll { overflow-x: auto; margin: .5rem 0 1rem }
table { border-collapse: collapse; font-size: .875rem; font-variant-numeric: tabular-nums }
th, td { padding: .25rem .9rem .25rem 0; text-align: right; vertical-align: top; white-space: nowrap;
  border-bottom: 1px solid #e4e4e4 }
th { border-bottom-color: #999; font-weight: 600 }
th.words, td.words { text-align: left; white-space: normal; overflow-wrap: break-word }
td.words:first-child { white-space: nowrap }
.pair { display: grid; grid-template-columns: 1fr 1fr; gap: 1rem 1.5rem }
.pair > * { min-width: 0 }
@media (max-width: 50rem) { .pair { grid-template-columns: 1fr } }
figure { margin: 0 0 1rem; break-inside: avoid }
img { max-width: 100%; max-height: 44rem; width: auto; height: auto; display: block }
.pair img { max-height: 32rem }
svg { width: 100%; height: auto }
.keys { display: flex; flex-wrap: wrap; gap: .1rem 1.2rem; margin: .25rem 0; font-size: .875rem }
.keys span { display: inline-flex; align-items: center; gap: .4rem }
.keys i { width: 1.1rem; height: .35rem }
footer { margin-top: 2.5rem; border-top: 1px solid #ccc; padding-top: .5rem }
"""
"""The look of a page, without its ``style`` element."""


def paragraph(text: str) -> str:
    """A paragraph."""
    return f"<p>{escape(text)}</p>\n"


def heading(text: str, level: int = 2) -> str:
    """A heading."""
    return f"<h{level}>{escape(text)}</h{level}>\n"


def warnings(texts: Iterable[str]) -> str:
    """Lines that stand out."""
    return "".join(f'<p class="warning">{escape(text)}</p>\n' for text in texts)


def figures(values: Mapping[str, str]) -> str:
    """Large figures, each over what it counts."""
    pairs = (f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in values.items())
    return f'<dl class="figures">{"".join(pairs)}</dl>'


def keys(colors: Mapping[str, str]) -> str:
    """What the colors of a plot stand for."""
    entries = (f'<span><i style="background:{color}"></i>{escape(name)}</span>' for name, color in colors.items())
    return f'<div class="keys">{"".join(entries)}</div>\n'


def table(header: Sequence[str], rows: Iterable[Sequence[str]], words: Set[int]) -> str:
    """A table; columns that hold words are flush left, numbers flush right."""

    def line(kind: str, cells: Sequence[str]) -> str:
        tags = [f'{kind} class="words"' if k in words else kind for k in range(len(cells))]
        return "<tr>" + "".join(f"<{t}>{escape(c)}</{kind}>" for t, c in zip(tags, cells, strict=True)) + "</tr>\n"

    body = "".join(line("td", row) for row in rows)
    made = f"<table>\n<thead>{line('th', header)}</thead>\n<tbody>{body}</tbody>\n</table>\n"
    return f'<div class="scroll">{made}</div>\n'
