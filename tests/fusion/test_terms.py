from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.optimize import least_squares

from caliv_graph.config.guesses import FOUND_SIGMA
from caliv_graph.errors import ConfigError
from caliv_graph.fusion.terms import arranged, drive_digest, fuse, moved_to, own_term, slid
from caliv_graph.geometry.se3 import retract_vehicle_axes, vehicle_axes_difference
from caliv_graph.products import (
    Array,
    DataTerm,
    GivenPoses,
    Guess,
    ImuSamples,
    MotionData,
    PoseFrame,
)
from tests.drives_with_chair import RADIUS_M
from tests.fusion.drives import TRUTH, arc_information, drive, information, moved, shift
from tests.samples import turn_about_centre

NAMES = ("front", "rear")
LOOSE = np.array([10.0] * 3 + [100.0] * 3)


def term(seed: int, spread: float = 0.0, names: tuple[str, ...] = NAMES) -> DataTerm:
    rng = np.random.default_rng(seed)
    poses = moved({n: TRUTH[n] for n in names}, spread * rng.uniform(-1.0, 1.0, 6 * len(names)))
    D = information(names, seed)
    return DataTerm((str(seed),), poses, D, D @ (1e-3 * rng.normal(size=6 * len(names))))


def cost(term: DataTerm, poses: dict[str, gtsam.Pose3]) -> float:
    e = np.concatenate(
        [vehicle_axes_difference(poses[n], T) for n, T in term.T_vehicle_lidar.items()]
    )
    return float(0.5 * e @ term.information @ e - term.gradient @ e)


@pytest.mark.parametrize("degrees", [0.0, 1.0, 10.0])
def test_a_moved_quadratic_has_the_same_slope_and_curvature(degrees: float) -> None:
    """Against numerical derivatives of the cost at the new extrinsics."""
    old = term(1)
    rng = np.random.default_rng(2)
    d = np.asarray(np.radians(degrees) * rng.uniform(-1.0, 1.0, 12), np.float64)
    new = moved_to(old, moved(dict(old.T_vehicle_lidar), d))
    step = 1e-4

    def at(e: Array) -> float:
        return cost(old, moved(dict(new.T_vehicle_lidar), e))

    for axis in step * np.eye(12):
        slope = (at(axis) - at(-axis)) / (2.0 * step)
        assert slope == pytest.approx(-new.gradient @ axis / step, rel=1e-3, abs=30.0)
    if degrees == 0.0:
        assert new.information == pytest.approx(old.information, rel=1e-12)


@pytest.mark.parametrize("sigma_rad", [np.inf, 1.0])
def test_a_quadratic_slides_along_the_circle_that_its_data_leave_open(sigma_rad: float) -> None:
    """By 0.2 rad about the centre of the arc; what little it knows of the turn it keeps."""
    names = ("unseen", *NAMES)
    truth = {name: TRUTH[name] for name in NAMES} | {"unseen": TRUTH["left"]}
    turn = np.concatenate(list(turn_about_centre({n: TRUTH[n] for n in NAMES}).vector.values()))
    lever = np.array([0.0, 0.0, 1.0] + [0.0] * 9)
    D = arc_information(NAMES) + sigma_rad**-2.0 * np.outer(lever, lever)
    centre = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, -RADIUS_M, 0.0]))
    motion = centre.compose(gtsam.Pose3(gtsam.Rot3.Yaw(0.2), np.zeros(3))).compose(centre.inverse())
    axes = np.kron(np.eye(4), motion.rotation().matrix())
    all_D = np.zeros((18, 18))
    all_D[6:, 6:] = axes @ D @ axes.T
    poses = {n: motion.compose(truth[n]) if n in NAMES else truth[n] for n in names}
    guesses = {n: Guess(poses[n], FOUND_SIGMA.sigmas(), found=True) for n in names}

    found = slid(DataTerm(("a",), poses, all_D, np.zeros(18)), truth, guesses)

    assert list(found.T_vehicle_lidar) == list(names)
    for name, T in found.T_vehicle_lidar.items():
        assert T.equals(truth[name], 1e-5)
    assert found.information[6:, 6:] == pytest.approx(D, abs=1e-4 * D.max())
    assert not found.information[:6].any()
    # Its minimum is 0.2 rad back.
    assert found.gradient[6:] @ turn == pytest.approx(0.2 * sigma_rad**-2.0, rel=1e-3, abs=1e-6)
    # What the data determine does not slide.
    all_D[6:, 6:] = information(NAMES)
    rigid = DataTerm(("a",), poses, all_D, np.zeros(18))
    assert slid(rigid, truth, guesses) is rigid


def test_one_term_is_solved_where_its_data_are_best_met() -> None:
    alone = term(3, spread=0.01)
    guesses = {n: Guess(TRUTH[n], LOOSE) for n in NAMES}

    fused = fuse([alone], guesses)

    step = np.asarray(np.linalg.solve(alone.information, alone.gradient), np.float64)
    for n, T in moved(dict(alone.T_vehicle_lidar), step).items():
        assert fused.T_vehicle_lidar[n].equals(T, 1e-10)
    assert fused.gradient * np.sqrt(np.diag(fused.cov)) == pytest.approx(np.zeros(12), abs=1e-6)


