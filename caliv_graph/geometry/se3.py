"""SE(3) on `gtsam.Pose3`: operations that GTSAM lacks in Python, single and in batches.

Frames, tangent order and *vehicle axes* are defined in `caliv_graph.conventions`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import gtsam
import numpy as np
from scipy.linalg import block_diag

from caliv_graph.products import Array


def cross(a: Array, b: Array) -> Array:
    """Cross products of (..., 3); numpy's own takes several times as long."""
    return np.stack(
        [
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ],
        axis=-1,
    )


def tangent_axes(directions: Array) -> Array:
    """Two unit vectors perpendicular to each unit vector and to each other.

    With the direction as third axis they form a right-handed frame.

    Args:
        directions: (..., 3).

    Returns:
        (..., 2, 3).
    """
    if directions.ndim == 1:
        return _axes_of_one(*directions.tolist())
    x, y, z = np.moveaxis(directions, -1, 0)
    none = np.zeros_like(x)
    across = np.stack([[none, -z, y], [z, none, -x], [-y, x, none]])
    # The first is also perpendicular to the coordinate axis farthest from the direction.
    least = np.argmin(np.abs(directions), axis=-1)
    first = np.where(least == 0, across[0], np.where(least == 1, across[1], across[2]))
    first /= np.sqrt(first[0] ** 2 + first[1] ** 2 + first[2] ** 2)
    a, b, c = first
    second = np.stack([y * c - z * b, z * a - x * c, x * b - y * a])
    return np.asarray(np.moveaxis(np.stack([first, second]), (0, 1), (-2, -1)))


def _axes_of_one(x: float, y: float, z: float) -> Array:
    """`tangent_axes` of one direction, the same bits: a tenth of the time without arrays."""
    nearly = [abs(x), abs(y), abs(z)]
    a, b, c = ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))[nearly.index(min(nearly))]
    length = math.sqrt(a * a + b * b + c * c)
    a, b, c = a / length, b / length, c / length
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


def turned_twist(R_a_b: Array, twist_b: Array) -> Array:
    """(6,) angular velocity and velocity in axes a, of those (6,) in axes b."""
    return np.concatenate([R_a_b @ twist_b[:3], R_a_b @ twist_b[3:]])


def twist_by_turn(twists: Array, pivot: Array | None = None) -> Array:
    """(..., 6, 3) change of twists (..., 6) that are constant in the map, by a turn of their axes.

    The derivative of `turned_twist(R^T, ...)` by a right perturbation of R, `ad(twist)` without its
    last columns. With a `pivot` (3,) the axes turn about it, and their origin becomes another point
    of the body, with another velocity; None: about their origin.
    """
    by_shift = skew(twists[..., 3:])
    if pivot is not None:
        by_shift = by_shift + skew(twists[..., :3]) @ skew(pivot)
    return np.concatenate([skew(twists[..., :3]), by_shift], axis=-2)


def rpy(R_a_b: Array) -> Array:
    """Roll, pitch, yaw in radians of a (3, 3) rotation matrix; shape (3,)."""
    return np.asarray(gtsam.Rot3(R_a_b).rpy(), dtype=np.float64)


def quaternion_xyzw(rotation: gtsam.Rot3) -> tuple[float, float, float, float]:
    """The unit quaternion of a rotation in the order x y z w."""
    q: Any = rotation.toQuaternion()
    return (q.x(), q.y(), q.z(), q.w())


def left_jacobian_inverse(xi: Array) -> Array:
    """Derivative of `Log(Exp(d) Exp(xi))` by d at d = 0.

    GTSAM's `LogmapDerivative` is the inverse of the *right* Jacobian at xi. The left Jacobian at xi
    equals the right one at -xi.

    Args:
        xi: (6,), rotation then translation.

    Returns:
        (6, 6).
    """
    return np.asarray(gtsam.Pose3.LogmapDerivative(gtsam.Pose3.Expmap(-xi)), dtype=np.float64)


def right_to_vehicle_axes(T_vehicle_lidar: gtsam.Pose3) -> Array:
    """Rotates a right perturbation of `T_vehicle_lidar` into vehicle axes; (6, 6), orthonormal.

    Its transpose rotates vehicle axes into a right perturbation.
    """
    R = T_vehicle_lidar.rotation().matrix()
    out = np.zeros((6, 6))
    out[:3, :3] = R
    out[3:, 3:] = R
    return out


def joint_right_to_vehicle_axes(poses: Iterable[gtsam.Pose3]) -> Array:
    """(6n, 6n) `right_to_vehicle_axes` of n extrinsics, block diagonal."""
    return np.asarray(block_diag(*(right_to_vehicle_axes(T) for T in poses)), dtype=np.float64)


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


def common_motion(found: Sequence[gtsam.Pose3], guessed: Sequence[gtsam.Pose3]) -> gtsam.Pose3:
    """T_vehicle_guessed: the frame in which poses on the vehicle were guessed, by where they are.

    The mean of `T_vehicle_x T_guessed_x^-1` over all x.
    """
    moves = [T.compose(guess.inverse()) for T, guess in zip(found, guessed, strict=True)]
    mean = np.mean([gtsam.Pose3.Logmap(moves[0].between(T)) for T in moves], axis=0)
    return moves[0].compose(gtsam.Pose3.Expmap(mean))


def stack(poses: Sequence[gtsam.Pose3]) -> tuple[Array, Array]:
    """Rotation matrices (n, 3, 3) and translations (n, 3) of poses, for batch computations."""
    R = np.array([p.rotation().matrix() for p in poses]).reshape(-1, 3, 3)
    t = np.array([p.translation() for p in poses]).reshape(-1, 3)
    return R, t


def unstack(R: Array, t: Array) -> tuple[gtsam.Pose3, ...]:
    """Poses of rotation matrices (n, 3, 3) and translations (n, 3).

    The matrices are made orthonormal, so that rounding of many small steps does not add up.
    """
    return tuple(gtsam.Pose3(gtsam.Rot3.ClosestTo(Ri), ti) for Ri, ti in zip(R, t, strict=True))
