from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

LARGEST = 30e6
"""Bytes of a wheel and of a source distribution, at most."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (built,) = out.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def unpacked(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site") / "Grünes Haus π"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def run(code: str, unpacked: Path, cwd: Path) -> str:
    """Run code that finds the package in the unpacked wheel only, from a folder that has nothing to do with it."""
    cache = {"NUMBA_CACHE_DIR": str(unpacked.parent / "numba")}  # starts empty, and goes with the test
    environment = {**os.environ, **cache, "PYTHONPATH": str(unpacked), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_wheel_carries_code_data_and_types(unpacked: Path) -> None:
    package = unpacked / "greenhouse_gym"
    for path in sorted((ROOT / "greenhouse_gym").rglob("*.py")):
        assert (unpacked / path.relative_to(ROOT)).is_file()
    for name in ("py.typed", "robots/ur5e.xml"):
        assert (package / name).read_bytes() == (ROOT / "greenhouse_gym" / name).read_bytes()
    for folder in ("tests", "benchmarks", "scenes", "training"):
        assert not (unpacked / folder).exists()
    assert next(unpacked.glob("*.dist-info/licenses/LICENSE")).is_file()
    assert "greenhouse-gym = greenhouse_gym.cli:main" in next(unpacked.glob("*.dist-info/entry_points.txt")).read_text()


@pytest.mark.parametrize("bank", ["default", "mini"])
def test_the_wheel_carries_the_shipped_banks(unpacked: Path, bank: str) -> None:
    shipped = unpacked / "greenhouse_gym" / "_scenes" / bank
    assert (shipped / "manifest.json").is_file()
    for path in (ROOT / "scenes" / bank).iterdir():
        assert (shipped / path.name).read_bytes() == path.read_bytes()


def test_the_wheel_is_small(wheel: Path) -> None:
    assert wheel.stat().st_size < LARGEST


def test_an_installed_package_uses_its_own_data_and_writes_nothing_beside_itself(
    unpacked: Path, tmp_path: Path
) -> None:
    """It may lie in a folder that cannot be written; this one has spaces and other letters in its path."""
    code = (
        "import greenhouse_gym, gymnasium\n"
        "from greenhouse_gym.scene import SceneBank\n"
        "env = gymnasium.make('TomatoReach-v0', bank='mini')\n"
        "env.reset(seed=0)\n"
        "env.step(env.action_space.sample())\n"
        "print(greenhouse_gym.__file__)\n"
        "print(SceneBank.open('mini').path)\n"
        "print(len([scene for scene in SceneBank.open('mini')]))\n"
        "scene = SceneBank.open('mini')[0]\n"
        "scene.save('Szene é.json')\n"
    )
    before = sorted(unpacked.rglob("*"))
    module, bank, count = run(code, unpacked, tmp_path).splitlines()
    assert Path(module).is_relative_to(unpacked)
    assert Path(bank) == (unpacked / "greenhouse_gym" / "_scenes" / "mini").resolve()
    assert int(count) == 8
    assert (tmp_path / "Szene é.json").is_file()
    assert sorted(unpacked.rglob("*")) == before


def test_the_source_distribution_is_whole(tmp_path: Path) -> None:
    """Data, license, tests and documentation, and little beside them."""
    command = [sys.executable, "-m", "build", "--sdist", "--no-isolation", "--outdir", str(tmp_path), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (built,) = tmp_path.glob("*.tar.gz")
    assert built.stat().st_size < LARGEST
    with tarfile.open(built) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    wanted = {"LICENSE", "README.md", "CITATION.cff", "Makefile", "constraints.txt", "docs/index.md"}
    wanted |= {"scenes/default/manifest.json", "training/policies/ppo-ur5e.safetensors", "tests/test_package.py"}
    assert wanted <= held
    assert not [name for name in held if name.startswith((".venv", "site/", "demo/", "runs/"))]


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_wheel_installs_into_a_fresh_environment(wheel: Path, tmp_path: Path) -> None:
    """By the package index that pip is set up with, into a folder with spaces and other letters in its path."""
    home = tmp_path / "Grünes Haus π"
    subprocess.run([sys.executable, "-m", "venv", home], check=True)
    python = home / "bin" / "python"
    constraints = ["--constraint", str(ROOT / "constraints.txt")]
    subprocess.run([python, "-m", "pip", "install", "--quiet", *constraints, f"{wheel}[plan]"], check=True)
    program = home / "bin" / "greenhouse-gym"
    code = "from greenhouse_gym.cli import main; main()"  # the program's first line would hold the path, with its space
    assert program.is_file()
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    for arguments in (
        ["doctor"],
        ["compare", "random", "roadmap", "RRTConnect", "SBL", "--bank", "mini", "--episodes", "2"],
    ):
        done = subprocess.run(
            [python, "-c", code, *arguments], capture_output=True, text=True, cwd=tmp_path, env=environment, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr


def test_the_banks_scenes_are_whole() -> None:
    """Every file of `default` is the manifest's, no row lies in two splits; the scenes of `mini` are read."""
    from greenhouse_gym.build.scenes import BuildSettings
    from greenhouse_gym.scene import DIFFICULTIES, SceneBank
    from greenhouse_gym.scene.manifest import SPLITS

    bank, mini = SceneBank.open("default"), SceneBank.open("mini")
    rows = {split: {entry.row for entry in bank.manifest.scenes if entry.split == split} for split in SPLITS}
    assert all(rows.values())
    assert not rows["train"] & rows["test"]
    assert not rows["train"] & rows["validation"]
    for entry in bank.manifest.scenes:
        assert hashlib.sha256((bank.path / entry.file).read_bytes()).hexdigest() == entry.sha256
        assert entry.truth
        assert entry.targets
        assert sum(entry.targets.values()) > 0
    assert set(mini.names()) <= set(bank.names())
    targets = []
    for scene in mini:
        assert len(scene.obstacles) <= BuildSettings().max_shapes
        assert 0 < len(scene.targets) <= len(scene.tomatoes)
        assert scene.truth is not None
        assert scene.occupancy is not None
        targets += scene.targets
    assert all((target.witness is None) == (target.difficulty == "unreachable") for target in targets)
    assert {target.difficulty for target in targets} == set(DIFFICULTIES)


def test_versions_agree() -> None:
    from importlib.metadata import version

    import greenhouse_gym

    assert greenhouse_gym.__version__ == version("greenhouse-gym")
