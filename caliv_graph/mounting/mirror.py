"""Guesses that mirror each other: of a symmetric rig, y to the right looks like swapped topics."""

from __future__ import annotations

import math

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import vehicle_axes_difference

_MIRROR = np.diag([1.0, -1.0, 1.0])

_AXES = [2, 3, 4, 5]
"""Yaw, x, y and z. Roll and pitch are small, and users write them with either sign."""

_ALIKE = np.array([math.radians(15.0), 0.3, 0.3, 0.3])
"""Difference of yaw (rad), x, y and z (m) up to which two sides of a vehicle are alike: guesses
are 3 degrees and 0.1 m off, and mounts of a symmetric rig differ by a few degrees more."""


def mirrored(T_vehicle_lidar: gtsam.Pose3) -> gtsam.Pose3:
    """The same mounting on the other side of the vehicle: left and right exchanged."""
    R = _MIRROR @ T_vehicle_lidar.rotation().matrix() @ _MIRROR
    return gtsam.Pose3(gtsam.Rot3(R), _MIRROR @ T_vehicle_lidar.translation())


def are_mirror_images(one: gtsam.Pose3, other: gtsam.Pose3) -> bool:
    """Whether two LiDARs stand on either side of a vehicle, by their guesses.

    Two that are one behind the other in the middle are no such pair.
    """
    off = np.abs(vehicle_axes_difference(mirrored(one), other))[_AXES]
    apart = np.abs(vehicle_axes_difference(one, other))[_AXES]
    return bool((off < _ALIKE).all() and (apart > _ALIKE).any())
