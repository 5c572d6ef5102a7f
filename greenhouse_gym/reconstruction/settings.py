"""All settings of the reconstruction, with the paper's values where it names one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from greenhouse_gym.capture.protocols import PROTOCOLS, Protocol
from greenhouse_gym.common.setting_checks import check_numbers
from greenhouse_gym.errors import InvalidValueError, require_choice

Poses = Literal["estimate", "given", "refine"]
POSES: tuple[str, ...] = get_args(Poses)

_POSITIVE = (
    "foreground", "normal_window", "shift_step", "shifts_tried", "samples", "coarse_distance", "fine_distance",
    "icp_iterations", "longest_gap", "max_rmse", "voxel", "outlier_radius", "max_rotation", "max_sideways",
)  # fmt: skip
_SHARES = (
    "min_foreground", "max_foreground", "max_shift_difference", "facing", "min_overlap", "min_fitness",
    "max_contradicted", "min_registered",
)  # fmt: skip


@dataclass(frozen=True)
class ReconstructionSettings:
    """How a recording becomes a row.

    Raises:
        InvalidValueError: A value is not what it can be, such as the size of a voxel that is not positive.
        UnknownNameError: There are no such ``poses``.
    """

    # what belongs to the row
    foreground: float = 0.60  # m, the paper's cut
    min_foreground: float = 0.01  # share of the reference image that must be foreground
    max_foreground: float = 0.98  # share beyond which silhouettes say nothing
    normal_window: int = 7  # px at the D435's 424 px of focal length, side of the window a normal is fitted in
    # where registration starts
    poses: Poses = "estimate"  # of the stations: estimated, given by the recording, or given and refined
    shift_step: int = 2  # px, "a few pixels at a time"
    shifts_tried: int = 3  # the best ones, until ICP convinces from one
    max_shift_difference: float = 0.9  # share of the foreground that may differ at the best shift; ICP decides
    # registration
    samples: int = 5000  # points of a station that ICP moves
    coarse_distance: float = 0.02  # m, Open3D's point-to-plane ICP
    fine_distance: float = 0.005  # m, ICP between surfaces that face the same way
    facing: float = 0.8  # least cosine between the normals of two points that are partners
    icp_iterations: int = 30  # most iterations of each ICP
    links: tuple[int, ...] = (2, 3)  # also register stations that many steps apart, and optimize the pose graph
    # what is accepted
    step_range: tuple[float, float] = (0.03, 0.15)  # m the tripod may move from one station to the next
    longest_gap: float = 0.45  # m beyond which a new segment of the row begins
    min_overlap: float = 0.15  # share of the points that the other station could see
    min_fitness: float = 0.6  # share of those points with a partner within fine_distance
    max_rmse: float = 0.0025  # m along the normals of those partners
    see_through: float = 0.03  # m behind a point at which the other station must see something to contradict it
    max_contradicted: float = 0.10  # share of the points both could see that one station sees through
    max_rotation: float = 0.14  # rad between two stations, twice the tripod's +-2 degrees about each axis
    max_sideways: float = 0.06  # m across the row between two stations
    min_registered: float = 0.25  # share of the stations without which there is no row
    # calibration of the cameras
    calibration_stations: int = 5  # from which depth errors and the rig are estimated; 0 = not at all
    calibrate_rig: bool = True  # also where the cameras stand, if that explains the overlap notably better
    calibrate_edges: bool = True  # also how far near things grow over far ones, where the photographs tell
    # the merged cloud
    voxel: float = 0.002  # m, one point of the cloud per cube of this size
    outlier_radius: float = 0.006  # m around a point within which other points support it
    outlier_neighbours: int = 2  # fewest points within that radius
    outlier_stations: int = 2  # fewest stations that must have seen something where others see through
    outlier_views: int = 2  # fewest stations that must see through a place to put it in doubt

    def __post_init__(self) -> None:
        check_numbers(self, _POSITIVE, _SHARES)
        require_choice("way to pose stations", self.poses, POSES)
        if self.normal_window % 2 == 0:
            raise InvalidValueError(f"normal_window must be odd, so that it has a middle, got {self.normal_window}")
        if not all(isinstance(link, int) and link >= 2 for link in self.links):
            raise InvalidValueError(f"links must be whole numbers of steps from 2 on, got {self.links}")

    @classmethod
    def of(cls, protocol: Protocol) -> ReconstructionSettings:
        """What a protocol needs: the cut behind its plants, and room for the noise of its distance.

        A stereo camera's noise grows with the square of the distance; neighboring pixels share it, so partners are
        looked for and believed in proportion to the distance.
        """
        usual = cls()
        farther = protocol.distance / PROTOCOLS["paper"].distance
        return cls(
            foreground=protocol.foreground,
            fine_distance=usual.fine_distance * farther,
            max_rmse=usual.max_rmse * farther,
        )
