"""The moving picture of README: an arm reaches for a tomato; left the reconstruction it plans in, right the true row.

    python benchmarks/moving_picture.py --scene own-cluster-2024-w00-01 --target 15

The episode is played with ``physics="truth"``, so the arm moves as it does among the true plants. It must reach the
tomato; else the script says how the episode ended and draws nothing. Writes benchmarks/results/reaching.gif.
"""

from __future__ import annotations

import argparse
import io

import gymnasium
import mujoco
import numpy as np
from PIL import Image, ImageDraw
from results_file import RESULTS

from greenhouse_gym.agents import PlannerAgent, Problem
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.errors import GreenhouseError
from greenhouse_gym.geometry import Array
from greenhouse_gym.rendering.opengl import OpenGLMissingError, OpenGLRenderer
from greenhouse_gym.rendering.renderer import Viewpoint, render_scene
from greenhouse_gym.rendering.task_pictures import task_lines
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene, SceneBank, compile_scene
from greenhouse_gym.scene.obstacles import Surroundings

WIDTH, HEIGHT = 400, 400
VIEW = Viewpoint((-1.0, -1.75, 1.7), (0.22, -0.1, 1.15), 46.0)
EVERY = 2  # steps of the environment between two frames
STEP = 0.05  # s from one action to the next
HOLD = 1.5  # s the last frame is shown
COLORS = 96


def play(scene: Scene, target: int, bank: SceneBank) -> tuple[Robot, list[Array]]:
    """Joint angles of an episode that reaches its target.

    Raises:
        GreenhouseError: It does not.
    """
    agent = PlannerAgent("ShortcutConnect", time_limit=None, max_checks=20_000)
    env = gymnasium.make("TomatoReach-v0", bank=bank, physics="truth").unwrapped
    observation, info = env.reset(seed=0, options={"scene": scene.name, "target": target})
    agent.reset(Problem(scene, target, env.robot, env.start))
    joints = [env.model_and_data()[1].qpos.copy()]
    over = False
    while not over:
        observation, _, terminated, truncated, info = env.step(agent.act(observation))
        joints.append(env.model_and_data()[1].qpos.copy())
        over = terminated or truncated
    env.close()
    if not info["is_success"]:
        raise GreenhouseError(f"{scene.name}, tomato {target}: {agent.status}, touched {info['contact'] or 'nothing'}")
    return env.robot, joints


class Panel:
    """One world with the arm in it.

    Args:
        world: The shapes.
        robot: The arm.
        goal: (3,) where the target is in it, metres.
    """

    def __init__(self, world: Surroundings, robot: Robot, goal: Array):
        self._compiled = compile_scene(world, robot, capacity=max(300, len(world.obstacles)))
        self._data = mujoco.MjData(self._compiled.model)
        self._goal, self._trace = goal, list[Array]()
        try:
            self._renderer: OpenGLRenderer | None = OpenGLRenderer(self._compiled.model, WIDTH, HEIGHT)
        except OpenGLMissingError:
            self._renderer = None

    def frame(self, joints: Array) -> Image.Image:
        """The arm at a configuration, with the way of its tip so far."""
        model, data = self._compiled.model, self._data
        data.qpos[:] = joints
        mujoco.mj_forward(model, data)
        tip = data.site_xpos[self._compiled.tip_site].copy()
        self._trace.append(tip)
        lines = task_lines(tip, self._goal, self._trace)
        if self._renderer is None:
            return Image.fromarray(render_scene(model, data, VIEW, WIDTH, HEIGHT, lines))
        return Image.fromarray(self._renderer.picture(model, data, VIEW, lines))


def main() -> None:
    """Play, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="own-cluster-2024-w00-01")
    parser.add_argument("--target", type=int, default=12)
    arguments = parser.parse_args()
    bank = SceneBank.open("default")
    scene = bank.scene(arguments.scene)
    if scene.truth is None:
        raise GreenhouseError(f"{scene.name} carries no truth to draw")
    robot, joints = play(scene, arguments.target, bank)
    goal = scene.tomatoes[arguments.target].center
    nearest = min(scene.truth.tomatoes, key=lambda tomato: float(np.linalg.norm(tomato.center - goal)))
    truth = Surroundings(name=f"{scene.name}-truth", placement=scene.placement, **dict(scene.truth))
    panels = {
        "the scan, which the arm knows": Panel(scene, robot, goal),
        "the true row": Panel(truth, robot, nearest.center),
    }
    frames = []
    for configuration in [*joints[:-1:EVERY], joints[-1]]:
        picture = Image.new("RGB", (2 * WIDTH + 4, HEIGHT + 22), "white")
        for k, (title, panel) in enumerate(panels.items()):
            picture.paste(panel.frame(configuration), (k * (WIDTH + 4), 22))
            ImageDraw.Draw(picture).text((k * (WIDTH + 4) + 6, 4), title, fill=(40, 40, 40), font_size=13)
        frames.append(picture)
    palette = frames[-1].quantize(COLORS, dither=Image.Dither.NONE)
    drawn = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [round(1000 * STEP * EVERY)] * (len(drawn) - 1) + [round(1000 * HOLD)]
    file = io.BytesIO()
    drawn[0].save(file, "gif", save_all=True, append_images=drawn[1:], duration=durations, loop=0, optimize=True)
    path = write_atomically(RESULTS / "reaching.gif", file.getvalue())
    print(f"{path}: {len(drawn)} frames, {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
