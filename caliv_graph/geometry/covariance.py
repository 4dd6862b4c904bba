"""Covariance of the pose between two LiDARs, from the joint covariance of their extrinsics."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import right_to_vehicle_axes
from caliv_graph.products import Array


def relative_jacobian(T_vehicle_a: gtsam.Pose3, T_vehicle_b: gtsam.Pose3) -> Array:
    """Derivative of `T_b_a = T_vehicle_b^-1 T_vehicle_a` with respect to the two extrinsics.

    From `(T_vehicle_b Exp(d_b))^-1 T_vehicle_a Exp(d_a) = T_b_a Exp(-Ad(T_b_a^-1) d_b) Exp(d_a)`.

    Returns:
        (6, 12): right perturbation of `T_b_a` (frame of a) by those of `T_vehicle_a` and
        `T_vehicle_b`, in this order.
    """
    T_a_b = T_vehicle_a.between(T_vehicle_b)
    return np.hstack([np.eye(6), -np.asarray(T_a_b.AdjointMap(), dtype=np.float64)])


def relative_covariance(
    T_vehicle_a: gtsam.Pose3, T_vehicle_b: gtsam.Pose3, cov_joint: Array
) -> Array:
    """Covariance of `T_b_a` to first order.

    Args:
        T_vehicle_a: extrinsic of LiDAR a.
        T_vehicle_b: extrinsic of LiDAR b.
        cov_joint: (12, 12) of `T_vehicle_a`, then `T_vehicle_b`; right perturbations, rotation
            then translation, rad and m.

    Returns:
        (6, 6) of `T_b_a`, right perturbation (frame of a), same order and units.
    """
    J = relative_jacobian(T_vehicle_a, T_vehicle_b)
    cov = J @ cov_joint @ J.T
    return np.asarray((cov + cov.T) / 2.0)


def about_one_jacobian(T_vehicle_lidar: Sequence[gtsam.Pose3], index: int) -> Array:
    """Derivative of n extrinsics about one of them, with respect to all.

    That one is held, the others keep their places to it: `relative_jacobian` for each, at its own
    six coordinates.

    Returns:
        (6 n, 6 n) right perturbations; the rows of the one that is held are zero.
    """
    out = np.eye(6 * len(T_vehicle_lidar))
    own = slice(6 * index, 6 * index + 6)
    for i, T in enumerate(T_vehicle_lidar):
        out[6 * i : 6 * i + 6, own] = -T.between(T_vehicle_lidar[index]).AdjointMap()
    out[own] = 0.0
    return out


def parent_axes_covariance(T_parent_child: gtsam.Pose3, cov: Array) -> Array:
    """Rotates a covariance from the child's axes into the parent's, at the child's origin.

    For an extrinsic the parent is the vehicle, and these are *vehicle axes* (see `conventions`).

    Args:
        T_parent_child: the pose.
        cov: (6, 6) of it, right perturbation.

    Returns:
        (6, 6), rotation about and shift along the parent's axes.
    """
    J = right_to_vehicle_axes(T_parent_child)
    return np.asarray(J @ cov @ J.T)
