"""Guesses that mirror each other: of a symmetric rig, y to the right looks like swapped topics."""

from __future__ import annotations

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.products import Array

_MIRROR = np.diag([1.0, -1.0, 1.0])

_AXES = [2, 3, 4, 5]
"""Yaw, x, y and z. Roll and pitch are small, and users write them with either sign."""

_SIGMAS = 3.0
"""Of the difference of two guesses, up to which one is the mirror image of the other."""


def mirrored(T_vehicle_lidar: gtsam.Pose3) -> gtsam.Pose3:
    """The same mounting on the other side of the vehicle: left and right exchanged."""
    R = _MIRROR @ T_vehicle_lidar.rotation().matrix() @ _MIRROR
    return gtsam.Pose3(gtsam.Rot3(R), _MIRROR @ T_vehicle_lidar.translation())


def are_mirror_images(
    guesses: tuple[gtsam.Pose3, gtsam.Pose3], sigmas: tuple[Array, Array]
) -> bool:
    """Whether two LiDARs stand on either side of a vehicle, as alike as their guesses are known.

    `sigmas` (6,) are of the guesses, vehicle axes, rad and m. One LiDAR in the middle is no pair.
    """
    one, other = guesses
    off = np.abs(vehicle_axes_difference(mirrored(one), other))[_AXES]
    limits = _SIGMAS * np.hypot(*sigmas)[_AXES]
    apart = np.abs(vehicle_axes_difference(one, other))[_AXES]
    return bool((off < limits).all() and (apart > limits).any())
