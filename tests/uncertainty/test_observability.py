"""What a drive without ground determines, and the step and covariance of `auto`."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
import scipy.linalg
from scipy.spatial.transform import Rotation

from caliv_graph.calibration.graph import (
    cloud_graph,
    initial_values,
    merged,
    optimise,
    pose_graph,
    prior_graph,
)
from caliv_graph.calibration.linear import add_shape, dense_system, linearise_clouds
from caliv_graph.calibration.problem import Problem
from caliv_graph.conventions import AXES, key_extrinsic, key_pose_error, key_target, key_vehicle
from caliv_graph.geometry.se3 import retract_vehicle_axes
from caliv_graph.products import Array, PoseNoise, Uncertainty
from caliv_graph.uncertainty.observability import (
    UNIT,
    assess,
    covariance_with_prior_in_null_space,
    rigid_twist,
    scaling,
    simplified,
    spectrum,
    step_with_prior_in_null_space,
)
from caliv_graph.wording.directions import named
from tests.calibration.problems import predictions
from tests.drives_with_chair import (
    ARC,
    ARC_LEFT,
    CHAIR_XYZ_M,
    FIGURE_EIGHT,
    RADIUS_M,
    S_CURVE,
    STANDSTILL,
    STRAIGHT,
    over_a_ramp,
    poses_of,
)
from tests.samples import MOUNTINGS, pose, turn_about, twist_of_all

GUESS_SIGMAS = np.array([math.radians(1.73)] * 3 + [0.058] * 3)
"""Of the config's defaults: +-3 degrees and +-0.1 m."""

REGISTRATION_SIGMAS = np.array([2e-3] * 3 + [1e-3] * 3)

WHITE = PoseNoise(1e-3, 5e-3, 1e-5, 1e-4, 4.0)
"""5 mm and 1 mrad on every pose, and next to nothing that lasts."""

EXACT = PoseNoise(1e-4, 5e-4, 1e-5, 1e-4, 4.0)
"""Poses good enough that what the data tell at all, they tell well."""

HEIGHT = "height of all LiDARs together"
TURN = f"rotation of all LiDARs about the turn centre: x and yaw together, {RADIUS_M:.2f} m per rad"

DRIVES = {
    "straight": [poses_of(STRAIGHT, 24)],
    "arc": [poses_of(ARC, 24)],
    "arc to the left": [poses_of(ARC_LEFT, 24)],
    "S-curve": [poses_of(S_CURVE, 24)],
    "figure-eight": [poses_of(FIGURE_EIGHT, 24)],
    "left arc, right arc": [poses_of(ARC_LEFT, 12), poses_of(ARC, 12)],
    "S-curve over a ramp": [over_a_ramp(poses_of(S_CURVE, 24))],
    "standstill": [poses_of(STANDSTILL, 12)],
}

LOST: dict[str, set[str]] = {
    "straight": {
        HEIGHT,
        "shift of all LiDARs together forward: x",
        "shift of all LiDARs together sideways: y",
        "roll of all LiDARs together",
    },
    "arc": {HEIGHT, TURN},
    "arc to the left": {HEIGHT, TURN},
    "S-curve": {HEIGHT},
    "figure-eight": {HEIGHT},
    "left arc, right arc": {HEIGHT},
    "S-curve over a ramp": set(),
}
"""What people shall read. Of standstill, where it is everything, it is counted below."""

LOST_AXES = {
    "straight": {"x", "y", "z", "roll"},
    "arc": {"x", "yaw", "z"},
    "arc to the left": {"x", "yaw", "z"},
    "S-curve": {"z"},
    "figure-eight": {"z"},
    "left arc, right arc": {"z"},
    "S-curve over a ramp": set(),
    "standstill": set(AXES),
}


@dataclass(frozen=True)
class Case:
    """A drive on which every LiDAR sees the chair at every pose.

    Attributes:
        problem: with the given poses and the guesses.
        truth: values of all variables.
        measured: T_target_lidar of each cloud as registered.
    """

    problem: Problem
    truth: gtsam.Values
    measured: tuple[gtsam.Pose3, ...]

    @property
    def prior(self) -> Array:
        sigmas = [self.problem.prior_sigmas[name] for name in self.problem.lidars]
        return np.diag(np.concatenate(sigmas) ** -2.0)

    def extrinsics(self, values: gtsam.Values) -> dict[str, gtsam.Pose3]:
        return {name: self.problem.extrinsic(values, name) for name in self.problem.lidars}


