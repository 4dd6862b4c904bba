from __future__ import annotations

import math
import tracemalloc
from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.readers.imu import ImuCollector, check_imu
from caliv_graph.readers.motion import GnssCollector, TwistCollector
from caliv_graph.readers.poses import PoseCollector, TfCollector, right_perturbations
from tests.readers.bags import (
    SECOND,
    START,
    Message,
    as_object,
    fix,
    header,
    imu,
    odometry,
    tf,
    twist,
    xyz,
    xyzw,
)

UNKNOWN = [-1.0, *[0.0] * 8]


def fed(collector: Any, *messages: Message) -> Any:
    for message in messages:
        stamp = message["header"]["stamp"] if "header" in message else {"sec": 0, "nanosec": 0}
        collector.add(stamp["sec"] * SECOND + stamp["nanosec"], as_object(message))
    return collector


def test_imu_samples_are_sorted_and_each_stamp_taken_once() -> None:
    collector = fed(
        ImuCollector(),
        imu(START + 20, force=(0, 0, 2)),
        imu(START, force=(0, 0, 0)),
        imu(START + 10, force=(0, 0, 1), rate=(0.1, 0.2, 0.3)),
        imu(START + 10, force=(9, 9, 9)),
    )

    samples = collector.finish()

    assert samples.stamps_ns.tolist() == [START, START + 10, START + 20]
    assert samples.specific_force[:, 2].tolist() == [0, 1, 2]
    assert samples.angular_velocity[1].tolist() == [0.1, 0.2, 0.3]
    assert samples.orientation_xyzw[0].tolist() == [0.0, 0.0, 0.6, 0.8]
    # Zeros in a covariance mean that it is not known.
    assert samples.orientation_cov is None
    assert samples.angular_velocity_cov is None
    assert samples.specific_force_cov is None
    assert collector.notes() == []


def test_imu_covariances() -> None:
    stated: dict[str, Any] = {
        "orientation_covariance": np.diag([1e-6, 2e-6, 3e-6]).ravel(),
        "angular_velocity_covariance": np.diag([1e-4, 2e-4, 3e-4]).ravel(),
        "linear_acceleration_covariance": np.diag([1e-2, 0.0, 3e-2]).ravel(),
    }
    samples = fed(ImuCollector(), imu(START, **stated), imu(START + 1)).finish()

    np.testing.assert_array_equal(samples.orientation_cov[0], np.diag([1e-6, 2e-6, 3e-6]))
    assert np.isnan(samples.orientation_cov[1]).all()
    np.testing.assert_array_equal(samples.angular_velocity_cov, np.diag([1e-4, 2e-4, 3e-4]))
    # Nothing is measured without any error: a single zero says no more than zeros do.
    assert samples.specific_force_cov is None


def test_covariances_that_change_go_with_their_messages() -> None:
    def stated(scale: float) -> dict[str, Any]:
        return {
            "orientation_covariance": (scale * np.diag([1e-6, 2e-6, 3e-6])).ravel(),
            "angular_velocity_covariance": (scale * np.diag([1e-4, 2e-4, 3e-4])).ravel(),
        }

    # Out of order, one stamp twice: rows and covariances must stay together.
    scales = {START + 4: 4.0, START: 1.0, START + 2: 2.0, START + 3: 2.0, START + 1: 1.0}
    messages = [imu(stamp, **stated(scale)) for stamp, scale in scales.items()]
    samples = fed(ImuCollector(), *messages, imu(START + 3, **stated(9.0))).finish()

    by_stamp = [scales[stamp] for stamp in samples.stamps_ns.tolist()]
    np.testing.assert_allclose(samples.orientation_cov[:, 0, 0], 1e-6 * np.array(by_stamp))
    np.testing.assert_allclose(np.diag(samples.angular_velocity_cov), [2e-4, 4e-4, 6e-4])


def test_covariances_that_never_change_take_no_memory() -> None:
    stated: dict[str, Any] = {"orientation_covariance": np.diag([1e-6, 2e-6, 3e-6]).ravel()}
    message = as_object(imu(START, **stated))
    collector = ImuCollector()
    tracemalloc.start()
    try:
        for k in range(2000):
            collector.add(START + k, message)
        collected, _ = tracemalloc.get_traced_memory()
        samples = collector.finish()
        assert samples is not None
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert samples.orientation_cov is not None
    assert samples.orientation_cov.shape == (2000, 3, 3)
    np.testing.assert_array_equal(samples.orientation_cov[-1], np.diag([1e-6, 2e-6, 3e-6]))
    # 92 bytes of ten numbers, a stamp and a reference; growing arrays have some to spare.
    assert collected / 2000 < 130
    # 88 more of the product. With all covariances it was 304 and 376.
    assert (held - collected) / 2000 < 100


