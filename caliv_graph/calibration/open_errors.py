"""Errors that are correlated over time, of a size that neither LiDARs nor motion data tell.

The size is integrated out (`trajectory/README.md`, section 9). Where nothing tells it, neither zero
nor the most likely value is a sigma to trust.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from caliv_graph.calibration.evidence import Evidence
from caliv_graph.calibration.variance_components import time_of_expected
from caliv_graph.products import Array
from caliv_graph.trajectory.correlated import AXES, GROUPS, CorrelatedError
from caliv_graph.trajectory.error_likelihood import ErrorLikelihood

NONE = 0.5
"""Prior probability that the errors of a sensor are white: neither is presumed."""

ALIKE = 0.5
"""Prior probability that those which are not are as large, over the white sigma, along all axes:
else horizontal and vertical ones have any sizes, none among them."""

LEAST = 0.01
"""Least expected size: a chain of errors needs one, and this does nothing."""

SIZES = np.geomspace(0.1, 2.0, 6)
"""Of a correlated error, over the white sigma of the sensor: equally probable. The sigma that a
driver states is meant for the whole error: one of twice as much shows itself, and a tenth does not
matter. Where less than the stated sigma is white, what is left may be correlated (`sizes_of`)."""

TIMES_S = np.geomspace(1.0, 100.0, 5)
"""Correlation times, equally probable: shorter ones are as good as white, longer ones constant over
a drive."""

SURELY_NONE = 0.95
"""Posterior probability from which the errors count as white: nothing is smoothed again."""


RATHER_NONE = 0.5
"""The same where motion data alone tell, without a target or structure. On a sound drive they leave
it at 0.6 to 0.8."""


LIMITED_SIGMAS = np.geomspace(1e-5, 30.0, 60)
LIMITED_TIMES_S = np.geomspace(2.0, 300.0, 8)
"""Sigmas (rad or m) and correlation times at which the motion data are asked for what they rule
out; between them it is smooth. All that `sensor_noise.SLOW` and `TIME` allow lies within."""

Limit = Callable[[float, float], tuple[float, float, float]]
"""Logarithms of a sigma and a time -> how much less likely the motion data have such an error than
the most likely smaller one, minus log-likelihood, and its slopes."""


@dataclass(frozen=True)
class OpenError:
    """A correlated error whose size and time are integrated out.

    Attributes:
        none: posterior probability that there is none.
        expected: the Gauss-Markov error of the expected variance, that probability included.
    """

    none: float
    expected: CorrelatedError


def sizes_of(evidence: Evidence, kind: str) -> Array:
    """`SIZES` of a sensor, up to twice what its driver states, in steps as large."""
    left = evidence.stated_over_white.get(kind, 1.0)
    step = SIZES[1] / SIZES[0]
    more = math.ceil(math.log(max(left, 1.0)) / math.log(step) - 1e-9)
    return np.append(SIZES, SIZES[-1] * step ** np.arange(1, more + 1))


def of_expected_size(
    evidence: Evidence, found: Sequence[CorrelatedError]
) -> tuple[CorrelatedError, ...]:
    """The errors of greatest likelihood with their expected sizes and times instead.

    The greatest likelihood of an error that barely shows is too small as often as too large, and
    sigmas would be wrong by as much. Those beyond `SIZES` stay. `evidence` as in `open_errors`.
    """
    out = list(found)
    for i, error in enumerate(found):
        white = evidence.sensor_sigmas.get(error.kind)
        if white is None:
            continue
        if (np.array(error.sigmas) <= sizes_of(evidence, error.kind)[-1] * white).all():
            others = [*out[:i], *out[i + 1 :]]
            out[i] = open_error(evidence, others, error.kind).expected
    return tuple(out)


def open_errors(
    evidence: Evidence,
    found: Sequence[CorrelatedError],
    kinds: Sequence[str],
    none_from: float = SURELY_NONE,
) -> tuple[CorrelatedError, ...]:
    """The errors of some sensors that may be there, of expected size; the most probable first.

    Args:
        evidence: of LiDARs and motion data; all white errors of what the LiDARs see are known.
        found: errors whose size is known.
        kinds: of the sensors that are left.
        none_from: posterior probability of none from which there is none.
    """
    out: list[CorrelatedError] = []
    left = [kind for kind in kinds if kind in evidence.sensor_sigmas]
    while left:
        posteriors = [open_error(evidence, [*found, *out], kind) for kind in left]
        first = min(posteriors, key=lambda of: of.none)
        if first.none > none_from:
            break
        out.append(first.expected)
        left.remove(first.expected.kind)
    return tuple(out)


def open_error(evidence: Evidence, found: Sequence[CorrelatedError], kind: str) -> OpenError:
    """The posterior of one sensor's error; other arguments as in `open_errors`."""
    sizes, groups = sizes_of(evidence, kind), _groups(evidence, kind)
    others = [_covariance(evidence, e.kind, np.array(e.sigmas), e.time_s) for e in found]
    at_one = np.zeros(len(others))
    of_none = evidence.observed.value(others, at_one)
    motion = [of.given(found) for of in evidence.motion]
    gain = np.zeros((len(groups), len(sizes), len(TIMES_S)))
    for g, group in enumerate(groups):
        for j, time_s in enumerate(TIMES_S.tolist()):
            moved = _covariance(evidence, kind, group, time_s)
            seen = [
                evidence.observed.value([*others, moved], np.append(at_one, math.log(size)))
                for size in sizes.tolist()
            ]
            unit = _error(kind, group, time_s)
            gain[g, :, j] = of_none - np.array(seen) + sum(of.gains(unit, sizes) for of in motion)
    return _summary(kind, groups, sizes, gain)


