"""Camera poses of a rig from a ChArUco board that neighbors see at the same moments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.rig import Intrinsics, RgbdFrame, Rig, Station
from greenhouse_gym.capture.rig_file import Mounting
from greenhouse_gym.common.extras import needs
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, invert, pose, transform

with needs("reconstruct"):
    import cv2

_MIN_CORNERS = 8  # for a pose
_MIN_MARKERS = 4  # in an image that shows the board or one like it
_MIN_MOMENTS = 3  # at which a camera sees the board together with another


@dataclass(frozen=True)
class Board:
    """A ChArUco board: ``columns`` by ``rows`` squares of ``square`` metres, markers of ``marker`` metres.

    The markers are those of OpenCV's dictionary ``dictionary``, in the order in which OpenCV draws them. Boards with an
    even number of rows come in two layouts; both are found.
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

    def to_opencv(self, legacy: bool = False) -> Any:
        """Return OpenCV's board, ``legacy`` with a marker in the first corner of an even number of rows.

        OpenCV drew boards so before version 4.6, and calib.io still does.
        """
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, dictionary)
        board.setLegacyPattern(legacy)
        return board


@dataclass(frozen=True, eq=False)
class BoardDetection:
    """A board in one image: ``corners`` (k, 3) metres on it, ``pixels`` (k, 2), and ``camera_from_board`` (4, 4)."""

    corners: Array
    pixels: Array
    camera_from_board: Array


@dataclass(frozen=True, eq=False)
class BoardCalibration:
    """Result of a calibration from boards."""

    mounting: Mounting  # the camera poses; the reference camera keeps its own
    residual: Mapping[str, float]  # root mean square reprojection error of the corners, by camera, pixels
    moments: Mapping[str, int]  # number of moments at which each camera saw the board together with another
    turned: Mapping[str, float]  # rotation of each camera against the rig, radians
    shifted: Mapping[str, float]  # translation of each camera against the rig, metres


def find_board(frame: RgbdFrame, board: Board) -> tuple[BoardDetection | None, int]:
    """Return the board in an image, None if too few of its corners are visible, and the number of visible markers."""
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    markers: list[Any] = []
    for legacy in (False, True) if board.rows % 2 == 0 else (False,):
        charuco = board.to_opencv(legacy)
        corners, numbers, *markers = cv2.aruco.CharucoDetector(charuco).detectBoard(gray, None, None, *markers)
        if numbers is not None and len(numbers) >= _MIN_CORNERS:
            return _located(frame, charuco, corners, numbers), len(markers[0])
        if not len(markers[0]):
            break
    return None, len(markers[0])


def _located(frame: RgbdFrame, charuco: Any, corners: Any, numbers: Any) -> BoardDetection | None:
    on_board = np.asarray(charuco.getChessboardCorners(), dtype=np.float64)[np.ravel(numbers)]
    pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    matrix = frame.intrinsics.matrix
    found, turn, origin = cv2.solvePnP(on_board, pixels, matrix, None, flags=cv2.SOLVEPNP_IPPE)
    if not found:
        return None
    turn, origin = cv2.solvePnPRefineLM(on_board, pixels, matrix, None, turn, origin)
    return BoardDetection(on_board, pixels, pose(Rotation.from_rotvec(turn.ravel()).as_matrix(), origin.ravel()))


def calibrate_from_boards(stations: Iterable[Station], rig: Rig, board: Board) -> BoardCalibration:
    """Estimate the camera poses of a rig, and the cameras' depth errors, from images of a board.

    Args:
        stations: Moments at which the board was in view; two cameras that see it then are linked.
        rig: The rig as assumed; its reference camera stays.
        board: The board.

    Raises:
        InvalidValueError: A camera sees the board too seldom together with others.
    """
    moments: list[dict[str, BoardDetection]] = []
    ratios: dict[str, list[float]] = {name: [] for name in rig.cameras}
    other_layout = 0
    for station in stations:
        detected = {name: find_board(frame, board) for name, frame in station.frames.items()}
        visible = {name: found for name, (found, _) in detected.items() if found}
        other_layout += sum(found is None and markers >= _MIN_MARKERS for found, markers in detected.values())
        for name, detection in visible.items():
            ratios[name] += _depth_ratios(station.frames[name], detection)
        if len(visible) > 1:
            moments.append(visible)
    counts = {name: sum(name in visible for visible in moments) for name in rig.cameras}
    rare = [f"{name} ({count} times)" for name, count in counts.items() if count < _MIN_MOMENTS]
    if rare:
        hint = (
            f"; {other_layout} images show its markers, but not as on a board of {board.columns}x{board.rows} squares: "
            "check columns, rows and markers"
        )
        raise InvalidValueError(
            f"together with another camera the board is seen too seldom by {', '.join(rare)}; at least {_MIN_MOMENTS} "
            f"times needed{hint if other_layout else ''}"
        )
    reference_from = _chained_poses(moments, rig)
    intrinsics = {name: camera.intrinsics for name, camera in rig.cameras.items()}
    refined, residual = _bundle_adjusted(moments, reference_from, rig.reference, intrinsics)
    rig_from_reference = rig.cameras[rig.reference].rig_from_camera
    errors = {name: float(np.median(each)) - 1.0 for name, each in ratios.items() if len(each) >= 20}
    mounting = Mounting({name: rig_from_reference @ refined[name] for name in rig.cameras}, rig.reference, errors)
    return BoardCalibration(mounting, residual, counts, *mounting.difference(rig))