def test_two_terms_give_the_minimum_of_both() -> None:
    """Against a general solver; the estimates are 3 degrees and 50 mm apart."""
    terms = [term(4, spread=0.03), term(5, spread=0.03)]
    guesses = {n: Guess(TRUTH[n], LOOSE) for n in NAMES}

    fused = fuse(terms, guesses)

    roots = [np.linalg.cholesky(t.information) for t in terms]

    def residuals(e: Array) -> Array:
        poses = moved({n: TRUTH[n] for n in NAMES}, e)
        return np.concatenate(
            [
                root.T
                @ np.concatenate(
                    [vehicle_axes_difference(poses[n], T) for n, T in t.T_vehicle_lidar.items()]
                )
                - np.linalg.solve(root, t.gradient)
                for t, root in zip(terms, roots, strict=True)
            ]
        )

    solved = least_squares(
        residuals, np.zeros(12), x_scale=1e-3, xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    for i, n in enumerate(NAMES):
        expected = retract_vehicle_axes(TRUTH[n], solved.x[6 * i : 6 * i + 6])
        assert vehicle_axes_difference(fused.T_vehicle_lidar[n], expected) == pytest.approx(
            np.zeros(6), abs=2e-6
        )


def test_a_joint_solve_takes_the_guess_for_a_measurement() -> None:
    alone = replace(term(6), gradient=np.zeros(12))
    sigmas = np.full(6, 2e-3)
    guesses = {n: Guess(alone.T_vehicle_lidar[n], sigmas) for n in NAMES}

    fused = fuse([alone], guesses, "joint")

    expected = np.linalg.inv(alone.information + np.eye(12) / sigmas[0] ** 2)
    assert fused.cov == pytest.approx(expected, rel=1e-3, abs=1e-12)


def test_lidars_that_are_not_asked_for_are_eliminated() -> None:
    names = ("front", "rear", "left")
    three = term(7, names=names)
    cov = np.linalg.inv(three.information)
    mean = cov @ three.gradient

    D, c = arranged(three, ["left", "front"])

    rows = [*range(12, 18), *range(6)]
    assert np.linalg.inv(D) == pytest.approx(cov[np.ix_(rows, rows)], rel=1e-6, abs=1e-15)
    assert np.linalg.solve(D, c) == pytest.approx(mean[rows], rel=1e-6)


def test_lidars_that_a_term_does_not_know_get_nothing() -> None:
    D, c = arranged(term(8), ["left", "rear", "front"])

    assert not D[:6].any()
    assert not c[:6].any()
    assert D[12:, 12:] == pytest.approx(term(8).information[:6, :6])


def test_a_file_without_gradient_is_where_its_data_are_best_met() -> None:
    D = arc_information(NAMES)
    error = shift(NAMES, "front", y=0.003)
    stated = drive(D, source="a", error=error, guess_error=np.full(12, 0.01))
    silent = replace(stated, gradient_data=None)

    own, fallback = own_term(stated, "a.yaml"), own_term(silent, "a.yaml")

    assert fallback.information == pytest.approx(own.information, abs=1e-3 * own.information.max())
    assert not fallback.gradient.any()
    with pytest.raises(
        ConfigError, match=r"a\.yaml: joint\.data_gradient is missing, and a result"
    ):
        own_term(replace(silent, provenance={"mode": "staged"}), "a.yaml")


def test_of_what_a_file_names_undetermined_its_data_say_nothing() -> None:
    silent = replace(
        drive(arc_information(NAMES) + 50.0 * np.eye(12), source="a"), gradient_data=None
    )
    (direction,) = silent.undetermined
    vector = np.concatenate([direction.vector[n] for n in NAMES])

    own = own_term(silent, "a.yaml")

    assert vector @ own.information @ vector == pytest.approx(0.0, abs=1e-6)


def motion(name: str = "drive", seed: int = 1, poses: bool = False) -> MotionData:
    rng = np.random.default_rng(seed)
    stamps = np.arange(3, dtype=np.int64)
    given = GivenPoses(
        stamps, (gtsam.Pose3(), gtsam.Pose3(), gtsam.Pose3.Expmap(rng.normal(size=6)))
    )
    imu = ImuSamples(stamps, rng.normal(size=(3, 3)), rng.normal(size=(3, 3)))
    return MotionData(name, poses=given) if poses else MotionData(name, imu=imu)


@pytest.mark.parametrize("poses", [True, False])
def test_the_digest_is_of_the_drive_not_of_its_name(poses: bool) -> None:
    assert drive_digest(motion("a", poses=poses)) == drive_digest(motion("b", poses=poses))
    assert drive_digest(motion(seed=1, poses=poses)) != drive_digest(motion(seed=2, poses=poses))


def test_the_digest_is_without_the_name_of_the_frame_as_earlier_ones() -> None:
    given = motion(poses=True)
    assert given.poses is not None
    framed = replace(given, poses=replace(given.poses, frame=PoseFrame("imu_link")))
    assert drive_digest(framed) == drive_digest(given)
    assert drive_digest(motion(poses=True)) != drive_digest(motion(poses=False))
