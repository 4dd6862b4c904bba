"""How large the errors of a LiDAR's ranges are that no average removes: for every part.

Data sheets state an accuracy of 10 to 50 mm at most over all ranges and materials, and a
repeatability of 3 to 10 mm. A size is unknown by a factor: it has a prior on a grid, is integrated
over where the data say something of it, and is the prior's root mean square where they do not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caliv_graph.config.noise import NoiseConfig
from caliv_graph.products import Array, IntArray

TYPICAL_OFFSET_M = 3e-3
"""Median of the prior of the offsets' sigma, of all ranges of a LiDAR: less than the repeatability
that data sheets state, as most of that is noise."""

LOG_SPREAD = math.log(2.5)
"""1 sigma of the logarithm of a size: the offsets of two units in three are between 1.2 and 7.5 mm,
and those of one in forty are beyond 18 mm, as those who state an accuracy of 30 mm allow for."""

OFFSETS_M = np.geomspace(1e-4, 3e-2, 15)
"""Sigmas of the offsets in the integral: from nothing to the largest accuracy of a data sheet."""

INCIDENCES_M = np.geomspace(1e-4, 1e-2, 9)
"""Sigmas of the growth with 1 / cos(incidence), likewise: from nothing to what makes as much as the
largest offset at 75 degrees."""

TYPICAL_INCIDENCE_M = 1.3e-3
"""Median of the prior of their sigma. Its root mean square is `INCIDENCE_M`."""

INCIDENCE_M = 3e-3
"""Sigma of the growth with 1 / cos(incidence) where it is not estimated. Data sheets do not state
it; at 75 degrees it makes 9 mm, which is the repeatability of one of them."""

GRAZING_COS = math.cos(math.radians(75.0))
"""Cosine of the incidence below which the growth is an error of its own: nobody knows how ranges
go on where footprints are metres long and echoes weak. On ground at 15 m all beams are there."""

SURFACE_M = 3e-3
"""Sigma of the bias of a LiDAR on one surface where nothing tells: echoes of bright and of dark
paint differ by millimetres in data sheets."""

GROUND_M = 3e-3
"""Sigma of one more bias on the ground, which is of one colour, likewise."""


BEAM_M = 1e-3
"""Sigma of the bias of the ranges of one channel beside the others, likewise."""

BEAM_RAD = 5e-5
"""Sigma of the error of elevation and azimuth of one channel, likewise."""

BEAM_SIZES = np.geomspace(0.1, 30.0, 15)
"""Sizes of the errors of the beams in the integral, in these: up to 3 cm and 1.5 mrad, unless less
is stated of the ranges."""

CHANNELS_APART_RAD = 0.01
"""Usual angle between two channels: in that distance an error of the beams is another."""


GROUND_FRAME = 4
"""Coordinates of the frame in which a LiDAR sees the ground: three turns and a height."""

LEAST_TILT_RAD, LEAST_HEIGHT_M = 1e-6, 1e-5
"""1 sigma of a tilt and of a height of the ground that are none: far below what any drive tells."""


@dataclass(frozen=True)
class RangeErrors:
    """What a config says of them, metres.

    Attributes:
        offset_m: 1 sigma of the bias of all ranges of a LiDAR; None: unknown.
        incidence_m: 1 sigma of its growth with 1 / cos(incidence).
        ground_m: 1 sigma of one more bias on the ground.
        surface_m: 1 sigma of one more bias on a surface, where nothing tells.
        beam_m: 1 sigma of one more bias of the beams at one elevation, where nothing tells.
        ground_tilt_rad: 1 sigma of the tilt in which a LiDAR sees all ground; not metres.
        ground_height_m: 1 sigma of the height in which it sees all ground.
    """

    offset_m: float | None = None
    incidence_m: float = INCIDENCE_M
    ground_m: float = GROUND_M
    surface_m: float = SURFACE_M
    beam_m: float = BEAM_M
    ground_tilt_rad: float = 0.0
    ground_height_m: float = 0.0

    @property
    def sees_ground_apart(self) -> bool:
        """Whether each LiDAR sees the ground in a frame of its own."""
        return self.ground_tilt_rad > 0.0 or self.ground_height_m > 0.0

    @property
    def ground_frame(self) -> Array:
        """(`GROUND_FRAME`,) 1 sigma of that frame: turns in lidar axes, rad; height, metres."""
        tilt_rad = max(self.ground_tilt_rad, LEAST_TILT_RAD)
        return np.array([*[tilt_rad] * 3, max(self.ground_height_m, LEAST_HEIGHT_M)])

    @property
    def beams(self) -> tuple[float, ...]:
        """Medians of the sizes of the errors of the beams at one elevation.

        Range (m), elevation and azimuth (rad), change of range (m/rad) and elevation with it.
        """
        change = (self.beam_m / CHANNELS_APART_RAD, BEAM_RAD / CHANNELS_APART_RAD)
        return self.beam_m, BEAM_RAD, BEAM_RAD, *change

    @property
    def beam_priors(self) -> tuple[SizePrior, ...]:
        """The priors of these sizes, about them as medians; of ranges at most what is stated."""
        most_m = math.inf if self.offset_m is None else self.offset_m
        most = (most_m, math.inf, math.inf, most_m / CHANNELS_APART_RAD, math.inf)
        priors = [log_normal(median * BEAM_SIZES, median) for median in self.beams]
        return tuple(
            SizePrior(np.minimum(prior.sigmas, limit), prior.cost)
            for prior, limit in zip(priors, most, strict=True)
        )

    @property
    def offsets(self) -> SizePrior:
        """The prior of the offsets' sigma."""
        return offset_prior(self.offset_m)


