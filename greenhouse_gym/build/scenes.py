"""Cut scenes out of a reconstructed row: obstacles around each placement of the arm, occupancy, and truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.recordings import Recording, fingerprint
from greenhouse_gym.common.settings_files import check_numbers
from greenhouse_gym.crops import PlantRow
from greenhouse_gym.crops.parts import Stem
from greenhouse_gym.crops.shape_tables import ShapeParts, as_tables, from_tables, select_near, transform_tables
from greenhouse_gym.crops.truth_shapes import TOLERANCE, truth_of
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, invert, pose, transform
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud
from greenhouse_gym.reconstruction.occupancy_carving import CarvedSpace, CarvingSettings, carve
from greenhouse_gym.scene import ArmPlacement, Provenance, Scene, Shapes
from greenhouse_gym.scene.occupancy import UNKNOWN, OccupancyGrid
from greenhouse_gym.scene.workspace import DECIMALS, REACH, in_frame, keep_nearest, shoulder_point, within_reach
from greenhouse_gym.shapes import RowShapes, ShapeSettings


@dataclass(frozen=True)
class BuildSettings:
    """Settings for cutting scenes out of a row, and of all stages before. Lengths are metres.

    Raises:
        InvalidValueError: A value is out of range, such as a distance that is not positive.
    """

    spacing: float = 0.5  # between the placements of two scenes of a row
    width: float = 1.6  # of a scene along the row
    stem_distance: float = 0.60  # from the arm's base axis to the stem line
    reach: float = REACH  # from the shoulder; farther shapes are left out
    max_shapes: int = 600  # in a scene; dense foliage seen from top to bottom has as many within reach
    max_targets: int | None = None  # in a scene, near and far ones; None for every tomato
    min_target_radius: float = 0.0075  # smaller tomatoes are not picked, so they are not targets
    leaf_tolerance: float = TOLERANCE  # distance from a leaf mesh at which the boxes of its truth may lie
    robot: str = "ur5e"  # the arm that targets are rated for
    reconstruction: ReconstructionSettings | None = None  # by default as the protocol of each recording requires
    shapes: ShapeSettings = field(default_factory=ShapeSettings)
    carving: CarvingSettings = field(default_factory=CarvingSettings)

    def __post_init__(self) -> None:
        check_numbers(
            self, ("spacing", "width", "stem_distance", "reach", "max_shapes", "max_targets", "leaf_tolerance")
        )


def provenance_of(
    recording: Recording, week: int | None, settings: BuildSettings, known: Provenance | None = None
) -> Provenance:
    """Return the provenance that all scenes of a recording share.

    Args:
        recording: The recording; its name is the row's unless ``known`` names the row.
        week: Growth week, if known.
        settings: All settings.
        known: The row, its style and source, if known.
    """
    return (known or Provenance(row=recording.name)).model_copy(
        update={
            "week": week,
            "protocol": recording.protocol,
            "recording": recording.name,
            "recording_sha256": fingerprint(recording),
            "settings": _as_json(settings),
            "package_version": version("greenhouse-gym"),
        }
    )


def occupancy_summary(scene: Scene, settings: BuildSettings) -> str:
    """Return a line on the fraction of the space around an arm that is known."""
    if scene.occupancy is None:
        return f"{scene.name}: no occupancy grid"
    shoulder = shoulder_point()
    fraction = scene.occupancy.known_fraction(shoulder, settings.reach)
    text = f"{scene.name}: {fraction:.0%} of the space within reach was seen"
    centers = scene.occupancy.centers
    plants = (centers[..., 0] > settings.stem_distance / 2) & (centers[..., 2] > shoulder[2])
    if not (scene.occupancy.states[plants] != UNKNOWN).any():
        text += f"; nothing of the plants above {shoulder[2]:g} m: an arm confined to known space will hardly move"
    return text


def scene_name(recording: Recording, index: int) -> str:
    """Return the name of a scene of a recording, by the index of its placement."""
    return f"{recording.name}-{index:02d}"


def placement_positions(along: Array, settings: BuildSettings) -> list[float]:
    """Return evenly spaced positions of the arm along a row, at least half a spacing from the ends of the recording.

    Args:
        along: (stations,) positions of the registered stations along the row in any order, metres.
        settings: All settings.

    Returns:
        Metres along the row, from the end at which the walk began.
    """
    first, last = float(along.min()), float(along.max())
    count = max(1, int((last - first) / settings.spacing + 1e-9))
    positions = (first + last) / 2 + settings.spacing * (np.arange(count) - (count - 1) / 2)
    backward = abs(along[0] - first) > abs(along[0] - last)
    return [float(y) for y in (positions[::-1] if backward else positions)]


def level(row: RowCloud) -> Array:
    """Return the pose (4, 4) of the row cloud's frame in a level frame.

    A tripod is put up level within a degree or two at every station. The mean of all stations is better than the first
    station, whose frame the cloud is in.
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
    """Place the arm along a row and cut out the obstacles around each placement.

    Args:
        row: The reconstructed row.
        shapes: Its shapes, in the row's frame.
        recording: The recording from which it was reconstructed.
        week: Growth week, if known.
        settings: All settings.
        origin: Provenance of the scenes, if it is already known.

    Returns:
        Scenes without targets; each frame has its origin on the floor below the arm.
    """
    leveled = level(row)
    whole = _in_frame(ShapeParts(shapes.tomatoes, shapes.stems, shapes.clutter), leveled)
    heads = transform(leveled, row.world_from_station[row.registered][:, :3, 3])
    stations = np.flatnonzero(row.registered)
    provenance = origin or provenance_of(recording, week, settings)
    origins = _placement_origins(whole.stems, heads, recording, settings)
    carving = None if row.observed is None else _carve(row, leveled, origins, settings)
    scenes = []
    for k, point in enumerate(origins):
        shift = pose(translation=-point)
        station = int(stations[np.argmin(np.abs(heads[:, 1] - point[1]))])
        near = within_reach(_in_frame(whole, shift), settings.reach, settings.width)
        truth = None
        if recording.truth is not None:
            truth = _truth_around(recording, row, station, shift @ leveled, settings)
        scenes.append(
            Scene(
                name=scene_name(recording, k),
                **keep_nearest(near, settings.max_shapes)._asdict(),
                placement=ArmPlacement(),
                truth=truth,
                occupancy=None if carving is None else _occupancy_around(carving, point, settings),
                provenance=provenance.model_copy(update={"station": station}),
            )
        )
    return scenes


