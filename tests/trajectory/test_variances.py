"""Noise levels of the motion sensors, and errors that are correlated over time."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import cast

import numpy as np
import pytest

from caliv_graph.conventions import key_bias, key_imu, key_velocity
from caliv_graph.errors import TrajectoryError
from caliv_graph.products import Array, IntArray, MotionData
from caliv_graph.trajectory.build import build_graph
from caliv_graph.trajectory.chain import STATE, UNDETERMINED
from caliv_graph.trajectory.chain_solution import inverse_in_blocks, solved
from caliv_graph.trajectory.correlated import CorrelatedError, unit_information
from caliv_graph.trajectory.effects import (
    STEP_NS,
    error_effects,
    poses_and_gain,
    smoothed_in_time,
)
from caliv_graph.trajectory.noise import configured_errors
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.variances import NoiseLikelihood, fit, free_components
from tests.trajectory.motions import Course, Sensors, arc_drive, config_for, record, rows_of, stamps
from tests.trajectory.test_chain import random_chain

COURSE = Course(arc_drive(8.0))
WANTED = stamps(7.0, 2.0)[2:]


@pytest.mark.parametrize("common", [0, 2])
def test_a_chain_is_solved_and_inverted_like_a_dense_matrix(
    common: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    chain, H = random_chain(5, common, seed=4)
    gradient = np.random.default_rng(1).standard_normal(len(H)) * np.sqrt(np.diag(H))
    inverse = np.linalg.inv(H)

    found = solved(chain, gradient)

    assert found.step == pytest.approx(-inverse @ gradient, rel=1e-6)
    assert found.log_determinant == pytest.approx(np.linalg.slogdet(H)[1], abs=1e-6)
    n = STATE * 5
    states = inverse[:n, :n].reshape(5, STATE, 5, STATE)
    for i in range(5):
        assert found.cov[i] == pytest.approx(states[i, :, i], rel=1e-6)
    for i in range(4):
        assert found.cov_next[i] == pytest.approx(states[i, :, i + 1], rel=1e-5)
    border = inverse[:n, n:].reshape(5, STATE, common)
    assert found.cov_border == pytest.approx(border, rel=1e-5)
    wanted = np.array([3, STATE + 1, 4 * STATE])
    monkeypatch.setattr("caliv_graph.trajectory.chain_solution.COLUMNS_TOGETHER", 2)
    blocks = [columns for _, columns in inverse_in_blocks(chain, wanted)]
    assert len(blocks) > 1
    assert np.hstack(blocks) == pytest.approx(inverse[:, wanted], rel=1e-5)


def test_the_information_of_a_gauss_markov_error_is_the_inverse_of_its_covariance() -> None:
    at = np.array([0, 100, 150, 400, 1000]) * 1_000_000
    seconds = at * 1e-9
    cov = np.exp(-np.abs(seconds[:, None] - seconds) / 0.3)

    diagonal, next_, log_determinant = unit_information(at, 0.3)

    information = np.diag(diagonal) + np.diag(next_, 1) + np.diag(next_, -1)
    assert information == pytest.approx(np.linalg.inv(cov), abs=1e-9)
    assert log_determinant == pytest.approx(-np.linalg.slogdet(cov)[1])
    rows = np.random.default_rng(0).standard_normal((2, 5))
    assert smoothed_in_time(rows, at, 0.3) == pytest.approx(rows @ cov)


@cache
def base() -> SmoothedTrajectory:
    """Of the drive whose messages state the right sigmas."""
    return smoothed(recorded())


def recorded(seed: int = 2, **scales: float) -> MotionData:
    """A drive whose messages state sigmas that are off by factors."""
    motion = record(COURSE, Sensors(), seed)
    imu, gnss = motion.imu, motion.gnss
    assert imu is not None
    assert gnss is not None
    gyro, force = (scales.get(name, 1.0) for name in ("gyroscope", "accelerometer"))
    horizontal, vertical = (scales.get(f"gnss_{n}", 1.0) for n in ("horizontal", "vertical"))
    sigmas = np.array([0.0167 / horizontal, 0.0167 / horizontal, 0.02 / vertical])
    return replace(
        motion,
        imu=replace(
            imu,
            angular_velocity_cov=np.eye(3) * (0.005 / gyro) ** 2,
            specific_force_cov=np.eye(3) * (0.05 / force) ** 2,
        ),
        gnss=replace(gnss, cov_enu=np.tile(np.diag(sigmas**2), (len(gnss.stamps_ns), 1, 1))),
    )


def smoothed(
    motion: MotionData, errors: tuple[CorrelatedError, ...] = (), **noise: object
) -> SmoothedTrajectory:
    return smooth_trajectory(motion, config_for(Sensors(), noise=noise), WANTED, errors)


def test_stated_sigmas_that_hold_are_kept() -> None:
    trajectory = base()

    assert trajectory.data is not None
    assert trajectory.data.scales == {}
    assert trajectory.noise_sources["gnss"] == "messages"


def test_stated_sigmas_that_the_data_contradict_are_scaled() -> None:
    wrong = {"gnss_horizontal": 0.5, "gnss_vertical": 2.0}
    trajectory = smoothed(recorded(gnss_horizontal=0.5, gnss_vertical=2.0))

    assert trajectory.data is not None
    found = trajectory.data.scales
    for name, factor in wrong.items():
        assert found[name] == pytest.approx(factor, rel=0.3), name
    assert "by the residuals" in trajectory.noise_sources["gnss"]
    assert "vertical times" in trajectory.noise_sources["gnss"]


def test_a_drive_that_is_smoothed_again_keeps_its_noise_levels(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    motion = recorded(gnss_vertical=2.0)
    first = smoothed(motion)
    monkeypatch.setattr("caliv_graph.trajectory.smooth.estimated_scales", None)
    again = smooth_trajectory(motion, config_for(Sensors()), WANTED, scales=first.data.scales)
    assert again.data.scales == first.data.scales
    assert again.noise_sources == first.noise_sources
    for one, other in zip(
        again.trajectory.T_map_vehicle, first.trajectory.T_map_vehicle, strict=True
    ):
        assert one.equals(other, 2e-5)  # a hundredth of its sigma


def test_fixes_outside_the_imu_do_not_judge_the_noise() -> None:
    """Sigmas stated ten times too small, and an IMU that ends halfway: as without these fixes."""
    motion = recorded(gnss_horizontal=10.0, gnss_vertical=10.0)
    imu, gnss = motion.imu, motion.gnss
    assert imu is not None
    assert gnss is not None
    middle_ns = (imu.stamps_ns[0] + imu.stamps_ns[-1]) // 2
    early = imu.stamps_ns <= middle_ns
    short = rows_of(imu, early)
    beside = gnss.stamps_ns <= short.stamps_ns[-1]
    assert beside.mean() < 0.6
    cropped = rows_of(gnss, beside)

    whole = smoothed(replace(motion, imu=short))
    without = smoothed(replace(motion, imu=short, gnss=cropped))

    np.testing.assert_array_equal(whole.states.p_map_imu, without.states.p_map_imu)
    assert whole.warnings == without.warnings
    assert whole.data.positions is not None
    sigma = np.sqrt(np.median(whole.data.positions.cov_map[:, 0, 0]))
    assert 0.01 < sigma < 0.03  # 0.0167 m, stated as 0.0017


def test_sigmas_of_the_config_are_kept() -> None:
    trajectory = smoothed(recorded(), gnss_horizontal_m=0.05, gnss_vertical_m=0.05)

    assert trajectory.data is not None
    assert not any(name.startswith("gnss") for name in trajectory.data.scales)


def test_the_slope_of_the_likelihood_is_right() -> None:
    trajectory = base()
    assert trajectory.data is not None
    nodes, states = trajectory.nodes_ns[:30], trajectory.states
    none: IntArray = np.zeros(0, dtype=np.int64)
    graph = build_graph(trajectory.data, trajectory.nodes_ns, states, none, "none").factors
    kinds = trajectory.factor_kinds
    keys = {key(i) for i in range(30) for key in (key_imu, key_velocity, key_bias)}
    inside = [i for i in range(graph.size()) if set(graph.at(i).keys()) <= keys]
    part = type(graph)()
    for i in inside:
        part.push_back(graph.at(i))
    likelihood = NoiseLikelihood(
        part.linearize(trajectory.estimate().values),
        [kinds[i] for i in inside],
        [],
        nodes,
        states.R_map_imu[:30],
        (CorrelatedError("gnss", (0.02, 0.02, 0.01), 5.0),),
        free_components(trajectory.data),
    )
    scales = np.array([1.2, 0.8, 1.1, 0.9, 1.3, 0.7])
    _, slope = likelihood.at(scales)

    for i in range(6):
        moved = [scales * np.exp(1e-4 * s * np.eye(6)[i]) for s in (1.0, -1.0)]
        more, less = (likelihood.at(at)[0] for at in moved)
        assert slope[i] == pytest.approx((more - less) / 2e-4, rel=1e-3, abs=1e-2)


def test_levels_whose_likelihood_cannot_be_worked_out_are_no_end_of_the_fit() -> None:
    """A jump of the fixes made the search try levels at which the chain is not positive."""
    tried = []

    class Likelihood:
        names = ("gnss_horizontal", "velocity")
        best = np.array([0.4, -0.3])
        curvatures = np.zeros(2)  # so that steps are too long

        def at(self, scales: Array) -> tuple[float, Array]:
            x = np.log(scales)
            tried.append(x)
            if np.abs(x).max() > 0.6:
                raise TrajectoryError(UNDETERMINED)
            off = x - self.best
            return 1e3 * float(off @ off), 2e3 * off

        @property
        def as_stated(self) -> tuple[float, Array]:
            return self.at(np.ones(2))

    scales, _ = fit(cast("NoiseLikelihood", Likelihood()), set(Likelihood.names))

    assert max(np.abs(x).max() for x in tried) > 0.6
    assert np.log(list(scales.values())) == pytest.approx(Likelihood.best, abs=0.01)


def shifted(motion: MotionData, north_m: Array) -> MotionData:
    """The drive with errors (n,) of its fixes to the north."""
    assert motion.gnss is not None
    turned = motion.gnss.latitude_deg + np.degrees(north_m / 6.37e6)
    return replace(motion, gnss=replace(motion.gnss, latitude_deg=turned))


def test_errors_that_are_stated_already_have_no_effects_to_work_out() -> None:
    assert error_effects(base(), WANTED.tolist(), []) == ()


def test_poses_follow_an_error_of_the_fixes_by_the_gain() -> None:
    motion = recorded()
    assert motion.gnss is not None
    at = motion.gnss.stamps_ns
    # Zero at the first fix, the map's origin; constant over each step of the gain; too small for
    # stated sigmas to be doubted.
    error = 2e-3 * np.sin(1e-9 * (at - at[0]) // (STEP_NS * 1e-9) * STEP_NS * 1e-9)
    moved = smoothed(shifted(motion, error))
    (effects,) = error_effects(base(), WANTED.tolist(), ["gnss"])

    expected = effects.gain[:, 1] @ (2e-3 * np.sin(1e-9 * (effects.stamps_ns - at[0]) - 0.25))
    (before, after) = (t.joint_information(WANTED)[1] for t in (base(), moved))
    change = np.array([a.localCoordinates(b) for a, b in zip(before, after, strict=True)])

    assert np.abs(expected).max() > 1e-3
    assert change.ravel() == pytest.approx(expected, abs=5e-5)


def test_poses_and_inputs_follow_an_error_by_the_gain(monkeypatch: pytest.MonkeyPatch) -> None:
    motion = recorded()
    assert motion.gnss is not None
    at = motion.gnss.stamps_ns
    error = 2e-3 * (1e-9 * (at - at[0]) // (STEP_NS * 1e-9)) / 14.0
    typed = {"gnss": {"lever_arm": [1.2, 0.3, 0.85], "lever_arm_sigma": 0.01}}
    config = config_for(Sensors(), **typed)
    trajectory, moved = (
        smooth_trajectory(of, config, WANTED) for of in (motion, shifted(motion, error))
    )
    held = error_effects(trajectory, WANTED.tolist(), ["gnss"])[0]
    by_step = 2e-3 * ((held.stamps_ns - trajectory.nodes_ns[0]) // STEP_NS) / 14.0

    # The arm alone is free, and as far as in the smoother.
    monkeypatch.setattr("caliv_graph.trajectory.effects.suspect_parameters", lambda _: ())
    joint, gain = poses_and_gain(trajectory, WANTED, ["orientation", "gnss"])

    expected = trajectory.joint(WANTED)
    assert joint.information == pytest.approx(expected.information, rel=1e-6, abs=1e-2)
    both = (t.joint_information(WANTED)[1] for t in (trajectory, moved))
    change = np.concatenate([a.localCoordinates(b) for a, b in zip(*both, strict=True)])
    of_gnss = gain.reshape(len(gain), 2, 3, -1)[:, 1, 1]
    assert change == pytest.approx(of_gnss @ by_step, abs=1e-5)
    assert np.abs(change - held.gain[:, 1] @ by_step).max() > 3e-5
    assert np.abs(change).max() > 1e-3


def test_the_gain_of_some_steps_is_a_part_of_that_of_all() -> None:
    """Nodes after the steps that are asked for are eliminated first; they still count."""
    some = WANTED[:5]
    _, whole = poses_and_gain(base(), some, ["orientation", "gnss"])
    joint, part = poses_and_gain(base(), some, ["orientation", "gnss"], int(some[-1]))

    steps = part.shape[1] // 6
    assert steps < whole.shape[1] // 6
    expected = whole.reshape(len(whole), 6, -1)[:, :, :steps].reshape(part.shape)
    assert part == pytest.approx(expected, abs=1e-6 * np.abs(whole).max())
    assert len(joint.information) == 6 * len(some)


def test_an_input_that_may_be_wrong_explains_what_it_could() -> None:
    """A constant error of the fixes in the vehicle is a lever arm: nobody sees it by the poses."""
    heading = np.array([T.rotation().matrix() for T in base().joint(WANTED).T_map_vehicle])
    joint, _ = poses_and_gain(base(), WANTED, ["gnss"])

    information = joint.information.reshape(len(WANTED), 6, len(WANTED), 6)
    for axis in range(2):
        # The fixes shift by an arm: the poses move back along the vehicle's axis.
        arm = np.zeros((len(WANTED), 6))
        arm[:, 3 + axis] = 0.01
        told = np.einsum("ia,iajb,jb->", arm, information, arm)
        assert told < 0.5 * np.einsum(
            "ia,iajb,jb->",
            arm,
            base().joint(WANTED).information.reshape(information.shape),
            arm,
        )
    assert len(heading) == len(WANTED)


def test_a_correlated_error_widens_the_covariance_as_far_as_the_gain_says() -> None:
    motion = recorded()
    small = smoothed(motion, (CorrelatedError("gnss", (1e-5, 1e-5, 1e-5), 5.0),))
    large = smoothed(motion, (CorrelatedError("gnss", (0.02, 0.02, 0.02), 5.0),))
    cov, tiny, wide = (
        np.linalg.inv(t.joint_information(WANTED)[0]) for t in (base(), small, large)
    )
    (effects,) = error_effects(base(), WANTED.tolist(), ["gnss"])
    rows = effects.gain.reshape(len(cov), -1)
    considered = cov + 4e-4 * sum(
        smoothed_in_time(g, effects.stamps_ns, 5.0) @ g.T for g in np.moveaxis(effects.gain, 1, 0)
    )

    assert rows.shape[0] == 6 * len(WANTED)
    assert np.sqrt(np.diag(tiny) / np.diag(cov)) == pytest.approx(1.0, abs=1e-3)
    # The smoother that knows of the error is better than the one that does not, and not by much.
    ratio = np.sqrt(np.diag(considered) / np.diag(wide)).reshape(-1, 6)
    assert ratio.min() > 0.999
    assert ratio[:, 3:].max() < 1.1
    assert large.correlated[0].sigmas == (0.02, 0.02, 0.02)


@pytest.mark.parametrize(
    ("tilt_deg", "yaw_deg", "sigmas_deg"),
    [(0.1, None, (0.1, 0.1, 0.1)), (0.1, 0.2, (0.1, 0.1, 0.2)), (None, 0.2, (0.0, 0.0, 0.2))],
)
def test_an_orientation_errs_about_the_vertical_by_a_size_of_its_own(
    tilt_deg: float | None, yaw_deg: float | None, sigmas_deg: tuple[float, ...]
) -> None:
    stated = {"orientation_correlated_deg": tilt_deg, "orientation_correlated_yaw_deg": yaw_deg}

    (error,) = configured_errors(config_for(Sensors(), noise=stated))

    assert error.kind == "orientation"
    assert np.degrees(error.sigmas) == pytest.approx(sigmas_deg, abs=1e-4)


def test_correlated_errors_of_the_config_are_used() -> None:
    trajectory = smoothed(recorded(), gnss_correlated_horizontal_m=0.03, gnss_correlation_s=20.0)

    (error,) = trajectory.correlated
    assert (error.kind, error.sigmas[:2], error.time_s) == ("gnss", (0.03, 0.03), 20.0)
    assert trajectory.trajectory.cov is not None
    position = np.sqrt(np.diagonal(trajectory.trajectory.cov, axis1=1, axis2=2))[:, 3:5]
    assert np.median(position) == pytest.approx(0.03, rel=0.2)
