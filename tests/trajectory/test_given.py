"""Given poses become a trajectory, unchanged, with the covariances of their messages."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import gtsam
import numpy as np
import pytest

from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, GivenPoses, MotionData, Recording, Trajectory
from caliv_graph.trajectory.given import given_trajectory, scatter_of_poses
from caliv_graph.trajectory.noise import (
    MIN_POSE_POSITION_M,
    MIN_POSE_ROTATION_RAD,
    given_pose_covariances,
)
from caliv_graph.trajectory.select import GivenTrajectory, smooth_trajectories
from tests.trajectory.motions import Sensors, config_for


def recorded(*stamps_ns: int) -> MotionData:
    """A drive of which nothing but the poses was recorded."""
    poses = tuple(
        gtsam.Pose3(gtsam.Rot3.Yaw(0.01 * stamp), np.array([1.0 * stamp, 0.1, 2.0]))
        for stamp in stamps_ns
    )
    return MotionData("drive/", poses=GivenPoses(np.array(stamps_ns, dtype=np.int64), poses))


def test_the_poses_are_those_of_the_recording() -> None:
    trajectory = given_trajectory(recorded(1, 5, 9))

    assert trajectory.stamps_ns.tolist() == [1, 5, 9]
    assert trajectory.T_map_vehicle[2].rotation().yaw() == pytest.approx(0.09)
    assert trajectory.T_map_vehicle[2].translation() == pytest.approx([9.0, 0.1, 2.0])


@pytest.mark.parametrize("stamps", [(), (3,)])
def test_one_pose_is_no_drive(stamps: tuple[int, ...]) -> None:
    with pytest.raises(TrajectoryError) as caught:
        given_trajectory(recorded(*stamps))

    assert str(caught.value) == (
        f"drive/: {len(stamps)} vehicle pose(s), needs at least 2. Choose another topics.pose or "
        "data.poses"
    )


def test_a_drive_without_poses_is_an_error() -> None:
    with pytest.raises(TrajectoryError, match="drive/: has no vehicle poses"):
        given_trajectory(MotionData("drive/"))


def localised(
    white: tuple[float, float], slow: tuple[float, float], said: tuple[float, float]
) -> MotionData:
    """A curve of 60 s at 20 Hz, with errors (rad, m) per axis, and what every message states."""
    rng, n = np.random.default_rng(3), 1200
    seconds = 0.05 * np.arange(n)
    yaw = 0.4 * np.sin(0.3 * seconds)
    way = np.cumsum(0.1 * np.stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw], axis=1), axis=0)
    wave = np.sin(2.0 * np.pi * (seconds[:, None] / 20.0 + np.arange(6) / 6.0)) * np.sqrt(2.0)
    error = rng.standard_normal((n, 6)) * np.repeat(white, 3) + wave * np.repeat(slow, 3)
    poses = tuple(
        gtsam.Pose3(gtsam.Rot3.Yaw(a), at) * gtsam.Pose3(gtsam.Rot3.Expmap(e[:3]), e[3:])
        for a, at, e in zip(yaw, way, error, strict=True)
    )
    cov = np.tile(np.diag(np.repeat(said, 3) ** 2), (n, 1, 1))
    stamps = np.round(1e9 * seconds).astype(np.int64)
    return MotionData("drive/", poses=GivenPoses(stamps, poses, cov))


def as_used(motion: MotionData) -> GivenTrajectory:
    recording = cast(Recording, SimpleNamespace(name="drive/", lidars=(), motion=lambda: motion))
    (trajectory,) = smooth_trajectories([recording], config_for(Sensors()), [[]], {0: motion})
    assert isinstance(trajectory, GivenTrajectory)
    return trajectory


def test_the_scatter_of_poses_is_their_white_error() -> None:
    found = scatter_of_poses(given_trajectory(localised((3e-4, 3e-3), (2e-3, 0.02), (1.0, 1.0))))

    assert found == pytest.approx((3e-4, 3e-3), rel=0.1)


def test_a_stated_error_that_is_mostly_slow_is_no_white_one() -> None:
    slow = as_used(localised((3e-4, 3e-3), (2e-3, 0.02), (2e-3, 0.02)))
    white = as_used(localised((2e-3, 0.02), (3e-4, 3e-3), (2e-3, 0.02)))

    assert slow.error_covariances([0]) is None
    assert slow.slow_stated == pytest.approx((2e-3, 0.02))
    assert white.slow_stated == (None, None)
    (said,) = slow.warnings
    assert "state errors of 0.11 degrees and 20 mm" in said
    assert "scatter by at most 0.017 degrees and 3 mm" in said
    assert white.error_covariances([0]) is not None
    assert white.warnings == ()


def test_a_rotation_that_scatters_as_it_is_stated_tells_no_slow_error() -> None:
    found = as_used(localised((2e-3, 3e-3), (3e-4, 0.02), (2e-3, 0.02)))

    turn, place = found.slow_stated
    assert turn is None
    assert place == pytest.approx(0.02)


def test_an_axis_that_nobody_observes_is_no_slow_error() -> None:
    motion = localised((3e-4, 3e-3), (2e-3, 0.02), (2e-3, 0.02))
    assert motion.poses is not None
    assert motion.poses.cov is not None
    cov = motion.poses.cov.copy()
    cov[:, 0, 0] = cov[:, 5, 5] = 1e6
    found = as_used(replace(motion, poses=replace(motion.poses, cov=cov)))

    assert found.slow_stated == pytest.approx((2e-3, 0.02))


def test_rare_poses_keep_what_they_state() -> None:
    # From one to the next a vehicle moves by more than their errors.
    motion = localised((3e-4, 3e-3), (2e-3, 0.02), (2e-3, 0.02))
    assert motion.poses is not None
    assert motion.poses.cov is not None
    rare = GivenPoses(
        motion.poses.stamps_ns[::20], motion.poses.T_map_vehicle[::20], motion.poses.cov[::20]
    )
    assert scatter_of_poses(given_trajectory(MotionData("drive/", poses=rare))) is not None
    assert as_used(MotionData("drive/", poses=rare)).error_covariances([0]) is not None


SIGMAS = np.array([0.001, 0.002, 0.003, 0.01, 0.02, 0.03])
UNKNOWN = np.full((6, 6), np.nan)


def facing_north(*covs: Array) -> Trajectory:
    """Poses a microsecond apart, the vehicle's x axis along the map's y."""
    poses = tuple(gtsam.Pose3(gtsam.Rot3.Yaw(np.pi / 2), np.zeros(3)) for _ in covs)
    return Trajectory(np.arange(len(covs), dtype=np.int64) * 1000, poses, np.array(covs))


def test_covariances_are_turned_into_the_axes_of_the_errors() -> None:
    given = GivenTrajectory(facing_north(np.diag(SIGMAS**2), 4.0 * np.diag(SIGMAS**2)))
    cov = given.error_covariances([0, 1000, 250])
    assert cov is not None
    # Rotation stays in vehicle axes; forward (10 mm) is north, left (20 mm) is west.
    expected = np.diag(SIGMAS[[0, 1, 2, 4, 3, 5]] ** 2)
    np.testing.assert_allclose(cov[0], expected, atol=1e-15)
    np.testing.assert_allclose(cov[1], 4.0 * expected, atol=1e-15)
    np.testing.assert_allclose(cov[2], 1.75 * expected, atol=1e-15)


def test_a_pose_next_to_one_of_unknown_covariance_keeps_its_own() -> None:
    given = GivenTrajectory(facing_north(UNKNOWN, np.diag(SIGMAS**2), UNKNOWN))
    cov = given.error_covariances([0, 999, 1000, 1001])
    assert cov is not None
    assert np.isfinite(cov).all(axis=(1, 2)).tolist() == [False, False, True, False]


@pytest.mark.parametrize(
    "cov", [np.zeros((6, 6)), UNKNOWN, -np.eye(6), np.diag([1.0, 1, 1, 1, 1, 0])], ids=str
)
def test_a_covariance_that_is_none_is_unknown(cov: Array) -> None:
    assert GivenTrajectory(facing_north(cov, cov)).error_covariances([0, 10]) is None


def test_the_config_goes_before_the_messages() -> None:
    full = np.diag(SIGMAS**2)
    full[0, 4] = full[4, 0] = 0.5 * SIGMAS[0] * SIGMAS[4]
    position = config_for(Sensors(), noise={"pose_position_m": 0.5})
    both = config_for(Sensors(), noise={"pose_position_m": 0.5, "pose_rotation_deg": 1.0})
    silent = config_for(Sensors())

    cov = given_pose_covariances(np.array([full, UNKNOWN]), position)
    kept = given_pose_covariances(full[None], silent)

    assert cov is not None
    assert kept is not None
    np.testing.assert_allclose(cov[0], np.diag([*SIGMAS[:3] ** 2, 0.25, 0.25, 0.25]))
    assert np.isnan(cov[1]).all()
    np.testing.assert_array_equal(kept[0], full)
    assert given_pose_covariances(full[None], both) is None
    assert given_pose_covariances(None, silent) is None


def test_no_message_is_trusted_without_bound() -> None:
    cov = given_pose_covariances(1e-18 * np.eye(6)[None], config_for(Sensors()))
    assert cov is not None
    np.testing.assert_allclose(
        np.sqrt(np.diagonal(cov[0])), [MIN_POSE_ROTATION_RAD] * 3 + [MIN_POSE_POSITION_M] * 3
    )


class PosesOnly:
    """A recording of which nothing but the poses is read."""

    name = "drive/"
    lidars = ()

    def __init__(self, *covs: Array) -> None:
        given = facing_north(*covs)
        self._poses = GivenPoses(given.stamps_ns, given.T_map_vehicle, given.cov)

    def motion(self) -> MotionData:
        return MotionData("drive/", poses=self._poses)


def test_messages_that_state_none_among_others_are_reported() -> None:
    known = np.diag(SIGMAS**2)
    for covs, lines in (
        ((known, known), ()),
        ((UNKNOWN, UNKNOWN), ()),
        (
            (known, UNKNOWN, known),
            ("drive/: 1 of 3 vehicle poses state no covariance: their white error is estimated",),
        ),
    ):
        (given,) = smooth_trajectories([PosesOnly(*covs)], config_for(Sensors()), [[0]])  # type: ignore[list-item]
        assert given.warnings == lines


def weaving(period_s: float) -> GivenPoses:
    """Exact poses of a vehicle that weaves at 2.7 m/s, its tightest curve of 7.5 m, 20.5 s."""
    stamps = np.arange(0, 20_500_000_000, round(1e9 * period_s), dtype=np.int64)
    at = np.arange(0.0, 20.5, 1e-3)
    x, y = (2.7e-3 * np.cumsum(f(1.2 * np.sin(0.3 * at))) for f in (np.cos, np.sin))
    return GivenPoses(
        stamps,
        tuple(
            gtsam.Pose3(
                gtsam.Rot3.Yaw(1.2 * np.sin(0.3 * s)),
                np.array([np.interp(s, at, x), np.interp(s, at, y), 0.0]),
            )
            for s in (1e-9 * stamps).tolist()
        ),
    )


@pytest.mark.parametrize(
    ("period_s", "scans_s", "told"),
    [(2.0, 0.1, True), (0.2, 0.1, False), (2.0, 2.0, False)],
    ids=["rare", "frequent", "at-the-scans"],
)
def test_poses_too_rare_for_the_scans_between_them_are_told(
    period_s: float, scans_s: float, told: bool
) -> None:
    motion = MotionData("drive/", poses=weaving(period_s))
    wanted = np.arange(0, 18_000_000_001, round(1e9 * scans_s), dtype=np.int64)
    nothing = cast("Recording", SimpleNamespace())
    (found,) = smooth_trajectories([nothing], config_for(Sensors()), [wanted], {0: motion})

    assert ["poses come every 2 s" in line for line in found.warnings] == [True] * told
    if told:
        _, true_m = GivenTrajectory(given_trajectory(MotionData("", poses=weaving(0.02)))).poses_at(
            wanted
        )
        error_m = np.linalg.norm(found.poses_at(wanted)[1] - true_m, axis=1)
        said_mm = float(found.warnings[0].split("to about ")[1].split(" mm")[0])
        assert 0.5 < said_mm / (1e3 * np.sqrt(np.mean(error_m**2))) < 2.0
