"""Draw the moving pictures of README and of the gallery, in docs/gallery/.

python -m benchmarks.agents.moving_picture --picture two-agents
python -m benchmarks.agents.moving_picture --picture vector

``two-agents`` shows the same tomato in the true row twice: left a plan made on the scan alone, right the agent that
looks before it moves. ``vector`` shows 64 simulations of one vector environment, which a learned policy controls. The
other films of the gallery are made by ``greenhouse-gym watch``. Takes some minutes.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import zip_longest
from typing import Any

import gymnasium
import numpy as np
from PIL import Image, ImageDraw

from benchmarks.common import ROOT, parser
from greenhouse_gym.agents import Problem, make_agent
from greenhouse_gym.agents.agent import options_for
from greenhouse_gym.rendering.picture_files import write_film
from greenhouse_gym.rendering.renderer import Viewpoint

GALLERY = ROOT / "docs" / "gallery"
SCENE, TARGET = "own-cherry-2034-w02-00", 53
AGENTS = {"ShortcutConnect": "plans on the scan alone", "watchful": "looks before it moves"}
VIEW = Viewpoint((-1.0, -1.55, 1.75), (0.3, 0.0, 1.2), 50.0)
WIDTH, HEIGHT, TITLE = 400, 420, 26
REACHED, COLLIDED, TEXT = (46, 158, 91), (214, 66, 50), (60, 60, 60)
EVERY, HOLD = 2, 18  # actions between two images, and images for which the end stays

TILE, TILES, EVERY_OF_TILES = (72, 60), 8, 4
"""Size of one of the simulations, pixels; number of them along each side; actions between two images."""


def episode(name: str, title: str) -> Iterator[Image.Image]:
    """Yield the images of an agent's episode in the true row, its title and outcome above them."""
    agent = make_agent(name)
    options = options_for(agent, {"scene": SCENE, "target": TARGET, "physics": "truth"})
    env = gymnasium.make(
        "TomatoReach-v0", render_mode="rgb_array", width=WIDTH, height=HEIGHT, camera=VIEW, **options
    ).unwrapped
    observation, info = env.reset(seed=0)
    agent.reset(Problem.of(env.simulation, 0, 0))
    over = False
    yield titled(env.render(), title, TEXT)
    while not over:
        observation, _, terminated, truncated, info = env.step(agent.act(observation))
        over = terminated or truncated
        if over:
            ended = "reaches the tomato" if info["is_success"] else "hits a leaf"
            yield titled(env.render(), f"{title}: {ended}", REACHED if info["is_success"] else COLLIDED)
        elif info["steps"] % EVERY == 0:
            yield titled(env.render(), title, TEXT)
    env.close()


def titled(image: Any, title: str, color: tuple[int, int, int]) -> Image.Image:
    """Return an image with a title above it."""
    picture = Image.new("RGB", (WIDTH, HEIGHT + TITLE), "white")
    picture.paste(Image.fromarray(image), (0, TITLE))
    ImageDraw.Draw(picture).text((6, 4), title, fill=color, font_size=16)
    return picture


def two_agents() -> Iterator[Any]:
    """Yield images of both agents next to each other; the one that ends first stays."""
    films = [list(episode(name, title)) for name, title in AGENTS.items()]
    for images in zip_longest(*films):
        films = [[image or film[-1]] for image, film in zip(images, films, strict=True)]
        picture = Image.new("RGB", (2 * WIDTH + 6, HEIGHT + TITLE), "white")
        for k, (image,) in enumerate(films):
            picture.paste(image, (k * (WIDTH + 6), 0))
        yield np.asarray(picture)
    for _ in range(HOLD):
        yield np.asarray(picture)


def vector() -> Iterator[Any]:
    """Yield images of 64 simulations until each has ended once; a frame in color shows how."""
    agent = make_agent("ppo-warp-ur5e")
    options = options_for(agent, {"split": "test", "difficulty": "easy"})
    count = TILES**2
    env = gymnasium.make_vec(
        "TomatoReach-v0", num_envs=count, render_mode="rgb_array", width=TILE[0], height=TILE[1], **options
    )
    observations, infos = env.reset(seed=0)
    tiles = list(env.render())
    ended = np.zeros(count, dtype=bool)
    yield mosaic(tiles)
    for step in range(1, 121):
        observations, _, terminated, truncated, infos = env.step(agent.act(observations))
        images = env.render() if step % EVERY_OF_TILES == 0 or (terminated | truncated).any() else None
        for k in np.flatnonzero(~ended):
            if images is not None:
                tiles[k] = images[k]
            if terminated[k] or truncated[k]:
                tiles[k] = framed(tiles[k], REACHED if infos["is_success"][k] else COLLIDED)
        ended |= terminated | truncated
        if step % EVERY_OF_TILES == 0:
            yield mosaic(tiles)
        if ended.all():
            break
    for _ in range(HOLD // 2):
        yield mosaic(tiles)


def framed(image: Any, color: tuple[int, int, int]) -> Any:
    """Return an image with a colored frame."""
    picture = Image.fromarray(image)
    ImageDraw.Draw(picture).rectangle((0, 0, TILE[0] - 1, TILE[1] - 1), outline=color, width=4)
    return np.asarray(picture)


def mosaic(tiles: list[Any]) -> Any:
    """Return the images of all simulations in rows and columns."""
    return np.concatenate([np.concatenate(tiles[k : k + TILES], axis=1) for k in range(0, len(tiles), TILES)])


PICTURES = {"two-agents": (two_agents, 20 / EVERY), "vector": (vector, 20 / EVERY_OF_TILES)}
"""Pictures by name, and their images per second, which show the motion as fast as it is."""


def main() -> None:
    """Play, draw and write a picture."""
    command = parser(__doc__)
    command.add_argument("--picture", choices=PICTURES, default="two-agents")
    name = command.parse_args().picture
    images, fps = PICTURES[name]
    written = write_film(images(), GALLERY / f"{name}.webp", fps)
    print(f"{written}: {written.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
