"""Measure the processor time of an image by OpenGL, with this package's drawing quality and with MuJoCo's own.

python -m benchmarks.speed.images

Without a GPU, OpenGL draws in software, on the processor. Both qualities take turns, so that other work on the machine
affects them alike. A frame of a film is an action of a random agent, the image, its caption and its encoding. Takes a
minute.
"""

from __future__ import annotations

import resource
import tempfile
from collections.abc import Mapping
from pathlib import Path
from unittest.mock import patch

import gymnasium

from benchmarks.common import RESULTS, parser, write_results
from greenhouse_gym.agents import RandomAgent
from greenhouse_gym.rendering import opengl
from greenhouse_gym.reporting.film import film

MUJOCO: Mapping[str, int] = {"offsamples": 4, "shadowsize": 4096, "numslices": 28, "numstacks": 16, "numquads": 4}
SEEDS = range(2)
SCENE = "own-cherry-2034-w02-03"
HELD = 20  # frames of the last image of an episode


def main() -> None:
    """Measure and write ``benchmarks/results/images.json``."""
    command = parser(__doc__)
    command.add_argument("--images", type=int, default=12, help="images of each kind and seed")
    a = command.parse_args()
    own, usual = [], []
    for seed in SEEDS:
        own.append(image_seconds(opengl._QUALITY, a.images, seed))
        usual.append(image_seconds(MUJOCO, a.images, seed))
    results = {
        "image 640x480": sum(own) / len(own),
        "the same with MuJoCo's own quality": sum(usual) / len(usual),
        "ratio": sum(usual) / sum(own),
        "frame of a film, GIF": film_seconds(".gif"),
        "frame of a film, MP4": film_seconds(".mp4"),
    }
    results = {name: round(value, 4) for name, value in results.items()}
    print(results)
    write_results(RESULTS / "images.json", results)


def image_seconds(quality: Mapping[str, int], images: int, seed: int) -> float:
    """Return the processor seconds of an image after the first, s."""
    with patch.object(opengl, "_QUALITY", quality):
        env = gymnasium.make("TomatoReach-v0", bank="default", render_mode="rgb_array").unwrapped
        env.reset(seed=seed)
        env.render()
        before = spent()
        for _ in range(images):
            env.render()
        seconds = spent() - before
        env.close()
    return seconds / images


def film_seconds(suffix: str) -> float:
    """Return the processor seconds of a frame, from a film of five episodes and one of a single episode, s."""
    seconds, frames = [], []
    with tempfile.TemporaryDirectory() as folder:
        for episodes in (1, 5):
            drawn: list[int] = []
            before = spent()
            film(
                RandomAgent(), Path(folder) / f"film{suffix}", episodes=episodes, step_limit=60, scene=SCENE, target=0,
                on_progress=drawn.append,
            )  # fmt: skip
            seconds.append(spent() - before)
            frames.append(len(drawn) + episodes * HELD)
    return (seconds[1] - seconds[0]) / (frames[1] - frames[0])


def spent() -> float:
    """Return the processor time of this process and its finished children, s."""
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


if __name__ == "__main__":
    main()
