"""Recordings of a row: frames, rigs, readers and writer, the simulated rig."""

from greenhouse_gym.capture.formats import RecordingFormat, open_recording, recording_formats
from greenhouse_gym.capture.formats.own import write_recording
from greenhouse_gym.capture.formats.single_camera import single_camera
from greenhouse_gym.capture.light import Light
from greenhouse_gym.capture.protocols import PROTOCOLS, CaptureProtocol, get_protocol, join_passes, simulate_protocol
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import (
    D435_DEPTH,
    SEED_RIG,
    Camera,
    Intrinsics,
    RgbdFrame,
    Rig,
    Station,
    three_camera_rig,
)
from greenhouse_gym.capture.sensor import (
    StereoDropout,
    StereoNoise,
    TimeOfFlightNoise,
    sense_depth,
    sense_time_of_flight,
)
from greenhouse_gym.capture.simulated import CaptureSettings, simulate_recording

__all__ = [
    "D435_DEPTH",
    "PROTOCOLS",
    "SEED_RIG",
    "Camera",
    "CaptureProtocol",
    "CaptureSettings",
    "Intrinsics",
    "Light",
    "Recording",
    "RecordingFormat",
    "RgbdFrame",
    "Rig",
    "Station",
    "StereoDropout",
    "StereoNoise",
    "TimeOfFlightNoise",
    "get_protocol",
    "join_passes",
    "open_recording",
    "recording_formats",
    "sense_depth",
    "sense_time_of_flight",
    "simulate_protocol",
    "simulate_recording",
    "single_camera",
    "three_camera_rig",
    "write_recording",
]
