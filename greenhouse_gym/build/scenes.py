"""Scenes cut out of a reconstructed row: what stands around the arm wherever it is put up, the truth, what was seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.fingerprint import fingerprint
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, Box, Capsule, Shape, Sphere, invert, pose, transform
from greenhouse_gym.common.setting_checks import check_numbers
from greenhouse_gym.crops.shape_tables import as_tables, from_tables, moved, near
from greenhouse_gym.crops import PlantRow
from greenhouse_gym.crops.decimation import TOLERANCE
from greenhouse_gym.crops.truth_shapes import truth_of
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud
from greenhouse_gym.reconstruction.seen import Carving, CarvingSettings, carve
from greenhouse_gym.scene import Provenance, Scene, Shapes, Stand
from greenhouse_gym.scene.occupancy import UNSEEN, SeenSpace
from greenhouse_gym.shapes import RowShapes, ShapeSettings
from greenhouse_gym.build.workspace import DECIMALS, at_most, in_frame, shoulder_point, within_reach


@dataclass(frozen=True)
class BuildSettings:
    """How scenes are cut out of a row, and all settings of the stages before. Lengths are metres.

    Raises:
        InvalidValueError: A value is not what it can be, such as a distance that is not positive.
    """

    spacing: float = 0.5  # between the stands of two scenes of a row
    width: float = 1.6  # of a scene along the row
    stem_distance: float = 0.60  # from the arm's base axis to the stem line
    reach: float = 1.35  # from the shoulder; what lies farther is left out
    primitives: int = 600  # most shapes in a scene; dense foliage seen from top to bottom has as many within reach
    targets: int | None = None  # most targets in a scene, near and far ones; None for every tomato
    smallest_target: float = 0.0075  # radius below which nobody picks a tomato, so that it is no target
    leaves: float = TOLERANCE  # how far from a leaf of meshes the boxes of its truth may lie
    robot: str = "ur5e"  # the arm that targets are rated for
    reconstruction: ReconstructionSettings | None = None  # by default what each recording's protocol needs
    shapes: ShapeSettings = field(default_factory=ShapeSettings)
    carving: CarvingSettings = field(default_factory=CarvingSettings)

    def __post_init__(self) -> None:
        check_numbers(self, ("spacing", "width", "stem_distance", "reach", "primitives", "targets", "leaves"))


def provenance_of(
    recording: Recording, week: int | None, settings: BuildSettings, known: Provenance | None = None
) -> Provenance:
    """Where all scenes of a recording come from.

    Args:
        recording: The recording; without more knowledge its name is the row's.
        week: Growth week, if known.
        settings: All settings.
        known: The row, its style and source, where they are known.
    """
    return (known or Provenance(row=recording.name)).model_copy(
        update={
            "week": week,
            "protocol": recording.protocol,
            "recording": recording.name,
            "recording_sha256": fingerprint(recording),
            "settings": _plain(settings),
            "package_version": version("greenhouse-gym"),
        }
    )


def what_was_seen(scene: Scene, settings: BuildSettings) -> str:
    """A line on how much of the space around an arm the scan saw."""
    if scene.seen is None:
        return f"{scene.name}: what the scan saw is not known"
    shoulder = shoulder_point()
    text = f"{scene.name}: {scene.seen.share(shoulder, settings.reach):.0%} of the space within reach was seen"
    plants = scene.seen.states[scene.seen.centers[..., 0] > settings.stem_distance / 2]
    above = scene.seen.centers[..., 2][scene.seen.centers[..., 0] > settings.stem_distance / 2]
    if not (plants[above > shoulder[2]] != UNSEEN).any():
        text += f"; nothing of the plants above {shoulder[2]:g} m: an arm that must not leave it will hardly move"
    return text


def scene_name(recording: Recording, stand: int) -> str:
    """Name of the scene at a stand of a recording, counted from 0."""
    return f"{recording.name}-{stand:02d}"


def stand_positions(along: Array, settings: BuildSettings) -> list[float]:
    """Where along the row the arm is put up: evenly, at least half a spacing from the ends of the walk.

    Args:
        along: (stations,) where the registered stations stood, metres along the row in any order.
        settings: All settings.

    Returns:
        Metres along the row, the end at which the walk began first.
    """
    first, last = float(along.min()), float(along.max())
    count = max(1, int((last - first) / settings.spacing + 1e-9))
    stands = (first + last) / 2 + settings.spacing * (np.arange(count) - (count - 1) / 2)
    backward = abs(along[0] - first) > abs(along[0] - last)
    return [float(y) for y in (stands[::-1] if backward else stands)]


def level(row: RowCloud) -> Array:
    """(4, 4) pose of the row cloud's frame in a level one.

    A tripod is put up level within a degree or two at every station; the mean of all stations is better than the first,
    whose frame the cloud is in.
    """
    rotations = Rotation.from_matrix(row.world_from_station[row.registered][:, :3, :3])
    return pose(rotations.mean().inv().as_matrix())


def cut_scenes(
    row: RowCloud,
    shapes: RowShapes,
    recording: Recording,
    week: int | None,
    settings: BuildSettings,
    origin: Provenance | None = None,
) -> list[Scene]:
    """Put the arm up at every stand along a row and keep what is around it.

    Args:
        row: The reconstructed row.
        shapes: What was found in it, in the row's frame.
        recording: What it was reconstructed from.
        week: Growth week, if known.
        settings: All settings.
        origin: What the scenes' provenance tells, where it is known already.

    Returns:
        Scenes without targets; each frame has its origin on the floor below the arm.
    """
    leveled = level(row)
    tomatoes, stems, clutter = (
        [in_frame(shape, leveled) for shape in part] for part in (shapes.tomatoes, shapes.stems, shapes.clutter)
    )
    heads = transform(leveled, row.world_from_station[row.registered][:, :3, 3])
    numbers = np.flatnonzero(row.registered)
    made_from = origin or provenance_of(recording, week, settings)
    places = _stand_origins(stems, heads, recording, settings)
    carving = None if row.sight is None else _carving(row, leveled, places, settings)
    scenes = []
    for k, place in enumerate(places):
        shift = pose(translation=-place)
        station = int(numbers[np.argmin(np.abs(heads[:, 1] - place[1]))])
        around = [
            within_reach([in_frame(shape, shift) for shape in part], settings.reach, settings.width)
            for part in (tomatoes, stems, clutter)
        ]
        around = at_most(around, settings.primitives)
        scenes.append(
            Scene(
                name=scene_name(recording, k),
                tomatoes=tuple(s for s in around[0] if isinstance(s, Tomato)),
                stems=tuple(s for s in around[1] if isinstance(s, Stem)),
                clutter=tuple(around[2]),
                stand=Stand(),
                truth=None
                if recording.truth is None
                else _truth_around(recording, row, station, shift @ leveled, settings),
                seen=None if carving is None else _seen_from(carving, place, settings),
                provenance=made_from.model_copy(update={"station": station}),
            )
        )
    return scenes


def stand_poses(row: RowCloud, shapes: RowShapes, recording: Recording, settings: BuildSettings) -> Array:
    """(stands, 4, 4) where `cut_scenes` puts the arm up: the frame of each scene in that of the row."""
    leveled = level(row)
    heads = transform(leveled, row.world_from_station[row.registered][:, :3, 3])
    origins = _stand_origins([in_frame(stem, leveled) for stem in shapes.stems], heads, recording, settings)
    return np.array([invert(leveled) @ pose(translation=origin) for origin in origins])


def _stand_origins(stems: Sequence[Shape], heads: Array, recording: Recording, settings: BuildSettings) -> list[Array]:
    """(3,) points on the floor below the arm, in the leveled frame, of stems and stations (n, 3) in that frame."""
    aside = _stem_line(stems, recording) - settings.stem_distance
    return [np.array([aside, along, 0.0]) for along in stand_positions(heads[:, 1], settings)]


def _carving(row: RowCloud, leveled: Array, stands: Sequence[Array], settings: BuildSettings) -> Carving:
    """The space within reach of all stands, in the leveled frame of the cloud."""
    low, high = _space(settings)
    ends = [stand + corner for stand in stands for corner in (low, high)]
    return carve(row, leveled, np.min(ends, axis=0), np.max(ends, axis=0), settings.carving)


def _seen_from(carving: Carving, stand: Array, settings: BuildSettings) -> SeenSpace:
    low, high = _space(settings)
    states, corner = carving.cut(stand + low, stand + high)
    return SeenSpace.of(states, np.round(corner - stand, DECIMALS), carving.voxel)


def _space(settings: BuildSettings) -> tuple[Array, Array]:
    """Corners (3,) of the space around a stand that an arm may get to, metres."""
    reach = settings.reach
    return np.array([-reach, -reach, 0.0]), np.array([reach, reach, Stand().shoulder_height + reach])


def _truth_around(
    recording: Recording, row: RowCloud, station: int, scene_from_row: Array, settings: BuildSettings
) -> Shapes:
    """All of the true row within the arm's reach, in a scene's frame.

    It is registered by the true pose of the station nearest to the arm, never fitted: that leaves the drift along the
    row out, which an arm put up there would not feel.

    Raises:
        InvalidValueError: The recording does not say where that station stood.
    """
    assert recording.truth is not None
    true_from_station = recording[station].world_from_station
    if true_from_station is None:
        raise InvalidValueError(
            f"recording {recording.name!r} carries the truth of its row but not where station {station} stood: give "
            "its stations their world_from_station, or leave the truth out (remove truth.npz)"
        )
    return truth_in_scene(
        recording.truth, scene_from_row @ row.world_from_station[station] @ invert(true_from_station), settings
    )


def truth_in_scene(row: PlantRow, scene_from_row: Array, settings: BuildSettings) -> Shapes:
    """All of a true row within the arm's reach, as a scene file keeps it.

    Args:
        row: The row.
        scene_from_row: (4, 4) pose of the row's frame in the scene's.
        settings: All settings.
    """
    true = truth_of(row, settings.leaves)
    # as tables, since a row of meshes has thousands of shapes
    tables = moved(as_tables(true.tomatoes, true.stems, true.clutter), scene_from_row)
    parts = from_tables(near(tables, shoulder_point(), settings.reach))
    return _shapes(*(within_reach(list(part), settings.reach) for part in parts)).compact()


def _shapes(tomatoes: Sequence[Shape], stems: Sequence[Shape], clutter: Sequence[Shape]) -> Shapes:
    return Shapes(
        tomatoes=tuple(s for s in tomatoes if isinstance(s, Tomato)),
        stems=tuple(s for s in stems if isinstance(s, Stem)),
        clutter=tuple(s for s in clutter if isinstance(s, Sphere | Capsule | Box)),
    )


def _stem_line(stems: Sequence[Shape], recording: Recording) -> float:
    """Distance of the stem line from the tripod's line: the median of the main stems, else the nominal half metre."""
    main = [(s.start[0] + s.end[0]) / 2 for s in stems if isinstance(s, Stem) and s.kind == "main"]
    camera = recording.rig.cameras[recording.rig.reference].rig_from_camera[0, 3]
    return float(np.median(main)) if main else float(camera) + 0.5


def _plain(settings: BuildSettings) -> dict[str, Any]:
    """Settings as they come back from JSON: tuples as lists."""
    plain: dict[str, Any] = {
        key: {k: list(v) if isinstance(v, tuple) else v for k, v in value.items()} if isinstance(value, dict) else value
        for key, value in asdict(settings).items()
    }
    return plain
