"""Sentences about mountings: what was found without a guess, and guesses that are mistaken."""

from __future__ import annotations

import math
from collections.abc import Sequence

import gtsam
import numpy as np

from caliv_graph.config.model import Config
from caliv_graph.mounting.doubts import Doubt, turned_over
from caliv_graph.mounting.mirror import are_mirror_images
from caliv_graph.mounting.place import Placement
from caliv_graph.mounting.sharpness import CELLS_M
from caliv_graph.readers.pose_frame import pose_key

WITH_Y_LEFT = (
    "change the sign of y and yaw of all guesses, and of roll or pitch if they are counted so"
)
"""Of guesses with y to the right: with z up roll changes its sign, with z down pitch does."""

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


def mistake_sentence(found: Doubt, config: Config) -> str:
    """A mistake that explains what the LiDARs see: which, the numbers, and what to correct."""
    if found.kind == "upside_down":
        return f"{found.name}: most likely, {_upside_down(found, config)}"
    what, undone, remedy = _mistake(found, config)
    cell_m = CELLS_M[-1]
    sharing = ", ".join(
        f"{then:.1f} points of '{name}' share a cell of {cell_m:g} m (now {now:.1f})"
        for name, (now, then) in found.sharing.items()
    )
    return (
        f"{found.name}: most likely, {what}. {undone}, what stands still is seen at one place: "
        f"{sharing}. {remedy}"
    )


def _upside_down(found: Doubt, config: Config) -> str:
    """Which LiDAR hangs, or stands, and its guess the right way up."""
    (name,) = found.lidars
    over = turned_over(config.lidars[name].guess(), found.turn_deg)
    listed = ", ".join(f"{angle:.1f}" for angle in np.degrees(over.rotation().rpy()) + 0.0)
    axis = "roll" if found.turn_deg == 0 else "pitch"
    return (
        f"the initial guess has lidar '{name}' upside down: the ground that it sees would be above "
        f"it ({axis} about 180 degrees off). Set lidars.{name}.initial.rpy_deg to about [{listed}]"
    )


def _mistake(found: Doubt, config: Config) -> tuple[str, str, str]:
    """What is wrong, how it is undone, and what to do."""
    names = [f"'{name}'" for name in found.lidars]
    if found.kind == "exchanged":
        a, b = found.lidars
        what = f"the topics of lidars {names[0]} and {names[1]} are swapped"
        remedy = f"Exchange lidars.{a}.topic and lidars.{b}.topic"
        if are_mirror_images(config.lidars[a].guess(), config.lidars[b].guess()):
            what += ", or y of both guesses counts to the right, for they mirror each other"
            remedy += f"; or, with y to the right in the guesses, {WITH_Y_LEFT}"
        return what, "With the initial guess of the other one", remedy
    if found.kind == "turned":
        (name,) = found.lidars
        roll, pitch, yaw = config.lidars[name].given.rpy_deg
        right = math.remainder(yaw - found.turn_deg, 360.0)
        return (
            f"the initial guess of lidar {names[0]} is turned by {_turn(found)}",
            "Without this turn",
            f"Set lidars.{name}.initial.rpy_deg to about [{roll:.1f}, {pitch:.1f}, {right:.1f}]",
        )
    if found.kind == "heading":
        return (
            f"the heading of the vehicle is turned by {_turn(found)}",
            "Without this turn",
            _heading_remedy(found, config),
        )
    if found.kind == "left_handed":
        whose = "the clouds" if len(names) > 1 else f"the clouds of lidar {names[0]}"
        return (
            f"{whose} are left-handed: y points to the right, with x forward and z up",
            "With the sign of y changed",
            "Write the points with y to the left",
        )
    what = "the poses are of a map with z down (north, east, down)"
    remedy = "Set data.pose_axes: ned"
    if config.data.pose_axes == "ned":
        what = "the poses are of a map with z up, other than data.pose_axes: ned says"
        remedy = "Set data.pose_axes: flu"
    elif config.data.format == "caliv":
        remedy = (
            "Convert input/ego_poses.yaml to a vehicle with x forward, y left, z up, in a map "
            "with z up"
        )
    return (
        f"{what}, or all clouds are left-handed (y to the right): the vehicle turns right where "
        "they turn left",
        "With one of them mirrored",
        f"{remedy}; or, if the poses are right, write the points with y to the left",
    )


def _turn(found: Doubt) -> str:
    """An angle to the left or right."""
    if abs(found.turn_deg) == 180:
        return "180 degrees of yaw"
    return (
        f"{abs(found.turn_deg)} degrees of yaw to the {'left' if found.turn_deg > 0 else 'right'}"
    )


def _heading_remedy(found: Doubt, config: Config) -> str:
    """Where the heading of the vehicle comes from, and what to check there."""
    if found.given:
        source = "the poses" if config.data.format == "caliv" else pose_key(config)
        key = f"the orientation in {source}"
    elif config.topics.heading is not None:
        key = "heading.yaw_deg"
    elif config.topics.imu is not None:
        key = "imu.T_vehicle_imu and from where the IMU's yaw counts"
    else:
        key = "the sign of the velocities in topics.twist"
    reversed_too = ""
    if abs(found.turn_deg) == 180:
        reversed_too = ": a vehicle that reverses points against its course"
    return f"Check {key}, and that all initial guesses are in the vehicle frame{reversed_too}"


def _pose(T_vehicle_lidar: gtsam.Pose3) -> str:
    # Adding zero makes minus zero a zero.
    x, y, z = np.round(T_vehicle_lidar.translation(), 1) + 0.0
    roll, pitch, yaw = np.round(np.degrees(T_vehicle_lidar.rotation().rpy())) + 0.0
    return f"xyz: [{x:.1f}, {y:.1f}, {z:.1f}] m, rpy_deg: [{roll:.0f}, {pitch:.0f}, {yaw:.0f}]"