def make_case(drives: Sequence[Sequence[gtsam.Pose3]], *lidars: str) -> Case:
    """Without errors: the given poses and the guesses are the truth."""
    names = lidars or ("front", "rear")
    poses = [T for drive in drives for T in drive]
    drive_of = [d for d, drive in enumerate(drives) for _ in drive]
    extrinsics = {name: pose(*MOUNTINGS[name]) for name in names}
    problem = Problem(
        lidars=names,
        reference=names[-1],
        guesses=extrinsics,
        prior_sigmas=dict.fromkeys(names, GUESS_SIGMAS),
        fixed=frozenset(),
        poses=tuple((d, 500_000_000 * i) for i, d in enumerate(drive_of)),
        T_map_vehicle=tuple(poses),
        origins_map={drive: np.zeros(3) for drive in range(len(drives))},
        cloud_lidar=np.repeat(np.arange(len(names)), len(poses)),
        cloud_pose=np.tile(np.arange(len(poses)), len(names)),
        cloud_placement=np.tile(np.array(drive_of), len(names)),
        placements=len(drives),
    )
    truth = gtsam.Values()
    for i, T in enumerate(poses):
        truth.insert(key_vehicle(i), T)
        truth.insert(key_pose_error(i), np.zeros(6))
    truth.insert(key_extrinsic(), extrinsics[problem.reference])
    for name in names:
        for key in problem.extrinsic_keys_of(name)[1:]:
            truth.insert(key, extrinsics[problem.reference].between(extrinsics[name]))
    T_map_target = gtsam.Pose3(gtsam.Rot3(), np.array(CHAIR_XYZ_M))
    for m in range(problem.placements):
        truth.insert(key_target(m), T_map_target.inverse())
    return Case(problem, truth, tuple(predictions(problem, truth)))


def with_errors(case: Case, seed: int, noise: PoseNoise = WHITE) -> Case:
    """White errors of the poses, of the registration, and of the guesses."""
    rng = np.random.default_rng(seed)

    def moved(T: gtsam.Pose3, rotation_rad: Array, position_m: Array) -> gtsam.Pose3:
        R = T.rotation().compose(gtsam.Rot3.Expmap(rotation_rad))
        return gtsam.Pose3(R, T.translation() + position_m)

    given = [
        moved(
            T,
            noise.white_rotation_rad * rng.normal(size=3),
            noise.white_position_m * rng.normal(size=3),
        )
        for T in case.problem.T_map_vehicle
    ]
    guesses = {
        name: moved(T, rng.uniform(-0.052, 0.052, 3), rng.uniform(-0.1, 0.1, 3))
        for name, T in case.problem.guesses.items()
    }
    measured = [
        gtsam.Pose3.Expmap(REGISTRATION_SIGMAS * rng.normal(size=6)).compose(Z)
        for Z in case.measured
    ]
    problem = replace(case.problem, T_map_vehicle=tuple(given), guesses=guesses)
    return Case(problem, case.truth, tuple(measured))


def shape_information(problem: Problem, *, disjoint: bool = False) -> Array:
    """(6 J, 6 J) of the clouds' poses, the shape estimated from them: none on their common motion.

    Args:
        problem: the clouds.
        disjoint: no two LiDARs saw the same skin of the target: nothing ties them together.
    """
    one = np.diag(REGISTRATION_SIGMAS**-2.0)
    H = scipy.linalg.block_diag(*[one] * problem.clouds)
    # A shape of its own for every placement and, if they are disjoint, every LiDAR.
    group = problem.cloud_placement.copy()
    if disjoint:
        group = group * len(problem.lidars) + problem.cloud_lidar
    for which in np.unique(group):
        member = group == which
        together = np.kron(np.outer(member, member), one) / member.sum()
        H -= together
    return H


def data_information(
    case: Case, values: gtsam.Values, noise: PoseNoise, *, disjoint: bool = False
) -> Array:
    """(6n, 6n) of the extrinsics, vehicle axes, everything else eliminated."""
    problem = case.problem
    H = shape_information(problem, disjoint=disjoint)
    system = dense_system(problem, pose_graph(problem, noise), values)
    system = add_shape(system, linearise_clouds(problem, values), H, np.zeros(len(H)))
    D, _, _, _ = system.schur()
    to_tangent = np.linalg.inv(problem.to_vehicle_axes(values))
    D = to_tangent.T @ D @ to_tangent
    return np.asarray(0.5 * (D + D.T))


