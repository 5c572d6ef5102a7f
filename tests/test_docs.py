"""Code of README and the documentation runs, commands parse, files are valid."""

from __future__ import annotations

import json
import re
import runpy
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from typer.main import get_command

from greenhouse_gym.capture import open_recording
from greenhouse_gym.capture.formats.own import RecordingIndex
from greenhouse_gym.capture.rig_file import load_mounting
from greenhouse_gym.cli import app
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.manifest import Manifest

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")]
PAGES = [*filter(Path.exists, PAGES), *sorted((ROOT / "docs").rglob("*.md"))]
SHORTER = {'backend="warp", difficulty': 'backend="warp", bank="mini", difficulty', "learn(5_000_000)": "learn(16_384)"}
"""Replacements that make code of the pages short enough for a test."""
SHELL = ("sh", "bash", "console", "shell")


class Block(NamedTuple):
    page: Path
    language: str
    title: str
    code: str


def blocks(page: Path) -> Iterator[Block]:
    for language, title, code in re.findall(
        r"^```(\w+)(?: title=\"(.*?)\")?\n(.*?)^```", page.read_text(), re.M | re.S
    ):
        yield Block(page, language, title, code)


ALL = [block for page in PAGES for block in blocks(page)]


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def python_of(page: Path) -> str:
    """The Python of a page, in one piece; examples that it includes have tests of their own."""
    code = "\n".join(b.code for b in blocks(page) if b.language == "python" and "--8<--" not in b.code)
    for long, short in SHORTER.items():
        code = code.replace(long, short)
    return code


@pytest.mark.parametrize("page", [page for page in PAGES if python_of(page)], ids=name)
def test_code_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(python_of(page), name(page), "exec"), {"__name__": "__docs__"})


def test_included_files_exist() -> None:
    included = [(b.page, path) for b in ALL for path in re.findall(r"--8<-- \"(.*?)\"", b.code)]
    assert included
    for page, path in included:
        assert (ROOT / path).is_file(), f"{name(page)}: {path}"


def commands() -> Iterator[tuple[Path, list[str]]]:
    """Command lines in blocks, each as its words."""
    for block in ALL:
        if block.language in SHELL:
            for line in block.code.replace("\\\n", " ").splitlines():
                for command in line.split("&&"):
                    yield block.page, shlex.split(command, comments=True)


def test_commands_parse() -> None:
    """Names of commands and of options, and the values of options, are right; the files they name need not exist."""
    known = get_command(app).commands  # type: ignore[attr-defined]
    seen = set()
    for page, words in commands():
        where = f"{name(page)}: {' '.join(words)}"
        if words[:1] != ["greenhouse-gym"]:
            continue
        assert words[1] in known, where
        seen.add(words[1])
        try:
            known[words[1]].make_context(words[1], words[2:])
        except Exception as error:
            if type(error).__name__ != "Exit":  # --print-settings ends there
                raise AssertionError(f"{where}: {error}") from error
    assert {"render", "train", "compare", "plan", "build"} <= seen


def test_commands_named_in_passing_exist() -> None:
    known = get_command(app).commands  # type: ignore[attr-defined]
    for page in PAGES:
        for mentioned in re.findall(r"`greenhouse-gym ([^`]*)`", page.read_text()):
            words = mentioned.split()
            assert words[0] in known, f"{name(page)}: {mentioned}"
            command = known[words[0]]
            if len(words) > 1:  # of a group
                command = getattr(command, "commands", {}).get(words[1], command)
            options = {option for parameter in command.params for option in parameter.opts}
            assert {word for word in words if word.startswith("--")} <= options, f"{name(page)}: {mentioned}"


def test_scripts_targets_and_extras_exist() -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M))
    extras = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"])
    for page, words in commands():
        where = f"{name(page)}: {' '.join(words)}"
        if words[:1] == ["make"]:
            assert set(words[1:]) <= targets, where
        if words[:1] == ["python"] and words[1:2] != ["-m"]:
            assert (ROOT / words[1]).is_file(), where
        for named in re.findall(r"\[([\w,]+)\]", " ".join(words)) if words[:2] == ["pip", "install"] else []:
            assert set(named.split(",")) <= extras, where


def test_files_in_the_docs_are_valid() -> None:
    kinds = {"recording.json": RecordingIndex, "scene.json": Scene, "manifest.json": Manifest}
    read = set()
    for block in ALL:
        if block.language == "toml":
            tomllib.loads(block.code)
        if block.language == "json":
            json.loads(block.code)
            if block.title in kinds:
                read.add(block.title)
                kinds[block.title].model_validate_json(block.code)
    assert read == set(kinds)


def test_yaml_in_the_docs_is_valid(tmp_path: Path) -> None:
    """Rig files are read, and descriptions of folders are opened as far as their images, which are not there."""
    found = [block for block in ALL if block.language == "yaml" and "--8<--" not in block.code]
    assert len(found) == 2
    for block in found:
        file = tmp_path / "cameras.yaml"
        file.write_text(block.code)
        if "rig_from_camera" in block.code:
            assert load_mounting(file).reference == "middle"
        else:
            with pytest.raises(FileFormatError, match=r"found 0 of camera color, 0 of camera depth|no color"):
                open_recording(tmp_path)


def test_every_block_says_what_it_is() -> None:
    """A block without a language would be hidden from these tests."""
    for page in PAGES:
        fences = re.findall(r"^```(.*)$", page.read_text(), re.M)[::2]
        known = re.compile(r"(python|sh|json|toml|yaml|text)( title=\".*\")?")
        assert all(known.fullmatch(fence) for fence in fences), name(page)


def test_links_lead_to_files() -> None:
    """Links between pages, to pictures and to files of the repository; the site's builder looks at anchors as well."""
    dead = []
    for page in PAGES:
        text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)
        for link in re.findall(r"\]\(([^)\s#]+)(?:#[^)]*)?\)", text):
            if not re.match(r"https?:|mailto:", link) and not (page.parent / link).exists():
                dead.append(f"{name(page)}: {link}")
    assert dead == []


def test_generated_tables_are_made() -> None:
    """Each page names tables that exist, and none is empty or left out."""
    tables = runpy.run_path(str(ROOT / "docs" / "generated.py"))["TABLES"]
    named = [found for page in PAGES for found in re.findall(r"<!-- generated: (\w+) -->", page.read_text())]
    assert sorted(set(named)) == sorted(tables)
    for name_, table in tables.items():
        assert table().count("\n|") > 4, name_
    assert "| `joint_position` | 0 to 5 | 0 to 6 |" in tables["observations"]()


def test_the_sites_navigation_leads_to_pages() -> None:
    """The site's builder tells of pages that it does not lead to."""
    listed = re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text())
    assert [page for page in listed if not (ROOT / "docs" / page).is_file()] == []


def test_scenes_named_in_the_docs_exist() -> None:
    for page, words in commands():
        if "--scene" in words and (scene := words[words.index("--scene") + 1]) != "NAME":
            bank = words[words.index("--bank") + 1] if "--bank" in words else "default"
            assert scene in SceneBank.open(bank).names(), name(page)


def test_readme_is_short_and_says_what_the_package_is_about() -> None:
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 110
    assert "robot arm" in text.split("![")[0]


def test_nothing_names_a_machines_paths() -> None:
    for page in PAGES:
        assert not re.search(r"(?<![\w.])/(work|home|root|tmp)/", page.read_text()), name(page)
