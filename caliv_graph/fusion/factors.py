"""Factors for localisers in which extrinsics are variables beside the vehicle's poses.

Variables: X = T_map_vehicle at a stamp, M = T_vehicle_lidar of a LiDAR.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import gtsam
import numpy as np

from caliv_graph.products import Array

NoiseModel = gtsam.noiseModel.Base


def random_walk(
    key_before: int, key_after: int, duration_s: float, sigmas: Array
) -> gtsam.BetweenFactorPose3:
    """An extrinsic that may drift slowly: a random walk between two times.

    Args:
        key_before: key of M at the earlier time.
        key_after: key of M at the later time.
        duration_s: time between them, seconds.
        sigmas: (6,) sigmas of the walk, lidar axes: rotation (rad/sqrt(s)), then translation
            (m/sqrt(s)).

    Raises:
        ValueError: the duration or a sigma is zero or negative.
    """
    step = math.sqrt(duration_s) * np.asarray(sigmas) if duration_s > 0.0 else np.zeros(6)
    if not (step > 0.0).all():
        raise ValueError("random_walk: duration_s and all sigmas have to be above zero")
    noise = gtsam.noiseModel.Diagonal.Sigmas(step)
    return gtsam.BetweenFactorPose3(key_before, key_after, gtsam.Pose3(), noise)


def lidar_pose_error(
    T_map_vehicle: gtsam.Pose3, T_vehicle_lidar: gtsam.Pose3, T_map_lidar: gtsam.Pose3
) -> tuple[Array, Array, Array]:
    """`r = Log(Z^-1 X M)` of a measured pose Z = T_map_lidar, and its derivatives.

    Returns:
        r (6,) in lidar axes; and (6, 6) by right perturbations of X and of M.
    """
    r = gtsam.Pose3.Logmap(T_map_lidar.between(T_map_vehicle.compose(T_vehicle_lidar)))
    by_extrinsic = np.asarray(gtsam.Pose3.LogmapDerivative(gtsam.Pose3.Expmap(r)))
    by_vehicle = by_extrinsic @ T_vehicle_lidar.inverse().AdjointMap()
    return np.asarray(r), by_vehicle, by_extrinsic


def lidar_pose_factor(
    key_vehicle: int, key_extrinsic: int, T_map_lidar: gtsam.Pose3, noise: NoiseModel
) -> gtsam.CustomFactor:
    """A scan that was registered to a map, with the extrinsic as a variable.

    GTSAM has no native factor of a pose, an extrinsic and their measured product. This factor
    cannot be serialised; `linear_lidar_pose_factor` can.

    Args:
        key_vehicle: key of X.
        key_extrinsic: key of M.
        T_map_lidar: the measured pose.
        noise: noise of r, 6 dimensions, lidar axes, rotation before translation.
    """

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        r, by_vehicle, by_extrinsic = lidar_pose_error(
            values.atPose3(key_vehicle), values.atPose3(key_extrinsic), T_map_lidar
        )
        if jacobians is not None:
            jacobians[0], jacobians[1] = by_vehicle, by_extrinsic
        return r

    return gtsam.CustomFactor(noise, [key_vehicle, key_extrinsic], error)


def linear_lidar_pose_factor(
    key_vehicle: int,
    key_extrinsic: int,
    T_map_lidar: gtsam.Pose3,
    noise: NoiseModel,
    values: gtsam.Values,
) -> gtsam.LinearContainerFactor:
    """`lidar_pose_factor` linearised once, at given values: native and serialisable.

    A fixed-lag smoother does the same with a factor that leaves its window. It is exact to first
    order about `values`. Create it again when the estimate has moved by more than about a degree.

    Args:
        key_vehicle: key of X.
        key_extrinsic: key of M.
        T_map_lidar: the measured pose.
        noise: noise of r, as in `lidar_pose_factor`. The weight of a robust kernel is fixed at
            `values`.
        values: values of X and M; others are ignored.
    """
    factor = lidar_pose_factor(key_vehicle, key_extrinsic, T_map_lidar, noise)
    point = gtsam.Values()
    point.insert(key_vehicle, values.atPose3(key_vehicle))
    point.insert(key_extrinsic, values.atPose3(key_extrinsic))
    return gtsam.LinearContainerFactor(factor.linearize(point), point)


def serialisable(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values
) -> gtsam.NonlinearFactorGraph:
    """A graph in which every custom factor is replaced by its linearisation.

    Args:
        graph: any factors; native ones are kept.
        values: linearisation point of the custom factors.
    """
    out = gtsam.NonlinearFactorGraph()
    for i in range(graph.size()):
        factor = graph.at(i)
        if isinstance(factor, gtsam.CustomFactor):
            point = gtsam.Values()
            for key in factor.keys():  # noqa: SIM118 - a factor is no dict
                _insert(point, values, key)
            factor = gtsam.LinearContainerFactor(factor.linearize(point), point)
        out.add(factor)
    return out


def _insert(point: gtsam.Values, values: gtsam.Values, key: int) -> None:
    """Copies a pose, a rotation or a vector from one `Values` to another."""
    read: Callable[[int], object]
    for read in (values.atPose3, values.atRot3, values.atVector):
        try:
            value = read(key)
        except RuntimeError:
            continue
        point.insert(key, value)
        return
    raise ValueError(f"{gtsam.DefaultKeyFormatter(key)}: is no pose, rotation or vector")