def test_orientations_that_are_none() -> None:
    nan = math.nan
    collector = fed(
        ImuCollector(),
        imu(START, orientation_covariance=UNKNOWN),
        imu(START + 1, quaternion=(0, 0, 0, 0)),
        imu(START + 2, quaternion=(0, 0, 0, 2)),
        imu(START + 3, quaternion=(nan, 0, 0, 1)),
        imu(START + 4, quaternion=(0, 0, 0.6004, 0.8)),
    )

    q = collector.finish().orientation_xyzw

    assert np.isnan(q[:4]).all()
    assert np.linalg.norm(q[4]) == pytest.approx(1.0, abs=1e-12)
    assert collector.notes() == [
        "the orientation of 3 of 5 messages is not a unit quaternion, and is not used"
    ]


def test_an_imu_without_orientation() -> None:
    quiet = fed(ImuCollector(), *(imu(START + k, orientation_covariance=UNKNOWN) for k in range(3)))
    assert quiet.finish().orientation_xyzw is None
    assert quiet.notes() == []
    unfilled = fed(ImuCollector(), *(imu(START + k, quaternion=(0, 0, 0, 1)) for k in range(3)))
    assert unfilled.finish().orientation_xyzw is None
    assert "identity in all messages" in unfilled.notes()[0]


def test_nan_in_samples_is_counted() -> None:
    collector = fed(
        ImuCollector(),
        imu(START, force=(math.nan, 0, 0)),
        imu(START + 1),
        imu(START + 2, rate=(0, math.inf, 0)),
    )

    assert collector.finish().stamps_ns.tolist() == [START + 1]
    assert collector.notes() == ["of 3 messages not used: 2 with NaN or infinity"]
    assert fed(ImuCollector()).finish() is None


@pytest.mark.parametrize(
    ("force", "rate", "gravity", "turning"),
    [
        ((0.5, -0.3, 9.7), (0, 0, 0.3), "", ""),
        ((0.0, 0.0, 1.01), (0, 0, 0.3), "units of g", ""),
        ((0.3, 0.2, 0.1), (0, 0, 0.3), "gravity seems to be removed", ""),
        ((0.0, 0.0, 0.0), (0, 0, 0.3), "gravity seems to be removed", ""),
        ((0.0, 0.0, 981.0), (0, 0, 0.3), "not m/s^2", ""),
        ((0.0, 0.0, -9.81), (0, 0, 17.0), "", "degrees per second"),
    ],
)
def test_units_of_an_imu(force: Any, rate: Any, gravity: str, turning: str) -> None:
    check = check_imu(fed(ImuCollector(), imu(START, force, rate)).finish())

    assert gravity in check.gravity_problem
    assert bool(check.gravity_problem) == bool(gravity)
    assert turning in check.rate_problem
    assert bool(check.rate_problem) == bool(turning)
    assert check.specific_force_m_s2 == pytest.approx(np.linalg.norm(force))


def test_fixes() -> None:
    cov = np.diag([1.0, 2.0, 4.0]).ravel()
    collector = fed(
        GnssCollector(),
        fix(START, status=-1),
        fix(START + 1, latitude=math.nan),
        fix(START + 2, latitude=0.0, longitude=0.0),
        fix(START + 3, latitude=91.0),
        fix(START + 4, position_covariance=cov, position_covariance_type=2),
        fix(START + 5, position_covariance=cov, position_covariance_type=0),
        fix(START + 6, position_covariance_type=2, status=2),
    )

    fixes = collector.finish()

    assert fixes.stamps_ns.tolist() == [START + 4, START + 5, START + 6]
    assert (fixes.latitude_deg[0], fixes.longitude_deg[0], fixes.altitude_m[0]) == (48, 11, 500)
    np.testing.assert_array_equal(fixes.cov_enu[0], np.diag([1.0, 2.0, 4.0]))
    assert np.isnan(fixes.cov_enu[1:]).all()
    assert collector.fixes == 3
    assert collector.notes() == [
        "of 7 messages not used: 1 without a fix (status < 0), 1 without latitude, longitude or "
        "altitude, 2 at latitude and longitude 0 or out of their range"
    ]


def test_a_receiver_that_never_had_a_fix() -> None:
    collector = fed(GnssCollector(), fix(START, status=-1), fix(START + 1, status=-1))

    assert collector.finish() is None
    assert "2 without a fix" in collector.notes()[0]


