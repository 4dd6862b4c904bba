"""A drive on fewer poses: the same Gaussian."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.products import IntArray
from caliv_graph.structure.prior import PosePrior
from caliv_graph.structure.problem import Problem, first_state
from caliv_graph.structure.solve import solve_structure
from caliv_graph.structure.term import term_of
from caliv_graph.structure.thinning import on_all_poses, with_scans
from tests.structure.test_solve import problem_of
from tests.structure.yards import TRUE, figure_eight, yard


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of(yard(), figure_eight(12), 1)


def with_more_poses(problem: Problem) -> tuple[Problem, IntArray]:
    """The same drive with a pose 0.1 s after each; also which coordinates its own poses have."""
    prior, m = problem.prior, len(problem.prior.stamps_ns)
    rng = np.random.default_rng(3)
    own = (12 * np.arange(m)[:, None] + np.arange(6)).ravel()
    H = np.zeros((12 * m, 12 * m))
    H[np.ix_(own, own)] = prior.information
    for i in range(m):
        J = np.hstack([rng.standard_normal((6, 6)), np.eye(6)]) * 1e3
        both = slice(12 * i, 12 * i + 12)
        H[both, both] += J.T @ J
    T = [P for T in prior.T_map_vehicle for P in (T, T.retract(np.full(6, 0.01)))]
    stamps = np.array([t for s in prior.stamps_ns for t in (s, s + 100_000_000)])
    more = PosePrior(stamps, tuple(T), {}, H, np.zeros(12 * m), np.zeros((0, 0)), np.zeros(0))
    more.gradient[own] = prior.gradient
    twists = problem.twists
    assert twists is not None
    wide = replace(
        problem,
        prior=more,
        pose_of_scan=2 * problem.pose_of_scan,
        twists=np.repeat(twists, 2, axis=0),
    )
    return wide, own


def test_poses_without_scans_leave_the_prior_of_the_others(problem: Problem) -> None:
    wide, own = with_more_poses(problem)
    back, poses = with_scans(wide, np.ones(len(wide.pose_of_scan), dtype=bool))
    assert poses.tolist() == list(range(0, 24, 2))
    cov = np.linalg.inv(wide.prior.information)
    known = np.linalg.inv(back.prior.information)
    scale = np.sqrt(np.diag(known))
    assert known / np.outer(scale, scale) == pytest.approx(
        cov[np.ix_(own, own)] / np.outer(scale, scale), abs=1e-6
    )
    assert (back.pose_of_scan == problem.pose_of_scan).all()


def test_poses_without_scans_follow_the_others(problem: Problem) -> None:
    wide, own = with_more_poses(problem)
    back, poses = with_scans(wide, np.ones(len(wide.pose_of_scan), dtype=bool))
    d = 1e-3 * np.random.default_rng(4).standard_normal(len(own))
    state = first_state(back, TRUE)
    moved = [back.prior.chart.pose(v) for v in d.reshape(-1, 6)]
    T = [P.compose(by) for P, by in zip(back.prior.T_map_vehicle, moved, strict=True)]
    state = replace(
        state,
        moved=d,
        R_map_vehicle=np.array([P.rotation().matrix() for P in T]),
        t_map_vehicle=np.array([P.translation() for P in T]),
    )
    every = on_all_poses(wide.prior, poses, state)
    pull = wide.prior.gradient - wide.prior.information @ every.moved
    rest = np.setdiff1d(np.arange(len(pull)), own)
    assert pull[rest] == pytest.approx(0.0, abs=1e-5)
    assert every.moved[own] == pytest.approx(d)
    assert every.t_map_vehicle[::2] == pytest.approx(state.t_map_vehicle)
    other = wide.prior.T_map_vehicle[1].compose(wide.prior.chart.pose(every.moved[6:12]))
    assert gtsam.Pose3.Logmap(
        other.between(gtsam.Pose3(gtsam.Rot3(every.R_map_vehicle[1]), every.t_map_vehicle[1]))
    ) == pytest.approx(np.zeros(6), abs=1e-12)


def test_the_term_does_not_depend_on_poses_without_scans(problem: Problem) -> None:
    """Kept on the poses of the scans, it is the same."""
    wide, _ = with_more_poses(problem)
    start = dict(zip(TRUE, problem.guesses, strict=True))
    terms = []
    for drive, kept in ((problem, np.arange(12)), (wide, np.arange(0, 24, 2))):
        found = solve_structure(drive, start)
        assert found is not None
        terms.append(term_of(found, kept))
    scale = np.sqrt(np.diag(terms[0].information))
    assert terms[1].gradient / scale == pytest.approx(terms[0].gradient / scale, abs=1e-3)
    assert terms[1].information / np.outer(scale, scale) == pytest.approx(
        terms[0].information / np.outer(scale, scale), abs=1e-4
    )
