"""What `render` gives: the same picture whoever else draws, and one by ray casting where there is no OpenGL."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from greenhouse_gym.envs import TomatoReachEnv, TomatoReachVectorEnv, viewer
from greenhouse_gym.scene import SceneBank, opengl


def moved(bank: SceneBank, seed: int, **keywords: Any) -> TomatoReachEnv:
    """An environment after three steps that bend the arm towards the plants."""
    env = TomatoReachEnv(bank=bank, render_mode="rgb_array", **keywords)
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
    monkeypatch.setattr(viewer, "WIDTH", 160)  # rays take their time
    monkeypatch.setattr(viewer, "HEIGHT", 120)


@pytest.mark.usefixtures("without_opengl")
def test_without_opengl_rays_draw_the_picture(bank: SceneBank) -> None:
    env = moved(bank, 0)
    model, _ = env.model_and_data()
    with pytest.raises(opengl.OpenGLMissingError, match=r"libEGL.*apt install"):
        opengl.OpenGLRenderer(model)
    image = env.render()
    assert image.shape == (120, 160, 3)
    assert image.dtype == np.uint8
    assert image.std() > 20
    assert len(on_red_line(image)) > 5
    env.step(np.ones(6))
    assert not np.array_equal(env.render(), image)
    env.close()


@pytest.mark.usefixtures("without_opengl")
def test_rays_and_opengl_see_the_same_scene(bank: SceneBank, monkeypatch: pytest.MonkeyPatch) -> None:
    cast = moved(bank, 1).render()
    monkeypatch.undo()
    monkeypatch.setattr(viewer, "WIDTH", 160)
    monkeypatch.setattr(viewer, "HEIGHT", 120)
    env = moved(bank, 1)
    drawn = env.render()
    if env._viewer._gl is None:
        pytest.skip("no OpenGL here")
    env.close()
    # Light and shade differ; what is seen where does not.
    ends = [(line.min(axis=0), line.max(axis=0)) for line in map(on_red_line, (cast, drawn))]
    np.testing.assert_allclose(ends[0], ends[1], atol=0.03)


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
    venv = TomatoReachVectorEnv(3, bank=bank, render_mode="rgb_array")
    venv.reset(seed=4)
    images = venv.render()
    assert images is not None
    single = TomatoReachEnv(bank=bank, render_mode="rgb_array")
    for i, image in enumerate(images):
        single.reset(seed=4 + i)
        np.testing.assert_array_equal(image, single.render())
    single.close()
    venv.close()


def test_depth_needs_no_opengl(bank: SceneBank, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opengl, "_context_class", lambda: pytest.fail("asked for OpenGL"))
    env = TomatoReachEnv(bank=bank, render_mode="depth_array")
    env.reset(seed=0)
    depth = env.render()
    assert depth.dtype == np.float32
    assert depth.shape == (480, 640)
    assert 0.3 < np.median(depth[depth > 0]) < 6.0
