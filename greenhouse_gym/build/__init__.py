"""From reconstructed rows to scenes, and from scenes to banks."""

from greenhouse_gym.build.bank_builder import build_bank, default_splits
from greenhouse_gym.build.scenes import BuildSettings, cut_scenes

__all__ = ["BuildSettings", "build_bank", "cut_scenes", "default_splits"]
