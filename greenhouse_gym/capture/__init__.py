"""Recordings of a row: frames, rigs, readers and writer, the simulated rig."""

from greenhouse_gym.capture.frames import RgbdFrame, Station
from greenhouse_gym.capture.readers import open_recording
from greenhouse_gym.capture.recordings import Recording, write_recording
from greenhouse_gym.capture.rig import D435_DEPTH, SEED_RIG, Camera, Intrinsics, Rig, three_camera_rig
from greenhouse_gym.capture.sensor import StereoNoise, sense_depth
from greenhouse_gym.capture.simulated import WalkSettings, simulate_recording

__all__ = [
    "D435_DEPTH",
    "SEED_RIG",
    "Camera",
    "Intrinsics",
    "Recording",
    "RgbdFrame",
    "Rig",
    "Station",
    "StereoNoise",
    "WalkSettings",
    "open_recording",
    "sense_depth",
    "simulate_recording",
    "three_camera_rig",
    "write_recording",
]
