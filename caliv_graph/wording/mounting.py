"""Sentences about mountings that were found without an initial guess."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from caliv_graph.mounting.place import Placement

MOST_OTHERS = 2
"""Other mountings that are listed."""


def placement_sentence(found: Placement) -> str:
    """Where a LiDAR without an initial guess was found, and what else fits."""
    text = (
        f"lidar '{found.lidar}': no initial guess was given. What stands still in the drive gives "
        f"the first one: {_pose(found.T_vehicle_lidar)}"
    )
    if not found.others:
        return text
    listed = "; ".join(map(_pose, found.others[:MOST_OTHERS]))
    return f"{text}. Other mountings fit nearly as well: {listed}"


def region_sentence(placements: Sequence[Placement]) -> str:
    """Why a LiDAR may see nothing in a region of the map; or nothing.

    A drive that does not determine a mounting leaves what the LiDAR sees metres off in the map: on
    an arc, turned about its centre.
    """
    names = [f"'{found.lidar}'" for found in placements if found.others]
    if not names:
        return ""
    return (
        f"No initial guess was given, and several mountings of {', '.join(names)} fit this drive, "
        "which put what it sees at places of the map that are metres apart: the target may be "
        "there and seem to be outside the region. Enter an initial guess (lidars.<name>.initial), "
        "or leave out 'target', so that the target is searched for"
    )


def _pose(T_vehicle_lidar: gtsam.Pose3) -> str:
    # Adding zero makes minus zero a zero.
    x, y, z = np.round(T_vehicle_lidar.translation(), 1) + 0.0
    roll, pitch, yaw = np.round(np.degrees(T_vehicle_lidar.rotation().rpy())) + 0.0
    return f"xyz: [{x:.1f}, {y:.1f}, {z:.1f}] m, rpy_deg: [{roll:.0f}, {pitch:.0f}, {yaw:.0f}]"
