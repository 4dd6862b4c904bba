"""How the vehicle stands on the ground: numbers by hand, and the same knowledge as in a term."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse

from caliv_graph.geometry.se3 import tangent_axes
from caliv_graph.products import Array
from caliv_graph.structure.elimination import eliminated
from caliv_graph.structure.stance import MeanTilt, stance_of, standing_errors
from caliv_graph.structure.standing import UNEVEN_RAD, Standing, Stands, tilt_rows
from caliv_graph.trajectory.imu import exp_so3

SIGMA_M = 0.02
STANDING = Standing(0.5, SIGMA_M, None, 0.005, 1e-3)
N = 4


def quadratic(sigma_m: float) -> tuple[Array, Array]:
    """Of N coordinates, the error of the height under its prior, and two of an unknown tilt."""
    rng = np.random.default_rng(1)
    rows = rng.standard_normal((12, N + 1))
    H, b = np.eye(N + 3), np.zeros(N + 3)
    H[: N + 1, : N + 1] = rows.T @ rows
    b[: N + 1] = rows.T @ rng.standard_normal(12)
    H[N, N] += sigma_m**-2.0
    return H, b


def without_height(sigma_m: float) -> tuple[Array, Array]:
    """The same, the error of the height eliminated."""
    H, b = quadratic(sigma_m)
    cross = H[:N, N]
    return H[:N, :N] - np.outer(cross, cross) / H[N, N], b[:N] - cross * b[N] / H[N, N]


def test_a_height_of_another_sigma_follows_from_the_stance() -> None:
    tilt = MeanTilt(np.zeros(2), np.zeros((2, N + 3)), np.eye(2))
    stance = stance_of(STANDING, 0.0, *quadratic(SIGMA_M), tilt)
    assert stance is not None
    row, var = stance.rows[0], stance.cov[0, 0]
    H, b = without_height(SIGMA_M)
    for sigma_m in (0.005, 0.5):
        weight = 1.0 / (var + sigma_m**2) - 1.0 / (var + SIGMA_M**2)
        expected, gradient = without_height(sigma_m)
        assert H + weight * np.outer(row, row) == pytest.approx(expected)
        assert b - weight * row * stance.value[0] == pytest.approx(gradient)


def test_a_tilt_that_follows_the_height_moves_with_it() -> None:
    rows = np.zeros((2, N + 3))
    rows[0, N] = 3.0
    tilt = MeanTilt(np.array([0.1, 0.2]), rows, 1e-4 * np.eye(2))
    stance = stance_of(STANDING, 0.0, *quadratic(SIGMA_M), tilt)
    assert stance is not None
    assert stance.value[1:] == pytest.approx([0.1 + 3.0 * stance.value[0], 0.2])
    assert stance.rows[1] == pytest.approx(3.0 * stance.rows[0])
    assert stance.cov[0, 1] == pytest.approx(3.0 * stance.cov[0, 0])
    assert stance.cov[1, 1] == pytest.approx(9.0 * stance.cov[0, 0] + 1e-4)


def test_what_is_stated_is_in_the_term_and_what_is_unknown_is_not_told() -> None:
    H, b = quadratic(SIGMA_M)
    tilt = MeanTilt(np.zeros(2), np.zeros((2, N + 3)), np.eye(2))
    stated = replace(STANDING, tilt_sigma_rad=1e-3)
    height_alone = stance_of(stated, 0.0, H, b, tilt)
    assert height_alone is not None
    assert (height_alone.value.shape, height_alone.tilt_in_term) == ((1,), True)
    unknown = replace(STANDING, height_m=None)
    tilt_alone = stance_of(unknown, 0.0, H, b, tilt)
    assert tilt_alone is not None
    assert (tilt_alone.value.shape, tilt_alone.height_sigma_m) == ((2,), None)
    assert stance_of(replace(stated, height_m=None), 0.0, H, b, tilt) is None
    assert stance_of(STANDING, 0.0, H, b, None) is None


@pytest.mark.parametrize("tilt_sigma_rad", [2e-3, None])
@pytest.mark.parametrize("height_m", [0.5, None])
def test_errors_of_the_stand_can_be_taken_back_into_a_term(
    height_m: float | None, tilt_sigma_rad: float | None
) -> None:
    """Kept as variables with their priors, they say the same as eliminated."""
    standing = replace(STANDING, height_m=height_m, tilt_sigma_rad=tilt_sigma_rad)
    stated = [height_m is not None, *[tilt_sigma_rad is not None] * 2]
    rng = np.random.default_rng(4)
    rows, right = rng.standard_normal((20, N + 3)), rng.standard_normal(20)
    now = np.array([0.01, 2e-3, -1e-3])
    priors = np.array([SIGMA_M, *[tilt_sigma_rad or 1.0] * 2]) ** -2.0
    H, b = rows.T @ rows, rows.T @ right
    H[np.ix_(range(N, N + 3), range(N, N + 3))] += np.diag(priors)
    b[N:] -= priors * now

    errors = standing_errors(standing, now, H, b)

    if not any(stated):
        assert errors is None
        return
    assert errors is not None
    assert (errors.height, errors.tilt) == (stated[0], stated[1])
    assert errors.value == pytest.approx(now[stated])
    cross = np.linalg.solve(H[N:, N:], H[N:, :N])
    term, gradient = H[:N, :N] - H[:N, N:] @ cross, b[:N] - cross.T @ b[N:]
    both, pull = errors.kept_in(term, gradient)
    # By the rows alone, what is not stated under its wide prior.
    kept = np.concatenate([np.full(N, True), stated])
    H_rows, b_rows = rows.T @ rows, rows.T @ right
    own = np.diag(np.concatenate([np.zeros(N), np.where(stated, 0.0, priors)]))
    b_rows[N:] -= np.where(stated, 0.0, priors * now)
    inverse = np.linalg.inv(H_rows + own)
    assert np.linalg.inv(both) == pytest.approx(inverse[np.ix_(kept, kept)])
    assert np.linalg.solve(both, pull) == pytest.approx((inverse @ b_rows)[kept])


def test_mean_tilt_and_its_derivatives() -> None:
    rng = np.random.default_rng(2)
    R = exp_so3(0.1 * rng.standard_normal((3, 3)))
    normals = np.array([[0.02, -0.01, 1.0], [0.0, 0.03, 1.0]])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    stands = Stands(np.array([0, 1, 2]), np.array([0, 1, 1]))
    size, plane = 18 + 6, 18

    def mean(d: Array) -> Array:
        turned = R @ exp_so3(d[:18].reshape(3, 6)[:, :3])
        turn = np.einsum("kj,kji->ki", d[18:].reshape(2, 3)[:, :2], tangent_axes(normals))
        tilted = np.einsum("kij,kj->ki", exp_so3(np.cross(normals, turn)), normals)
        return tilt_rows(STANDING, stands, turned, tilted, plane, size)[0]

    value, rows, sigma = tilt_rows(STANDING, stands, R, normals, plane, size)
    by_hand = [(R[i].T @ normals[k])[:2] for i, k in ((0, 0), (1, 1), (2, 1))]
    assert value == pytest.approx(np.mean(by_hand, axis=0))
    step = 1e-6
    numerical = [(mean(step * e) - mean(-step * e)) / (2.0 * step) for e in np.eye(size)]
    assert rows == pytest.approx(np.transpose(numerical), abs=1e-6)
    assert sigma == pytest.approx(np.hypot(UNEVEN_RAD / np.sqrt(2.0), 1e-3 / np.sqrt(3.0)))


def test_rows_follow_the_surfaces_that_are_eliminated() -> None:
    rng = np.random.default_rng(3)
    J = rng.standard_normal((20, 7))
    J[:10, 3:5], J[10:, 5:] = 0.0, 0.0  # two surfaces that are not coupled
    H, nothing = J.T @ J, scipy.sparse.csr_array((1, 7))
    blocks = [np.array([3, 4]), np.array([5, 6])]
    others = scipy.sparse.csr_array(H[3:])
    b = rng.standard_normal(7)
    surfaces = eliminated(H[:3, :3].copy(), others, nothing, b, blocks)[2]
    rows = rng.standard_normal((3, 7))
    rows[2, 3:5] = 0.0
    reduced, cov, at_zero = surfaces.reduced(scipy.sparse.csr_array(rows))
    inverse = np.linalg.inv(H[3:, 3:])
    assert reduced == pytest.approx(rows[:, :3] - rows[:, 3:] @ inverse @ H[3:, :3])
    assert cov == pytest.approx(rows[:, 3:] @ inverse @ rows[:, 3:].T)
    assert at_zero == pytest.approx(rows[:, 3:] @ inverse @ b[3:])
