"""Factors of the ground: the plane as a LiDAR sees it, and the vehicle standing on it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from caliv_graph.calibration.problem import HEAVE_SIGMA_M
from caliv_graph.config.range_errors import GROUND_FRAME
from caliv_graph.geometry.se3 import skew, turned_twist, twist_by_turn
from caliv_graph.products import Array, GroundObservation
from caliv_graph.trajectory.rates import by_rates

SWAY_SIGMA_RAD = 1e-3
"""Sway: tilt of the body on its springs at each stamp from its mean over the drive, per axis, where
the config does not give it. It leans by 1.3 mrad in a turn at walking pace (measured on the drive
of the CaLiV authors)."""


def plane_normal(g: Array) -> Array:
    """(3,) upward unit normal in the map of a plane g."""
    a, b = float(g[0]), float(g[1])
    inverse = 1.0 / math.sqrt(1.0 + a * a + b * b)
    return np.array([-a * inverse, -b * inverse, inverse])


def normal_jacobian(g: Array) -> Array:
    """(3, 3) derivative of `plane_normal` by g."""
    # Written out, like the functions below: a graph calls this for hundreds of factors some fifty
    # times, and numpy takes microseconds for every small array.
    a, b = float(g[0]), float(g[1])
    inverse = 1.0 / math.sqrt(1.0 + a * a + b * b)
    cube = inverse**3
    return np.array(
        [
            [a * a * cube - inverse, a * b * cube, 0.0],
            [a * b * cube, b * b * cube - inverse, 0.0],
            [-a * cube, -b * cube, 0.0],
        ]
    )


def height_over(g: Array, centre: Array, place_map: Array) -> tuple[float, Array, Array]:
    """Distance of a place from the plane along its normal, metres; (3,) by g; (3,) by the place."""
    a, b = float(g[0]), float(g[1])
    inverse = 1.0 / math.sqrt(1.0 + a * a + b * b)
    x, y = float(place_map[0] - centre[0]), float(place_map[1] - centre[1])
    height = inverse * (float(place_map[2] - g[2]) - a * x - b * y)
    bend = -height * inverse**2
    by_plane = np.array([bend * a - inverse * x, bend * b - inverse * y, -inverse])
    return height, by_plane, np.array([-a * inverse, -b * inverse, inverse])


def _chain(
    values: gtsam.Values, keys: Sequence[int], derivatives: bool
) -> tuple[gtsam.Pose3, list[Array]]:
    """The product of poses, and per pose the product's right perturbation by that of the pose.

    Only the poses after it matter: no number here grows with the distance from the map's origin.
    """
    *first, last = keys
    after = values.atPose3(last)
    moves = [np.eye(6)]
    for key in reversed(first):
        if derivatives:
            moves.append(np.asarray(after.inverse().AdjointMap()))
        after = values.atPose3(key).compose(after)
    return after, moves[::-1]


def compensated(observation: GroundObservation, R_vehicle_lidar: Array) -> Array:
    """(3,) tilts along its axes and distance of an observation compensated with an extrinsic."""
    said = np.array([0.0, 0.0, observation.distance_m])
    turn = turn_from_guess(observation, R_vehicle_lidar)
    if turn is None or observation.by_extrinsic is None:
        return said
    return np.asarray(said + observation.by_extrinsic @ turn)


def turn_from_guess(observation: GroundObservation, R_vehicle_lidar: Array) -> Array | None:
    """(3,) right perturbation from the rotation that an observation is compensated with, rad.

    None: it needed no compensation.
    """
    if observation.R_vehicle_lidar is None:
        return None
    return np.asarray(
        gtsam.Rot3.Logmap(gtsam.Rot3(observation.R_vehicle_lidar.T @ R_vehicle_lidar))
    )


def compensated_by_turn(observation: GroundObservation, R_vehicle_lidar: Array) -> Array:
    """(3, 3) derivative of `compensated` by a right perturbation of the rotation."""
    turn = turn_from_guess(observation, R_vehicle_lidar)
    if turn is None or observation.by_extrinsic is None:
        return np.zeros((3, 3))
    return np.asarray(observation.by_extrinsic @ gtsam.Rot3.LogmapDerivative(turn))


def held(observation: GroundObservation, R_vehicle_lidar: Array) -> GroundObservation:
    """An observation as its motion is compensated with an extrinsic, whatever a solve makes of it.

    Where clouds are put together with that extrinsic as well, both turn alike, and neither says
    anything about it. What bends the ground stays: `ground_floors.with_floors` comes before.
    """
    change = compensated(observation, R_vehicle_lidar)
    change[2] -= observation.distance_m
    return replace(moved(observation, change), R_vehicle_lidar=None, by_extrinsic=None)


def moved(observation: GroundObservation, change: Array) -> GroundObservation:
    """An observation whose (a, b, distance) have changed by a little, (3,)."""
    a, b, further_m = change.tolist()
    u, v = observation.axes_lidar
    normal = observation.normal_lidar + a * u + b * v
    normal /= np.linalg.norm(normal)
    u = u - (u @ normal) * normal
    u /= np.linalg.norm(u)
    v = v - (v @ normal) * normal - (v @ u) * u
    return replace(
        observation,
        normal_lidar=normal,
        distance_m=observation.distance_m + further_m,
        axes_lidar=np.stack([u, v / np.linalg.norm(v)]),
    )


def ground_plane_factor(
    pose_keys: Sequence[int],
    key_plane: int,
    centre: Array,
    observation: GroundObservation,
    weight: float = 1.0,
    heave_m: float = 0.0,
    key_bias: int | None = None,
    key_rates: int | None = None,
) -> gtsam.CustomFactor:
    """Role a: the plane as a LiDAR sees it.

    `r = [u . n, v . n, d] - [a, b, distance]`, n the plane's normal in the lidar frame and d the
    LiDAR's distance from it, both predicted from `X E S_a`; u and v are the observation's axes;
    a, b and distance its values, motion compensated with the present extrinsic `E S_a` and rates,
    less what the range biases of the LiDAR change of them.

    Args:
        pose_keys: of X_i, E and, unless the LiDAR is the reference, S_a.
        key_plane: of the drive's plane.
        centre: (2,) metres, where the plane's height is defined.
        observation: the measurement.
        weight: on its information.
        heave_m: 1 sigma of heave between scan and pose, beside the observation's covariance.
        key_bias: of the LiDAR's range biases, and of the frame in which it sees all ground (turn
            (3,), lidar axes, and height); None, or an observation that does not tell what the
            biases change: none.
        key_rates: of the errors of the drive's rates, likewise.
    """
    poses = list(pose_keys)
    axes = observation.axes_lidar
    by_bias = observation.by_range_bias
    nuisances: dict[int, Array] = {}
    if key_bias is not None and by_bias is not None:
        nuisances[key_bias] = np.hstack([by_bias, -by_frame(observation)])
    if key_rates is not None and observation.by_rates is not None:
        nuisances[key_rates] = -observation.by_rates @ by_rates(_turning(observation))
    moving = _Moving.of(observation) if key_rates in nuisances else None
    free = observation.R_vehicle_lidar is not None and observation.by_extrinsic is not None
    usual = np.array([0.0, 0.0, observation.distance_m])

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        T, moves = _chain(values, poses, jacobians is not None)
        g = values.atVector(key_plane)
        d, by_plane, n = height_over(g, centre, T.translation())
        rotation = T.rotation()
        R_lidar_map = rotation.matrix().T
        n_lidar = R_lidar_map @ n
        said = usual
        if free:
            R_vehicle_lidar = values.atPose3(poses[0]).rotation().between(rotation).matrix()
            said = compensated(observation, R_vehicle_lidar)
        twist = None
        if moving is not None:
            twist = moving.at(values.atPose3(poses[0]).rotation().matrix())
        if moving is not None and twist is not None:
            said = said + moving.by_rates @ twist - moving.usual
        if jacobians is not None:
            J = np.zeros((3, 6))
            J[:2, :3] = axes @ skew(n_lidar)
            J[2, 3:] = n_lidar
            jacobians[0] = J @ moves[0]
            if free:
                J[:, :3] -= compensated_by_turn(observation, R_vehicle_lidar)
            for i, move in enumerate(moves[1:], start=1):
                jacobians[i] = J @ move
            by_g = np.empty((3, 3))
            by_g[:2], by_g[2] = axes @ R_lidar_map @ normal_jacobian(g), by_plane
            jacobians[len(moves)] = by_g
            for i, by_one in enumerate(nuisances.values(), start=len(moves) + 1):
                jacobians[i] = by_one
            if moving is not None and twist is not None:
                jacobians[0][:, :3] -= moving.by_rates @ twist_by_turn(twist)
        for key, by_one in nuisances.items():
            said = said - by_one @ values.atVector(key)
        r = np.empty(3)
        r[:2], r[2] = axes @ n_lidar, d
        return np.asarray(r - said)

    cov = with_heave(observation, heave_m)
    if observation.repeated is not None:
        cov += observation.repeated
    noise = gtsam.noiseModel.Gaussian.Covariance(cov / weight)
    return gtsam.CustomFactor(noise, [*poses, key_plane, *nuisances], error)


def by_frame(observation: GroundObservation) -> Array:
    """(3, `GROUND_FRAME`) change of what is predicted if the LiDAR turns, and rises."""
    out = np.zeros((3, GROUND_FRAME))
    out[:2, :3] = observation.axes_lidar @ skew(observation.normal_lidar)
    out[2, 3] = 1.0
    return out


@dataclass(frozen=True)
class _Moving:
    """How an observation changes whose points moved with the same velocities in the map.

    Attributes:
        twist_map: (6,) of the vehicle, by the trajectory.
        by_rates: (3, 6) change of the observation by that twist in vehicle axes.
        usual: (3,) what the twist makes of it at the rotation of the trajectory.
    """

    twist_map: Array
    by_rates: Array
    usual: Array

    @classmethod
    def of(cls, observation: GroundObservation) -> _Moving | None:
        """None if the observation does not tell."""
        V, R_0, by_twist = observation.twist_map, observation.R_map_vehicle, observation.by_rates
        if V is None or R_0 is None or by_twist is None:
            return None
        return cls(V, by_twist, by_twist @ turned_twist(R_0.T, V))

    def at(self, R_map_vehicle: Array) -> Array:
        """(6,) the twist in vehicle axes, at another rotation of the vehicle."""
        return turned_twist(R_map_vehicle.T, self.twist_map)


def _turning(observation: GroundObservation) -> Array:
    """(3,) angular velocity in vehicle axes with which the points of an observation were moved."""
    V, R_0 = observation.twist_map, observation.R_map_vehicle
    return np.zeros(3) if V is None or R_0 is None else R_0.T @ V[:3]


def with_heave(observation: GroundObservation, heave_m: float) -> Array:
    """(3, 3) of an observation, with the heave between scan and pose."""
    cov = observation.cov.copy()
    cov[2, 2] += heave_m**2
    return cov


def standing_factor(
    key_pose: int,
    key_plane: int,
    key_error: int,
    centre: Array,
    vehicle_height_m: float,
    weight: float = 1.0,
    sigma_m: float | None = None,
) -> gtsam.CustomFactor:
    """Role b: `r = height of the vehicle frame over the plane - vehicle_height - error`.

    Its sigma is that of one scan, by heave and waves of the ground (None: the usual heave); the
    error (`key_error`) is common to the drive.
    `centre` (2,) metres is where the plane's height is defined; `weight` is on the information.
    """

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        X = values.atPose3(key_pose)
        height, by_plane, n = height_over(values.atVector(key_plane), centre, X.translation())
        if jacobians is not None:
            J = np.zeros((1, 6))
            J[0, 3:] = n @ X.rotation().matrix()
            jacobians[0] = J
            jacobians[1] = by_plane[None]
            jacobians[2] = -np.ones((1, 1))
        return np.asarray(height - vehicle_height_m - values.atVector(key_error))

    sigma_m = HEAVE_SIGMA_M if sigma_m is None else sigma_m
    noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma_m / math.sqrt(weight))
    return gtsam.CustomFactor(noise, [key_pose, key_plane, key_error], error)


def parallel_factor(
    key_pose: int,
    key_plane: int,
    key_tilt: int,
    weight: float = 1.0,
    sigma_rad: float | None = None,
) -> gtsam.CustomFactor:
    """Role c: `r` = x and y of the plane's normal in the vehicle frame, less the drive's tilt.

    Its sigma is that of one scan, by sway and waves of the ground (None: the usual sway).
    """

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        R_vehicle_map = values.atPose3(key_pose).rotation().matrix().T
        g = values.atVector(key_plane)
        n_vehicle = R_vehicle_map @ plane_normal(g)
        if jacobians is not None:
            J = np.zeros((2, 6))
            J[:, :3] = skew(n_vehicle)[:2]
            jacobians[0] = J
            jacobians[1] = R_vehicle_map[:2] @ normal_jacobian(g)
            jacobians[2] = -np.eye(2)
        return np.asarray(n_vehicle[:2] - values.atVector(key_tilt))

    sigma_rad = SWAY_SIGMA_RAD if sigma_rad is None else sigma_rad
    noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma_rad / math.sqrt(weight))
    return gtsam.CustomFactor(noise, [key_pose, key_plane, key_tilt], error)
