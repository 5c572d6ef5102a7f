"""Scene files, their MuJoCo models, and banks of scenes."""

from greenhouse_gym.scene.bank import SceneBank
from greenhouse_gym.scene.mjcf import CompiledScene, compile_scene, scene_spec
from greenhouse_gym.scene.obstacles import ArmPlacement, Shapes
from greenhouse_gym.scene.scene import DIFFICULTIES, Difficulty, Provenance, Scene, Target

__all__ = [
    "DIFFICULTIES",
    "ArmPlacement",
    "CompiledScene",
    "Difficulty",
    "Provenance",
    "Scene",
    "SceneBank",
    "Shapes",
    "Target",
    "compile_scene",
    "scene_spec",
]