def test_yaw_rates_are_those_that_a_driver_knows() -> None:
    def turning(stamp: int, rate: float, variance: float) -> Any:
        cov = np.zeros(36)
        cov[35] = variance
        message = odometry(stamp, (0, 0, 0), velocity=(1, 0, 0), twist_cov=cov)
        message["twist"]["twist"]["angular"] = xyz((0, 0, rate))
        return message

    found = fed(
        TwistCollector(),
        turning(START, 0.2, 0.01),
        turning(START + 1, -0.1, 0.0),
        turning(START + 2, 0.3, 1e9),
        turning(START + 3, math.nan, 0.0),
    ).finish()
    np.testing.assert_array_equal(found.yaw_rate, [0.2, -0.1, math.nan, math.nan])
    np.testing.assert_array_equal(found.yaw_rate_var, [0.01, math.nan, math.nan, math.nan])
    none = fed(TwistCollector(), turning(START, 0.0, 0.01), turning(START + 1, 0.0, 0.01)).finish()
    assert none.yaw_rate is None
    assert none.yaw_rate_var is None


def test_velocities_of_all_types() -> None:
    cov = np.zeros((6, 6))
    cov[:3, :3] = np.diag([0.1, 0.2, 0.3])
    cov[3:, 3:] = 9.0
    stamped = {
        "_type": "geometry_msgs/msg/TwistWithCovarianceStamped",
        "header": header(START + 1, "base_link"),
        "twist": {"twist": {"linear": xyz((4, 5, 6))}, "covariance": cov.ravel()},
    }
    collector = fed(
        TwistCollector(),
        odometry(START + 2, (0, 0, 0), velocity=(7, 8, 9), twist_cov=np.zeros(36)),
        twist(START, (1, 2, 3)),
        stamped,
        twist(START + 3, (math.nan, 0, 0)),
    )

    found = collector.finish()

    assert found.velocity.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    np.testing.assert_array_equal(found.velocity_cov[1], np.diag([0.1, 0.2, 0.3]))
    assert np.isnan(found.velocity_cov[[0, 2]]).all()
    assert collector.notes() == ["of 4 messages not used: 1 with NaN or infinity"]


def test_a_velocity_in_axes_that_do_not_turn_is_told() -> None:
    collector = fed(TwistCollector(), twist(START, (1, 0, 0), frame_id="map"))

    assert collector.finish().velocity_cov is None
    assert "stated in the frame 'map'" in collector.notes()[0]


def test_poses_and_their_covariance() -> None:
    # Against a numerical draw: ROS perturbs t in the map's axes, and R from the left.
    rng = np.random.default_rng(5)
    T = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.4, 2.0), np.array([5.0, -3.0, 1.0]))
    roots = rng.normal(size=(6, 6)) * 1e-3
    cov_ros = roots @ roots.T
    draws = rng.multivariate_normal(np.zeros(6), cov_ros, 4000)
    logs = []
    for d in draws:
        R = gtsam.Rot3.Expmap(d[3:]).compose(T.rotation())
        logs.append(gtsam.Pose3.Logmap(T.between(gtsam.Pose3(R, T.translation() + d[:3]))))
    q: Any = T.rotation().toQuaternion()

    collector = fed(
        PoseCollector(),
        odometry(START, T.translation(), (q.x(), q.y(), q.z(), q.w()), pose_cov=cov_ros.ravel()),
        odometry(START + 1, (0, 0, 0), (0, 0, 0, 0)),
        odometry(START + 2, (math.nan, 0, 0)),
        odometry(START + 3, (1, 0, 0)),
    )
    poses = collector.finish()

    assert poses.T_map_vehicle[0].equals(T, 1e-9)
    scale = np.sqrt(np.outer(np.diag(poses.cov[0]), np.diag(poses.cov[0])))
    assert np.abs((np.cov(np.array(logs).T) - poses.cov[0]) / scale).max() < 0.1
    assert np.isnan(poses.cov[1]).all()
    assert collector.notes() == [
        "of 4 messages not used: 1 with NaN or infinity, "
        "1 whose orientation is not a unit quaternion"
    ]


def test_the_covariance_of_a_turned_vehicle_by_hand() -> None:
    # Facing left: 1 m^2 along the map's y is along the vehicle's x; yaw stays yaw.
    R = gtsam.Rot3.Rz(math.pi / 2).matrix()[None]
    cov = right_perturbations(R, np.diag([4.0, 1.0, 9.0, 0.1, 0.2, 0.3])[None])

    np.testing.assert_allclose(cov[0], np.diag([0.2, 0.1, 0.3, 1.0, 4.0, 9.0]), atol=1e-12)