def solved(case: Case, noise: PoseNoise) -> gtsam.Values:
    """The minimum of pose factors, given poses and guesses."""
    problem = case.problem
    information = np.tile(np.diag(REGISTRATION_SIGMAS**-2.0), (problem.clouds, 1, 1))
    graph = merged(
        pose_graph(problem, noise),
        prior_graph(problem, problem.lidars),
        cloud_graph(problem, case.measured, information),
    )
    return optimise(graph, initial_values(problem, case.measured), 30)


def verdict_of(case: Case, noise: PoseNoise, *, disjoint: bool = False) -> Uncertainty:
    D = data_information(case, case.truth, noise, disjoint=disjoint)
    return assessed(D, case.prior, case.extrinsics(case.truth))


def verdict_on_noise(case: Case, seed: int, noise: PoseNoise = WHITE) -> tuple[Uncertainty, Array]:
    """What is said after a solve, and the ratios of the sigmas, largest first."""
    noisy = with_errors(case, seed, noise)
    values = solved(noisy, noise)
    D = data_information(noisy, values, noise)
    split = spectrum(D, case.prior)
    ratio = np.sort(split.sigma_data / split.sigma_prior)[::-1]
    return assessed(D, case.prior, case.extrinsics(values)), ratio


def assessed(
    D: Array, prior: Array, extrinsics: Mapping[str, gtsam.Pose3], held: Sequence[str] = ()
) -> Uncertainty:
    """The verdicts, their directions with names."""
    return named(assess(D, prior, extrinsics, held), extrinsics)


def texts(uncertainty: Uncertainty) -> list[str]:
    return sorted(direction.text for direction in uncertainty.undetermined)


def said(uncertainty: Uncertainty) -> list[str]:
    """The texts; roll about whichever axis along the way: any will do where y is lost too."""
    return sorted(
        text.replace("roll and y of all LiDARs together", "roll of all LiDARs together")
        for text in texts(uncertainty)
    )


def lost_axes(uncertainty: Uncertainty) -> dict[str, set[str]]:
    return {
        name: {axis for axis, known in axes.items() if not known}
        for name, axes in uncertainty.determined.items()
    }


def unscaled_basis(uncertainty: Uncertainty, lidars: Sequence[str]) -> Array:
    """(6n, k) orthonormal basis of the undetermined directions, scaled units."""
    vectors = [
        np.concatenate([d.vector[name] for name in lidars]) / scaling(len(lidars))
        for d in uncertainty.undetermined
    ]
    return np.asarray(scipy.linalg.orth(np.array(vectors).T))


# ------------------------------------------------------------------ the table, without noise


@pytest.mark.parametrize("name", list(LOST))
def test_what_a_drive_does_not_determine_is_named_and_nothing_else(name: str) -> None:
    case = make_case(DRIVES[name])

    uncertainty = verdict_of(case, EXACT)

    assert said(uncertainty) == sorted(LOST[name])
    assert lost_axes(uncertainty) == dict.fromkeys(case.problem.lidars, LOST_AXES[name])
    # Sensor to sensor: nothing in which LiDARs move apart is lost, nor even weak.
    assert all(d.together for d in (*uncertainty.undetermined, *uncertainty.weak))


def test_standing_still_loses_the_vehicle_but_not_the_other_lidar() -> None:
    case = make_case(DRIVES["standstill"])

    uncertainty = verdict_of(case, EXACT)

    assert len(uncertainty.undetermined) == 6
    assert all(direction.together for direction in uncertainty.undetermined)
    assert set.intersection(*lost_axes(uncertainty).values()) == set(AXES)


@pytest.mark.parametrize(
    ("name", "lost"), [("standstill", 12), ("arc", 4), ("S-curve", 2)], ids=["still", "arc", "S"]
)
def test_lidars_that_saw_different_skins_are_not_tied_by_the_target(name: str, lost: int) -> None:
    case = make_case(DRIVES[name])

    uncertainty = verdict_of(case, EXACT, disjoint=True)

    # What a drive loses, it now loses for each LiDAR by itself.
    assert len(uncertainty.undetermined) == lost
    assert sum(not direction.together for direction in uncertainty.undetermined) >= lost // 2
    if name == "arc":
        # Two metres ahead of the axle, y comes along with a fifth of x: at the edge of being told.
        alone = [t.replace("x and y of", "x of") for t in texts(uncertainty) if "lidar '" in t]
        assert alone == [
            "yaw and x of lidar 'front' together",
            "yaw and x of lidar 'rear' together",
            "z of lidar 'front'",
            "z of lidar 'rear'",
        ]


