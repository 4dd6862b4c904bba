"""Waves of the ground and heave, as far as planes and stands scatter at a solution."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace

import gtsam
import numpy as np
from scipy.special import chdtrc

from caliv_graph.calibration.evidence import SEEN
from caliv_graph.calibration.ground import (
    TOGETHER_NS,
    GroundWeights,
    ground_centres,
    plane_factor_of,
    standing_shares,
    taken_poses,
)
from caliv_graph.calibration.ground_factors import height_over
from caliv_graph.calibration.problem import Problem
from caliv_graph.calibration.solve import SolveState
from caliv_graph.config.model import Config
from caliv_graph.conventions import key_ground, key_height, key_vehicle
from caliv_graph.products import Array, GroundObservation

FEWEST_PLANES = 8
"""Planes, and residuals beyond what is fitted, at least: a variance to a half."""

LARGEST_RATIO, CHANCE = 1.5, 1e-3
"""Mean square of residuals in their variance from which they do, unless by chance."""

ROUNDS = 40
"""Halvings of the interval in which the variance is looked for."""


FURTHER_SOLVES = 2
"""Solves at most after the first one: levels of the ground that are off by ten times are right
after one, mostly."""


@dataclass(frozen=True)
class GroundLevels:
    """1 sigma of what moves ground planes and stands from scan to scan.

    Attributes:
        normal_rad: tilt of a plane by waves of the ground.
        distance_m: its distance, likewise.
        heave_m: heave of the body.
    """

    normal_rad: float
    distance_m: float
    heave_m: float

    @classmethod
    def of(cls, problem: Problem) -> GroundLevels:
        """Those that a problem has."""
        normal_rad, _, distance_m = problem.floors.tolist()
        return cls(normal_rad, distance_m, problem.heave_m)

    @property
    def text(self) -> str:
        """In units of the reader."""
        waves = f"{1e3 * self.normal_rad:.3g} mrad and {1e3 * self.distance_m:.3g} mm of waves"
        return f"{waves}, {1e3 * self.heave_m:.3g} mm of heave"

    @property
    def beyond_ground(self) -> tuple[str, ...]:
        """A warning: a level is at its limit, which no ground reaches; none if none is."""
        if not any(map(operator.eq, astuple(self), astuple(MOST))):
            return ()
        return (
            "planes of the ground and heights of the vehicle above it scatter too much for "
            f"ground, as by {self.text}; at most {MOST.text} are taken for ground. Roll, pitch and "
            "z have little of it. Look for ground that is none (a ramp, a kerb, a load in view, "
            "vegetation), and for a vehicle height (ground.vehicle_height) that is wrong",
        )


MOST = GroundLevels(normal_rad=0.05, distance_m=0.2, heave_m=0.2)
"""Larger levels are no ground and no springs, but a mistake."""


def scattering_more(levels: GroundLevels, asked: GroundLevels) -> str:
    """Why a result asks for another solve, `asked` being larger than its levels."""
    return (
        "planes of the ground and heights of the vehicle above it scatter more than their "
        f"noise levels ({levels.text}), as by {asked.text}"
    )


def unsettled_sentence(why: str) -> str:
    """Of a result that asks for one more solve after `FURTHER_SOLVES`."""
    return (
        f"the result has not settled: solved again {FURTHER_SOLVES} times with what it asked for, "
        f"{why}. It may be off by more than its sigmas: look for ground that is none (a ramp, a "
        "kerb, a load in view), and for a LiDAR or a vehicle height (ground.vehicle_height) that "
        "is far from its guess"
    )


def failed_sentence(what: str) -> str:
    """Of a result that asks for another solve, which fails; `what` is its error."""
    return (
        "the result asks for another solve, about it and with its noise levels, which "
        f"failed: {what.rstrip('.')}. The result is that of the solve before, which "
        "may be off by more than its sigmas: better initial guesses "
        "(lidars.<name>.initial) and more scans lead to one that needs no other"
    )


def asked_levels(state: SolveState) -> GroundLevels:
    """`larger_levels` of a solved graph; those that it has, where it has no ground."""
    if state.ground_weights is None:
        return GroundLevels.of(state.problem)
    return larger_levels(
        state.problem, state.grounds, state.ground_weights, state.values, state.config
    )


def larger_levels(
    problem: Problem,
    observations: Sequence[GroundObservation],
    weights: GroundWeights,
    values: gtsam.Values,
    config: Config,
) -> GroundLevels:
    """The levels that a solution asks for: those of the problem, or larger ones, at most `MOST`.

    Before it, few planes tell: of seven, known to 2 mrad with the tilt that all share, waves of 0.1
    mrad were as likely as of 0.4, and S2S roll was off by ten sigmas. Those beside the target
    alone had heave and distance of 0.4 mm, where the ground of the drive has waves of 14 mm. Here
    all LiDARs agree on one ground, all along the drive. What scatters more than its sigmas say does
    so by waves; stands, which the waves lift as they do planes, by heave for the rest. `values` is
    the solution, `weights` are the robust ones in use. What the config states is held.
    """
    out, noise = GroundLevels.of(problem), config.noise
    tilts, distances = _of_planes(problem, observations, weights, values)
    if noise.ground_normal_deg is None:
        out = replace(out, normal_rad=tilts.larger(out.normal_rad, MOST.normal_rad))
    if noise.ground_distance_m is None:
        out = replace(out, distance_m=distances.larger(out.distance_m, MOST.distance_m))
    height_m = config.ground.vehicle_height
    if noise.heave_m is None and height_m is not None:
        stands = _of_stands(problem, weights, values, height_m, out.distance_m)
        out = replace(out, heave_m=stands.larger(out.heave_m, MOST.heave_m))
    return out


@dataclass(frozen=True)
class _Scatter:
    """Residuals of one kind at a solution.

    Attributes:
        residuals: (n, k).
        variances: (n, k) of these.
        repeated: (n, k) squared, what a residual has in common with others, times their number.
        fitted: number of coordinates that the solution is fitted to.
    """

    residuals: Array
    variances: Array
    repeated: Array
    fitted: int

    def larger(self, sigma: float, most: float) -> float:
        """The level that the residuals ask for, up to `most`; `sigma` is in their variances."""
        free = self.residuals.size - self.fitted
        if len(self.residuals) < FEWEST_PLANES or free < FEWEST_PLANES:
            return sigma
        ratio = self._squares(0.0) / free
        # Waves that scans share are as many as there are places; noise of points is of each scan.
        apart = free / float(np.mean(1.0 + self.repeated / self.variances**2))
        if ratio < LARGEST_RATIO or chdtrc(apart, ratio * apart) > CHANCE:
            return sigma
        low, high = 0.0, float(np.max(self.residuals**2))
        for _ in range(ROUNDS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self._squares(middle) > free else (low, middle)
        return max(sigma, min(float(np.sqrt(sigma**2 + high)), most))

    def _squares(self, more: float) -> float:
        """Sum of squares in variances that are larger by `more`; outliers are three sigmas off."""
        return float(np.minimum(self.residuals**2 / (self.variances + more), 9.0).sum())


def _of_planes(
    problem: Problem,
    observations: Sequence[GroundObservation],
    weights: GroundWeights,
    values: gtsam.Values,
) -> tuple[_Scatter, _Scatter]:
    """Tilts (n, 2) and distances (n, 1) of the planes in use whose pose the problem has.

    Without what biases of the ranges do to them.
    """
    taken = taken_poses(problem, observations)
    seen = [n for n in range(len(observations)) if taken[n] >= 0 and weights.planes[n] >= SEEN]
    lidars = {observations[n].lidar for n in seen}
    centres = ground_centres(problem, (observations[n].drive for n in seen))
    residuals, variances, repeated = np.zeros((3, len(seen), 3))
    for row, n in enumerate(seen):
        o = observations[n]
        factor = plane_factor_of(problem, o, int(taken[n]), centres[o.drive])
        residuals[row] = factor.unwhitenedError(values)
        variances[row] = np.diag(o.cov)
        variances[row, 2] += weights.heave_m[n] ** 2
        if o.repeated is not None:
            shared = problem.floors**2 + np.diag(o.by_bend)
            repeated[row] = np.diag(o.repeated) * shared
    fitted = len(lidars) + len(centres)
    tilts, distances = (
        _Scatter(residuals[:, k], variances[:, k], repeated[:, k], n * fitted)
        for k, n in ((slice(2), 2), (slice(2, 3), 1))
    )
    return tilts, distances


def _of_stands(
    problem: Problem,
    weights: GroundWeights,
    values: gtsam.Values,
    height_m: float,
    waves_m: float,
) -> _Scatter:
    """Heights (n, 1) of the vehicle frame over its drive's plane, less the drive's error.

    `waves_m` is 1 sigma of the waves below it. Poses of one place share them, and those of one
    moment the heave.
    """
    seen = np.flatnonzero(weights.stands >= SEEN)
    residuals = np.zeros((len(seen), 1))
    poses = [problem.poses[i] for i in seen.tolist()]
    centres = ground_centres(problem, (drive for drive, _ in poses))
    for row, (i, (drive, _)) in enumerate(zip(seen.tolist(), poses, strict=True)):
        place = values.atPose3(key_vehicle(i)).translation()
        height = height_over(values.atVector(key_ground(drive)), centres[drive], place)[0]
        residuals[row] = height - height_m - values.atVector(key_height(drive))
    variances = np.full_like(residuals, problem.heave_m**2 + waves_m**2)
    drives, stamps = np.array(poses, dtype=np.int64).reshape(-1, 2).T
    at_once = np.abs(stamps[:, None] - stamps) <= TOGETHER_NS
    at_once &= drives[:, None] == drives
    together = at_once.sum(axis=1, keepdims=True) - 1.0
    shares = standing_shares(problem, weights.stands)[seen, None] - 1.0
    repeated = shares * waves_m**4 + together * problem.heave_m**4
    return _Scatter(residuals, variances, repeated, len(centres))
