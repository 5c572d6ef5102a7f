"""Your own crop: red balls on sticks, grown, photographed, reconstructed and reached for, in a few minutes.

python examples/own_crop.py
"""

import sys
import tempfile

import gymnasium
import numpy as np

import greenhouse_gym  # noqa: F401  (registers the environment)
from greenhouse_gym.build import BuildSettings, build_bank
from greenhouse_gym.capture import simulate_recording
from greenhouse_gym.crops import Crop, PlantMotion, PlantRow
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.envs import Randomization
from greenhouse_gym.geometry import Sphere
from greenhouse_gym.shapes import ShapeSettings


def grow_sticks(seed: int, length: float, week: int, style: object, stem_line: float) -> PlantRow:
    """Grow a row with a stick every 30 cm and three balls per stick, on twigs towards the aisle."""
    rng = np.random.default_rng(seed)
    balls, sticks = [], []
    for plant, y in enumerate(np.arange(0.15, length, 0.3)):
        sticks.append(Stem([stem_line, y, 0.4], [stem_line, y, 1.8], 0.007, "main"))
        for z in np.array([0.8, 1.05, 1.3]) + rng.uniform(-0.08, 0.08, 3):
            twig = np.array([stem_line - 0.06, y + rng.uniform(-0.03, 0.03), z])
            sticks.append(Stem([stem_line, y, z], twig, 0.002, "peduncle"))
            balls.append(Tomato(Sphere(twig - [0.03, 0.0, 0.0], 0.03), plant, ripeness=1.0))
    return PlantRow(tuple(balls), tuple(sticks), (), length, week)


BALLS = Crop("balls", {"sticks": grow_sticks}, shape_settings={"radii": (0.02, 0.04)}, motion=PlantMotion(0.02, 0.02))


def main(length: float) -> None:
    """Build a bank of one row and reach for its balls, which have moved since the scan."""
    row = BALLS.grow(seed=1, length=length)
    settings = BuildSettings(shapes=ShapeSettings(**BALLS.shape_settings), max_targets=2)
    with tempfile.TemporaryDirectory() as folder:
        bank = build_bank([simulate_recording(row, seed=1)], folder, BALLS.name, settings=settings)
        moving = Randomization(plants=BALLS.motion)
        env = gymnasium.make("TomatoReach-v0", bank=bank, physics="truth", randomization=moving)
        _, info = env.reset(seed=0)
        print(f"{len(row.tomatoes)} balls grown, {len(bank[0].tomatoes)} found; {info['distance']:.2f} m to the first")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 1.0)
