from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_modules_import_only_what_they_may() -> None:
    """The contracts in pyproject.toml."""
    code = "import sys; from importlinter.cli import lint_imports_command; lint_imports_command()"
    done = subprocess.run(
        [sys.executable, "-c", code, "--no-cache"], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout
    assert "0 kept" not in done.stdout


def test_nothing_but_posix_is_needed_to_plan_and_evaluate() -> None:
    """Windows lacks these modules, macOS the affinity: neither is needed to import, or to count cores."""
    code = (
        "import os, sys\n"
        "for name in ('resource', 'fcntl', 'pwd', 'grp', 'termios'): sys.modules[name] = None\n"
        "for name in ('sched_getaffinity', 'sched_setaffinity'): delattr(os, name)\n"
        "import greenhouse_gym.evaluation, greenhouse_gym.planning, greenhouse_gym.planning.ompl_worker\n"
        "import greenhouse_gym.envs, greenhouse_gym.cli\n"
        "from greenhouse_gym.common.executors import usable_cores\n"
        "assert usable_cores() >= 1\n"
        "from greenhouse_gym.agents import RandomAgent\n"
        "from greenhouse_gym.evaluation import evaluate\n"
        "evaluate(RandomAgent(), episodes=2, num_envs=2, bank='mini', observation='points')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_shapes_need_no_opencv() -> None:
    """A cloud from a laser scanner becomes shapes where only Open3D is installed."""
    code = "import sys, greenhouse_gym.shapes; assert 'cv2' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_settings_of_trainings_need_no_torch() -> None:
    code = (
        "import sys\n"
        "from greenhouse_gym.learning import BcThenPpoSettings, PpoSettings, SacSettings\n"
        "BcThenPpoSettings(), PpoSettings(), SacSettings()\n"
        "assert not {'torch', 'stable_baselines3'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_libraries_of_reports_and_exports_are_loaded_where_they_are_used() -> None:
    code = (
        "import sys, greenhouse_gym, greenhouse_gym.cli, greenhouse_gym.export\n"
        "assert not {'PIL', 'jinja2', 'matplotlib', 'trimesh'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_benchmark_and_training_can_be_imported() -> None:
    files = [*(ROOT / "benchmarks").rglob("*.py"), *(ROOT / "training").glob("*.py")]
    names = sorted(".".join(path.relative_to(ROOT).with_suffix("").parts) for path in files)
    names.remove("benchmarks.speed.fetch_reach")  # needs an old MuJoCo
    code = f"import importlib\nfor name in {names}: importlib.import_module(name)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
