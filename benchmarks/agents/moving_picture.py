"""Draw the moving picture of README: an arm reaches a tomato; left the reconstruction it plans in, right the true row.

python -m benchmarks.agents.moving_picture --scene own-cluster-2024-w00-01 --target 12

The episode is played with ``physics="truth"``, so the arm moves as it does among the true plants, and it must reach the
tomato. Writes benchmarks/results/reaching.gif. Takes a minute.
"""

from __future__ import annotations

import io

import gymnasium
import mujoco
import numpy as np
from PIL import Image, ImageDraw

from benchmarks.common import RESULTS, parser
from greenhouse_gym.agents import PlannerAgent, Problem
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.errors import GreenhouseError
from greenhouse_gym.geometry import Array
from greenhouse_gym.rendering.opengl import OpenGLMissingError, OpenGLRenderer
from greenhouse_gym.rendering.renderer import Viewpoint, render_scene
from greenhouse_gym.rendering.task_pictures import task_lines
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene, SceneBank, compile_scene
from greenhouse_gym.scene.truth import true_scene

WIDTH, HEIGHT = 400, 400
VIEW = Viewpoint((-1.0, -1.75, 1.7), (0.22, -0.1, 1.15), 46.0)
EVERY = 2  # steps of the environment between two frames
DURATION, HOLD = 100, 1500  # ms for which a frame is shown, and the last one


def play(scene: Scene, target: int) -> tuple[Robot, list[Array]]:
    """Return the joint angles of an episode that reaches its target.

    Raises:
        GreenhouseError: The target was not reached.
    """
    agent = PlannerAgent("ShortcutConnect", time_limit=None, max_checks=20_000)
    env = gymnasium.make("TomatoReach-v0", physics="truth").unwrapped
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


def frames(world: Scene, robot: Robot, goal: Array, path: list[Array]) -> list[Image.Image]:
    """Draw the arm along a path among the shapes of a world, with the path of its tip so far and the goal (3,)."""
    compiled = compile_scene(world, robot, capacity=max(300, len(world.obstacles)))
    model, data = compiled.model, mujoco.MjData(compiled.model)
    try:
        renderer: OpenGLRenderer | None = OpenGLRenderer(model, WIDTH, HEIGHT)
    except OpenGLMissingError:
        renderer = None
    trace: list[Array] = []
    drawn = []
    for joints in path:
        data.qpos[:] = joints
        mujoco.mj_forward(model, data)
        trace.append(data.site_xpos[compiled.tip_site].copy())
        lines = task_lines(trace[-1], goal, trace)
        if renderer is None:
            drawn.append(Image.fromarray(render_scene(model, data, VIEW, WIDTH, HEIGHT, lines)))
        else:
            drawn.append(Image.fromarray(renderer.picture(model, data, VIEW, lines)))
    return drawn


def main() -> None:
    """Play, draw and write the picture."""
    command = parser(__doc__)
    command.add_argument("--scene", default="own-cluster-2024-w00-01")
    command.add_argument("--target", type=int, default=12)
    arguments = command.parse_args()
    scene = SceneBank.open("default").scene(arguments.scene)
    robot, joints = play(scene, arguments.target)
    path = [*joints[:-1:EVERY], joints[-1]]
    goal, truth = scene.tomatoes[arguments.target].center, true_scene(scene)
    true_goal = min((tomato.center for tomato in truth.tomatoes), key=lambda c: float(np.linalg.norm(c - goal)))
    panels = {
        "the scan, which the arm knows": frames(scene, robot, goal, path),
        "the true row": frames(truth, robot, true_goal, path),
    }
    pictures = []
    for k in range(len(path)):
        picture = Image.new("RGB", (2 * WIDTH + 4, HEIGHT + 22), "white")
        for column, (title, drawn) in enumerate(panels.items()):
            picture.paste(drawn[k], (column * (WIDTH + 4), 22))
            ImageDraw.Draw(picture).text((column * (WIDTH + 4) + 6, 4), title, fill=(40, 40, 40), font_size=13)
        pictures.append(picture)
    palette = pictures[-1].quantize(96, dither=Image.Dither.NONE)
    first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    file = io.BytesIO()
    first.save(
        file,
        "gif",
        save_all=True,
        append_images=others,
        duration=[DURATION] * len(others) + [HOLD],
        loop=0,
        optimize=True,
    )
    written = write_atomically(RESULTS / "reaching.gif", file.getvalue())
    print(f"{written}: {len(pictures)} frames, {written.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
