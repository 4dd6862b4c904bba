"""The planned chain against the smoother that it stands for, and against numerical derivatives."""

from __future__ import annotations

import math
from pathlib import Path

import gtsam
import numpy as np
import pytest

from caliv_graph.config.load import parse_config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.geometry.se3 import retract_vehicle_axes
from caliv_graph.planning.assumptions import Assumptions, Ground
from caliv_graph.planning.information import Columns, add_clouds, add_ground, eliminate_heave
from caliv_graph.planning.motion import NODE_NS, PlannedMotion, plan_motion
from caliv_graph.planning.sightings import Sighting, ground_by_range_bias, placements, sight
from caliv_graph.products import Array, IntArray
from caliv_graph.scenario.drive_models import ArcDrive, DriveModel, SCurveDrive, StraightDrive
from caliv_graph.scenario.drives import Drive, make_drive
from caliv_graph.scenario.model import Scenario
from caliv_graph.scenario.sensor_models import OutageModel
from caliv_graph.simulation.recording import simulate_drive
from caliv_graph.simulation.writer import config_of
from caliv_graph.targets.ground.planes import DISTANCE_FLOOR_M, NORMAL_FLOOR_RAD
from caliv_graph.trajectory.chain import Chain
from caliv_graph.trajectory.measurements import nearest_node
from caliv_graph.trajectory.smooth import smooth_trajectory
from tests.drives_with_chair import paper_scenario

STAMPS = np.arange(1, 9) * NANOSECONDS_PER_SECOND


def planned_covariance(motion: PlannedMotion, stamps: IntArray) -> Array:
    """(6m, 6m) of T_map_vehicle at some stamps, right perturbations."""
    n = len(motion.nodes_ns)
    chain = Chain(motion.diagonal, motion.coupling, np.zeros((n, 15, 0)), np.zeros((0, 0)))
    cov = np.linalg.inv(chain.pose_information(motion.nodes_of(stamps)))
    turn = np.kron(np.eye(len(stamps)), motion.to_vehicle)
    return np.asarray(turn @ cov @ turn.T)


def relative(poses: tuple[gtsam.Pose3, ...], cov: Array, a: int, b: int) -> Array:
    """(6, 6) covariance of pose b against pose a."""
    J = np.zeros((6, len(cov)))
    J[:, 6 * b : 6 * b + 6] = np.eye(6)
    J[:, 6 * a : 6 * a + 6] = -np.asarray(poses[b].between(poses[a]).AdjointMap())
    return np.asarray(J @ cov @ J.T)


def scenario_of(drive: DriveModel) -> Scenario:
    scenario = paper_scenario(drive)
    imu = scenario.imu.model_copy(
        update={"mounting": PoseConfig(xyz=(0.8, -0.3, 0.4), rpy_deg=(2.0, -3.0, 90.0))}
    )
    gnss = scenario.gnss.model_copy(
        update={
            "lever_arm": (-0.5, 0.2, 1.5),
            "phase_s": 0.03,
            "outages": (OutageModel(start_s=3.0, duration_s=2.0),),
        }
    )
    return scenario.model_copy(update={"imu": imu, "gnss": gnss})


@pytest.mark.parametrize(
    "drive", [SCurveDrive(duration_s=9.0), StraightDrive(duration_s=9.0)], ids=["S", "straight"]
)
def test_covariances_are_those_of_the_smoother(drive: DriveModel) -> None:
    scenario = scenario_of(drive)
    recording = simulate_drive(scenario, 1)
    raw = config_of(recording, has_bag=True)
    raw["gnss"]["lever_arm_sigma"], raw["imu"]["rotation_sigma_deg"] = 1e-7, 1e-6  # known
    raw["imu"]["gyroscope_scale_sigma"] = 0.0
    config = parse_config(raw, "config", Path())
    stamps = STAMPS + recording.truth.start_ns
    information, poses = smooth_trajectory(recording.motion(), config, stamps).joint_information(
        stamps
    )
    cov = np.asarray(np.linalg.inv(information), dtype=np.float64)

    motion = plan_motion(recording.truth.drive, scenario, STAMPS, "sensors")
    planned = planned_covariance(motion, STAMPS)

    # Huber takes a twentieth of the fixes' information; the rest of the difference is noise in
    # where things were linearised.
    for i in range(len(STAMPS)):
        block = slice(6 * i, 6 * i + 6)
        ratio = np.sqrt(np.diag(planned[block, block]) / np.diag(cov[block, block]))
        assert ratio == pytest.approx(np.ones(6), abs=0.1)
    # What extrinsics depend on: errors of poses against each other, 1 s and 7 s apart.
    for a, b in ((2, 3), (3, 4), (0, 7)):
        one, other = relative(poses, planned, a, b), relative(poses, cov, a, b)
        assert np.sqrt(np.diag(one) / np.diag(other)) == pytest.approx(np.ones(6), abs=0.1)


