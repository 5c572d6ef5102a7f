"""Recordings that another process works on: they travel as paths and seeds, and are the same there."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from row_helpers import HALF

from greenhouse_gym.capture import Recording, Station, join_passes, open_recording, simulate_recording, write_recording
from greenhouse_gym.capture.recordings import fingerprint
from greenhouse_gym.crops import grow_row


def simulated(folder: Path) -> Recording:
    return simulate_recording(grow_row(seed=1, length=0.3), seed=1, rig=HALF, stations=2)


def on_disk(folder: Path) -> Recording:
    return open_recording(write_recording(simulated(folder), folder / "recording"))


def joined(folder: Path) -> Recording:
    return join_passes([simulated(folder), simulated(folder)])


def of_one_camera(folder: Path) -> Recording:
    for kind, image in (("color", np.zeros((480, 640, 3), np.uint8)), ("depth", np.ones((480, 640), np.uint16))):
        (folder / kind).mkdir()
        for i in range(2):
            cv2.imwrite(str(folder / kind / f"{i}.png"), image)
    return open_recording(folder, "open3d")


@pytest.mark.parametrize("make", [simulated, on_disk, joined, of_one_camera])
def test_recordings_are_the_same_elsewhere(make: Callable[[Path], Recording], tmp_path: Path) -> None:
    recording = make(tmp_path)
    message = pickle.dumps(recording)
    there = pickle.loads(message)
    assert len(message) < 1_000_000
    assert fingerprint(there) == fingerprint(recording)
    assert list(there.rig.cameras) == list(recording.rig.cameras)
    for k in (0, len(recording) - 1):
        same_station(there[k], recording[k])
    same_station(pickle.loads(pickle.dumps(there))[0], recording[0])  # also one that is in use


def same_station(first: Station, second: Station) -> None:
    for name, frame in second.frames.items():
        np.testing.assert_array_equal(first.frames[name].color, frame.color)
        np.testing.assert_array_equal(first.frames[name].depth, frame.depth)
    assert (first.world_from_station is None) == (second.world_from_station is None)
    if second.world_from_station is not None:
        np.testing.assert_array_equal(first.world_from_station, second.world_from_station)