def _in_frame(parts: ShapeParts, target_from_source: Array) -> ShapeParts:
    return ShapeParts(
        tuple(in_frame(tomato, target_from_source) for tomato in parts.tomatoes),
        tuple(in_frame(stem, target_from_source) for stem in parts.stems),
        tuple(in_frame(shape, target_from_source) for shape in parts.clutter),
    )


def _placement_origins(
    stems: Sequence[Stem], heads: Array, recording: Recording, settings: BuildSettings
) -> list[Array]:
    """Return the points (3,) on the floor below the arm, in the leveled frame of stems and stations (n, 3)."""
    aside = _stem_line(stems, recording) - settings.stem_distance
    return [np.array([aside, along, 0.0]) for along in placement_positions(heads[:, 1], settings)]


def _carve(row: RowCloud, leveled: Array, origins: Sequence[Array], settings: BuildSettings) -> CarvedSpace:
    """Carve the space within reach of all placements, in the leveled frame of the cloud."""
    low, high = _workspace_corners(settings)
    ends = [origin + corner for origin in origins for corner in (low, high)]
    return carve(row, leveled, np.min(ends, axis=0), np.max(ends, axis=0), settings.carving)


def _occupancy_around(carving: CarvedSpace, origin: Array, settings: BuildSettings) -> OccupancyGrid:
    low, high = _workspace_corners(settings)
    states, corner = carving.cut(origin + low, origin + high)
    return OccupancyGrid.from_states(states, np.round(corner - origin, DECIMALS), carving.voxel)


def _workspace_corners(settings: BuildSettings) -> tuple[Array, Array]:
    """Return the corners (3,) of the space that an arm may reach, relative to its origin, metres."""
    reach = settings.reach
    return np.array([-reach, -reach, 0.0]), np.array([reach, reach, ArmPlacement().shoulder_height + reach])


def _truth_around(
    recording: Recording, row: RowCloud, station: int, scene_from_row: Array, settings: BuildSettings
) -> Shapes:
    """Return all shapes of the true row within the arm's reach, in the frame of a scene.

    The true row is registered by the true pose of the station nearest to the arm, never fitted. This leaves out the
    drift along the row, which does not affect an arm at that station.

    Raises:
        InvalidValueError: The recording lacks the true pose of that station.
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
    """Return all shapes of a true row within the arm's reach, as a scene file stores them.

    Args:
        row: The row.
        scene_from_row: (4, 4) pose of the row's frame in the scene's.
        settings: All settings.
    """
    true = truth_of(row, settings.leaf_tolerance)
    # tables are much faster, since a row of meshes has thousands of shapes
    tables = transform_tables(as_tables(true.tomatoes, true.stems, true.clutter), scene_from_row)
    parts = within_reach(from_tables(select_near(tables, shoulder_point(), settings.reach)), settings.reach)
    return Shapes(**parts._asdict()).compact()


def _stem_line(stems: Sequence[Stem], recording: Recording) -> float:
    """Return the distance of the stem line from the tripod's: the median of the main stems, else half a metre."""
    main = [(stem.start[0] + stem.end[0]) / 2 for stem in stems if stem.kind == "main"]
    camera = recording.rig.cameras[recording.rig.reference].rig_from_camera[0, 3]
    return float(np.median(main)) if main else float(camera) + 0.5


def _as_json(settings: BuildSettings) -> dict[str, Any]:
    """Return settings as they come back from JSON, with lists in place of tuples."""
    plain: dict[str, Any] = {
        key: {k: list(v) if isinstance(v, tuple) else v for k, v in value.items()} if isinstance(value, dict) else value
        for key, value in asdict(settings).items()
    }
    return plain