@pytest.mark.parametrize(
    ("name", "twists"),
    [
        ("arc", [turn_about((0.0, -RADIUS_M)), [0, 0, 0, 0, 0, 1]]),
        ("arc to the left", [turn_about((0.0, RADIUS_M)), [0, 0, 0, 0, 0, 1]]),
        ("straight", [[1, 0, 0, 0, 0, 0], *np.eye(6)[3:].tolist()]),
        ("figure-eight", [[0, 0, 0, 0, 0, 1]]),
        ("standstill", np.eye(6).tolist()),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_the_undetermined_directions_are_those_of_the_geometry(
    name: str, twists: list[list[float]]
) -> None:
    case = make_case(DRIVES[name], "front", "left", "rear")
    lidars = case.problem.lidars
    expected = np.array(
        [
            np.concatenate([*twist_of_all(twist, case.problem.guesses).values()]) / scaling(3)
            for twist in twists
        ]
    ).T

    found = unscaled_basis(verdict_of(case, EXACT), lidars)

    assert found.shape == expected.shape
    # The same subspace: the largest angle between the two is far below 1 mrad per rad.
    assert scipy.linalg.subspace_angles(found, expected).max() < 1e-3


def test_a_turn_of_the_lidars_about_the_centre_is_a_turn_of_the_targets_frame() -> None:
    # Where the table's second line comes from: nothing in the clouds changes.
    case = make_case(DRIVES["arc"])
    problem, values = case.problem, gtsam.Values(case.truth)
    angle = 0.02
    turn = gtsam.Pose3.Expmap(angle * np.array(turn_about((0.0, -RADIUS_M))))
    values.update(key_extrinsic(), turn.compose(values.atPose3(key_extrinsic())))
    moved = predictions(problem, values)
    change = [a.compose(b.inverse()) for a, b in zip(moved, case.measured, strict=True)]

    for T in change:
        assert gtsam.Pose3.Logmap(change[0].between(T)) == pytest.approx(np.zeros(6), abs=1e-6)
    assert gtsam.Rot3.Logmap(change[0].rotation())[2] == pytest.approx(angle)


# ------------------------------------------------------------------ the table, with noise


@pytest.mark.parametrize("name", ["straight", "S-curve", "figure-eight", "left arc, right arc"])
@pytest.mark.parametrize("seed", [1, 2])
def test_noise_neither_hides_nor_invents_a_direction(name: str, seed: int) -> None:
    uncertainty, _ = verdict_on_noise(make_case(DRIVES[name]), seed)

    assert said(uncertainty) == sorted(LOST[name])


def test_a_ramp_tells_the_height_of_noisy_lidars_too() -> None:
    # More poses: what the ramp tells, it tells by the sine of its slope.
    case = make_case([over_a_ramp(poses_of(S_CURVE, 60))])

    uncertainty, _ = verdict_on_noise(case, 1)

    assert texts(uncertainty) == []


@pytest.mark.parametrize(
    "noise",
    [WHITE, PoseNoise(1e-2, 5e-2, 1e-5, 1e-4, 4.0)],
    ids=["5 mm and 1 mrad", "50 mm and 10 mrad"],
)
def test_a_noisy_arc_never_looks_determined(noise: PoseNoise) -> None:
    # The trap: errors of the poses turn the path a little, and the sums say that this is enough.
    case = make_case(DRIVES["arc"])
    for seed in range(20):
        uncertainty, ratio = verdict_on_noise(case, seed, noise)

        radius = [float(m[1]) for t in texts(uncertainty) if (m := re.search(r"([\d.]+) m per", t))]
        assert [HEIGHT in texts(uncertainty), len(uncertainty.undetermined)] == [True, 2]
        assert radius == [pytest.approx(RADIUS_M, abs=0.15)]
        # Not by a hair either: the faked sigma is 30 times that of the guesses.
        assert ratio[1] > 25.0
        assert ratio[2] < 0.3


# ------------------------------------------------------------------ spectrum


def test_a_direction_is_lost_at_half_of_the_priors_sigma_and_weak_at_a_tenth() -> None:
    sigma_prior = np.array([20e-3, 30e-3, 10e-3, 50e-3, 60e-3, 40e-3])
    ratio = np.array([0.51, 0.49, 0.11, 0.09, math.inf, 0.001])
    with np.errstate(divide="ignore"):
        D = np.diag((ratio * sigma_prior) ** -2.0)

    split = spectrum(D, np.diag(sigma_prior**-2.0))

    axis = np.abs(split.vectors).argmax(axis=0)
    assert {AXES[i] for i in axis[split.undetermined]} == {"roll", "y"}
    assert {AXES[i] for i in axis[split.weak]} == {"pitch", "yaw"}
    assert split.sigma_prior == pytest.approx((sigma_prior / UNIT)[axis])
    assert split.sigma_data == pytest.approx((ratio * sigma_prior / UNIT)[axis])


def test_best_determined_comes_first_in_units_of_1_mrad_and_10_mm() -> None:
    # 2 mrad, 1 mrad, 4 mrad, 5 mm, 30 mm, 80 mm.
    D = np.diag(np.array([2e-3, 1e-3, 4e-3, 5e-3, 30e-3, 80e-3]) ** -2.0)

    split = spectrum(D, np.eye(6))

    assert split.sigma_data == pytest.approx([0.5, 1.0, 2.0, 3.0, 4.0, 8.0])
    order = [AXES[i] for i in np.abs(split.vectors).argmax(axis=0)]
    assert order == ["x", "pitch", "roll", "y", "yaw", "z"]


def test_the_number_of_lost_directions_may_be_decided_before() -> None:
    prior = np.diag(np.full(6, 1.0))
    D = np.diag(np.array([1.0, 4.0, 9.0, 16.0, 25.0, 36.0]) * 1e4)

    for count in range(4):
        split = spectrum(D, prior, count)
        lost = np.abs(split.vectors).argmax(axis=0)[split.undetermined]
        # The largest ratio of sigmas: the smallest information, the prior being the same for all.
        assert sorted(lost) == list(range(count))


def test_what_the_data_know_nothing_of_is_lost_whatever_was_decided() -> None:
    # A LiDAR whose clouds have lost their weights: its steps would have no end.
    D, prior = np.diag([1e4, 1e4, 1e4, 1e4, 0.0, 1e-5]), np.eye(6)
    split = spectrum(D, prior, 0)
    assert sorted(np.abs(split.vectors).argmax(axis=0)[split.undetermined]) == [4, 5]
    step = step_with_prior_in_null_space(D, np.full(6, 1e-9), prior, np.zeros(6), split)
    assert np.isfinite(step).all()
    assert np.abs(step).max() < 1e-6


# ------------------------------------------------------------------ a solve that respects it


def test_along_what_is_lost_the_guess_decides_and_has_no_say_elsewhere() -> None:
    D = np.diag([1e6, 4e6, 1e6, 1e4, 1e4, 0.0])
    prior = np.diag(GUESS_SIGMAS**-2.0)
    c = np.array([3e3, -8e3, 0.0, 50.0, -20.0, 0.0])
    offset = np.array([0.01, 0.02, -0.01, 0.03, -0.04, 0.05])

    step = step_with_prior_in_null_space(D, c, prior, offset, spectrum(D, prior))

    # z returns to the guess; everything else goes where the data say: c / D, whatever the guess.
    assert step == pytest.approx([3e-3, -2e-3, 0.0, 5e-3, -2e-3, -0.05])


def test_what_the_data_tell_of_a_lost_direction_is_not_listened_to() -> None:
    # Information that noise faked: 1 % of the guess's.
    prior = np.diag(GUESS_SIGMAS**-2.0)
    D = np.diag([1e6, 1e6, 1e6, 1e6, 1e6, 0.01 / 0.058**2])
    c = D @ np.array([0.0, 0.0, 0.0, 0.0, 0.0, 3.0])

    step = step_with_prior_in_null_space(D, c, prior, np.zeros(6), spectrum(D, prior))

    assert step == pytest.approx(np.zeros(6), abs=1e-12)


def test_one_lidar_shares_its_x_and_y_out_by_the_guess() -> None:
    # Only x - y is measured: as d = 20 mm. The rest: x' = ox + x, y' = oy + y meet the guesses
    # best, weighted by 1 / sigma^2, 1 and 1/4 here: (ox + oy + ... ) by hand below.
    D = np.diag([1e6, 1e6, 1e6, 1e4, 1e4, 1e4])
    D[3, 4] = D[4, 3] = -1e4
    prior = np.diag([1e3, 1e3, 1e3, 1e2, 0.25e2, 1e2])
    d, ox, oy = 0.02, 0.03, -0.05
    c = np.array([0.0, 0.0, 0.0, 1e4 * d, -1e4 * d, 0.0])
    offset = np.array([0.0, 0.0, 0.0, ox, oy, 0.0])

    step = step_with_prior_in_null_space(D, c, prior, offset, spectrum(D, prior))

    # min (ox + y + d)^2 + (oy + y)^2 / 4  =>  y = -(0.05 + -0.0125) / 1.25 = -0.03
    assert step[3:5] == pytest.approx([-0.01, -0.03])


def two_heights(sigma_front_m: float, sigma_rear_m: float) -> tuple[Array, Array]:
    """Data that know all but the common height of two LiDARs, and guesses of it."""
    D = np.diag([1e6, 1e6, 1e6, 1e6, 1e6, 1e6] * 2)
    D[5, 11] = D[11, 5] = -1e6
    sigmas = np.tile(GUESS_SIGMAS, 2)
    sigmas[[5, 11]] = sigma_front_m, sigma_rear_m
    return D, np.diag(sigmas**-2.0)


@pytest.mark.parametrize(
    ("sigma_front_m", "sigma_rear_m", "weight"),
    [(0.058, 0.058, 0.5), (0.04, 0.08, 0.8)],
    ids=["alike", "the front one better"],
)
def test_the_guesses_of_two_lidars_vote(
    sigma_front_m: float, sigma_rear_m: float, weight: float
) -> None:
    D, prior = two_heights(sigma_front_m, sigma_rear_m)
    # The front LiDAR is to go up by 10 mm against the rear one. The guesses were 60 mm higher in
    # front and 20 mm lower behind.
    c = np.zeros(12)
    c[[5, 11]] = 1e6 * 0.01, -1e6 * 0.01
    offset = np.zeros(12)
    offset[[5, 11]] = -0.06, 0.02

    step = step_with_prior_in_null_space(D, c, prior, offset, spectrum(D, prior))

    front, rear = step[5], step[11]
    assert front - rear == pytest.approx(0.01)
    # Behind, the front guess says -(-0.06 + 0.01), the rear one -0.02.
    assert rear == pytest.approx(weight * 0.05 + (1.0 - weight) * -0.02)
    assert np.delete(step, [5, 11]) == pytest.approx(np.zeros(10), abs=1e-12)


def test_covariance_of_two_votes_by_hand() -> None:
    D, prior = two_heights(0.04, 0.08)

    cov = covariance_with_prior_in_null_space(prior, spectrum(D, prior))

    # Data: front - rear with variance 1e-6 s, s of the pseudo-inverse of [[1, -1], [-1, 1]] seen
    # along (1, -1): 1. The common height: 1 / (1/0.04^2 + 1/0.08^2) = 0.00128, and what the
    # difference drags along: 0.8 of it behind, 0.2 in front.
    joint = 0.00128
    assert cov[5, 5] == pytest.approx(joint + 0.2**2 * 1e-6)
    assert cov[11, 11] == pytest.approx(joint + 0.8**2 * 1e-6)
    assert cov[5, 11] == pytest.approx(joint - 0.2 * 0.8 * 1e-6)
    others = [0, 1, 2, 3, 4, 6, 7, 8, 9, 10]
    assert np.diag(cov)[others] == pytest.approx(np.full(10, 1e-6))


def test_covariance_against_monte_carlo() -> None:
    case = make_case(DRIVES["arc"])
    D = data_information(case, case.truth, WHITE)
    sigmas = np.array([0.02, 0.03, 0.04, 0.03, 0.05, 0.02, 0.03, 0.03, 0.01, 0.08, 0.06, 0.04])
    prior = np.diag(sigmas**-2.0)
    split = spectrum(D, prior)
    assert split.undetermined.sum() == 2
    rng = np.random.default_rng(7)
    values, vectors = np.linalg.eigh(D)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    draws = 4000
    errors = np.array(
        [
            # From the truth: the data err by c ~ N(0, D), the guesses by their sigma.
            step_with_prior_in_null_space(
                D, root @ rng.normal(size=12), prior, sigmas * rng.normal(size=12), split
            )
            for _ in range(draws)
        ]
    )

    cov = covariance_with_prior_in_null_space(prior, split)

    white = np.linalg.solve(np.linalg.cholesky(cov), errors.T)
    sample = white @ white.T / draws
    # Eigenvalues of a sample covariance of 12 dimensions: 1 +- 2 sqrt(12 / 4000).
    assert np.abs(np.linalg.eigvalsh(sample) - 1.0).max() < 0.15
    assert cov == pytest.approx(cov.T, abs=1e-18)


# ------------------------------------------------------------------ simplified


@pytest.mark.parametrize("seed", range(10))
def test_mixtures_are_taken_apart(seed: int) -> None:
    # Height of two LiDARs, and the turn about the centre, in scaled units, mixed by a rotation.
    lidars = {name: pose(*MOUNTINGS[name]) for name in ("front", "rear")}
    twists = ([0.0, 0.0, 0.0, 0.0, 0.0, 1.0], turn_about((0.0, -RADIUS_M)))
    pure = np.array(
        [np.concatenate([*twist_of_all(t, lidars).values()]) / scaling(2) for t in twists]
    ).T
    pure /= np.linalg.norm(pure, axis=0)
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi)
    mix = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])

    parts = simplified(pure @ mix)

    assert np.abs(parts.T @ parts) == pytest.approx(np.eye(2), abs=1e-9)
    assert np.abs(pure.T @ parts) == pytest.approx(np.eye(2), abs=1e-3)


