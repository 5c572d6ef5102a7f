"""Images of `render`: independent of other renderers, and by ray casting where OpenGL is missing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.envs import GreenhouseEnv, GreenhouseVectorEnv
from greenhouse_gym.errors import GreenhouseError
from greenhouse_gym.rendering import opengl, viewer
from greenhouse_gym.rendering.renderer import default_camera, render_depth
from greenhouse_gym.scene import SceneBank

SMALL = {"width": 160, "height": 120}  # rays take their time


def moved(bank: SceneBank, seed: int, **keywords: Any) -> GreenhouseEnv:
    """An environment after three steps that bend the arm towards the plants."""
    env = GreenhouseEnv(bank=bank, render_mode="rgb_array", **keywords)
    env.reset(seed=seed)
    for _ in range(3):
        env.step(np.array([0.2 * seed, 1.0, 0.5, 0.0, 0.0, 0.0]))
    return env


def on_red_line(image: np.ndarray) -> np.ndarray:
    """(k, 2) pixels in the red of the line from tip to target, as shares of the picture's size."""
    r, g, b = image.astype(int).transpose(2, 0, 1)
    return np.argwhere((r > 120) & (r > 2.5 * g) & (r > 2.5 * b)) / image.shape[:2]


@pytest.fixture
def without_opengl(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise ImportError("libEGL.so.1: cannot open shared object file")

    monkeypatch.setattr(opengl, "_context_class", missing)


@pytest.mark.usefixtures("without_opengl")
def test_without_opengl_rays_draw_the_picture(bank: SceneBank) -> None:
    env = moved(bank, 0, **SMALL)
    model, _ = env.model_and_data()
    with pytest.raises(opengl.OpenGLMissingError, match=r"libEGL.*apt install"):
        opengl.OpenGLRenderer(model)
    with pytest.warns(viewer.RenderingWarning, match="libEGL"):
        image = env.render()
    assert image.shape == (120, 160, 3)
    assert image.dtype == np.uint8
    assert image.std() > 20
    assert len(on_red_line(image)) > 5
    env.step(np.ones(6))
    assert not np.array_equal(env.render(), image)
    env.close()


@pytest.mark.parametrize("choice", ["osmesa", "nonsense", " EGL ", "off", ""])
def test_mujoco_can_be_imported_whatever_opengl_is_asked_for(choice: str) -> None:
    code = "import greenhouse_gym, mujoco, greenhouse_gym.rendering.opengl"
    environment = {**os.environ, "MUJOCO_GL": choice}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert choice != "nonsense" or "MUJOCO_GL=nonsense does not work here" in done.stderr


@pytest.mark.usefixtures("without_opengl")
@pytest.mark.filterwarnings("ignore:images are drawn by ray casting")
def test_rays_and_opengl_see_the_same_scene(bank: SceneBank, monkeypatch: pytest.MonkeyPatch) -> None:
    cast = moved(bank, 1, **SMALL).render()
    monkeypatch.undo()
    env = moved(bank, 1, **SMALL)
    drawn = env.render()
    if env._viewer._gl is None:
        pytest.skip("no OpenGL here")
    env.close()
    ends = [(line.min(axis=0), line.max(axis=0)) for line in map(on_red_line, (cast, drawn))]
    np.testing.assert_allclose(ends[0], ends[1], atol=0.03)
    sky = moved_depth(bank, 1) == 0
    assert 0.2 < sky.mean() < 0.8
    np.testing.assert_allclose(drawn[sky].mean(axis=0), cast[sky].mean(axis=0), atol=2)
    np.testing.assert_allclose(drawn[~sky].mean(axis=0), cast[~sky].mean(axis=0), rtol=0.06)
    off = np.abs(drawn.astype(int) - cast)
    assert np.median(off) <= 2
    assert off.mean() < 8  # edges


def moved_depth(bank: SceneBank, seed: int) -> np.ndarray:
    env = moved(bank, seed)
    model, data = env.model_and_data()
    return render_depth(model, data, default_camera(env.scene.placement), **SMALL)


def test_every_thread_draws_the_same(bank: SceneBank) -> None:
    env = moved(bank, 0)
    here = env.render()
    with ThreadPoolExecutor(1) as pool:
        for _ in range(2):
            np.testing.assert_array_equal(pool.submit(env.render).result(), here)
    np.testing.assert_array_equal(env.render(), here)
    env.close()


def in_a_forked_process(work: Callable[[], str]) -> str:
    """Return the result of ``work`` in a fork of this process, or that it hung."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        signal.alarm(60)
        try:
            os.write(write, work().encode())
        finally:
            os._exit(0)
    os.close(write)
    with os.fdopen(read) as pipe:
        result = pipe.read()
    os.waitpid(child, 0)
    return result or "it hung"


def test_a_forked_process_steps_and_draws_or_says_why_not(bank: SceneBank) -> None:
    env = GreenhouseEnv(bank=bank, render_mode="rgb_array")
    env.reset(seed=0)
    env.render()
    many = GreenhouseVectorEnv(2, bank=bank)
    many.reset(seed=0)

    def single() -> str:
        env.step(np.zeros(6))
        env.reset()
        env.close()
        env.reset()
        with pytest.warns(viewer.RenderingWarning, match="forked"):
            return str(env.render().shape)

    def vector() -> str:
        try:
            many.step(np.zeros((2, 6)))
        except GreenhouseError as error:
            return str(error)
        return "stepped"

    assert in_a_forked_process(single) == "(480, 640, 3)"
    assert "spawn" in in_a_forked_process(vector)
    many.step(np.zeros((2, 6)))
    assert env.render().std() > 20
    env.close()


def test_environments_draw_side_by_side(bank: SceneBank) -> None:
    alone = []
    for seed in range(3):
        env = moved(bank, seed)
        alone.append(env.render())
        env.close()
    assert not np.array_equal(alone[0], alone[1])
    together = [moved(bank, seed) for seed in range(3)]
    for _ in range(2):
        for env, image in zip(together, alone, strict=True):
            np.testing.assert_array_equal(env.render(), image)
    together[0].close()
    for env, image in zip(together[1:], alone[1:], strict=True):
        np.testing.assert_array_equal(env.render(), image)
        env.close()


def test_a_vector_environment_draws_each_simulation(bank: SceneBank) -> None:
    venv = GreenhouseVectorEnv(3, bank=bank, render_mode="rgb_array")
    venv.reset(seed=4)
    images = venv.render()
    assert images is not None
    single = GreenhouseEnv(bank=bank, render_mode="rgb_array")
    for i, image in enumerate(images):
        single.reset(seed=4 + i)
        np.testing.assert_array_equal(image, single.render())
    single.close()
    venv.close()


def test_depth_needs_no_opengl(bank: SceneBank, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opengl, "_context_class", lambda: pytest.fail("asked for OpenGL"))
    env = GreenhouseEnv(bank=bank, render_mode="depth_array")
    env.reset(seed=0)
    depth = env.render()
    assert depth.dtype == np.float32
    assert depth.shape == (480, 640)
    assert 0.3 < np.median(depth[depth > 0]) < 6.0
