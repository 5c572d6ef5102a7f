"""The project's vocabulary: first lines of docstrings, phrases that are not used, and names that stand for nothing."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parent.parent
CODE = sorted(path for folder in ("greenhouse_gym", "training", "benchmarks", "examples", "docs") for path in
              (ROOT / folder).rglob("*.py"))  # fmt: skip
PAGES = [path for path in sorted(ROOT.glob("*.md")) if path.name != "CHANGELOG.md"]
PAGES += [*sorted((ROOT / "docs").rglob("*.md")), ROOT / "scenes" / "README.md", ROOT / "benchmarks" / "README.md"]

INDIRECT_QUESTION = re.compile(r"(What|How|Whether|Where|Which|Who|Whose|When|Why)\b")
"""Words that make the first line of a docstring an indirect question."""

PHRASES = re.compile(
    r"\b(anew|beside|whoever|nobody|tells?|told|strewn|in vain|but for|of which|there is none|in the mean|"
    r"on the mean|is to be had|as far as that goes|goes on|going on|gone on|as \w+ as can be)\b",
    re.IGNORECASE,
)
"""Phrases for which there are plainer ones."""

WORDS = frozenset(
    [
        "agreed",
        "anew",
        "asks",
        "beside",
        "boxed",
        "cared",
        "company",
        "credible",
        "credited",
        "diary",
        "few",
        "glance",
        "headings",
        "hear",
        "hears",
        "judge",
        "judged",
        "judges",
        "knowledge",
        "lead",
        "least",
        "led",
        "most",
        "much",
        "pace",
        "patience",
        "places",
        "played",
        "receded",
        "shapeless",
        "share",
        "shares",
        "sight",
        "situation",
        "slowed",
        "some",
        "standing",
        "strayed",
        "strewn",
        "sure",
        "tell",
        "tells",
        "told",
        "touched",
        "touches",
        "unlooked",
        "unseen",
        "walk",
        "way",
        "ways",
    ]
)
"""Words that no name of the code contains."""

NAMES = re.compile(
    r"\b(Ways?Reward|Situation|Pace|Touches|Sight\w*|Patience|KeptRecords|SeenSpace|SpecWithStepLimit|careful_ways|"
    r"asks_\w+|on_(?:line|stage|piece|scene|target|training|told)|max_lead|Scene\.seen|unseen=|patience=|kept=)"
)
"""Former names that no page mentions."""


class Line(NamedTuple):
    path: Path
    number: int
    text: str

    def __str__(self) -> str:
        return f"{self.path.relative_to(ROOT)}:{self.number}: {self.text}"


@cache
def nodes(code: str) -> list[ast.AST]:
    return list(ast.walk(ast.parse(code)))


def docstrings(path: Path, code: str) -> Iterator[Line]:
    """Yield the docstrings of a module, its classes and its functions."""
    for node in nodes(code):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield Line(path, getattr(node, "lineno", 1), ast.get_docstring(node) or "")


def prose(path: Path, code: str) -> Iterator[Line]:
    """Yield the lines of all strings of a module and, if there is a phrase in its text, of its comments."""
    for node in nodes(code):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            for i, text in enumerate(node.value.splitlines()):
                yield Line(path, node.lineno + i, text.strip())
    if not PHRASES.search(code):
        return  # no comment has one either, and to read the tokens takes long
    for token in tokenize.generate_tokens(io.StringIO(code).readline):
        if token.type == tokenize.COMMENT:
            yield Line(path, token.start[0], token.string)


def definitions(path: Path, code: str) -> Iterator[Line]:
    """Yield the names that a module gives to functions, classes, arguments, variables and attributes."""
    for node in nodes(code):
        name = None
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            name = node.name
        elif isinstance(node, ast.arg):
            name = node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            name = node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            name = node.attr
        if name:
            yield Line(path, node.lineno, name)


def words(name: str) -> set[str]:
    """Return the words of a name in snake_case or CamelCase."""
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)}


def indirect_questions(path: Path, code: str) -> list[Line]:
    first = (line._replace(text=line.text.partition("\n")[0]) for line in docstrings(path, code))
    return [line for line in first if INDIRECT_QUESTION.match(line.text)]


def phrases(path: Path, lines: Iterator[Line]) -> list[Line]:
    return [line for line in lines if PHRASES.search(line.text)]


def banned_names(path: Path, code: str) -> list[Line]:
    return [line for line in definitions(path, code) if words(line.text) & WORDS]


def lines_of(path: Path) -> Iterator[Line]:
    """Yield the lines of a page."""
    return (Line(path, number, text) for number, text in enumerate(path.read_text().splitlines(), 1))


def assert_none(found: list[Line]) -> None:
    assert not found, "\n" + "\n".join(map(str, found))


def test_docstrings_begin_with_an_imperative_or_a_noun() -> None:
    assert_none([line for path in CODE for line in indirect_questions(path, path.read_text())])


def test_code_avoids_the_phrases() -> None:
    assert_none([line for path in CODE for line in phrases(path, prose(path, path.read_text()))])


def test_code_avoids_the_names() -> None:
    assert_none([line for path in CODE for line in banned_names(path, path.read_text())])


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_pages_avoid_phrases_and_former_names(path: Path) -> None:
    assert_none([line for line in lines_of(path) if PHRASES.search(line.text) or NAMES.search(line.text)])


def test_the_changelog_avoids_the_phrases() -> None:
    assert_none(phrases(ROOT, lines_of(ROOT / "CHANGELOG.md")))


def test_violations_are_found() -> None:
    code = '''
def ways_to(beside, few=1):
    """How far it goes.

    Looks anew.
    """
    self.unseen = f"{few} is told"  # nobody
    WalkJudge = 2
'''
    path = ROOT / "code.py"
    assert [line.number for line in indirect_questions(path, code)] == [2]
    assert sorted(line.number for line in phrases(path, prose(path, code))) == [5, 7, 7]
    assert {line.text for line in banned_names(path, code)} == {"ways_to", "beside", "few", "unseen", "WalkJudge"}
