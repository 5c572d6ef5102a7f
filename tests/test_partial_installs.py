"""With no extra, or with one alone, every command does its work or names the extra that is missing."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from greenhouse_gym.common.extras import MODULES

ROOT = Path(__file__).parent.parent
DECLARED = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

SHORT = ["--steps", "8", *(f"--set={name}" for name in ("num_envs=2", "rollout_steps=4", "batch_size=4"))]
"""Options of the shortest training."""

COMMANDS = {
    "simulate": ["simulate", "{out}/recording", "--length", "0.1"],
    "reconstruct": ["reconstruct", "{out}/recording", "--out", "{out}/row"],
    "build": ["build", "{out}/recording", "--out", "{out}/bank"],
    "shapes": ["shapes", "{out}/cloud.ply", "--out", "{out}/shapes"],
    "import": ["import", "{out}/video", "--out", "{out}/recording2"],
    "calibrate": ["calibrate", "{out}/video", "--out", "{out}/rig.yaml"],
    "formats": ["formats"],
    "plan": ["plan", "--scene", "{scene}", "--target", "0", "--bank", "mini", "--time-limit", "0.2"],
    "train": ["train", "ppo", "--bank", "mini", "--out", "{out}/run", *SHORT],
    "sweep": ["sweep", "--try", "seed=0", "--bank", "mini", "--out", "{out}/sweep", *SHORT],
    "compare": ["compare", "random", "--bank", "mini", "--episodes", "1"],
    "compare planners": ["compare", "RRTConnect", "--bank", "mini", "--episodes", "1"],
    "policy": ["policy", "export", "ppo-ur5e", "--out", "{out}/policy.onnx"],
    "demo": ["demo", "--quick", "--out", "{out}/demo"],
}

NEEDED = {
    "simulate": {"reconstruct"},
    "reconstruct": {"reconstruct"},
    "build": {"reconstruct", "plan"},
    "shapes": {"reconstruct"},
    "import": {"reconstruct"},
    "calibrate": {"reconstruct"},
    "formats": {"reconstruct"},
    "plan": {"plan"},
    "train": {"train"},
    "sweep": {"train"},
    "compare planners": {"plan"},
    "policy": {"onnx"},
    "demo": {"reconstruct", "plan", "train", "viz", "warp"},
}

RUN = """
import json, os, sys
hidden = set()
class Hiding:
    def __init__(self, finder):
        self.finder = finder
    def __getattr__(self, name):
        return getattr(self.finder, name)
    def find_spec(self, name, path=None, target=None):
        return None if name.split(".")[0] in hidden else self.finder.find_spec(name, path, target)
cases = json.loads(sys.argv[1])
hidden.update(*(case for case, _ in cases))
sys.meta_path[:] = map(Hiding, sys.meta_path)
from typer.testing import CliRunner
from greenhouse_gym.cli import app
import greenhouse_gym.planning
CliRunner().invoke(app, cases[0][1].get("compare", []))
for case, commands in cases:
    if os.fork() == 0:  # what all cases import and load is there already
        hidden.clear()
        hidden.update(case)
        results = {}
        for name, arguments in commands.items():
            result = CliRunner().invoke(app, arguments)
            error = result.exception
            results[name] = [result.exit_code, type(error).__name__, str(error)]
        print(json.dumps(results), flush=True)
        os._exit(0)
    os.wait()
