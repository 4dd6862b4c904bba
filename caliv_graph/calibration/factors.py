"""The factors of the calibration graph, one function per kind, with analytic Jacobians.

`caliv_graph/calibration/README.md` defines the variables X_i, E, S_a, C and b_i; `conventions`
their keys.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import (
    left_jacobian_inverse,
    right_to_vehicle_axes,
    skew,
    turned_twist,
    twist_by_turn,
    vehicle_axes_difference,
)
from caliv_graph.products import Array
from caliv_graph.trajectory.rates import by_rates


def chain_jacobians(chain: Sequence[gtsam.Pose3]) -> tuple[gtsam.Pose3, list[Array]]:
    """The product Z of poses T_0 ... T_n, and how it moves with each of them.

    Per pose the (6, 6) derivative of a *left* perturbation of Z by a right perturbation of that
    pose: `Z = Exp(J d) Z`, J the adjoint of the product up to it.
    """
    product = chain[0]
    jacobians = [product.AdjointMap()]
    for pose in chain[1:]:
        product = product.compose(pose)
        jacobians.append(product.AdjointMap())
    return product, jacobians


@dataclass(frozen=True)
class CloudMotion:
    """How a cloud moves with errors of time and rates; of neither by itself.

    Attributes:
        twist: (6,) xi, velocity of the vehicle at the stamp, a right perturbation per second, where
            the pose is the given or smoothed one.
        R_map_vehicle: (3, 3) of that pose. The velocities in the map are what is known: in vehicle
            axes they turn with the pose.
        offset: whether the time offset of the LiDAR is free.
        apart_s: tau, mean time of the points after the stamp, to which they were moved with rates
            that err; 0: none were.
        T_vehicle_lidar: the extrinsic with which they were moved; None likewise.
        acceleration: (6,) change of xi per second: 30 ms before a stamp, where a curve turns into
            the other, the vehicle turned at another rate by 0.04 rad/s, and 0.5 mrad further.
    """

    twist: Array
    R_map_vehicle: Array
    offset: bool = False
    apart_s: float = 0.0
    T_vehicle_lidar: gtsam.Pose3 | None = None
    acceleration: Array = field(default_factory=lambda: np.zeros(6))

    def moves(
        self, pose: gtsam.Pose3, keys: Sequence[int], values: gtsam.Values
    ) -> list[tuple[gtsam.Pose3, Array, Array]]:
        """Each motion from a pose.

        With it (6, size) its right perturbation by that of its variable, and (6, 3) by a turn of
        the pose.
        """
        out, left, offset_s = [], list(keys), 0.0
        if self.offset:
            offset_s = float(values.atVector(left.pop(0))[0])
            mean, then = (self.twist_from(pose, -share * offset_s) for share in (0.5, 1.0))
            by_motion = np.asarray(gtsam.Pose3.ExpmapDerivative(-offset_s * mean))
            by_turn = -offset_s * by_motion @ twist_by_turn(mean)
            out.append((gtsam.Pose3.Expmap(-offset_s * mean), -by_motion @ then[:, None], by_turn))
        if self.apart_s:
            then = self.twist_from(pose, -offset_s)
            wrong, by_errors = values.atVector(left.pop(0)), by_rates(then[:3])
            d = self.apart_s * (then + by_errors @ wrong)
            by_twist = self.apart_s * np.asarray(gtsam.Pose3.ExpmapDerivative(d))
            by_turn = twist_by_turn(then)
            by_turn[3:] -= skew(wrong[6:]) @ skew(then[:3])
            out.append((gtsam.Pose3.Expmap(d), by_twist @ by_errors, by_twist @ by_turn))
        return out

    def twist_from(self, pose: gtsam.Pose3, after_s: float = 0.0) -> Array:
        """(6,) the twist some time after the stamp, with the same velocities in the map."""
        return self.in_axes_of(pose, self.twist + after_s * self.acceleration)

    def in_axes_of(self, pose: gtsam.Pose3, twist: Array) -> Array:
        """(6,) a twist (6,) or its change, in the axes of the present pose."""
        return turned_twist(pose.rotation().matrix().T @ self.R_map_vehicle, twist)

    def undone(self) -> gtsam.Pose3:
        """From the points as they were moved to the points as they were measured."""
        if self.T_vehicle_lidar is None:
            return gtsam.Pose3()
        back = gtsam.Pose3.Expmap(-self.apart_s * self.twist)
        return self.T_vehicle_lidar.inverse().compose(back).compose(self.T_vehicle_lidar)


STILL = CloudMotion(np.zeros(6), np.eye(3))


def predict_cloud(
    keys: Sequence[int], values: gtsam.Values, motion: CloudMotion = STILL
) -> tuple[gtsam.Pose3, list[Array]]:
    """The pose that a cloud should have, and how it moves.

    It is `C X_i Exp(-o (xi - o a / 2)) Exp(tau (xi - o a + W e)) E S_a U`, xi and a velocity and
    acceleration at the stamp, W `by_rates`, U (`undone`) what rates and extrinsic do to points that
    were not moved.

    Args:
        keys: of C, X_i, of `motion` the time offset o and the errors of the rates e, E and, unless
            the LiDAR is the reference, S_a.
        values: of all of them.
        motion: stamps are late by o, rates wrong by e.

    Returns:
        T_target_lidar; and per key the (6, size) derivative of its left perturbation.
    """
    target, vehicle, *others = keys
    X = values.atPose3(vehicle)
    moved = motion.moves(X, others, values)
    chain = [values.atPose3(target), X, *(T for T, _, _ in moved)]
    Z, moves = chain_jacobians(chain + [values.atPose3(key) for key in others[len(moved) :]])
    for i, (_, by_variable, by_turn) in enumerate(moved, start=2):
        moves[1] = np.hstack([moves[1][:, :3] + moves[i] @ by_turn, moves[1][:, 3:]])
        moves[i] = moves[i] @ by_variable
    if motion.apart_s:
        Z = Z.compose(motion.undone())
        if motion.offset:
            acceleration = motion.in_axes_of(X, motion.acceleration)
            # The shift of the origin turns with the rates, too.
            acceleration[3:] += np.cross(acceleration[:3], values.atVector(others[1])[6:])
            moves[2] = moves[2] - moves[3][:, :6] @ acceleration[:, None]
    return Z, moves


def target_pose_factor(
    keys: Sequence[int],
    T_target_lidar: gtsam.Pose3,
    information: Array,
    motion: CloudMotion = STILL,
) -> gtsam.CustomFactor:
    """A registered cloud: `r = Log(Zhat Z^-1)`, the residual at the target (`README.md` says why).

    Z is `T_target_lidar` as registered, `information` (6, 6) of its left perturbation (target
    frame), rad and m. `predict_cloud` gives Zhat from `keys` and `motion`.
    """
    Z_inverse = T_target_lidar.inverse()
    order = list(keys)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        predicted, moves = predict_cloud(order, values, motion)
        r = gtsam.Pose3.Logmap(predicted.compose(Z_inverse))
        if jacobians is not None:
            J_left = left_jacobian_inverse(r)
            for i, move in enumerate(moves):
                jacobians[i] = J_left @ move
        return r

    return gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Information(information), order, error)


def given_pose_factor(
    key_pose: int,
    key_pose_error: int,
    T_map_vehicle: gtsam.Pose3,
    sigma_rotation_rad: float,
    sigma_position_m: float,
    cov: Array | None = None,
    late: tuple[int, Array] | None = None,
) -> gtsam.CustomFactor:
    """A given pose with a white error and the Gauss-Markov error b_i.

    `r = [Log(R_given^T R), t - t_given] - b - late g`: rotation in vehicle axes, position in map
    axes, since a position filter's error does not turn with the vehicle. The white error has one
    sigma per kind of axis, or the covariance `cov` (6, 6). `late` has the key of the time offset of
    the given poses and g, (6,) rates of the vehicle in these axes, rad/s and m/s; None: it is zero.
    """
    R_given = T_map_vehicle.rotation()
    t_given = T_map_vehicle.translation()
    sigmas = np.array([sigma_rotation_rad] * 3 + [sigma_position_m] * 3)
    noise: gtsam.noiseModel.Base = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    if cov is not None:
        noise = gtsam.noiseModel.Gaussian.Covariance(cov)
    by_error = -np.eye(6)
    keys, rates = [key_pose, key_pose_error], np.zeros(6)
    if late is not None:
        keys.append(late[0])
        rates = late[1]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        T = values.atPose3(key_pose)
        rotation = T.rotation()
        w = gtsam.Rot3.Logmap(R_given.between(rotation))
        if jacobians is not None:
            J = np.zeros((6, 6))
            J[:3, :3] = gtsam.Rot3.LogmapDerivative(w)
            J[3:, 3:] = rotation.matrix()
            jacobians[0] = J
            jacobians[1] = by_error
            if late is not None:
                jacobians[2] = -rates[:, None]
        r = np.concatenate([w, T.translation() - t_given]) - values.atVector(key_pose_error)
        return r if late is None else r - rates * values.atVector(late[0])[0]

    return gtsam.CustomFactor(noise, keys, error)


def gauss_markov_factor(
    key_before: int, key_after: int, decay: float, sigmas: Array
) -> gtsam.LinearContainerFactor:
    """A step of the first-order Gauss-Markov error, `b_after = decay * b_before + noise`.

    `decay` is exp(-dt / correlation time), `sigmas` (6,) those of the step.
    """
    linear = gtsam.JacobianFactor(
        key_before,
        -decay * np.eye(6),
        key_after,
        np.eye(6),
        np.zeros(6),
        gtsam.noiseModel.Diagonal.Sigmas(sigmas),
    )
    zero = gtsam.Values()
    zero.insert(key_before, np.zeros(6))
    zero.insert(key_after, np.zeros(6))
    return gtsam.LinearContainerFactor(linear, zero)


def extrinsic_prior(
    keys: Sequence[int], T_vehicle_lidar: gtsam.Pose3, sigmas: Array
) -> gtsam.CustomFactor:
    """The initial guess of one LiDAR's extrinsic, on `T_vehicle_a = E S_a`, in vehicle axes.

    `keys` are of E and, unless the LiDAR is the reference, S_a; `sigmas` (6,) rad and m.
    """
    order = list(keys)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        T, moves = chain_jacobians([values.atPose3(key) for key in order])
        r = vehicle_axes_difference(T, T_vehicle_lidar)
        if jacobians is not None:
            # Left rotation and shift of the LiDAR's origin from a right perturbation of T.
            J = right_to_vehicle_axes(T)
            J[:3, :3] = gtsam.Rot3.LogmapDerivative(-r[:3]) @ J[:3, :3]
            to_right = T.inverse().AdjointMap()
            for i, move in enumerate(moves):
                jacobians[i] = J @ to_right @ move
        return r

    return gtsam.CustomFactor(gtsam.noiseModel.Diagonal.Sigmas(sigmas), order, error)