def limits_by_motion(evidence: Evidence, kind: str) -> list[Limit]:
    """What the motion data rule out of an error of a sensor, by group of axes.

    They may not ask for one: a wrong level of the accelerometer looks like a slow error. But over
    seconds an IMU knows how far fixes are off: what LiDARs and map have wrong passed for 84 mm of
    them over 4.5 s (random drive 268 of the second simulator, truly 17 mm over 88 s).
    """
    motion = [of for of in evidence.motion if kind in of.kinds]
    return [_limit(motion, kind, axes) for axes in GROUPS[kind]] if motion else []


def _limit(motion: Sequence[ErrorLikelihood], kind: str, axes: Sequence[int]) -> Limit:
    from scipy.interpolate import RectBivariateSpline  # not at start-up

    unit = _along(axes, np.ones(AXES))
    gain = np.array(
        [
            sum(of.gains(_error(kind, unit, time_s), LIMITED_SIGMAS) for of in motion)
            for time_s in LIMITED_TIMES_S.tolist()
        ]
    )
    lost = np.maximum.accumulate(gain, axis=1) - gain
    smooth = RectBivariateSpline(np.log(LIMITED_TIMES_S), np.log(LIMITED_SIGMAS), lost)

    def limit(log_sigma: float, log_time: float) -> tuple[float, float, float]:
        x, y = np.array([log_time]), np.array([log_sigma])
        value, by_sigma, by_time = (smooth.ev(x, y, *d)[0] for d in ((0, 0), (0, 1), (1, 0)))
        return float(value), float(by_sigma), float(by_time)

    return limit


def _groups(evidence: Evidence, kind: str) -> list[Array]:
    """White sigmas (3,) along the map's axes for each group of axes, zero along others."""
    white = evidence.sensor_sigmas[kind]
    return [_along(axes, white) for axes in GROUPS[kind]]


def _along(axes: Sequence[int], sigmas: Array) -> Array:
    """Sigmas (3,) along some axes, zero along others."""
    return np.where(np.isin(np.arange(AXES), axes), sigmas, 0.0)


def _summary(kind: str, groups: Sequence[Array], sizes: Array, gain: Array) -> OpenError:
    """From the gain of log-likelihood over no error, by group of axes, by size and by time.

    What is known of one group does not depend on the other (to 0.3, measured): gains add up. All
    groups have the same time.
    """
    every, n = np.append(0.0, sizes), len(groups)
    gain = np.concatenate([np.zeros((n, 1, len(TIMES_S))), gain], axis=1)
    # One axis for the size of each group, the last one for the time.
    chosen = np.indices((len(every),) * n)
    joint = sum(of[at] for of, at in zip(gain, chosen, strict=True))
    weight = _prior(len(every), n)[..., None] * np.exp(joint - joint.max())
    weight /= weight.sum()
    variance = np.array([(weight * every[at][..., None] ** 2).sum((*range(n),)) for at in chosen])
    variance = np.maximum(variance, LEAST**2 / len(TIMES_S))
    time_s = time_of_expected(variance, TIMES_S)
    sigmas = np.sqrt(variance.sum(axis=1)) @ np.array(groups)
    return OpenError(float(weight[(0,) * n].sum()), _error(kind, sigmas, time_s))


def _prior(sizes: int, groups: int) -> Array:
    """(sizes, ...) prior probability of sizes, of which the first is none, of each group."""
    prior = np.full((sizes,) * groups, (1.0 - NONE) * (1.0 - ALIKE) / (sizes**groups - 1))
    alike = np.arange(1, sizes)
    prior[(alike,) * groups] += (1.0 - NONE) * ALIKE / len(alike)
    prior[(0,) * groups] = NONE
    return np.asarray(prior)


def _error(kind: str, sigmas: Array, time_s: float) -> CorrelatedError:
    east, north, up = sigmas.tolist()
    return CorrelatedError(kind, (east, north, up), time_s)


def _covariance(evidence: Evidence, kind: str, sigmas: Array, time_s: float) -> Array:
    """(N, N) of what the LiDARs see, by an error with sigmas (3,) along the map's axes."""
    return np.asarray(
        sum(
            sigma**2 * evidence.slow(kind, (axis,), time_s)
            for axis, sigma in enumerate(sigmas.tolist())
            if sigma
        )
    )
