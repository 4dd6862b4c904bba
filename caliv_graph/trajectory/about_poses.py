"""A smoothed trajectory linearised elsewhere than at its own estimate (`README.md`, section 9a)."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from caliv_graph.conventions import key_imu
from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.imu import exp_so3, interpolate, log_so3
from caliv_graph.trajectory.measurements import nearest_node
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.solve import solve
from caliv_graph.trajectory.states import States, poses_of_vehicle
from caliv_graph.trajectory.with_parameters import linearised

HOLD_RAD, HOLD_M = 1e-3, 0.005
"""1 sigma of the hold on the poses: they are no evidence, and are let go before the result. As much
as LiDARs err by from scan to scan, so that velocities and biases between them are the IMU's."""


def about_poses(
    smoothed: SmoothedTrajectory, stamps_ns: IntArray, R_map_vehicle: Array, t_map_vehicle: Array
) -> SmoothedTrajectory:
    """The same motion data, linearised at the states that poses of the vehicle ask for.

    Nothing is added to the data: the gradient of its Gaussian, which is zero at its own estimate,
    pulls back to there. `smoothed` is without errors that are correlated over time.

    Args:
        smoothed: of a drive.
        stamps_ns: (k,) of the poses, increasing, with a node for each.
        R_map_vehicle: (k, 3, 3).
        t_map_vehicle: (k, 3) metres, the drive's map.

    Raises:
        KeyError: a stamp has no node.
    """
    if smoothed.correlated:
        raise ValueError("the states of a trajectory with correlated errors stay")
    data, nodes = smoothed.data, smoothed.nodes_ns
    i = smoothed.node_indices(stamps_ns)
    R_iv, t_iv = data.T_vehicle_imu.rotation().matrix(), data.T_vehicle_imu.translation()
    R, t = R_map_vehicle @ R_iv, t_map_vehicle + R_map_vehicle @ t_iv
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([HOLD_RAD, HOLD_M], 3))
    held = [
        gtsam.PriorFactorPose3(key_imu(node), gtsam.Pose3(gtsam.Rot3(own), at), noise)
        for node, own, at in zip(i.tolist(), R, t, strict=True)
    ]
    kernel = data.config.robust.kernel
    states = _moved(smoothed.states, nodes, i, R, t)
    estimate = solve(data, nodes, states, smoothed.gnss_dropped, kernel, held=held)
    wanted, kept = smoothed.trajectory.stamps_ns, smoothed.chain_nodes
    poses = poses_of_vehicle(estimate.states, nearest_node(nodes, wanted), data.T_vehicle_imu)
    there = replace(
        smoothed,
        trajectory=replace(smoothed.trajectory, T_map_vehicle=poses),
        states=estimate.states,
        built_with=estimate.built_with,
        elsewhere=True,
    )
    del estimate  # its graph
    there = linearised(there)
    return there if kept is None else replace(there, chain=there.chain.only(kept), chain_nodes=kept)


def _moved(states: States, nodes: IntArray, i: IntArray, R: Array, t: Array) -> States:
    """States, turned and shifted with the nodes `i` (k,) to R_map_imu and t_map_imu there."""
    turn = R @ np.swapaxes(states.R_map_imu[i], 1, 2)
    turns = exp_so3(interpolate(nodes, nodes[i], log_so3(turn)))
    shift = t - np.einsum("kij,kj->ki", turns[i], states.p_map_imu[i])
    shifts = interpolate(nodes, nodes[i], shift)
    return replace(
        states,
        R_map_imu=turns @ states.R_map_imu,
        p_map_imu=np.einsum("nij,nj->ni", turns, states.p_map_imu) + shifts,
        velocity_map=np.einsum("nij,nj->ni", turns, states.velocity_map),
    )
