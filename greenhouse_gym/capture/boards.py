"""Where cameras stand on a rig, from a ChArUco board that neighbors see at the same moments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.frames import RgbdFrame, Station
from greenhouse_gym.capture.rig import Intrinsics, Rig
from greenhouse_gym.capture.rig_file import Mounting
from greenhouse_gym.common.extras import needs
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, invert, pose, rotation_angle, transform

with needs("reconstruct"):
    import cv2

_FEWEST = 8  # corners that give a pose
_VIEWS = 3  # moments at which two cameras must see the board


@dataclass(frozen=True)
class Board:
    """A ChArUco board: ``columns`` by ``rows`` squares of ``square`` metres, markers of ``marker`` metres.

    The markers are those of OpenCV's dictionary ``dictionary``, in the order in which OpenCV draws them.
    """

    columns: int = 8
    rows: int = 6
    square: float = 0.030
    marker: float = 0.022
    dictionary: str = "DICT_5X5_100"

    def __post_init__(self) -> None:
        if not hasattr(cv2.aruco, self.dictionary) or not self.dictionary.startswith("DICT_"):
            known = ", ".join(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
            raise InvalidValueError(f"board: unknown dictionary {self.dictionary!r}; known are {known}")
        if self.columns < 3 or self.rows < 3 or not 0 < self.marker < self.square:
            raise InvalidValueError(f"board: expected at least 3x3 squares, and markers smaller than them, got {self}")

    def drawn(self) -> Any:
        """OpenCV's board."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, dictionary)


@dataclass(frozen=True, eq=False)
class Sighting:
    """A board in one image: ``corners`` (k, 3) metres on it, ``pixels`` (k, 2), and ``camera_from_board`` (4, 4)."""

    corners: Array
    pixels: Array
    camera_from_board: Array


@dataclass(frozen=True, eq=False)
class BoardCalibration:
    """What boards told of a rig.

    Attributes:
        mounting: Where the cameras stand, the reference camera where it stood before.
        residual: Root mean square distance of corners from where they should be seen, by camera, pixels.
        moments: At how many moments each camera saw the board together with another.
        turned: By how much each camera is turned against the rig as it was, radians.
        shifted: By how much each is shifted, metres.
    """

    mounting: Mounting
    residual: Mapping[str, float]
    moments: Mapping[str, int]
    turned: Mapping[str, float]
    shifted: Mapping[str, float]


def find_board(frame: RgbdFrame, board: Board) -> Sighting | None:
    """The board in an image; None where too little of it is seen."""
    drawn = board.drawn()
    corners, numbers, _, _ = cv2.aruco.CharucoDetector(drawn).detectBoard(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY))
    if numbers is None or len(numbers) < _FEWEST:
        return None
    on_board = np.asarray(drawn.getChessboardCorners(), dtype=np.float64)[np.ravel(numbers)]
    pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    found, turn, place = cv2.solvePnP(on_board, pixels, frame.intrinsics.matrix, None, flags=cv2.SOLVEPNP_IPPE)
    if not found:
        return None
    turn, place = cv2.solvePnPRefineLM(on_board, pixels, frame.intrinsics.matrix, None, turn, place)
    return Sighting(on_board, pixels, pose(Rotation.from_rotvec(turn.ravel()).as_matrix(), place.ravel()))


def calibrate_from_boards(stations: Iterable[Station], rig: Rig, board: Board) -> BoardCalibration:
    """Where the cameras of a rig stand to each other, and their depth errors, from images of a board.

    Args:
        stations: Moments at which the board was held before the cameras; two cameras that see it then are joined.
        rig: The rig as it is thought to be; its reference camera stays.
        board: The board.

    Raises:
        InvalidValueError: A camera sees the board too seldom together with others.
    """
    moments: list[dict[str, Sighting]] = []
    ratios: dict[str, list[float]] = {name: [] for name in rig.cameras}
    for station in stations:
        seen = {name: found for name, frame in station.frames.items() if (found := find_board(frame, board))}
        for name, sighting in seen.items():
            ratios[name] += _depth_ratios(station.frames[name], sighting)
        if len(seen) > 1:
            moments.append(seen)
    counts = {name: sum(name in seen for seen in moments) for name in rig.cameras}
    rare = [f"{name} ({count} times)" for name, count in counts.items() if count < _VIEWS]
    if rare:
        raise InvalidValueError(
            f"together with another camera the board is seen too seldom by {', '.join(rare)}; at least {_VIEWS} needed"
        )
    reference_from = _chained(moments, rig)
    intrinsics = {name: camera.intrinsics for name, camera in rig.cameras.items()}
    refined, residual = _refined(moments, reference_from, rig.reference, intrinsics)
    rig_from_reference = rig.cameras[rig.reference].rig_from_camera
    placed = {name: rig_from_reference @ refined[name] for name in rig.cameras}
    errors = {name: float(np.median(each)) - 1.0 for name, each in ratios.items() if len(each) >= 20}
    against = {name: invert(camera.rig_from_camera) @ placed[name] for name, camera in rig.cameras.items()}
    return BoardCalibration(
        Mounting(placed, rig.reference, errors), residual, counts,
        {name: float(rotation_angle(apart[:3, :3])) for name, apart in against.items()},
        {name: float(np.linalg.norm(apart[:3, 3])) for name, apart in against.items()},
    )  # fmt: skip