def test_a_longer_outage_costs_position() -> None:
    scenario = scenario_of(ArcDrive(duration_s=9.0))
    drive = make_drive(scenario.drive)
    at = np.array([4 * NANOSECONDS_PER_SECOND])

    def sigma(*outages: OutageModel) -> Array:
        gnss = scenario.gnss.model_copy(update={"outages": outages})
        motion = plan_motion(drive, scenario.model_copy(update={"gnss": gnss}), at, "sensors")
        return np.sqrt(np.diag(planned_covariance(motion, at)))

    without = sigma()
    outage = sigma(OutageModel(start_s=1.5, duration_s=5.0))
    assert (outage[3:] > 1.2 * without[3:]).all()


def test_without_gnss_the_map_begins_at_the_start() -> None:
    scenario = scenario_of(ArcDrive(duration_s=9.0))
    gnss = scenario.gnss.model_copy(update={"enabled": False})
    scenario = scenario.model_copy(update={"gnss": gnss})

    motion = plan_motion(make_drive(scenario.drive), scenario, STAMPS, "sensors")

    sigma = np.sqrt(np.diag(planned_covariance(motion, STAMPS))).reshape(-1, 6)
    assert (np.diff(np.linalg.norm(sigma[:, 3:], axis=1)) > 0.0).all()


def test_given_poses_have_the_sigmas_that_the_scenario_states() -> None:
    scenario = paper_scenario(position_sigma_m=0.004, rotation_sigma_rad=0.002)

    motion = plan_motion(make_drive(scenario.drive), scenario, STAMPS, "poses")

    cov = planned_covariance(motion, STAMPS)
    sigma = np.tile([0.002] * 3 + [0.004] * 3, len(STAMPS))
    assert cov == pytest.approx(np.diag(sigma**2), abs=1e-9)


def test_given_poses_wander_as_stated() -> None:
    scenario = paper_scenario(position_sigma_m=0.004, rotation_sigma_rad=0.002)
    poses = scenario.poses.model_copy(update={"position_walk_m_sqrts": 0.01})
    scenario = scenario.model_copy(update={"poses": poses})

    motion = plan_motion(make_drive(scenario.drive), scenario, STAMPS, "poses")

    sigma = np.sqrt(np.diag(planned_covariance(motion, STAMPS))).reshape(-1, 6)
    # From the first pose on: 4 mm, and 10 mm times the root of the time.
    expected = np.sqrt(0.004**2 + 0.01**2 * np.arange(len(STAMPS)))
    for axis in (3, 4, 5):
        assert sigma[:, axis] == pytest.approx(expected, rel=1e-3)


def test_nodes_are_at_the_stamps_and_dense_enough() -> None:
    scenario = paper_scenario()
    stamps = np.array([33_000_000, 63_000_000, 5_000_000_123])

    nodes = plan_motion(make_drive(scenario.drive), scenario, stamps, "sensors").nodes_ns

    assert set(stamps.tolist()) <= set(nodes.tolist())
    assert np.diff(nodes).max() <= 1.6 * NODE_NS
    assert np.diff(nodes).min() > 1_000_000
    assert nearest_node(nodes, stamps + 400_000).tolist() == nearest_node(nodes, stamps).tolist()


# ------------------------------------------------------------------ Jacobians


class OneScan:
    """One scan of a scenario's first LiDAR on a ramp-free drive, as a function of all variables."""

    def __init__(self, ground: Ground) -> None:
        self.scenario = paper_scenario(ArcDrive(duration_s=17.0))
        self.drive: Drive = make_drive(self.scenario.drive)
        self.placement = placements(self.scenario)[0]
        whole = sight(self.drive, self.scenario, "front", self.placement, Assumptions().extraction)
        at = 20
        self.sighting = Sighting(
            "front",
            whole.placement,
            whole.scans,
            whole.stamps_ns,
            whole.range_m,
            whole.points,
            whole.towards_deg,
            whole.centres_lidar,
            np.array([at]),
        )
        self.stamps = whole.stamps_ns[[at]]
        self.motion = plan_motion(self.drive, self.scenario, self.stamps, "sensors")
        self.node = int(self.motion.nodes_of(self.stamps)[0])
        self.columns = Columns(("front",), True, [self.placement.name], ground)
        self.X = gtsam.Pose3(
            gtsam.Rot3(self.motion.R_map_vehicle[self.node]), self.motion.position_map[self.node]
        )
        self.E = self.scenario.lidars["front"].mounting.pose()
        self.C = gtsam.Pose3(gtsam.Rot3(), -self.placement.centre_map)

    @property
    def size(self) -> int:
        return 6 + self.columns.size

    def parts(self, d: Array) -> tuple[gtsam.Pose3, gtsam.Pose3, gtsam.Pose3]:
        """X, E and C moved by (size,) d: pose, mounting, time offset, target, ground."""
        late = d[6 + self.columns.offset("front")]
        twist = self.motion.twist[self.node]
        X = self.X.compose(gtsam.Pose3.Expmap(d[:6])).compose(gtsam.Pose3.Expmap(-late * twist))
        E = retract_vehicle_axes(self.E, d[6:12])
        target = self.columns.target(self.placement.name)
        C = gtsam.Pose3.Expmap(d[6 + target.start : 6 + target.stop]).compose(self.C)
        return X, E, C