def test_a_single_direction_is_left_as_it_is() -> None:
    basis = np.linspace(-1.0, 1.0, 12)[:, None]

    assert simplified(basis) == pytest.approx(basis)


def test_what_is_taken_apart_spans_what_it_was() -> None:
    basis = np.linalg.qr(np.random.default_rng(3).normal(size=(18, 5)))[0]

    parts = simplified(basis)

    assert scipy.linalg.subspace_angles(basis, parts).max() < 1e-7
    assert parts.T @ parts == pytest.approx(np.eye(5), abs=1e-9)


# ------------------------------------------------------------------ rigid motions

LIDARS = {name: pose(*MOUNTINGS[name]) for name in ("front", "rear")}


def test_yaw_of_each_lidar_in_its_place_is_no_motion_of_all() -> None:
    # Both turn by the same angle, but where they stand: seen from one, the other goes sideways.
    parts = {name: np.eye(6)[2] * 1e-3 for name in LIDARS}
    far = {**LIDARS, "rear": pose((-9.0, 0.0, 2.0), (0.0, 10.0, 180.0))}

    assert rigid_twist(parts, far) is None
    assert rigid_twist(twist_of_all(turn_about((0.0, 0.0)), far), far) is not None


# ------------------------------------------------------------------ assess

WEAK_PRIOR = np.eye(12)
"""1 rad and 1 m: everything below is better than that, but what is left out altogether."""


