"""Correlated errors whose size neither LiDARs nor motion data tell."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.calibration.evidence import Evidence
from caliv_graph.calibration.open_errors import (
    ALIKE,
    NONE,
    SIZES,
    TIMES_S,
    of_expected_size,
    open_error,
    open_errors,
    sizes_of,
)
from caliv_graph.calibration.variance_components import Observed
from caliv_graph.products import Array
from caliv_graph.trajectory.correlated import AXES, CorrelatedError
from caliv_graph.trajectory.error_likelihood import ErrorLikelihood

STEPS = 30
"""A drive of 15 s."""

STAMPS = np.arange(STEPS) * 500_000_000
WHITE = np.full(AXES, 0.02)
"""1 sigma of a fix, metres."""

FIXES = 5
"""Fixes in a step."""


def smooth_part() -> Array:
    """(STEPS, 4): what the vehicle's own motion takes up of the fixes."""
    t = np.linspace(-1.0, 1.0, STEPS)
    return np.vander(t, 4)


def evidence(fixes: Array) -> Evidence:
    """Of means (3, STEPS) of fixes along the axes; the LiDARs see nothing.

    The vehicle's own motion is a cubic with unknown coefficients.
    """
    own = smooth_part()
    kept = np.eye(STEPS) - own @ np.linalg.pinv(own)
    weight = FIXES / WHITE[0] ** 2
    gradient = (weight * fixes @ kept).ravel()
    motion = ErrorLikelihood(("gnss",), STAMPS, np.kron(np.eye(AXES), weight * kept), gradient)
    nothing = Observed(np.zeros(1), np.ones((1, 1)), np.ones(1), np.eye(1))
    return Evidence(nothing, np.zeros((1, 6)), {}, [], [motion], {"gnss": WHITE})


def correlated(time_s: float) -> Array:
    seconds = STAMPS * 1e-9
    return np.exp(-np.abs(seconds[:, None] - seconds) / time_s)


def drawn(rng: np.random.Generator) -> tuple[Array, float, bool]:
    """Means (3, STEPS) of fixes with errors from the prior; horizontal size; whether all white."""
    half = np.linalg.cholesky(correlated(float(rng.choice(TIMES_S))))
    horizontal = vertical = 0.0
    if rng.random() >= NONE:
        horizontal = vertical = rng.choice(SIZES)
        if rng.random() >= ALIKE:
            every = np.append(0.0, SIZES)
            pairs = [(h, v) for h in every for v in every if h or v]
            horizontal, vertical = pairs[rng.integers(len(pairs))]
    size = np.array([[horizontal], [horizontal], [vertical]])
    slow = size * WHITE[0] * rng.standard_normal((AXES, STEPS)) @ half.T
    fixes = slow + WHITE[0] / math.sqrt(FIXES) * rng.standard_normal((AXES, STEPS))
    return fixes, float(horizontal), not (horizontal or vertical)


def slope_error(fixes: Array, errors: tuple[CorrelatedError, ...]) -> tuple[float, float]:
    """Squared error of the vehicle's heading by fixes across the track, and its variance."""
    own = smooth_part()
    cov = WHITE[0] ** 2 / FIXES * np.eye(STEPS)
    for error in errors:
        cov = cov + error.sigmas[0] ** 2 * correlated(error.time_s)
    weighted = np.linalg.solve(cov, own)
    inverse = np.linalg.inv(own.T @ weighted)
    return float((inverse @ weighted.T @ fixes[0])[2] ** 2), float(inverse[2, 2])


def test_sigmas_are_those_of_the_errors_over_many_drives() -> None:
    """Size, probability and the heading that follows, against the truth of 120 short drives."""
    rng = np.random.default_rng(5)
    none, sizes, truth, white_ones, with_error, without = [], [], [], [], [], []
    for _ in range(120):
        fixes, size, all_white = drawn(rng)
        found = open_error(evidence(fixes), [], "gnss")
        none.append(found.none)
        sizes.append(found.expected.sigmas[0] / WHITE[0])
        truth.append(size)
        white_ones.append(all_white)
        squared, variance = slope_error(fixes, (found.expected,))
        with_error.append(squared / variance)
        squared, variance = slope_error(fixes, ())
        without.append(squared / variance)

    white = np.array(white_ones)
    assert np.mean(none) == pytest.approx(white.mean(), abs=0.06)
    assert np.mean(np.square(sizes)) == pytest.approx(np.mean(np.square(truth)), rel=0.25)
    assert np.mean(np.array(none)[white]) > np.mean(np.array(none)[~white]) + 0.15
    # Where the size is taken to be zero, errors are many times their variance.
    assert np.mean(without) > 2.5
    assert 0.6 < np.mean(with_error) < 1.4


