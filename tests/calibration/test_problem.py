"""What takes part in a calibration, by which key, and in whose axes."""

from __future__ import annotations

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.linear import retract
from caliv_graph.calibration.problem import HEAVE_SIGMA_M, Problem, pose_problem
from caliv_graph.calibration.sensor_noise import SensorNoise
from caliv_graph.config.guesses import TRUSTED_SIGMAS
from caliv_graph.config.lidars import LidarConfig, PoseSigmaConfig
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.conventions import key_extrinsic, key_sensor, key_target, key_vehicle
from caliv_graph.errors import SolveError
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.products import TargetCloud, TargetObservation, Trajectory
from caliv_graph.targets.ground.planes import DISTANCE_FLOOR_M, NORMAL_FLOOR_RAD
from caliv_graph.trajectory.select import GivenTrajectory
from tests.calibration.problems import make_case, moved
from tests.samples import MOUNTINGS, pose


def config_of(*names: str, reference: str = "", fixed: tuple[str, ...] = ()) -> Config:
    return Config(
        lidars={
            name: LidarConfig(
                topic=f"sensor_{i}",
                initial=PoseConfig(xyz=MOUNTINGS[name][0], rpy_deg=MOUNTINGS[name][1]),
                sigma=PoseSigmaConfig(xyz=(0.1, 0.2, 0.3), rpy_deg=(1.0, 2.0, 3.0)),
                fixed=name in fixed,
            )
            for i, name in enumerate(names)
        },
        reference=reference,
    )


def observed(placement: int, *seen: tuple[str, int, int]) -> TargetObservation:
    """A placement seen by (lidar, drive, stamp_ns)."""
    return TargetObservation(
        placement,
        f"target {placement}",
        np.zeros(3),
        tuple(TargetCloud(n, d, s, np.zeros((60, 3)), f"{n}/{s}") for n, d, s in seen),
    )


def drive(*stamps: int, x: float = 0.0) -> GivenTrajectory:
    """A pose per stamp, as many metres on as the stamp has nanoseconds."""
    return GivenTrajectory(
        Trajectory(
            np.array(stamps, dtype=np.int64),
            tuple(gtsam.Pose3(gtsam.Rot3(), np.array([x + s, 0.0, 0.0])) for s in stamps),
        )
    )


def small_problem(**changes: str) -> Problem:
    """Two drives; the rear LiDAR sees the second target only."""
    observations = [
        observed(0, ("front", 0, 30), ("front", 0, 10), ("left", 0, 10)),
        observed(1, ("front", 1, 5), ("rear", 1, 5), ("rear", 1, 10)),
    ]
    config = config_of("front", "rear", "left", reference=changes.get("reference", "rear"))
    return pose_problem(observations, [drive(10, 20, 30), drive(5, 10, x=1000.0)], config)


def test_poses_are_those_of_clouds_in_order_of_drive_and_stamp() -> None:
    problem = small_problem()
    assert problem.poses == ((0, 10), (0, 30), (1, 5), (1, 10))
    # Each drive's map begins at its first pose.
    assert [T.x() for T in problem.T_map_vehicle] == [0.0, 20.0, 0.0, 5.0]
    assert problem.clouds == 6
    # In order of placement and cloud.
    assert [problem.lidars[a] for a in problem.cloud_lidar] == [
        "front",
        "front",
        "left",
        "front",
        "rear",
        "rear",
    ]
    assert problem.cloud_pose.tolist() == [1, 0, 0, 2, 2, 3]
    assert problem.cloud_placement.tolist() == [0, 0, 0, 1, 1, 1]
    assert problem.placements == 2
    assert problem.drives().tolist() == [0, 0, 1, 1]
    assert problem.times_s()[:2] == pytest.approx([0.0, 20e-9])


def test_heave_and_waves_are_those_of_the_data() -> None:
    known = SensorNoise(0.002, np.array([1e-3, 1e-3, 7e-3]))
    observations = [observed(0, ("front", 0, 10), ("front", 0, 20))]

    problem = pose_problem(observations, [drive(10, 20)], config_of("front"), known)

    assert problem.heave_m == 0.002
    assert problem.floors.tolist() == [1e-3, 1e-3, 7e-3]
    usual = pose_problem(observations, [drive(10, 20)], config_of("front"))
    assert usual.heave_m == HEAVE_SIGMA_M
    assert usual.floors.tolist() == [NORMAL_FLOOR_RAD, NORMAL_FLOOR_RAD, DISTANCE_FLOOR_M]


def test_lidars_keep_the_order_of_the_config() -> None:
    problem = small_problem()
    assert problem.lidars == ("front", "rear", "left")
    assert problem.reference == "rear"
    for name in problem.lidars:
        assert problem.guesses[name].equals(pose(*MOUNTINGS[name]), 1e-12)


def test_sigmas_are_of_the_vehicle_s_axes_in_radians_and_metres() -> None:
    degree = math.pi / 180.0
    assert small_problem().prior_sigmas["front"] == pytest.approx(
        [degree, 2 * degree, 3 * degree, 0.1, 0.2, 0.3]
    )


def test_keys_are_in_the_order_of_the_product() -> None:
    problem = small_problem()
    E, front, left = key_extrinsic(), key_sensor(0), key_sensor(2)
    assert problem.extrinsic_keys_of("rear") == (E,)
    assert problem.extrinsic_keys_of("front") == (E, front)
    assert problem.extrinsic_keys_of("left") == (E, left)
    assert problem.extrinsic_keys() == (E, front, left)
    # The first cloud: target 0, the pose at stamp 30, the front LiDAR.
    assert problem.cloud_keys(0) == (key_target(0), key_vehicle(1), E, front)
    assert problem.cloud_keys(5) == (key_target(1), key_vehicle(3), E)
    every = (
        *problem.pose_keys(),
        *problem.pose_error_keys(),
        *problem.target_keys(),
        *problem.extrinsic_keys(),
    )
    assert len(set(every)) == 4 + 4 + 2 + 3


