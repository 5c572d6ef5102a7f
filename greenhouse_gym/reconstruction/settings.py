"""All settings of the reconstruction, with the paper's values where it names one."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ReconstructionSettings:
    """How a recording becomes a row."""

    foreground: float = 0.60  # m, the paper's cut
    shift_step: int = 2  # px, "a few pixels at a time"
    step_range: tuple[float, float] = (0.03, 0.15)  # m the tripod may move from one station to the next
    longest_gap: float = 0.45  # m beyond which two stations share too little to be registered
    min_foreground: float = 0.01  # share of the reference image that must be foreground
    max_shift_difference: float = 0.9  # share of the foreground that may differ at the best shift; ICP decides
    normal_window: int = 7  # px, side of the window a normal is fitted in
    register_voxel: float = 0.006  # m, the cloud that ICP moves
    surface_voxel: float = 0.003  # m, the cloud that ICP moves it to
    coarse_distance: float = 0.02  # m, point-to-plane ICP
    fine_distance: float = 0.005  # m, ICP between surfaces that face the same way
    facing: float = 0.8  # least cosine between the normals of two points that are partners
    icp_iterations: int = 30
    min_fitness: float = 0.35  # share of points with a partner within fine_distance
    max_rmse: float = 0.0025  # m along the normals of those partners
    max_rotation: float = 0.14  # rad between two stations, twice the tripod's +-2 degrees about each axis
    max_sideways: float = 0.06  # m across the row between two stations
    links: tuple[int, ...] = (2, 3)  # also register stations that many steps apart, and optimize the pose graph
    calibration_stations: int = 5  # from which the cameras' relative depth errors are estimated; 0 = not at all
    voxel: float = 0.002  # m, the merged cloud
    outlier_radius: float = 0.006  # m
    outlier_neighbours: int = 8