def _depth_ratios(frame: RgbdFrame, sighting: Sighting) -> list[float]:
    """Depth readings at the board's corners as multiples of what they should be."""
    true = transform(sighting.camera_from_board, sighting.corners)[:, 2]
    at = np.rint(sighting.pixels).astype(int)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < frame.depth.shape[1]) & (at[:, 1] < frame.depth.shape[0])
    read = frame.depth[at[inside, 1], at[inside, 0]]
    ratio = (read / true[inside])[read > 0]
    return [float(one) for one in ratio[np.abs(ratio - 1) < 0.1]]


def _chained(moments: Sequence[Mapping[str, Sighting]], rig: Rig) -> dict[str, Array]:
    """Reference from camera for every camera, from one neighbor to the next, by the median of all moments."""
    known = {rig.reference: np.eye(4)}
    while len(known) < len(rig.cameras):
        best: tuple[int, str, Array] | None = None
        for name in rig.cameras.keys() - known.keys():
            motions = [
                known[other] @ seen[other].camera_from_board @ invert(seen[name].camera_from_board)
                for seen in moments if name in seen for other in seen if other in known
            ]  # fmt: skip
            if motions and (best is None or len(motions) > best[0]):
                turn = Rotation.from_matrix([motion[:3, :3] for motion in motions]).mean().as_matrix()
                best = len(motions), name, pose(turn, np.median([motion[:3, 3] for motion in motions], axis=0))
        if best is None:
            alone = ", ".join(sorted(rig.cameras.keys() - known.keys()))
            raise InvalidValueError(f"no moment joins the camera {alone} to the reference camera {rig.reference!r}")
        known[best[1]] = best[2]
    return known


def _refined(
    moments: Sequence[Mapping[str, Sighting]],
    reference_from: Mapping[str, Array],
    reference: str,
    intrinsics: Mapping[str, Intrinsics],
) -> tuple[dict[str, Array], dict[str, float]]:
    """All cameras and boards placed so that corners are seen where they were; and what is left, pixels by camera."""
    movable = [name for name in reference_from if name != reference]
    boards = []
    for seen in moments:
        first = reference if reference in seen else next(iter(seen))
        boards.append(reference_from[first] @ seen[first].camera_from_board)
    start = np.concatenate([_vector(reference_from[name]) for name in movable] + [_vector(board) for board in boards])

    def places(x: Array) -> tuple[dict[str, Array], list[Array]]:
        parts = [_matrix(part) for part in x.reshape(-1, 6)]
        return {reference: np.eye(4)} | dict(zip(movable, parts, strict=False)), parts[len(movable) :]

    def off(x: Array, only: str | None = None) -> Array:
        cameras, there = places(x)
        parts = [np.zeros(0)]
        for seen, board in zip(moments, there, strict=True):
            for name, sighting in seen.items():
                if only in (None, name):
                    k = intrinsics[name]
                    in_camera = transform(invert(cameras[name]) @ board, sighting.corners)
                    pixels = in_camera[:, :2] / in_camera[:, 2:] * [k.fx, k.fy] + [k.cx, k.cy]
                    parts.append((pixels - sighting.pixels).ravel())
        return np.concatenate(parts)

    fit = least_squares(off, start, loss="soft_l1", f_scale=1.0, x_scale="jac", max_nfev=30)
    residual = {name: float(np.sqrt(2 * np.mean(off(fit.x, name) ** 2))) for name in reference_from}
    return places(fit.x)[0], residual


def _vector(place: Array) -> Array:
    return np.concatenate([Rotation.from_matrix(place[:3, :3]).as_rotvec(), place[:3, 3]])


def _matrix(vector: Array) -> Array:
    return pose(Rotation.from_rotvec(vector[:3]).as_matrix(), vector[3:])