def test_what_the_data_rule_out_is_small() -> None:
    """Fixes as white as they are stated; only errors that change in minutes may be there."""
    white = WHITE[0] / math.sqrt(FIXES) * np.random.default_rng(1).standard_normal((AXES, STEPS))

    assert open_error(evidence(white), [], "gnss").expected.sigmas[0] < 0.4 * WHITE[0]
    assert open_errors(evidence(white), [], ["orientation"]) == ()


def test_an_error_that_is_plain_has_its_size_and_a_known_one_counts_once() -> None:
    rng = np.random.default_rng(2)
    slow = (
        1.5 * WHITE[0] * rng.standard_normal((AXES, STEPS)) @ np.linalg.cholesky(correlated(4.0)).T
    )
    fixes = slow + WHITE[0] / math.sqrt(FIXES) * rng.standard_normal((AXES, STEPS))

    (error,) = open_errors(evidence(fixes), [], ["gnss"])

    assert error.sigmas[0] == pytest.approx(1.5 * WHITE[0], rel=0.4)
    again = open_error(evidence(fixes), [error], "gnss")
    assert again.none > 0.5


def test_the_most_likely_size_makes_room_for_the_expected_one() -> None:
    rng = np.random.default_rng(4)
    seen = evidence(drawn(rng)[0])
    barely = CorrelatedError("gnss", (1e-3, 1e-3, 2e-3), 3.0)
    plain = CorrelatedError("gnss", (3.0 * WHITE[0], 1e-3, 1e-3), 3.0)
    other = CorrelatedError("orientation", (1e-3, 1e-3, 1e-3), 3.0)

    assert of_expected_size(seen, [barely, other]) == (
        open_error(seen, [other], "gnss").expected,
        other,
    )
    assert of_expected_size(seen, [plain]) == (plain,)


def test_time_and_variance_are_those_of_the_expected_error() -> None:
    """Short lags: as the hypotheses together; any lag: it changes by no less than they do."""
    found = open_error(evidence(np.zeros((AXES, STEPS))), [], "gnss").expected

    assert TIMES_S[0] < found.time_s < TIMES_S[-1]
    assert 0.0 < found.sigmas[0] < WHITE[0]


def test_where_little_of_what_is_stated_is_white_the_rest_may_be_correlated() -> None:
    """A receiver states 14 mm for its whole error: 4 of it are white, 12 correlated."""
    rng = np.random.default_rng(5)
    half = np.linalg.cholesky(correlated(10.0))
    slow = 3.0 * WHITE[0] * rng.standard_normal((AXES, STEPS)) @ half.T
    fixes = slow + WHITE[0] / math.sqrt(FIXES) * rng.standard_normal((AXES, STEPS))
    silent = evidence(fixes)
    stating = replace(silent, stated_over_white={"gnss": 3.6})

    usual, wide = sizes_of(silent, "gnss"), sizes_of(stating, "gnss")
    np.testing.assert_array_equal(usual, SIZES)
    np.testing.assert_array_equal(wide[: len(SIZES)], SIZES)
    assert 2.0 * 3.6 <= wide[-1] < 2.0 * 3.6 * SIZES[1] / SIZES[0]
    assert wide[1:] / wide[:-1] == pytest.approx(SIZES[1] / SIZES[0])
    # Less than is stated is never left: the steps stay.
    np.testing.assert_array_equal(
        sizes_of(replace(silent, stated_over_white={"gnss": 0.5}), "gnss"), SIZES
    )

    clipped = open_error(silent, [], "gnss").expected.sigmas[0]
    found = open_error(stating, [], "gnss").expected.sigmas[0]
    assert clipped <= 2.0 * WHITE[0] * (1.0 + 1e-9)
    assert 2.2 * WHITE[0] < found < 5.0 * WHITE[0]