def without(*directions: Sequence[float]) -> Array:
    """Data information of two LiDARs: 1 mrad and 10 mm, but nothing along these (scaled units)."""
    basis = scipy.linalg.orth(np.array(directions, dtype=np.float64).T)
    unit = scaling(2)
    return np.asarray((np.eye(12) - basis @ basis.T) / np.outer(unit, unit))


def test_an_axis_is_lost_by_its_share_of_the_undetermined_subspace() -> None:
    # Squares, front: x 0.90, yaw 0.055, y 0.045 of its part; rear: the same axes the other way.
    front = np.sqrt([0.0, 0.0, 0.055, 0.90, 0.045, 0.0])
    rear = np.sqrt([0.0, 0.0, 0.90, 0.045, 0.055, 0.0])

    uncertainty = assessed(without([*front, *rear]), WEAK_PRIOR, LIDARS)

    assert lost_axes(uncertainty) == {"front": {"yaw", "x"}, "rear": {"yaw", "y"}}


def test_shares_add_up_over_directions() -> None:
    # y has 4 % of the first direction and all of the second.
    x_and_some_y = [0.0, 0.0, 0.0, math.sqrt(0.96), math.sqrt(0.04), 0.0, *[0.0] * 6]
    one = assessed(without(x_and_some_y), WEAK_PRIOR, LIDARS)
    height = [*[0.0] * 5, 1.0, *[0.0] * 6]
    # 4 % of x's direction are 2 % of both; 6 % would be 3 %.
    two = assessed(without(x_and_some_y, height), WEAK_PRIOR, LIDARS)

    assert lost_axes(one)["front"] == {"x"}
    assert lost_axes(two)["front"] == {"x", "z"}
    assert lost_axes(two)["rear"] == set()