def jacobian(function: object, size: int) -> Array:
    step = 1e-6
    assert callable(function)
    return np.array(
        [(function(step * e) - function(-step * e)) / (2.0 * step) for e in np.eye(size)]
    ).T


def test_clouds_information_is_that_of_numerical_derivatives() -> None:
    scan = OneScan("none")
    H = np.zeros((len(scan.motion.nodes_ns), scan.size, scan.size))

    add_clouds(H, scan.motion, scan.scenario, scan.sighting, scan.placement, scan.columns)

    X, E, C = scan.parts(np.zeros(scan.size))
    Z = C.compose(X).compose(E)

    def residual(d: Array) -> Array:
        X, E, C = scan.parts(d)
        return np.asarray(gtsam.Pose3.Logmap(C.compose(X).compose(E).compose(Z.inverse())))

    J = jacobian(residual, scan.size)
    target = slice(6 + scan.columns.target("chair").start, 6 + scan.columns.target("chair").stop)
    info = H[scan.node][target, target]
    expected = J.T @ info @ J
    assert H[scan.node] == pytest.approx(expected, abs=1e-6 * np.abs(expected).max())
    assert np.abs(np.delete(H, scan.node, axis=0)).max() == 0.0


def test_grounds_information_is_that_of_numerical_derivatives() -> None:
    scan = OneScan("height")
    columns = scan.columns
    H = np.zeros((len(scan.motion.nodes_ns), scan.size, scan.size))

    add_ground(
        H,
        scan.motion,
        scan.scenario,
        scan.drive,
        scan.stamps,
        columns,
        Assumptions(ground="height"),
    )

    anchor = scan.motion.position_map[scan.node]

    def residual(d: Array) -> Array:
        """The normal in the LiDAR's frame, its distance, and the vehicle's, over their sigmas."""
        X, E, _ = scan.parts(d)
        a, b, height, error = d[6 + columns.plane :]
        normal = np.array([-a, -b, 1.0]) / math.sqrt(1.0 + a * a + b * b)
        foot = np.array([*anchor[:2], height + anchor[2]])
        T = X.compose(E)
        rises = ground_by_range_bias(scan.scenario.lidars["front"])
        rises = rises @ d[6 + columns.all_biases[:3]]
        seen_turned = gtsam.Rot3.Expmap(d[6 + columns.all_biases[3:6]])
        (seen_higher,) = d[6 + columns.all_biases[6:]]
        R = X.rotation().compose(seen_turned).compose(E.rotation()).matrix()
        normal_seen = normal + X.rotation().matrix()[:, :2] @ rises[:2]
        over = normal @ (T.translation() - foot) + rises[2] + seen_higher
        stands = normal @ (X.translation() - foot) - error
        return np.concatenate(
            [
                R.T @ normal_seen / NORMAL_FLOOR_RAD,
                [over / DISTANCE_FLOOR_M, stands / math.hypot(0.005, DISTANCE_FLOOR_M)],
            ]
        )

    J = jacobian(residual, scan.size)
    expected = J.T @ J
    assert H[scan.node] == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())


def test_heave_is_one_more_unknown_of_each_scan() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(2, 9, 9))
    H = root @ np.swapaxes(root, 1, 2)
    sigma = 0.3

    found = eliminate_heave(H, sigma)

    for before, after in zip(H, found, strict=True):
        # With the heave as a variable of its own beside z, marginalised by covariances.
        both = np.block([[before, before[:, [5]]], [before[[5]], before[[5], [5]].reshape(1, 1)]])
        both[9, 9] += sigma**-2.0
        expected = np.linalg.inv(np.linalg.inv(both + 1e-12 * np.eye(10))[:9, :9])
        assert after == pytest.approx(expected, rel=1e-4, abs=1e-6)
