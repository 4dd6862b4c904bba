"""An estimate of the smoother at its nodes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam

from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.imu import DeadReckoning, Inertial, interpolate


@dataclass(frozen=True)
class States:
    """An estimate of all nodes.

    Attributes:
        R_map_imu: (n, 3, 3).
        p_map_imu: (n, 3) metres.
        velocity_map: (n, 3) m/s of the IMU's origin.
        force_bias: (n, 3) m/s^2, imu frame.
        gyro_bias: (n, 3) rad/s, imu frame.
        yaw_bias_rad: of the orientation source; 0 if not estimated.
    """

    R_map_imu: Array
    p_map_imu: Array
    velocity_map: Array
    force_bias: Array
    gyro_bias: Array
    yaw_bias_rad: float = 0.0


def first_nodes(states: States, n: int) -> States:
    """The estimate of the first n nodes."""
    return replace(
        states,
        R_map_imu=states.R_map_imu[:n],
        p_map_imu=states.p_map_imu[:n],
        velocity_map=states.velocity_map[:n],
        force_bias=states.force_bias[:n],
        gyro_bias=states.gyro_bias[:n],
    )


def poses_of_vehicle(
    states: States, nodes: IntArray, T_vehicle_imu: gtsam.Pose3
) -> tuple[gtsam.Pose3, ...]:
    """T_map_vehicle of some nodes, by their indices."""
    T_imu_vehicle = T_vehicle_imu.inverse()
    return tuple(
        gtsam.Pose3(gtsam.Rot3(R), p).compose(T_imu_vehicle)
        for R, p in zip(states.R_map_imu[nodes], states.p_map_imu[nodes], strict=True)
    )


def without_bias(inertial: Inertial, nodes_ns: IntArray, states: States) -> DeadReckoning:
    """Dead reckoning with the biases of an estimate, linear between nodes."""
    at = inertial.stamps_ns
    return DeadReckoning(
        at,
        inertial.gyro - interpolate(at, nodes_ns, states.gyro_bias),
        inertial.force - interpolate(at, nodes_ns, states.force_bias),
    )
