"""The doctor reports missing and broken parts, with a remedy."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from types import ModuleType

import pytest
from typer.testing import CliRunner

from greenhouse_gym.cli import app
from greenhouse_gym.cli import doctor as examined
from greenhouse_gym.common import open3d_loader
from greenhouse_gym.rendering import opengl
from greenhouse_gym.scene import bank


@pytest.fixture
def importing(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Nothing heavy is imported; a module can be made to fail."""
    failing: list[str] = []

    def load(name: str, package: str | None = None) -> ModuleType:
        if name in failing:
            raise ImportError(f"lib{name}.so.1: cannot open shared object file")
        return ModuleType(name)

    monkeypatch.setattr(importlib, "import_module", load)
    monkeypatch.setattr(open3d_loader, "open3d", lambda: ModuleType("open3d"))
    return failing.append


def by_subject() -> dict[str, examined.Finding]:
    return {finding.subject: finding for finding in examined.findings()}


@pytest.mark.usefixtures("importing")
def test_a_complete_installation_is_good() -> None:
    found = by_subject()
    assert {"greenhouse-gym", "Python", "cores", "OpenGL", "bank default", "bank mini", "policies"} <= set(found)
    assert {"extra reconstruct", "extra plan", "extra train", "always needed"} <= set(found)
    assert all(f.state == "good" for what, f in found.items() if "extra" not in what and what != "OpenGL"), found
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 0, result.output
    assert "ompl 1." in result.output


@pytest.mark.usefixtures("importing")
def test_a_missing_extra_is_reported_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    version = metadata.version

    def without_ompl(name: str) -> str:
        if name == "ompl":
            raise metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(metadata, "version", without_ompl)
    finding = by_subject()["extra plan"]
    assert (finding.state, finding.result) == ("missing", "ompl not installed")
    assert finding.advice == "pip install 'greenhouse-gym[plan]'"
    assert CliRunner().invoke(app, ["doctor"]).exit_code == 0  # no one needs every extra


def test_what_cannot_be_imported_is_broken(importing: Callable[[str], None]) -> None:
    importing("cv2")
    finding = by_subject()["extra reconstruct"]
    assert finding.state == "broken"
    assert "libcv2.so.1" in finding.result
    assert CliRunner().invoke(app, ["doctor"]).exit_code == 1


@pytest.mark.usefixtures("importing")
def test_no_opengl_is_no_reason_to_worry(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> None:
        raise opengl.OpenGLMissingError("OpenGL does not work here (no EGL); on Debian: apt install libegl1")

    monkeypatch.setattr(opengl, "OpenGLRenderer", none)
    finding = by_subject()["OpenGL"]
    assert finding.state == "missing"
    assert finding.advice == "on Debian: apt install libegl1"


@pytest.mark.usefixtures("importing")
def test_an_incomplete_installation_is_broken(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(bank, "data_path", lambda kind: tmp_path)
    found = by_subject()
    assert found["bank default"].state == found["bank mini"].state == "broken"
    assert "install the package again" in found["bank default"].advice
