"""Recording formats, one module each; those of other packages are found by their entry points."""

from greenhouse_gym.capture.formats.registry import ENTRY_POINTS, RecordingFormat, open_recording, recording_formats

__all__ = ["ENTRY_POINTS", "RecordingFormat", "open_recording", "recording_formats"]
