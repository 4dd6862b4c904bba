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


def unvalidated_sentence(name: str) -> str:
    """Why a drive without motion data validates nothing, and what does."""
    return (
        f"{name}: no motion data: validation puts the clouds of all LiDARs into one map by poses "
        "that no LiDAR made. Name IMU, GNSS, velocities or poses in topics (or data.poses) if they "
        "were recorded, or give --data a drive of this vehicle that has them"
    )
