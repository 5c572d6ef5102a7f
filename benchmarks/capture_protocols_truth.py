"""The truth around each stand, registered by the recording's known poses: for scenes that carry none yet."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from greenhouse_gym.build import BuildSettings, _moved, _stem_line, level, stand_positions
from greenhouse_gym.capture import Recording
from greenhouse_gym.geometry import Shape, distance_to_shapes, invert, pose, transform
from greenhouse_gym.plants import PlantRow
from greenhouse_gym.reconstruction import RowCloud
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.scene import Shapes
from greenhouse_gym.shapes import RowShapes


def with_truth(
    scenes: Sequence[Scene],
    cloud: RowCloud,
    shapes: RowShapes,
    row: PlantRow,
    recording: Recording,
    settings: BuildSettings,
) -> list[Scene]:
    leveled = level(cloud)
    stem_line = _stem_line([_moved(s, leveled) for s in shapes.stems], recording)
    good = np.flatnonzero(cloud.registered)
    heads = transform(leveled, cloud.world_from_station[good][:, :3, 3])
    direction = -1.0 if heads[np.argmax(np.abs(heads[:, 1])), 1] < 0 else 1.0
    result = []
    for scene, along in zip(scenes, stand_positions(recording, settings), strict=True):
        origin = np.array([stem_line - settings.stem_distance, direction * along, 0.0])
        scene_from_cloud = pose(translation=-origin) @ leveled
        near = good[np.argsort(np.abs(heads[:, 1] - origin[1]))[:5]]
        poses = []
        for i in near:
            known = recording[int(i)].world_from_station
            assert known is not None
            poses.append(scene_from_cloud @ cloud.world_from_station[i] @ invert(known))
        places = np.array(poses)
        middle = invert(places[0]) @ np.array([0.4, 0.0, 1.1, 1.0])  # the mean pose, right where the arm works
        turn = Rotation.from_matrix(places[:, :3, :3]).mean().as_matrix()
        there = (places @ middle)[:, :3].mean(axis=0)
        scene_from_world = pose(turn, there - turn @ middle[:3])

        def around(parts: Sequence[Shape], frame=scene_from_world) -> tuple[Shape, ...]:
            moved = [_moved(shape, frame) for shape in parts]
            distance = distance_to_shapes(np.array([[0.0, 0.0, 1.1]]), moved)[0]
            return tuple(shape for shape, far in zip(moved, distance, strict=True) if far < settings.reach)

        truth = Shapes(tomatoes=around(row.tomatoes), stems=around(row.stems), clutter=around(row.clutter))
        result.append(scene.model_copy(update={"truth": truth}))
    return result