@pytest.mark.parametrize(("share", "lost"), [(0.009, set()), (0.011, {"z"})], ids=["1", "2"])
def test_a_lidar_with_no_part_to_speak_of_loses_nothing(share: float, lost: set[str]) -> None:
    front = [0.0, 0.0, 0.0, 0.0, 0.0, math.sqrt(1.0 - share)]
    rear = [0.0, 0.0, 0.0, 0.0, 0.0, math.sqrt(share)]

    uncertainty = assessed(without([*front, *rear]), WEAK_PRIOR, LIDARS)

    assert lost_axes(uncertainty) == {"front": {"z"}, "rear": lost}


def test_held_axes_are_determined_for_no_lidar() -> None:
    D = without(np.eye(12)[2].tolist())

    uncertainty = assessed(D, WEAK_PRIOR, LIDARS, held=("x", "y", "z"))

    assert lost_axes(uncertainty) == {"front": {"yaw", "x", "y", "z"}, "rear": {"x", "y", "z"}}
    assert texts(uncertainty) == ["yaw of lidar 'front'"]


def test_weak_directions_are_named_and_stay_determined() -> None:
    D = np.diag(scaling(2) ** -2.0)
    prior = np.diag(np.tile(GUESS_SIGMAS, 2) ** -2.0)
    # The rear LiDAR's pitch to 6 mrad: a fifth of what its guess says.
    D[7, 7] = 6e-3**-2.0

    uncertainty = assessed(D, prior, LIDARS)

    assert texts(uncertainty) == []
    (weak,) = [d for d in uncertainty.weak if "rear" in d.text and "pitch" in d.text]
    assert (weak.text, weak.together) == ("pitch of lidar 'rear'", False)
    assert weak.sigma_data == pytest.approx(6e-3)
    assert weak.sigma_prior == pytest.approx(GUESS_SIGMAS[1])
    assert all(all(axes.values()) for axes in uncertainty.determined.values())


