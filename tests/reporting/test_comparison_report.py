"""The page that `compare --report` and `leaderboard --report` write."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from html_pages import HOSTILE, Page
from matplotlib.figure import Figure
from still_agent import STILL, StillAgent
from typer.testing import CliRunner

from greenhouse_gym.agents import RandomAgent, StraightLineAgent
from greenhouse_gym.cli import app
from greenhouse_gym.errors import FileWriteError, InvalidValueError
from greenhouse_gym.evaluation import retrace
from greenhouse_gym.evaluation.leaderboard import CURRENT, submit
from greenhouse_gym.evaluation.records import Evaluation, Record
from greenhouse_gym.reporting.comparison import comparison_page, dividing_episodes
from greenhouse_gym.reporting.comparison_figures import (
    SUCCESSES_BY_ACTIONS,
    arm_part,
    colors_of,
    first_motion,
    obstacle_kind,
)
from greenhouse_gym.reporting.plots import logarithmic
from greenhouse_gym.reporting.scene_page import Motion, Replay, scene_page
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)


def record(seed: int, success: bool, contact: tuple[str, ...] = (), **changes: object) -> Record:
    steps = 10 * (seed + 1)
    plain = Record(
        seed, f"scene-{seed}", 0, "easy" if seed % 2 else "hard", success, bool(contact), contact, steps, 0.5, 0.001,
        1.0, 1.0, 0.01, 0.001, 1.0, 0.01,
    )  # fmt: skip
    return replace(plain, **changes)  # type: ignore[arg-type]


def evaluation(agent: str, successes: str) -> Evaluation:
    """An episode per letter: s is a success, c a collision."""
    contact = {"c": ("forearm", "stem_3_main")}
    return Evaluation(agent, tuple(record(k, s == "s", contact.get(s, ())) for k, s in enumerate(successes)))


def frames(page: str) -> list[str]:
    """The pages in the frames of a page."""
    return [attributes["srcdoc"] or "" for attributes in Page(page).all("iframe")]


def data_of(scene: str) -> dict[str, object]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', scene, re.S)
    assert found
    return dict(json.loads(found[1]))


# -- which episodes, and figures --------------------------------------------------------------------------------------


def test_episodes_that_divide_the_agents_come_first() -> None:
    played = {"a": "ssss.s", "b": "ss..cs", "c": "s....s", "d": "scs..s"}
    agents = [evaluation(name, successes) for name, successes in played.items()]
    assert [r.seed for r in dividing_episodes(agents, 4)] == [1, 2, 3, 0]
    assert [r.scene for r in dividing_episodes(agents, 1)] == ["scene-1"]
    short = Evaluation("e", agents[0].records[2:4])
    assert [r.seed for r in dividing_episodes([*agents, short])] == [2, 3], "only what all of them played"


def test_what_collides_with_what() -> None:
    kinds = {
        ("rod", "tomato_35"): "tomato",
        ("wrist_3", "clutter_2"): "clutter",
        ("cup", "stem_12_peduncle"): "peduncle stem",
        ("forearm", "floor"): "floor",
        ("rod", "cart"): "cart",
        ("rod", "upper_arm"): "the arm itself",
    }
    for contact, kind in kinds.items():
        assert obstacle_kind(record(0, False, contact)) == kind
        assert arm_part(record(0, False, contact)) == contact[0]


def test_curves_are_stairs_of_successes() -> None:
    agents = [evaluation("a", "s.s."), evaluation("b", "....")]
    axes = Figure().add_subplot()
    SUCCESSES_BY_ACTIONS.draw(axes, agents, colors_of(["a", "b"]))
    one, other = axes.lines
    assert one.get_drawstyle() == "steps-post"
    assert one.get_xydata().tolist() == [[0, 0], [10, 0.25], [30, 0.5], [40, 0.5]]
    assert set(other.get_ydata()) == {0.0}, "nothing reached, nothing risen"
    assert axes.get_xlim() == (0, 40)
    assert axes.get_ylim() == (0, 1)


def test_the_first_motion_waits_for_the_plan_and_an_action() -> None:
    assert first_motion(record(0, True)) == pytest.approx(0.501)


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0.03, 21.0, [0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20]), (0.9e-4, 11.0, [1e-4, 1e-3, 0.01, 0.1, 1, 10])],
)
def test_ticks_of_a_logarithmic_axis(low: float, high: float, expected: list[float]) -> None:
    axes = Figure().add_subplot()
    logarithmic(axes, low, high)
    ticks = axes.get_xticks()
    np.testing.assert_allclose(ticks[(ticks >= low) & (ticks <= high)], expected)


# -- the page ---------------------------------------------------------------------------------------------------------


def page_of(tracks: dict[str, list[Evaluation]]) -> str:
    return comparison_page("A & B", tracks, colors_of([e.agent for es in tracks.values() for e in es]), ["a note"])


def test_the_page_has_all_figures_of_each_track() -> None:
    tracks = {
        "reconstruction": [evaluation("a", "ssssssss"), evaluation("b", "cc.....c"), Evaluation("c", (), "it broke")],
        "truth": [evaluation("a", "s......."), evaluation("b", "........")],
    }
    html = page_of(tracks)
    parsed = Page(html)
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", line) for line in html.splitlines()]
    assert ["a", "8", "100.0% [67.6, 100.0]", "100%", "100%", "0.0%"] in [row[:6] for row in rows]
    assert ["a", "b", "8 of 8", "0 of 8", "0.0078", "a is better"] in rows
    assert ["a", "b", "1 of 8", "0 of 8", "1", "may be equally good"] in rows
    assert ["main stem", "", "3", ""] in rows
    assert ["forearm", "", "3", ""] in rows
    assert ["a", "501", "501", "501"] in rows
    assert "c: it broke" in parsed.texts
    assert {"Success by track", "Track reconstruction", "Track truth"} <= set(parsed.texts)
    assert len(parsed.all("svg")) == 1 + 2 * 4
    assert "Success by track" not in Page(page_of({"truth": tracks["truth"]})).texts


def test_nothing_is_loaded_and_all_text_is_escaped(scene: Scene) -> None:
    hostile = {"truth": [evaluation(HOSTILE, "s."), replace(evaluation("b", ""), error=HOSTILE)]}
    parsed = Page(comparison_page(HOSTILE, hostile, colors_of([HOSTILE, "b"]), [HOSTILE], HOSTILE))
    assert parsed.texts.count(HOSTILE) >= 5
    assert not parsed.all("script")
    for html in (page_of(hostile), scene_page(scene, get_robot("ur5e"), replay_in(scene, HOSTILE))):
        outer = Page(html)
        assert not outer.all("link")
        assert not outer.all("img")
        assert not [a for _, a in outer.tags if {"src", "href"} & set(a)]
        (policy,) = (m["content"] for m in outer.all("meta") if m.get("http-equiv") == "Content-Security-Policy")
        assert policy is not None
        assert policy.startswith("default-src 'none'")
        assert "http" not in policy


def test_many_pairs_are_folded_away() -> None:
    agents = [evaluation(name, "s.") for name in "abcdef"]
    assert "15 pairs" in Page(page_of({"truth": agents})).texts
    assert not Page(page_of({"truth": agents[:3]})).all("details")


def replay_in(scene: Scene, name: str = "left") -> Replay:
    start = get_robot("ur5e").start
    turned = [start + k * np.array([step, 0.02, 0, 0, 0, 0]) for step in (0.05, -0.05) for k in range(20)]
    left, right = np.array(turned[:20]), np.array(turned[20:])
    motions = Motion(name, left, (1.0, 0.0, 0.0), "reached"), Motion("right", right, (0.0, 0.0, 1.0))
    return Replay("seed 1", 2, motions)


def test_a_scene_shows_the_ways_of_all_agents_together(scene: Scene) -> None:
    html = scene_page(scene, get_robot("ur5e"), replay_in(scene))
    data = data_of(html)
    assert data["together"] is True
    assert [m["name"] for m in data["motions"]] == ["left", "right"]  # type: ignore[attr-defined]
    assert [layer["name"] for layer in data["layers"]] == ["reconstruction", "target"]  # type: ignore[attr-defined]
    texts = Page(html).texts
    assert texts[texts.index("left") + 1] == "reached"


@pytest.mark.skipif(BROWSER is None, reason="no Chromium to open the page in")
def test_a_browser_draws_the_ways_in_their_colors(scene: Scene, tmp_path: Path) -> None:
    """In a frame of the page, whose rules about what may run the frame takes over."""
    tracks = {"reconstruction": [evaluation("left", "s"), evaluation("right", "c")]}
    shown = [("Seed 1", scene_page(scene, get_robot("ur5e"), replay_in(scene)))]
    file, picture = tmp_path / "page.html", tmp_path / "page.png"
    file.write_text(comparison_page("p", tracks, colors_of(["left", "right"]), (), "", shown))
    assert BROWSER is not None
    options = ["--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    options += ["--window-size=1100,2600", "--virtual-time-budget=3000", "--enable-logging=stderr", "--hide-scrollbars"]
    command = [BROWSER, *options, f"--user-data-dir={tmp_path / 'user'}", f"--screenshot={picture}", file.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert picture.is_file(), done.stderr
    assert not console
    image = cv2.imread(str(picture))[:, 450:].astype(int)  # beside the panel, which shows the colors as well
    for strong, weak in ((2, 0), (0, 2)):  # red and blue, as OpenCV orders them
        pure = (image[..., strong] > 250) & (image[..., weak] < 5) & (image[..., 1] < 5)
        assert pure.sum() > 20, "a way of the tip is missing"


# -- the commands -----------------------------------------------------------------------------------------------------


def run(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output + repr(result.exception)
    return result.output


def test_compare_writes_a_page_with_episodes_played_again(bank: SceneBank, tmp_path: Path) -> None:
    out = tmp_path / "new" / "report.html"
    arguments = ("--bank", bank.path, "--episodes", 3, "--seed", 5, "--report", out)
    assert f"report in {out}\n" in run("compare", "straight-line", "random", *arguments)
    html = out.read_text()
    assert "split test, seeds 5 to 7." in html
    scenes = frames(html)
    assert len(scenes) == 3
    agents = [StraightLineAgent(), RandomAgent()]
    ways = [retrace(agent, [5, 6, 7], bank=bank) for agent in agents]
    numbers = [int(m) for m in re.findall(r"<h3>Seed (\d)", html)]
    assert sorted(numbers) == [5, 6, 7]
    for number, scene in zip(numbers, scenes, strict=True):
        motions = data_of(scene)["motions"]
        assert [m["name"] for m in motions] == ["straight-line", "random"]  # type: ignore[attr-defined]
        for motion, traces in zip(motions, ways, strict=True):  # type: ignore[call-overload]
            np.testing.assert_allclose(motion["path"], traces[number - 5].joints, atol=1e-5)


def test_a_report_that_cannot_be_written_is_refused_before_the_episodes(bank: SceneBank, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["compare", "random", "--bank", str(bank.path), "--report", str(tmp_path)])
    assert isinstance(result.exception, FileWriteError)
    assert "random" not in result.output


def test_what_was_played_before_an_interruption_is_reported(
    bank: SceneBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(self: StillAgent, problem: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(StillAgent, "reset", interrupted)
    out = tmp_path / "report.html"
    arguments = ["--bank", str(bank.path), "--episodes", "2", "--report", str(out)]
    assert CliRunner().invoke(app, ["compare", "random", STILL, *arguments]).exit_code == 130
    parsed = Page(out.read_text())
    assert "random" in parsed.texts
    assert not parsed.all("iframe")


def test_what_was_played_is_reported_even_if_an_episode_cannot_be_played_again(
    bank: SceneBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("greenhouse_gym.reporting.comparison.retrace", lost)
    out = tmp_path / "report.html"
    arguments = ["--bank", str(bank.path), "--episodes", "1", "--report", str(out)]
    assert CliRunner().invoke(app, ["compare", "random", *arguments]).exit_code == 130
    assert "random" in Page(out.read_text()).texts


def test_the_leaderboard_has_a_page_too(tmp_path: Path) -> None:
    trial = submit(RandomAgent(), "random", tmp_path, ["reconstruction"], replace(CURRENT, episodes=2), note="dice")
    out = tmp_path / "page.html"
    refused = CliRunner().invoke(app, ["leaderboard", str(tmp_path), "--report", str(out)])
    assert isinstance(refused.exception, InvalidValueError), "a trial alone gives no page"
    entry = json.loads(trial.read_text())
    entry["protocol"]["episodes"] = CURRENT.episodes  # as if there were so many
    columns = {name: values * (CURRENT.episodes // 2) for name, values in entry["tracks"]["reconstruction"].items()}
    entry["tracks"]["reconstruction"] = columns | {"seed": list(range(CURRENT.episodes))}
    for name in ("random", STILL, "gone.py:Agent"):  # who played does not matter here
        (tmp_path / f"{name[:5]}.json").write_text(json.dumps({**entry, "agent": name}))
    run("leaderboard", tmp_path, "--report", out)
    html = out.read_text()
    assert "<h1>Leaderboard, protocol v2</h1>" in html
    assert "random: dice" in html
    assert "gone.py:Agent is not shown in 3-D: gone.py: there is no such file" in html
    assert [[m["name"] for m in data_of(f)["motions"]] for f in frames(html)] == [["random", STILL]] * 4  # type: ignore[attr-defined]
