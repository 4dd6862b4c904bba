"""SE(3) on `gtsam.Pose3`: the few operations GTSAM does not hand out, alone and in batches.

Frames, tangent order and *vehicle axes* are defined in `caliv_graph.conventions`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import gtsam
import numpy as np

from caliv_graph.products import Array


def tangent_axes(direction: Array) -> Array:
    """Two unit vectors (2, 3) at right angles to a unit vector (3,) and to each other.

    With the direction as third they are a right-handed frame.
    """
    x, y, z = direction.tolist()
    # At right angles to the coordinate axis that is farthest from the direction, too.
    least = min(range(3), key=lambda axis: abs(direction[axis]))
    u = [(0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)][least]
    length = math.hypot(*u)
    a, b, c = (part / length for part in u)
    return np.array([[a, b, c], [y * c - z * b, z * a - x * c, x * b - y * a]])


def skew(vectors: Array) -> Array:
    """Cross-product matrices: `skew(a) @ b == cross(a, b)`.

    Args:
        vectors: (..., 3).

    Returns:
        (..., 3, 3).
    """
    out = np.zeros((*vectors.shape[:-1], 3, 3))
    out[..., 0, 1] = -vectors[..., 2]
    out[..., 0, 2] = vectors[..., 1]
    out[..., 1, 0] = vectors[..., 2]
    out[..., 1, 2] = -vectors[..., 0]
    out[..., 2, 0] = -vectors[..., 1]
    out[..., 2, 1] = vectors[..., 0]
    return out


def rpy(R_a_b: Array) -> Array:
    """Roll, pitch, yaw in radians of a (3, 3) rotation matrix; shape (3,)."""
    return np.asarray(gtsam.Rot3(R_a_b).rpy(), dtype=np.float64)


def left_jacobian_inverse(xi: Array) -> Array:
    """Derivative of `Log(Exp(d) Exp(xi))` by d at d = 0.

    GTSAM's `LogmapDerivative` is the inverse of the *right* Jacobian at xi; the left one at xi is
    the right one at -xi.

    Args:
        xi: (6,), rotation then translation.

    Returns:
        (6, 6).
    """
    return np.asarray(gtsam.Pose3.LogmapDerivative(gtsam.Pose3.Expmap(-xi)), dtype=np.float64)


def right_to_vehicle_axes(T_vehicle_lidar: gtsam.Pose3) -> Array:
    """Turns a right perturbation of `T_vehicle_lidar` into vehicle axes; (6, 6), orthonormal.

    Its transpose turns vehicle axes into a right perturbation.
    """
    R = T_vehicle_lidar.rotation().matrix()
    out = np.zeros((6, 6))
    out[:3, :3] = R
    out[3:, 3:] = R
    return out


def vehicle_axes_difference(T_a: gtsam.Pose3, T_b: gtsam.Pose3) -> Array:
    """The vehicle-axes perturbation that turns `T_b` into `T_a`.

    Returns:
        (6,): rotation vector of `R_a R_b^T`, then `t_a - t_b`.
    """
    R = T_a.rotation().compose(T_b.rotation().inverse())
    return np.concatenate([gtsam.Rot3.Logmap(R), T_a.translation() - T_b.translation()])


def retract_vehicle_axes(T: gtsam.Pose3, d: Array) -> gtsam.Pose3:
    """Applies a vehicle-axes perturbation (6,) to `T_vehicle_lidar`."""
    R = gtsam.Rot3.Expmap(d[:3]).compose(T.rotation())
    return gtsam.Pose3(R, T.translation() + d[3:])


def stack(poses: Sequence[gtsam.Pose3]) -> tuple[Array, Array]:
    """Rotation matrices (n, 3, 3) and translations (n, 3) of poses, for work in batches."""
    R = np.array([p.rotation().matrix() for p in poses]).reshape(-1, 3, 3)
    t = np.array([p.translation() for p in poses]).reshape(-1, 3)
    return R, t


def unstack(R: Array, t: Array) -> tuple[gtsam.Pose3, ...]:
    """Poses of rotation matrices (n, 3, 3) and translations (n, 3).

    The matrices are made orthonormal again, so that many small steps do not add up to a shear.
    """
    return tuple(gtsam.Pose3(gtsam.Rot3.ClosestTo(Ri), ti) for Ri, ti in zip(R, t, strict=True))