def test_sigmas_are_those_along_the_vector_that_is_shown() -> None:
    case = make_case(DRIVES["arc"])
    noisy = with_errors(case, 1)
    values = solved(noisy, WHITE)
    D = data_information(noisy, values, WHITE)

    uncertainty = assessed(D, case.prior, case.extrinsics(values))

    for direction in uncertainty.undetermined:
        vector = np.concatenate([direction.vector[name] for name in case.problem.lidars])
        assert np.abs(vector).max() == pytest.approx(1.0)
        assert direction.sigma_prior == pytest.approx((vector @ case.prior @ vector) ** -0.5)
        assert direction.sigma_data == pytest.approx((vector @ D @ vector) ** -0.5)
    # Two guesses of 58 mm: 41 mm together. Of x on the arc 40 mm, for yaw goes with it.
    assert sorted(d.sigma_prior for d in uncertainty.undetermined) == pytest.approx(
        [0.0395, 0.041], abs=5e-4
    )


def test_the_spectrum_is_told_best_first() -> None:
    case = make_case(DRIVES["S-curve"])

    spectrum_mrad = verdict_of(case, WHITE).spectrum

    assert spectrum_mrad.shape == (12,)
    assert (np.diff(spectrum_mrad) >= 0.0).all()
    assert spectrum_mrad[-1] > 100.0 * spectrum_mrad[-2]


def test_the_verdict_does_not_depend_on_the_order_of_the_lidars() -> None:
    names = ("front", "left", "rear")
    case = make_case(DRIVES["arc"], *names)
    D = data_information(case, case.truth, WHITE)
    one = assessed(D, case.prior, case.extrinsics(case.truth))
    order = [2, 0, 1]
    rows = np.concatenate([np.arange(6 * i, 6 * i + 6) for i in order])
    other = assessed(
        D[np.ix_(rows, rows)],
        case.prior[np.ix_(rows, rows)],
        {names[i]: case.problem.guesses[names[i]] for i in order},
    )

    assert texts(one) == texts(other)
    assert lost_axes(one) == lost_axes(other)


def test_rotations_here_are_rotations_elsewhere() -> None:
    # The sign of the yaw: turned by the returned vector, a LiDAR turns as scipy says.
    parts = twist_of_all(turn_about((0.0, -RADIUS_M)), LIDARS)
    T = retract_vehicle_axes(LIDARS["front"], 0.1 * parts["front"])
    turned = Rotation.from_matrix(T.rotation().matrix() @ LIDARS["front"].rotation().matrix().T)

    assert turned.as_rotvec() == pytest.approx([0.0, 0.0, 0.1], abs=1e-9)
