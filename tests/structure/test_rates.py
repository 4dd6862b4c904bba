"""Rates that moved the points within sweeps are wrong: with honest sigmas all the same."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.geometry.chart import PoseChart
from caliv_graph.geometry.se3 import stack, vehicle_axes_difference
from caliv_graph.products import Array
from caliv_graph.structure.problem import Problem, first_state, placed_patches
from caliv_graph.structure.sightings import moved_moments
from caliv_graph.structure.slow_errors import told_of_errors
from caliv_graph.structure.solve import Solved, solve_roughly
from caliv_graph.structure.term import term_of
from caliv_graph.structure.turns import turn_sigmas
from caliv_graph.trajectory.rates import by_rates, rate_rows
from tests.structure.test_solve import GUESS_SIGMAS, between, information_of, problem_of, solve
from tests.structure.yards import TRUE, Noise, draw_prior, figure_eight, poses, yard
from tests.trajectory.test_variances import base

POSES = 12
TURN_RAD_S = 5e-3
NOISE = Noise(range_m=0.005, sighting_m=1e-4, bump_m=0.0, bias_m=0.0)


def test_a_cloud_without_times_does_not_sweep_whatever_stamp_it_has() -> None:
    """Where it shares that of another, all its points are as late."""
    patches = problem_of(yard(), figure_eight(POSES), 1, NOISE).patches
    front = patches.scan_lidar[patches.scan] == 0
    still = replace(patches, time_s=np.where(front, 0.002, 0.0))
    some = still.time_s + np.where(front & (patches.scan == patches.scan[front][0]), 1e-3, 0.0)
    some[np.flatnonzero(front)[0]] = 0.0

    assert not still.swept_scans.any()
    assert np.flatnonzero(replace(still, time_s=some).swept_scans).tolist() == [
        patches.scan[front][0]
    ]


@pytest.fixture(scope="module")
def swept() -> Problem:
    """Poses err, and their rates with them."""
    path = figure_eight(POSES)
    rng = np.random.default_rng(1)
    true = poses(*path)
    prior = draw_prior(true, rng, rotation_rad=5e-3, heave_m=1e-3)
    rows = rate_rows(prior.stamps_ns, prior.T_map_vehicle)
    assert rows is not None
    d = np.array([s.localCoordinates(T) for s, T in zip(prior.T_map_vehicle, true, strict=True)])
    problem = problem_of(yard(), path, 11, NOISE)
    assert problem.twists is not None
    off = by_rates(problem.twists[:, :3]) @ (rows @ d.ravel())
    off[:, :3] += np.cross(problem.twists[:, :3], d[:, :3])
    off[:, 3:] += np.cross(problem.twists[:, 3:], d[:, :3])
    return with_sweeps(replace(problem, prior=prior), off)


def with_sweeps(problem: Problem, off: Array) -> Problem:
    """The front LiDAR sweeps from left to right; true rates differ by `off` (M, 6) from those used.

    The yard is driven through at 50 m/s, in sweeps of 0.04 s: as in 0.1 s at 20 m/s.
    """
    assert problem.twists is not None
    patches = problem.patches
    centre = patches.centres_lidar
    front = patches.scan_lidar[patches.scan] == 0
    time_s = np.where(front, -0.02 * np.arctan2(centre[:, 1], centre[:, 0]), 0.0)
    pose = problem.pose_of_scan[patches.scan]
    moved = problem.twists[pose] * time_s[:, None]
    back = [TRUE["front"].inverse().compose(gtsam.Pose3.Expmap(-v)) for v in moved]
    R, t = stack([T.compose(TRUE["front"]) for T in back])
    swept = moved - off[pose] * time_s[:, None]
    return replace(
        problem,
        patches=replace(
            patches,
            time_s=time_s,
            moments=moved_moments(patches.moments, R, t),
            normal_lidar=np.einsum("nij,nj->ni", R, patches.normal_lidar),
        ),
        relative=np.array([gtsam.Pose3.Expmap(v).matrix() for v in swept]),
    )


def test_patches_are_seen_from_where_the_lidar_was(swept: Problem) -> None:
    """A metre from where it is at the stamp: ranges and incidences are those that it measured."""
    patches = swept.patches
    placed = placed_patches(swept, first_state(swept, TRUE))
    middles = placed.moments_at_stamp[:, :3, 3] / placed.moments_at_stamp[:, 3, 3, None]
    beams = middles - placed.origins_at_stamp
    assert np.linalg.norm(placed.origins_at_stamp, axis=1).max() > 0.8
    own = patches.centres_lidar
    ranges = np.linalg.norm(own, axis=1)
    assert np.linalg.norm(beams, axis=1) == pytest.approx(ranges, abs=1e-9)
    incidence = np.einsum("ni,ni->n", patches.normal_lidar, own)
    seen = np.einsum("ni,ni->n", placed.normals_at_stamp, beams)
    assert seen == pytest.approx(incidence, abs=1e-9)


def nees(found: Solved, motion: Array) -> float:
    """Of S2S, its z aside, which walls do not tell."""
    error = [
        vehicle_axes_difference(T, TRUE[name])
        for T, name in zip(found.state.T_vehicle_lidar, TRUE, strict=True)
    ]
    term = term_of(found, np.arange(found.layout.poses))
    cov = np.linalg.inv(information_of(term, motion) + np.diag(np.tile(GUESS_SIGMAS**-2.0, 2)))
    axes = np.array([between(column) for column in np.eye(12)]).T[:5]
    e = axes @ np.concatenate(error)
    return float(e @ np.linalg.solve(axes @ cov @ axes.T, e))


def test_wrong_rates_are_no_error_of_the_extrinsics(swept: Problem) -> None:
    motion = swept.prior.information
    assert nees(solve(swept), motion) > 30.0
    found = nees(solve(replace(swept, prior=swept.prior.with_rates())), motion)
    assert found < 15.1  # 5 degrees of freedom, one of 100


def test_a_turn_of_the_vehicle_frame_about_the_imu_is_no_error_of_the_rates(swept: Problem) -> None:
    """Residuals turn twists about the IMU, 2 m from the vehicle's origin, which goes elsewhere.

    In the twist and in the errors of the rates at once, that told S2V yaw to 0.8 mrad, whatever
    the IMU's rotation was known to (random drive 131 of the second simulator).
    """
    pivot = np.array([1.8, -0.9, 0.4])
    before = replace(swept.prior, chart=PoseChart(pivot))
    after = before.with_rates()
    for axis in np.eye(3):
        turns = np.tile(np.concatenate([axis, np.cross(pivot, axis)]), POSES)
        d = np.concatenate([turns, np.zeros(after.rates)])
        known = turns @ before.information @ turns
        assert d @ after.information @ d == pytest.approx(known, rel=1e-6)


def test_slow_errors_are_told_where_sweeps_are_put_together(swept: Problem) -> None:
    gain = np.random.default_rng(0).normal(size=(6 * POSES, 3))
    guesses = dict(zip(swept.patches.lidars, swept.guesses, strict=True))
    found = solve_roughly(replace(swept, prior=swept.prior.with_rates()), guesses)
    assert found is not None

    information, gradient = told_of_errors(found, swept.prior, gain)

    # No more than if the poses were known exactly, and not nothing.
    known = gain.T @ swept.prior.information @ gain
    part = np.linalg.eigvals(np.linalg.solve(known, information)).real
    assert 0.01 < part.min() <= part.max() < 1.0 + 1e-6
    assert gradient.shape == (3,)


def test_noise_of_the_gyroscope_within_sweeps_is_no_error_of_the_extrinsics() -> None:
    """0.2 mrad or so at the ends of the sweeps, in every scan another; three drives at 15 m/s."""
    count = 24
    problem = problem_of(yard(), figure_eight(count), 11, NOISE)
    honest = 0.0
    for seed in (5, 6, 7):
        off = np.zeros((count, 6))
        off[:, :3] = TURN_RAD_S * np.random.default_rng(seed).standard_normal((count, 3))
        noisy = with_sweeps(problem, off)
        sigmas = np.full((count, 3), TURN_RAD_S)
        honest += nees(solve(replace(noisy, turn_rad_s=sigmas)), noisy.prior.information)
    # One drive is enough to show what the sigmas are for.
    exact = nees(solve(noisy), noisy.prior.information)

    # Of 15 and of 5 degrees of freedom one of 100 is beyond.
    assert honest < 30.6
    assert exact > 15.1


def test_the_turn_within_a_sweep_is_by_its_length_and_the_gyroscope() -> None:
    """Scans at the same pose turn alike, as far as the longest of them."""
    problem = problem_of(yard(), figure_eight(POSES), 11, NOISE)
    trajectory = base()
    patches = with_sweeps(problem, np.zeros((POSES, 6))).patches
    density = np.diag(trajectory.data.noise.gyro_density)  # the IMU's axes are the vehicle's

    sigmas = turn_sigmas(patches, problem.pose_of_scan, trajectory)

    assert sigmas.shape == (POSES, 3)
    own = problem.pose_of_scan[patches.scan] == 3
    longest = np.abs(patches.time_s[own]).max()
    assert sigmas[3] == pytest.approx(np.sqrt(1.5 * density / longest))
    none = replace(patches, time_s=np.zeros(len(patches.time_s)))
    assert not turn_sigmas(none, problem.pose_of_scan, trajectory).size