def test_poses_of_other_types() -> None:
    plain = {"position": xyz((1, 2, 3)), "orientation": xyzw((0, 0, 0, 1))}
    stamped = {
        "_type": "geometry_msgs/msg/PoseStamped",
        "header": header(START),
        "pose": plain,
    }
    with_covariance = {
        "_type": "geometry_msgs/msg/PoseWithCovarianceStamped",
        "header": header(START + 1),
        "pose": {"pose": plain, "covariance": np.eye(6).ravel()},
    }

    poses = fed(PoseCollector(), stamped, with_covariance).finish()

    assert [T.x() for T in poses.T_map_vehicle] == [1, 1]
    assert np.isnan(poses.cov[0]).all()
    np.testing.assert_allclose(poses.cov[1], np.eye(6))
    assert fed(PoseCollector(), stamped).finish().cov is None


def test_a_chain_of_transforms() -> None:
    half = math.sin(math.pi / 4)
    collector = TfCollector()
    # The map moves slowly against odom and is sent rarely: in between it is interpolated.
    for k in range(11):
        stamp = START + k * SECOND // 10
        links: list[Any] = [("odom", "base_footprint", (k, 0, 0), (0, 0, 0, 1))]
        if k % 5 == 0:
            links.append(("map", "odom", (0, k, 0), (0, 0, half, half)))
        links.append(("wheel_base", "wheel", (0, 0, 0), (0, 0, 0, 1)))
        collector.add(stamp + 99, as_object(tf(*links, stamp_ns=stamp)))
    collector.add_static(as_object(tf(("base_footprint", "base_link", (0, 0, 0.5), (0, 0, 0, 1)))))

    poses = collector.finish()

    assert poses is not None
    assert poses.stamps_ns.tolist() == [START + k * SECOND // 10 for k in range(11)]
    # odom is turned to the left: its x is the map's y.
    found = [T.translation().tolist() for T in poses.T_map_vehicle]
    np.testing.assert_allclose(found, [[0, 2 * k, 0.5] for k in range(11)], atol=1e-9)
    assert poses.T_map_vehicle[3].rotation().yaw() == pytest.approx(math.pi / 2)
    assert "map -> odom -> base_footprint -> base_link" in collector.notes()[-1]


def test_a_map_that_is_sent_once_holds_throughout() -> None:
    collector = TfCollector()
    collector.add(0, as_object(tf(("map", "odom", (1, 0, 0), (0, 0, 0, 1)), stamp_ns=START - 5)))
    for k in range(3):
        link = ("odom", "base_link", (k, 0, 0), (0, 0, 0, 1))
        collector.add(0, as_object(tf(link, stamp_ns=START + k)))

    poses = collector.finish()

    assert poses is not None
    assert [T.x() for T in poses.T_map_vehicle] == pytest.approx([1, 2, 3])


def test_transforms_without_the_vehicle() -> None:
    collector = TfCollector()
    collector.add(0, as_object(tf(("a", "b", (0, 0, 0), (0, 0, 0, 1)))))
    collector.add_static(as_object(tf(("base_link", "lidar", (0, 0, 0), (0, 0, 0, 1)))))

    assert collector.finish() is None
    assert "none of the frames base_link, base_footprint" in collector.notes()[0]


def test_what_no_sensor_measures_is_left_out() -> None:
    """Finite, but its square is not: it would spoil every sum that it enters."""
    samples = fed(ImuCollector(), imu(START, rate=(0, 1e300, 0)), imu(START + 1)).finish()
    assert samples.stamps_ns.tolist() == [START + 1]
    samples = fed(ImuCollector(), imu(START, force=(0, 0, -1e200)), imu(START + 1)).finish()
    assert samples.stamps_ns.tolist() == [START + 1]
    speeds = fed(TwistCollector(), twist(START, (1e300, 0, 0)), twist(START + 1, (2, 0, 0)))
    assert speeds.finish().velocity.tolist() == [[2, 0, 0]]
    assert speeds.notes() == ["of 2 messages not used: 1 beyond 1000 m/s"]
    fixes = fed(GnssCollector(), fix(START, altitude=1e300), fix(START + 1))
    assert fixes.finish().stamps_ns.tolist() == [START + 1]
    poses = fed(PoseCollector(), odometry(START, (0, -1e9, 0)), odometry(START + 1, (1, 2, 3)))
    assert poses.finish().stamps_ns.tolist() == [START + 1]
