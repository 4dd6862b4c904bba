"""Sentences about drives without motion data."""

from __future__ import annotations

import math

from caliv_graph.config.model import Config
from caliv_graph.trajectory.odometry import VehicleStatement


def odometry_sentence(lidar: str, statement: VehicleStatement, config: Config) -> str:
    """What the motion of a drive was taken from, and what is assumed of the vehicle."""
    tilt, course = math.degrees(statement.tilt_rad), math.degrees(statement.course_rad)
    known = config.ground.vehicle_height is not None
    yaw = (
        f"yaw from the direction of travel (the vehicle moves along its x axis, without side slip, "
        f"to {course:.2f} degrees)"
        if math.isfinite(course)
        else "the vehicle did not move, so that nothing tells yaw"
    )
    z = "z from ground.vehicle_height" if known else "z is open without ground.vehicle_height"
    target = "; the target is not used" if config.target else ""
    return (
        f"no motion data: the motion is that of lidar '{lidar}' past walls and ground. S2V roll "
        f"and pitch are taken from the ground's normal (the vehicle stands parallel to it to "
        f"{tilt:.2f} degrees), {yaw}; {z}, x and y are open: an IMU with GNSS or velocities, or "
        f"poses, would tell them{target}"
    )


def unseen_words(lidar: str) -> str:
    """What a validation along the odometry of a LiDAR does not see, for the end of a verdict."""
    return (
        f"No motion data: the clouds lie along the odometry of lidar '{lidar}', so that S2S alone "
        "is seen here. An error that all LiDARs share is not: all six axes of S2V, and a clock "
        "that is off for all. Validate on a drive with motion data to see these"
    )
