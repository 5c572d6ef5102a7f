"""Search for the ``ready`` start of an arm and print the room that it has at all stands of a bank.

    python training/ready_starts.py --robot iiwa14 --seeds 8

Prints for each candidate the number of scenes in which it touches a plant, and the fraction of scenes in which it keeps
2 cm from all plants, in the reconstruction and in the truth. A start belongs into the key frame ``ready`` of the arm's
file if it touches nothing anywhere.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.clearance import smallest_clearance
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.robots.start import ready_start
from greenhouse_gym.scene import Scene, SceneBank, compile_scene
from greenhouse_gym.scene.truth import true_scene

ROOM = 0.02
"""Clearance that counts as room, metres."""


def main() -> None:
    """Search, measure and print."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("--robot", default="ur5e")
    command.add_argument("--bank", default="default")
    command.add_argument("--seeds", type=int, default=8, help="number of searches; the arm's own start comes first")
    a = command.parse_args()
    robot = get_robot(a.robot)
    found = (ready_start(robot.spec(), robot.lower, robot.upper, robot.foot, seed).round(2) for seed in range(a.seeds))
    candidates = [robot.start, *found]
    rooms = np.array(
        [clearances(scene, robot, candidates) for scene in SceneBank.open(a.bank) if len(scene.tomatoes) > 1]
    )
    for candidate, room in zip(candidates, rooms.transpose(2, 1, 0), strict=True):  # (worlds, scenes)
        contacts, kept = (room <= 0).sum(axis=1), (room >= ROOM).mean(axis=1)
        row = {"start": candidate.tolist(), "contacts": contacts.tolist(), "with_room": kept.round(3).tolist()}
        print(json.dumps(row))


def clearances(scene: Scene, robot: Robot, starts: Sequence[Array]) -> list[list[float]]:
    """Return the clearances of an arm at each start in the reconstruction and in the truth, metres."""
    worlds = [compile_scene(world, robot) for world in (scene, true_scene(scene) if scene.truth else scene)]
    # a target does not count, so all plants do after two
    return [
        [min(smallest_clearance(world, world.model, target, start[None]) for target in (0, 1)) for start in starts]
        for world in worlds
    ]


if __name__ == "__main__":
    main()
