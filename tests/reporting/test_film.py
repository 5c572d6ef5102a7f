from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from still_agent import StillAgent

from greenhouse_gym.errors import InvalidValueError, MissingDependencyError, UnknownNameError
from greenhouse_gym.evaluation import AgentError
from greenhouse_gym.rendering.viewer import Picture
from greenhouse_gym.reporting.film import film, outcome
from greenhouse_gym.scene import SceneBank

SMALL: dict[str, Any] = {"picture": Picture(96, 72), "split": "train", "step_limit": 4}


def frames(path: Path) -> list[tuple[np.ndarray, float]]:
    """The images of a GIF or WebP and the milliseconds that each stays."""
    with Image.open(path) as picture:
        found = []
        for k in range(picture.n_frames):
            picture.seek(k)
            picture.load()
            found.append((np.asarray(picture.convert("RGB")), picture.info["duration"]))
    return found


@pytest.mark.filterwarnings("error:.*Overwriting")
def test_an_episode_becomes_a_film(bank: SceneBank, tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    (filmed,) = film(StillAgent(), tmp_path / "still.mp4", bank=bank, **SMALL)
    assert not filmed.success
    assert filmed.outcome.startswith("ended ")
    assert (tmp_path / "still.mp4").read_bytes()[4:8] == b"ftyp"
    assert [path.name for path in tmp_path.iterdir()] == ["still.mp4"]


def test_a_gif_is_one_and_holds_the_outcome_for_a_second(bank: SceneBank, tmp_path: Path) -> None:
    filmed = film(StillAgent(), tmp_path / "still.GIF", bank=bank, episodes=2, **SMALL)
    assert len(filmed) == 2
    assert filmed[0].title != filmed[1].title
    assert (tmp_path / "still.GIF").read_bytes()[:3] == b"GIF"
    shown = frames(tmp_path / "still.GIF")
    assert [duration for _, duration in shown].count(1000) >= 2
    assert shown[0][0].shape == (72, 96, 3)
    assert sum(duration for _, duration in shown) == pytest.approx(2 * (4 * 50 + 1000))


@pytest.mark.parametrize("name", ["still.gif", "still.webp"])
def test_images_per_second_leave_the_time_as_it_is(name: str, bank: SceneBank, tmp_path: Path) -> None:
    film(StillAgent(), tmp_path / name, bank=bank, fps=10, **SMALL)
    assert sum(duration for _, duration in frames(tmp_path / name)) == pytest.approx(2 * 100 + 1000)


def test_one_scene_and_one_target(bank: SceneBank, tmp_path: Path) -> None:
    name = bank.names("train")[0]
    (filmed,) = film(StillAgent(), tmp_path / "a.gif", bank=bank, scene=name, target=3, **SMALL)
    assert filmed.title.startswith(f"still: {name}, tomato 3 (")
    with pytest.raises(UnknownNameError, match="no-such"):
        film(StillAgent(), tmp_path / "a.gif", bank=bank, scene="no-such", **SMALL)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"fps": 25}, "at most 20"),
        ({"fps": 0}, "above 0"),
        ({"fps": float("nan")}, "above 0"),
        ({"episodes": 0}, "episodes"),
        ({"target": 1}, "scene"),
    ],
)
def test_what_is_asked_for_is_checked(bank: SceneBank, tmp_path: Path, keywords: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        film(StillAgent(), tmp_path / "a.gif", bank=bank, **{**SMALL, **keywords})
    assert not list(tmp_path.iterdir())


def test_the_suffix_chooses_the_format_before_anything_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InvalidValueError, match=r"\.mp4 or \.gif"):
        film(StillAgent(), tmp_path / "a.avi", bank="no-such-bank")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingDependencyError, match="viz"):
        film(StillAgent(), tmp_path / "a.mp4", bank="no-such-bank")


class Failing(StillAgent):
    name = "failing"

    def __init__(self, after: int):
        self.left = after

    def act(self, observation: Any) -> np.ndarray:
        self.left -= 1
        return np.zeros(6) if self.left >= 0 else np.zeros(5)


def test_an_agent_that_fails_gives_up_or_never_began(bank: SceneBank, tmp_path: Path) -> None:
    (filmed,) = film(Failing(2), tmp_path / "a.gif", bank=bank, **SMALL)
    assert filmed.outcome.startswith("gave up after 2 actions: InvalidValueError")
    with pytest.raises(AgentError, match="failing"):
        film(Failing(0), tmp_path / "b.gif", bank=bank, **SMALL)
    assert not (tmp_path / "b.gif").exists()


def test_options_must_agree_with_the_agent(bank: SceneBank, tmp_path: Path) -> None:
    agent = StillAgent()
    agent.env_options = {"robot": "ur5e"}
    with pytest.raises(InvalidValueError, match="robot"):
        film(agent, tmp_path / "a.gif", bank=bank, robot="iiwa14", **SMALL)


@pytest.mark.parametrize(
    ("ended", "text"),
    [
        ((True, False, ("",), 30, 0.0), "reached it after 30 actions"),
        ((True, False, ("",), 700, 0.0, "", {"crated": 6.0, "wanted": 6.0}), "6 of 6 in the crate after 700 actions"),
        ((False, True, ("cup", "string"), 9, 0.1, "", {"crated": 1.0, "wanted": 6.0}),
         "hit string with its cup after 9 actions, 1 of 6 in the crate"),
    ],
)  # fmt: skip
def test_outcomes_of_harvests_count_the_fruit_in_the_crate(ended: tuple[Any, ...], text: str) -> None:
    assert outcome(*ended) == text
