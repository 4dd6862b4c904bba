from __future__ import annotations

import gtsam
import numpy as np
import pytest

from caliv_graph.geometry.covariance import (
    about_one_jacobian,
    parent_axes_covariance,
    relative_covariance,
    relative_jacobian,
)
from caliv_graph.products import Array
from tests.samples import MOUNTINGS, make_covariance, pose

FRONT = pose(*MOUNTINGS["front"])
LEFT = pose(*MOUNTINGS["left"])


def relative_error(T_a: gtsam.Pose3, T_b: gtsam.Pose3, d: Array) -> Array:
    """Right perturbation of T_b_a that the right perturbations d of T_a and T_b cause."""
    moved = T_b.compose(gtsam.Pose3.Expmap(d[6:])).between(T_a.compose(gtsam.Pose3.Expmap(d[:6])))
    return np.asarray(gtsam.Pose3.Logmap(T_b.between(T_a).between(moved)))


def test_the_jacobian_is_the_numerical_derivative() -> None:
    step = 1e-6
    numerical = np.array(
        [
            (relative_error(FRONT, LEFT, d) - relative_error(FRONT, LEFT, -d)) / (2 * step)
            for d in step * np.eye(12)
        ]
    ).T

    assert relative_jacobian(FRONT, LEFT) == pytest.approx(numerical, abs=1e-8)


def test_the_covariance_is_that_of_samples() -> None:
    cov_joint = make_covariance(2)
    rng = np.random.default_rng(3)
    samples = rng.multivariate_normal(np.zeros(12), cov_joint, size=20_000)

    errors = np.array([relative_error(FRONT, LEFT, d) for d in samples])

    cov = relative_covariance(FRONT, LEFT, cov_joint)
    sigma = np.sqrt(np.diag(cov))
    # 20000 samples know a correlation to 1 / sqrt(20000) = 0.7 percent.
    difference = (errors.T @ errors / len(errors) - cov) / np.outer(sigma, sigma)
    assert np.abs(difference).max() < 0.03


def test_about_one_lidar_only_the_places_of_the_others_to_it_are_uncertain() -> None:
    T = [FRONT, LEFT, pose(*MOUNTINGS["rear"])]
    cov_joint = make_covariance(3)

    J = about_one_jacobian(T, 1)
    cov = J @ cov_joint @ J.T

    assert cov[6:12] == pytest.approx(np.zeros((6, 18)), abs=1e-12)
    for i in (0, 2):
        own, held = 6 * i + np.arange(6), 6 + np.arange(6)
        both = np.concatenate([own, held])
        pair = relative_covariance(T[i], T[1], cov_joint[np.ix_(both, both)])
        assert cov[np.ix_(own, own)] == pytest.approx(pair, abs=1e-12)
    # What all share is no uncertainty at all.
    together = np.vstack([t.inverse().AdjointMap() for t in T])
    assert J @ together == pytest.approx(np.zeros((18, 6)), abs=1e-12)


def test_what_both_lidars_share_is_no_uncertainty_of_the_pair() -> None:
    # One rigid motion of the vehicle frame, seen from each LiDAR: Ad(T^-1) turns it into a right
    # perturbation of T.
    J = np.vstack([T.inverse().AdjointMap() for T in (FRONT, LEFT)])

    cov = relative_covariance(FRONT, LEFT, J @ np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) @ J.T)

    assert cov == pytest.approx(np.zeros((6, 6)), abs=1e-12)


def test_parent_axes_of_a_lidar_turned_left() -> None:
    # Its x is the vehicle's y, and its y the vehicle's -x.
    turned = pose((0.5, 0.9, 1.5), (0.0, 0.0, 90.0))

    cov = parent_axes_covariance(turned, np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))

    assert cov == pytest.approx(np.diag([2.0, 1.0, 3.0, 5.0, 4.0, 6.0]), abs=1e-12)