"""

Outcomes = dict[str, tuple[int, str, str]]


def ends(cases: list[tuple[list[str], dict[str, list[str]]]]) -> list[Outcomes]:
    """Return the end of each command of each case: modules that cannot be found, and commands."""
    arguments = [sys.executable, "-c", RUN, json.dumps(cases)]
    done = subprocess.run(arguments, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    results = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert len(results) == len(cases), done.stdout + done.stderr
    return results


EVERY_MODULE = sorted({module for modules in MODULES.values() for module in modules})


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Outcomes]]:
    """Folder and ends of the commands, where the modules of no extra or of one alone are found."""
    from greenhouse_gym.scene import SceneBank

    cases, folders = [], {installed: tmp_path_factory.mktemp(f"with-{installed}") for installed in ("", *MODULES)}
    for installed, out in folders.items():
        places = {"out": str(out), "scene": SceneBank.open("mini").names()[0]}
        commands = {
            name: [part.format(**places) for part in parts]
            for name, parts in COMMANDS.items()
            if name == "compare" or NEEDED[name] - {installed}
        }
        cases.append((sorted(set(EVERY_MODULE) - set(MODULES.get(installed, ()))), commands))
    return {installed: (folders[installed], results) for installed, results in zip(folders, ends(cases), strict=True)}


@pytest.mark.parametrize("installed", ["", *MODULES])
def test_what_is_missing_is_named_by_its_extra(outcomes: dict[str, tuple[Path, Outcomes]], installed: str) -> None:
    out, results = outcomes[installed]
    assert results["compare"][0] == 0, results
    for name, (_, error, message) in results.items():
        if name == "compare":
            continue
        assert error == "MissingDependencyError", f"{name}: {error}: {message}"
        (extra,) = re.findall(r"pip install 'greenhouse-gym\[(\w+)\]'", message)
        assert extra in NEEDED[name] - {installed}, f"{name}: {message}"
    assert not [path for path in out.rglob("*") if path.is_file() and "recording" not in str(path)]


def test_pictures_and_films_need_no_extra(tmp_path: Path) -> None:
    small = ["--fps", "1", "--size", "64x48", "--seed", "1"]
    commands = {
        "render": ["render", "--bank", "mini", "--out", f"{tmp_path}/scene.png"],
        "watch": ["watch", "random", "--bank", "mini", "--split", "train", "--out", f"{tmp_path}/film.gif", *small],
    }
    (results,) = ends([(EVERY_MODULE, commands)])
    assert [result[0] for result in results.values()] == [0, 0], results
    assert {path.name for path in tmp_path.iterdir()} == {"scene.png", "film.gif"}


def test_a_report_without_matplotlib_names_the_extra_before_the_episodes(tmp_path: Path) -> None:
    commands = {"compare": [*COMMANDS["compare"], "--report", str(tmp_path / "report.html")]}
    ((_, error, message),) = ends([(["matplotlib"], commands)])[0].values()
    assert error == "MissingDependencyError"
    assert "greenhouse-gym[viz]" in message
    assert not list(tmp_path.iterdir())


# -- what is declared -------------------------------------------------------------------------------------------------

IMPORTED_AS = {
    "opencv-python-headless": "cv2", "pyhelios3d": "pyhelios", "pillow": "PIL", "pyyaml": "yaml", "openexr": "OpenEXR",
    "warp-lang": "warp",
}  # fmt: skip
NOT_IMPORTED = {"moviepy", "mujoco_menagerie"}
"""Packages for Gymnasium's RecordVideo, and files of arms."""


def modules_of(requirements: list[str]) -> set[str]:
    names = [re.match(r"[A-Za-z0-9_.-]+", requirement)[0] for requirement in requirements]  # type: ignore[index]
    return {IMPORTED_AS.get(name, name.replace("-", "_")) for name in names}


def test_what_is_declared_is_imported_and_what_is_imported_is_declared() -> None:
    extras = {k: v for k, v in DECLARED["optional-dependencies"].items() if k not in ("all", "dev", "docs")}
    declared = modules_of(DECLARED["dependencies"]).union(*map(modules_of, extras.values()))
    imported = set()
    for path in (ROOT / "greenhouse_gym").rglob("*.py"):
        imported |= set(re.findall(r"^\s*(?:import|from) (\w+)", path.read_text(), re.M))
        imported |= set(re.findall(r"import_module\([\"'](\w+)", path.read_text()))
    assert declared - imported - NOT_IMPORTED == set()
    own = {"greenhouse_gym", "pydantic_core"}
    foreign = {name for name in imported if name not in sys.stdlib_module_names} - own
    assert {name for name in foreign - declared if _installed(name)} == set()


def _installed(name: str) -> bool:
    """Return whether a word after "import" is a package; the words of docstrings are not."""
    from importlib.util import find_spec

    return find_spec(name) is not None


def test_the_modules_of_extras_are_those_declared() -> None:
    for extra, modules in MODULES.items():
        assert set(modules) == modules_of(DECLARED["optional-dependencies"][extra])


# -- real installs ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("extra", ["", *MODULES])
def test_an_install_of_one_extra_alone(tmp_path: Path, extra: str) -> None:
    """In a fresh environment, by the package index that pip is set up with."""
    from greenhouse_gym.scene import SceneBank

    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    target = f"{ROOT}[{extra}]" if extra else str(ROOT)
    constraints = ["--constraint", str(ROOT / "constraints.txt")]
    subprocess.run([python, "-m", "pip", "install", "--quiet", *constraints, target], check=True)
    places = {"out": str(tmp_path), "scene": SceneBank.open("mini").names()[0]}
    code = "from greenhouse_gym.cli import main; main()"
    for name, parts in COMMANDS.items():
        arguments = [part.format(**places) for part in parts]
        done = subprocess.run(
            [python, "-c", code, *arguments], capture_output=True, text=True, cwd=tmp_path, check=False
        )
        assert "Traceback" not in done.stderr, f"{name}: {done.stderr}"
        if NEEDED.get(name, set()) - {extra}:
            assert done.returncode == 1, f"{name}: {done.stdout}{done.stderr}"
            assert "pip install 'greenhouse-gym[" in done.stderr, f"{name}: {done.stderr}"
