"""Export of scenes for other simulators and planners: MJCF, URDF, SDF, MoveIt, meshes, and planning problems."""

from greenhouse_gym.export.writers import FORMATS, export_scene

__all__ = ["FORMATS", "export_scene"]
