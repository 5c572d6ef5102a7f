"""The examples run, and are as short as they are meant to be."""

from __future__ import annotations

import ast
import json
import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from greenhouse_gym.agents import Problem
from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.capture.image_files import encode_png
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.envs import GreenhouseEnv
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.planning.planners import _ALL
from greenhouse_gym.scene import Scene

EXAMPLES = Path(__file__).parent.parent / "examples"
OWN = ("own_agent", "own_learner")
MAIN = ("own_planner", "own_rig", "own_robot")
LONGER = {"own_crop": 40}


@pytest.mark.parametrize("name", sorted(path.stem for path in EXAMPLES.glob("own_*.py")))
def test_examples_are_short(name: str) -> None:
    """The documentation states their number of lines."""
    text = (EXAMPLES / f"{name}.py").read_text()
    # without comments, docstrings and blank lines
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node):
            node.body = node.body[1:] or [ast.Pass()]
    lines = len([line for line in ast.unparse(tree).splitlines() if line.strip()])
    assert lines <= LONGER.get(name, 20)
    table = (EXAMPLES.parent / "docs" / "how-to" / "bring-your-own.md").read_text()
    assert re.search(rf"\| {lines} \|[^\n]*`examples/{name}\.py`", table), lines


@pytest.mark.parametrize("name", ["own_action", "own_distances", "own_observation", "own_reward"])
def test_own_parts_of_an_environment_run(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    assert re.search(r"\d\.\d", capsys.readouterr().out)


def test_own_agent_and_policy_play() -> None:
    for name, attribute in zip(OWN, ("ReachForIt", "Learned"), strict=True):
        agent = make_agent(f"{EXAMPLES}/{name}.py:{attribute}")
        evaluation = evaluate(agent, episodes=3, bank="mini", num_envs=3)
        assert evaluation.failures == 0
        assert all(r.joint_length > 0.1 for r in evaluation.records)


def test_without_a_scan_the_camera_is_all_that_counts(scene: Scene) -> None:
    def actions(known: Scene) -> list[np.ndarray]:
        agent, taken = make_agent(f"{EXAMPLES}/without_scan.py:ExploringAgent"), []
        env = GreenhouseEnv(bank="mini", **agent.env_options)
        observation, info = env.reset(options={"scene": scene, "target": 4})
        agent.reset(Problem(known, 4, env.robot, env.start, seed=5))
        over = False
        while not over:
            taken.append(agent.act(observation))
            observation, _, terminated, truncated, info = env.step(taken[-1])
            over = terminated or truncated
        assert info["is_success"]
        return taken

    bare = scene.model_copy(update={"stems": (), "clutter": (), "occupancy": None})
    np.testing.assert_array_equal(actions(scene), actions(bare))


def test_own_learner_prints_its_rate(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(EXAMPLES / "own_learner.py"), run_name="__main__")
    assert "of 16" in capsys.readouterr().out


@pytest.mark.parametrize("name", MAIN)
def test_example_scripts_run(name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", [name])
    registered = dict(_ALL.registered)
    try:
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    finally:
        _ALL.registered.clear()
        _ALL.registered.update(registered)
    assert {"own_planner": "solved", "own_rig": "4 stations", "own_robot": "easy"}[name] in capsys.readouterr().out


def test_own_crop_goes_all_the_way(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(EXAMPLES / "own_crop.py"))["main"](0.6)
    told = re.search(r"(\d+) balls grown, (\d+) found", capsys.readouterr().out)
    assert told is not None
    assert 4 <= int(told[2]) <= int(told[1]) + 2


def test_own_reader_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for kind, image in (("image", np.zeros((3, 4, 3), np.uint8)), ("range", np.full((3, 4), 5000, np.uint16))):
        for i in range(2):
            write_atomically(tmp_path / kind / f"{i}.png", encode_png(image))
    (tmp_path / "camera.txt").write_text("4 3 4.0 4.0 1.5 1.0")
    monkeypatch.setattr("sys.argv", ["own_reader.py", str(tmp_path)])
    runpy.run_path(str(EXAMPLES / "own_reader.py"), run_name="__main__")
    assert capsys.readouterr().out == "2 stations, 12 points at the first, 0.50 m away\n"


def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Its cells run in their order, and it is kept without outputs."""
    cells = json.loads((EXAMPLES / "quickstart.ipynb").read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert not any(cell["outputs"] for cell in code)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for cell in code:
        text = "".join(cell["source"]).replace("STEPS = 4_096", "STEPS = 1_024")
        exec(compile(text, "quickstart.ipynb", "exec"), names)
    assert "solved" in capsys.readouterr().out
    assert (tmp_path / "quickstart.gif").is_file()