def test_a_reference_that_saw_nothing_is_replaced_by_the_first_that_did() -> None:
    observations = [observed(0, ("rear", 0, 10), ("left", 0, 10))]
    config = config_of("front", "rear", "left", reference="front")
    problem = pose_problem(observations, [drive(10, 20)], config)
    assert problem.lidars == ("rear", "left")
    assert problem.reference == "rear"
    assert problem.extrinsic_keys_of("rear") == (key_extrinsic(),)
    assert problem.extrinsic_keys_of("left") == (key_extrinsic(), key_sensor(1))


def test_a_trusted_lidar_takes_part_even_if_it_saw_nothing() -> None:
    observations = [observed(0, ("rear", 0, 10), ("left", 0, 10))]
    config = config_of("front", "rear", "left", reference="front", fixed=("front",))
    problem = pose_problem(observations, [drive(10, 20)], config)
    assert problem.lidars == ("front", "rear", "left")
    assert problem.reference == "front"
    assert problem.fixed == {"front"}
    assert problem.prior_sigmas["front"] == pytest.approx(TRUSTED_SIGMAS)
    # To a tenth of a millimetre and a hundredth of a milliradian.
    np.testing.assert_allclose(TRUSTED_SIGMAS, [1e-5] * 3 + [1e-4] * 3)
    assert problem.prior_sigmas["rear"][3] == 0.1
    # What the data tell is compared with a guess, not with the trust, which is among the data.
    usual = np.diag(problem.guess_information())[:6] ** -0.5
    assert usual == pytest.approx([np.radians(1.73)] * 3 + [0.058] * 3, rel=0.01)


def test_nothing_seen_is_a_solve_error() -> None:
    with pytest.raises(SolveError, match="no cloud of a target to calibrate with"):
        pose_problem([observed(0)], [drive(10, 20)], config_of("front"))


@pytest.mark.parametrize("reference", ["front", "rear", "left"])
def test_mounting_is_the_product_of_its_keys(reference: str) -> None:
    case = make_case("front", "rear", "left", reference=reference)
    for name in case.problem.lidars:
        assert case.problem.extrinsic(case.truth, name).equals(pose(*MOUNTINGS[name]), 1e-9)
    # E before S.
    values = moved(case.truth, 1, 0.5, 1.0)
    other = next(n for n in case.problem.lidars if n != reference)
    E, S = (values.atPose3(key) for key in case.problem.extrinsic_keys_of(other))
    point = np.array([1.0, 2.0, 3.0])
    expected = E.transformFrom(S.transformFrom(point))
    assert case.problem.extrinsic(values, other).transformFrom(point) == pytest.approx(expected)


@pytest.mark.parametrize("reference", ["front", "rear", "left"])
def test_tangents_turn_into_vehicle_axes_of_every_lidar(reference: str) -> None:
    case = make_case("front", "rear", "left", reference=reference)
    problem = case.problem
    values = moved(case.truth, 2, 0.3, 1.0)
    Q = problem.to_vehicle_axes(values)
    assert Q.shape == (18, 18)
    step = 1e-6
    for column, d in enumerate(step * np.eye(18)):
        after = retract(values, problem.extrinsic_keys(), d)
        before = retract(values, problem.extrinsic_keys(), -d)
        numerical = np.concatenate(
            [
                vehicle_axes_difference(problem.extrinsic(after, n), problem.extrinsic(before, n))
                for n in problem.lidars
            ]
        ) / (2.0 * step)
        np.testing.assert_allclose(Q[:, column], numerical, atol=1e-7)


def test_moving_the_reference_moves_all_lidars_with_it() -> None:
    # 10 mm along the reference's x, which looks back and down by 10 degrees.
    problem = replace(make_case("front", "rear").problem, reference="rear")
    values = make_case("front", "rear").truth
    Q = problem.to_vehicle_axes(values)
    shift = Q @ np.concatenate([[0.0, 0.0, 0.0, 0.01, 0.0, 0.0], np.zeros(6)])
    expected = [-0.01 * math.cos(math.radians(10)), 0.0, -0.01 * math.sin(math.radians(10))]
    for lidar in (shift[:6], shift[6:]):
        assert lidar[:3] == pytest.approx(np.zeros(3), abs=1e-12)
        assert lidar[3:] == pytest.approx(expected, abs=1e-12)


def test_the_map_of_a_problem_begins_at_each_drive_s_first_pose() -> None:
    # Poses in a national grid are thousands of kilometres from its origin.
    observations = [
        observed(0, ("front", 0, 10), ("front", 0, 30)),
        observed(1, ("front", 1, 5), ("front", 1, 6)),
    ]
    trajectories = [drive(10, 30, x=5_334_000.0), drive(5, 6, x=-700.0)]

    problem = pose_problem(observations, trajectories, config_of("front"))

    x = [T.translation()[0] for T in problem.T_map_vehicle]
    assert x == [0.0, 20.0, 0.0, 1.0]
    assert problem.origins_map[0] == pytest.approx([5_334_010.0, 0.0, 0.0])
    assert problem.origins_map[1] == pytest.approx([-695.0, 0.0, 0.0])