def range_errors(noise: NoiseConfig) -> RangeErrors:
    """The sizes that a config states; who knows all ranges knows those at a slant, too."""
    stated_m = noise.lidar_range_bias_m
    most_m = math.inf if stated_m is None else stated_m
    return RangeErrors(
        offset_m=stated_m,
        incidence_m=min(INCIDENCE_M, most_m),
        ground_m=min(GROUND_M, most_m),
        surface_m=min(SURFACE_M, most_m),
        beam_m=min(BEAM_M, most_m),
        ground_tilt_rad=math.radians(noise.lidar_ground_tilt_deg or 0.0),
        ground_height_m=noise.lidar_ground_height_m or 0.0,
    )


UNSTATED = RangeErrors()
"""Of a config that says nothing."""


def growth(cosine: Array) -> Array:
    """(N, 2) growth of ranges with 1 / cos(incidence) - 1, and what is more of it when grazing.

    By a metre of `RangeErrors.incidence_m`, each, at cosines (N,) above zero.
    """
    until = np.minimum(1.0 / cosine, 1.0 / GRAZING_COS)
    return np.column_stack([until - 1.0, 1.0 / cosine - until])


@dataclass(frozen=True)
class SizePrior:
    """The prior of the sigma of some errors on a grid.

    Attributes:
        sigmas: (n,).
        cost: (n,) minus the logarithm of their probability, up to a constant.
    """

    sigmas: Array
    cost: Array

    @property
    def usual(self) -> float:
        """The root mean square: 1 sigma of an error of which the data say nothing."""
        weights = np.exp(self.cost.min() - self.cost)
        return float(np.sqrt(weights @ self.sigmas**2 / weights.sum()))


def log_normal(sigmas: Array, typical: float) -> SizePrior:
    """The prior of sigmas (n,) about a median, by `LOG_SPREAD`."""
    return SizePrior(sigmas, 0.5 * (np.log(sigmas / typical) / LOG_SPREAD) ** 2)


def flat(sigmas: Array) -> SizePrior:
    """A prior for which sigmas (n,) are equally likely; one of them: it is known."""
    return SizePrior(sigmas, np.zeros(len(sigmas)))


def offset_prior(stated_m: float | None) -> SizePrior:
    """The prior of the offsets' sigma; what is stated is known."""
    if stated_m is not None:
        return flat(np.array([stated_m]))
    return log_normal(OFFSETS_M, TYPICAL_OFFSET_M)


def incidence_prior(stated_m: float | None) -> SizePrior:
    """The prior of the sigma of the growth; of those who state one of all ranges, at most that."""
    if stated_m is not None:
        return flat(np.minimum(INCIDENCES_M, stated_m))
    return log_normal(INCIDENCES_M, TYPICAL_INCIDENCE_M)


def size_weights(
    information: Array, pull: Array, kinds: IntArray, priors: Sequence[SizePrior]
) -> Array:
    """Posterior of the sizes of some errors, as weights on the product of their grids.

    By the restricted likelihood: everything else is integrated out, so that errors that other
    variables can make up for say nothing.

    Args:
        information: (B, B) of the errors, everything else eliminated, without their own priors.
            It need not be symmetric to the last digit, nor positive for the kind with the most.
        pull: (B,) minus the gradient of the negative logarithm of the likelihood, at no errors.
        kinds: (B,) index of the prior that each error's size has.
        priors: of the sizes.
    """
    information = 0.5 * (information + information.T)
    # The kind with the most errors is integrated out on its own axes, at each of its sizes. What
    # is left is small.
    most = int(np.argmax(np.bincount(kinds, minlength=len(priors))))
    rest = [k for k in range(len(priors)) if k != most]
    grids = np.meshgrid(*(priors[k].sigmas for k in rest), indexing="ij")
    few, many = np.flatnonzero(kinds != most), np.flatnonzero(kinds == most)
    sizes = np.stack(grids, axis=-1)[..., np.searchsorted(rest, kinds[few])] if rest else np.ones(0)
    values, axes = np.linalg.eigh(information[np.ix_(many, many)])
    values = np.maximum(values, 0.0)
    common, pulled = axes.T @ information[np.ix_(many, few)], axes.T @ pull[many]
    variances = priors[most].sigmas[:, None] ** 2
    known = 1.0 + variances * values
    alone = 0.5 * (np.log(known) - variances / known * pulled**2).sum(axis=1)
    costs = []
    for own, lost in zip(alone, variances / known, strict=True):
        left = information[np.ix_(few, few)] - common.T @ (lost[:, None] * common)
        costs.append(own + _costs_of(left, pull[few] - common.T @ (lost * pulled), sizes))
    cost = np.moveaxis(np.array(costs), 0, most)
    for k, prior in enumerate(priors):
        cost += prior.cost.reshape([-1 if axis == k else 1 for axis in range(len(priors))])
    weights = np.exp(cost.min() - cost)
    return np.asarray(weights / weights.sum())


def _costs_of(information: Array, pull: Array, sigmas: Array) -> Array:
    """(...) minus the logarithms of the restricted likelihood, of errors with sigmas (..., B)."""
    if not len(pull):
        return np.zeros(sigmas.shape[:-1])
    own = np.eye(len(pull)) + sigmas[..., :, None] * information * sigmas[..., None, :]
    L, pulls = np.linalg.cholesky(own), sigmas * pull
    moved = np.linalg.solve(own, pulls[..., None])[..., 0]
    size = np.log(np.diagonal(L, axis1=-2, axis2=-1)).sum(axis=-1)
    return np.asarray(size - 0.5 * (pulls * moved).sum(axis=-1))
