"""Settings of the reconstruction, with the paper's values where it names one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from pydantic import Field

from greenhouse_gym.capture.protocols import PROTOCOLS, CaptureProtocol
from greenhouse_gym.common.settings_files import Count, Fraction, Positive, check_numbers
from greenhouse_gym.errors import require_choice

Poses = Literal["estimate", "given", "refine"]
POSES: tuple[str, ...] = get_args(Poses)


@dataclass(frozen=True)
class ReconstructionSettings:
    """Settings by which a recording becomes a row.

    Raises:
        InvalidValueError: A value is out of its bounds, such as the size of a voxel that is not positive.
        UnknownNameError: ``poses`` is not a known choice.
    """

    foreground: Positive = 0.60  # m, the paper's cut
    poses: Poses = "estimate"  # of the stations: estimated, given by the recording, or given and refined
    # registration
    fine_distance: Positive = 0.005  # m within which ICP pairs points of surfaces that face the same way
    links: tuple[Annotated[int, Field(ge=2)], ...] = (2, 3)  # also register stations that many steps apart
    # acceptance
    step_range: tuple[float, float] = (0.03, 0.15)  # m that the tripod may move from one station to the next
    min_overlap: Fraction = 0.15  # fraction of the points that the other station could see
    min_fitness: Fraction = 0.6  # fraction of those points with a partner within fine_distance
    max_rmse: Positive = 0.0025  # m along the normals of those partners
    max_contradicted: Fraction = 0.10  # fraction of the points in view of both that one station sees through
    max_rotation: Positive = 0.14  # rad between two stations, twice the tripod's +-2 degrees about each axis
    max_sideways: Positive = 0.06  # m across the row between two stations
    # calibration of the cameras
    calibration_stations: Count = 5  # by which depth errors and the rig are estimated; 0 = none
    calibrate_rig: bool = True  # also the camera poses, if that explains the overlap notably better
    calibrate_edges: bool = True  # also the edge fattening, where the photographs show it
    # the merged cloud
    voxel: Positive = 0.002  # m, one point of the cloud per cube of this size

    def __post_init__(self) -> None:
        require_choice("source of station poses", self.poses, POSES)
        check_numbers(self)

    @classmethod
    def of(cls, protocol: CaptureProtocol) -> ReconstructionSettings:
        """Return the settings that fit a protocol: the cut behind its plants, and tolerances for its distance.

        A stereo camera's noise grows with the square of the distance; neighboring pixels share it, so distances between
        partners and accepted errors scale with the distance alone.
        """
        usual = cls()
        farther = protocol.distance / PROTOCOLS["paper"].distance
        return cls(
            foreground=protocol.foreground,
            fine_distance=usual.fine_distance * farther,
            max_rmse=usual.max_rmse * farther,
        )