def _depth_ratios(frame: RgbdFrame, detection: BoardDetection) -> list[float]:
    """Return depth readings at the board's corners as multiples of their true depths."""
    true = transform(detection.camera_from_board, detection.corners)[:, 2]
    at = np.rint(detection.pixels).astype(int)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < frame.depth.shape[1]) & (at[:, 1] < frame.depth.shape[0])
    read = frame.depth[at[inside, 1], at[inside, 0]]
    ratio = (read / true[inside])[read > 0]
    return [float(one) for one in ratio[np.abs(ratio - 1) < 0.1]]


def _chained_poses(moments: Sequence[Mapping[str, BoardDetection]], rig: Rig) -> dict[str, Array]:
    """Return reference_from_camera of every camera, from one neighbor to the next, by the median of all moments."""
    known = {rig.reference: np.eye(4)}
    while len(known) < len(rig.cameras):
        best: tuple[int, str, Array] | None = None
        for name in rig.cameras.keys() - known.keys():
            motions = [
                known[other] @ visible[other].camera_from_board @ invert(visible[name].camera_from_board)
                for visible in moments
                if name in visible
                for other in visible
                if other in known
            ]
            if motions and (best is None or len(motions) > best[0]):
                turn = Rotation.from_matrix([motion[:3, :3] for motion in motions]).mean().as_matrix()
                best = len(motions), name, pose(turn, np.median([motion[:3, 3] for motion in motions], axis=0))
        if best is None:
            alone = ", ".join(sorted(rig.cameras.keys() - known.keys()))
            raise InvalidValueError(f"no moment links the camera {alone} to the reference camera {rig.reference!r}")
        known[best[1]] = best[2]
    return known


def _bundle_adjusted(
    moments: Sequence[Mapping[str, BoardDetection]],
    reference_from: Mapping[str, Array],
    reference: str,
    intrinsics: Mapping[str, Intrinsics],
) -> tuple[dict[str, Array], dict[str, float]]:
    """Minimize the reprojection error of all corners; return camera poses and residuals, pixels, by camera."""
    movable = [name for name in reference_from if name != reference]
    boards = []
    for visible in moments:
        first = reference if reference in visible else next(iter(visible))
        boards.append(reference_from[first] @ visible[first].camera_from_board)
    start = np.concatenate([_vector(reference_from[name]) for name in movable] + [_vector(board) for board in boards])

    def poses(x: Array) -> tuple[dict[str, Array], list[Array]]:
        parts = [_matrix(part) for part in x.reshape(-1, 6)]
        return {reference: np.eye(4)} | dict(zip(movable, parts, strict=False)), parts[len(movable) :]

    def errors(x: Array, only: str | None = None) -> Array:
        cameras, boards = poses(x)
        parts = [np.zeros(0)]
        for visible, board in zip(moments, boards, strict=True):
            for name, detection in visible.items():
                if only in (None, name):
                    k = intrinsics[name]
                    in_camera = transform(invert(cameras[name]) @ board, detection.corners)
                    pixels = in_camera[:, :2] / in_camera[:, 2:] * [k.fx, k.fy] + [k.cx, k.cy]
                    parts.append((pixels - detection.pixels).ravel())
        return np.concatenate(parts)

    fit = least_squares(errors, start, loss="soft_l1", f_scale=1.0, x_scale="jac", max_nfev=30)
    residual = {name: float(np.sqrt(2 * np.mean(errors(fit.x, name) ** 2))) for name in reference_from}
    return poses(fit.x)[0], residual


def _vector(matrix: Array) -> Array:
    return np.concatenate([Rotation.from_matrix(matrix[:3, :3]).as_rotvec(), matrix[:3, 3]])


def _matrix(vector: Array) -> Array:
    return pose(Rotation.from_rotvec(vector[:3]).as_matrix(), vector[3:])
