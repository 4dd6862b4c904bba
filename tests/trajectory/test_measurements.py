"""Measurements carried to nodes: the same however many are carried at a time."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caliv_graph.products import ImuSamples, TwistSamples
from caliv_graph.trajectory.factors import velocity_residuals
from caliv_graph.trajectory.imu import DeadReckoning
from caliv_graph.trajectory.measurements import (
    NodeOrientations,
    nearest_node,
    orientations_at_nodes,
    velocities_at_nodes,
)
from caliv_graph.trajectory.noise import imu_noise
from caliv_graph.trajectory.states import States
from caliv_graph.trajectory.wheels import UNMEASURED_M_S
from tests.trajectory.motions import START_NS, Sensors, config_for

SAMPLES = 400


def carried(nodes_ns: np.ndarray[tuple[int], np.dtype[np.int64]]) -> NodeOrientations:
    """Orientations of a turning IMU, of which some are missing, at nodes."""
    rng = np.random.default_rng(3)
    stamps = START_NS + 10_000_000 * np.arange(SAMPLES, dtype=np.int64)
    rate = np.array([0.02, -0.03, 0.2])
    turns = Rotation.from_rotvec(rate * (stamps - START_NS)[:, None] * 1e-9)
    noisy = turns * Rotation.from_rotvec(1e-3 * rng.standard_normal((SAMPLES, 3)))
    q = noisy.as_quat()
    q[rng.random(SAMPLES) < 0.1] = np.nan
    rates = np.tile(rate, (SAMPLES, 1))
    imu = ImuSamples(stamps, rates, np.tile([0.0, 0.0, 9.81], (SAMPLES, 1)), q)
    cov = np.broadcast_to(1e-6 * np.eye(3), (SAMPLES, 3, 3))
    dead = DeadReckoning(stamps, rates, imu.specific_force)
    found = orientations_at_nodes(imu, cov, nodes_ns, dead, imu_noise(imu, config_for(Sensors())))
    assert found is not None
    return found


def test_the_nearest_node_is_exact_to_the_nanosecond_and_the_later_of_two() -> None:
    nodes = START_NS + np.array([0, 3, 7], np.int64)
    stamps = START_NS + np.array([-5, 1, 2, 4, 5, 6, 20], np.int64)
    np.testing.assert_array_equal(nearest_node(nodes, stamps), [0, 0, 1, 1, 2, 2, 2])
    np.testing.assert_array_equal(nearest_node(nodes[:1], stamps), np.zeros(7))


@pytest.mark.parametrize("at_a_time", [1, 7, 64])
def test_orientations_in_parts_are_those_of_the_whole(
    at_a_time: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes = START_NS + np.array([0, 3, 90, 1000, 1010, 2500, 3900], np.int64) * 1_000_000
    whole = carried(nodes)

    monkeypatch.setattr("caliv_graph.trajectory.measurements.SAMPLES_AT_A_TIME", at_a_time)
    parts = carried(nodes)

    assert len(whole.nodes) >= 5
    # To the last bit: what is carried together must not show in a result.
    np.testing.assert_array_equal(parts.nodes, whole.nodes)
    np.testing.assert_array_equal(parts.R_map_imu, whole.R_map_imu)
    np.testing.assert_array_equal(parts.cov, whole.cov)
    # And they are orientations: the turn from the first node to the last.
    turn = Rotation.from_matrix(whole.R_map_imu[0].T @ whole.R_map_imu[-1]).as_rotvec()
    assert turn[2] == pytest.approx(0.2 * 3.9, abs=2e-3)


@pytest.mark.parametrize("height_m", [0.0, 0.4])
def test_forward_velocities_of_a_pitching_vehicle_agree_with_its_motion(height_m: float) -> None:
    """Gravity adds to each until the node, along axes that turn: 5 mm/s at half a rad/s.

    Of a point above the vehicle's origin they are larger while it pitches nose down.
    """
    rate, speed = 0.5, 3.0
    at = 10**12 + 2_000_000 * np.arange(1001)
    seconds = (at - at[0]) * 1e-9
    gyro = np.tile([0.0, rate, 0.0], (len(at), 1))
    turned = np.array([gtsam.Rot3.Ry(rate * s).matrix() for s in seconds])
    force = np.array([0.0, 0.0, -rate * speed]) + 9.8 * turned[:, 2]
    dead = DeadReckoning(at, gyro, force)
    nodes = at[0] + 100_000_000 * np.arange(1, 19)
    measured = speed + rate * height_m
    odometry = TwistSamples(at[25:-25:5], np.tile([measured, 0.0, 0.0], (len(at[25:-25:5]), 1)))
    cov = np.tile(np.diag([0.03**2, 10.0**2, 10.0**2]), (len(odometry.stamps_ns), 1, 1))
    samples = ImuSamples(at, gyro, force)
    noise = imu_noise(samples, config_for(Sensors()))
    T_vehicle_twist = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, height_m]))
    found = velocities_at_nodes(odometry, cov, nodes, dead, noise, T_vehicle_twist.inverse())
    assert found is not None
    R = np.array([gtsam.Rot3.Ry(rate * s).matrix() for s in (nodes - at[0]) * 1e-9])
    none = np.zeros((len(nodes), 3))
    states = States(R, none, R[:, :, 0] * speed, none, none)
    residuals = velocity_residuals(states, found.nodes, found.velocity_imu, found.delay_s, 9.8)
    assert np.abs(residuals[:, 0]).max() < 5e-4


def test_forward_velocities_along_axes_that_turn_tell_none_to_the_side() -> None:
    """Noise of 3 cm/s along axes that differ by 10 mrad would be 3 m/s to the side."""
    rates, speed, offset = np.array([0.1, 0.3, 0.5]), 3.0, np.array([0.2, -1.2, 0.4])
    at = 10**12 + 2_000_000 * np.arange(1001)
    seconds = (at - at[0]) * 1e-9
    turned = np.array([gtsam.Rot3.Expmap(rates * s).matrix() for s in seconds])
    # Of the IMU: that of the odometry's origin, and what the lever adds.
    velocity = turned @ (np.array([speed, 0.0, 0.0]) + np.cross(rates, offset))
    lifted = np.gradient(velocity, seconds, axis=0) + np.array([0.0, 0.0, 9.8])
    force = np.einsum("nji,nj->ni", turned, lifted)
    dead = DeadReckoning(at, np.tile(rates, (len(at), 1)), force)
    nodes = at[0] + 100_000_000 * np.arange(1, 19)
    noise = 0.03 * np.random.default_rng(1).standard_normal(len(at[25:-25:10]))
    measured = np.outer(speed + noise, [1.0, 0.0, 0.0])
    odometry = TwistSamples(at[25:-25:10], measured)
    lateral = UNMEASURED_M_S**2
    cov = np.tile(np.diag([0.03**2, lateral, lateral]), (len(noise), 1, 1))
    samples = ImuSamples(at, dead.gyro, force)
    T_twist_imu = gtsam.Pose3(gtsam.Rot3(), offset)

    found = velocities_at_nodes(
        odometry,
        cov,
        nodes,
        dead,
        imu_noise(samples, config_for(Sensors())),
        T_twist_imu,
        alone=np.ones(len(noise), dtype=bool),
    )

    assert found is not None
    here = np.searchsorted(at, nodes)
    none = np.zeros((len(nodes), 3))
    states = States(turned[here], none, velocity[here], none, none)
    residuals = velocity_residuals(states, found.nodes, found.velocity_imu, found.delay_s, 9.8)
    variances, axes = np.linalg.eigh(found.cov)
    forward = np.einsum("mi,mi->m", axes[:, :, 0] * np.sign(axes[:, :1, 0]), residuals)
    of_node = nearest_node(nodes, odometry.stamps_ns)
    mean = np.array([noise[of_node == k].mean() for k in found.nodes])
    # Of its five messages, but for the ends, where those beyond the nodes are left out.
    assert forward[1:-1] == pytest.approx(-mean[1:-1], abs=1e-4)
    assert np.sqrt(variances[1:-1, 0]) == pytest.approx(0.03 / np.sqrt(5.0), rel=0.1)
    assert np.abs(residuals[:, 1:]).max() < 0.1
    assert np.sqrt(variances[:, 1:]) == pytest.approx(UNMEASURED_M_S)
