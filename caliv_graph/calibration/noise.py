"""Noise of the given poses and scale of the registration, estimated from the data.

Restricted maximum likelihood: extrinsics and targets are integrated out, so that residuals which
they absorb do not count as precision (Patterson & Thompson 1971;
`caliv_graph/calibration/README.md`, "Noise levels").
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import gtsam
import numpy as np
import scipy.linalg
from scipy.linalg.lapack import dpotrf, dtrtrs
from scipy.optimize import minimize, minimize_scalar

from caliv_graph.calibration.graph import with_given_poses
from caliv_graph.calibration.linear import CloudLinearisation, linearise_clouds
from caliv_graph.calibration.pose_effects import (
    motion_covariance,
    pose_covariance,
    pose_effects,
    pose_parts,
    stated_effect,
)
from caliv_graph.calibration.problem import Problem
from caliv_graph.calibration.robust import own_blocks
from caliv_graph.calibration.vehicle_parameters import KEYS, POSE_TIME_OFFSET
from caliv_graph.config.noise import NoiseConfig
from caliv_graph.conventions import key_pose_error, key_vehicle
from caliv_graph.products import Array, BoolArray, IntArray, PoseNoise

TYPICAL = PoseNoise(
    white_rotation_rad=2e-4,
    white_position_m=2e-3,
    drift_rotation_rad=3e-4,
    drift_position_m=3e-3,
    drift_time_s=4.0,
)
"""Median of the prior: the filter of a good GNSS/INS."""

TYPICAL_SCALE = 1.0
"""Median of the prior of the scale on the registration's sigmas."""

LOG_SPREAD = math.log(10.0)
"""1 sigma of the log-normal prior about `TYPICAL`: a factor of ten."""

FLOORS = np.array([2e-5, 2e-4, 1e-5, 1e-4, 0.5])
"""Smallest values: rotation rad, position m (white, Gauss-Markov), scale."""

CEILINGS = np.array([0.05, 1.0, 0.1, 2.0, 10.0])

KNOWN_PART = 1e-9
"""Eigenvalues of the joint information below this part of the largest are those of the gauge."""

GROSS = 30.0
"""A cloud whose squared residual is this many times the median is left out of the noise fit."""

CLOUDS_USED = 50
"""Clouds that the variances are estimated from, spread evenly: the cost grows with their cube."""

GOLDEN_RATIO = (1.0 + math.sqrt(5.0)) / 2.0


def _configured(noise: NoiseConfig) -> list[float | None]:
    """The values of the config in SI units, in the order of the parameters."""
    white, drift = (
        None if v is None else math.radians(v)
        for v in (noise.pose_rotation_deg, noise.pose_drift_rotation_deg)
    )
    return [white, noise.pose_position_m, drift, noise.pose_drift_position_m, None]


def first_pose_noise(noise: NoiseConfig) -> PoseNoise:
    """The values of the config, and `TYPICAL` for the others."""
    typical = astuple(TYPICAL)
    values = [t if g is None else g for g, t in zip(_configured(noise), typical, strict=True)]
    return PoseNoise(values[0], values[1], values[2], values[3], noise.pose_drift_time_s)


def sound_clouds(
    problem: Problem,
    measured: Sequence[gtsam.Pose3],
    information: Array,
    values: gtsam.Values,
    noise: PoseNoise,
) -> BoolArray:
    """(J,) which clouds are not far off: those that noise levels are estimated from.

    Residuals are taken at the given poses, which `values` must hold: solved poses follow a cloud
    that is 0.3 m off. `information` (J, 6, 6) is without robust weights.
    """
    lines = linearise_clouds(problem, values)
    every = np.arange(problem.clouds)
    r, _, B = _stacked(problem, lines, measured, values, every)
    rotation = noise.white_rotation_rad**2 + noise.drift_rotation_rad**2
    position = noise.white_position_m**2 + noise.drift_position_m**2
    spread = np.tile([rotation] * 3 + [position] * 3, (problem.clouds, 1))
    stated = problem.stated()[problem.cloud_pose]
    spread[stated] = [noise.drift_rotation_rad**2] * 3 + [noise.drift_position_m**2] * 3
    given = problem.given()[problem.cloud_pose]
    V = np.linalg.inv(information)
    V += np.einsum("jax,jx,jbx->jab", B * given[:, None, None], spread, B)
    V += stated_effect(problem, B, every)
    V += np.einsum("jax,jxy,jby->jab", B, motion_covariance(problem, values, every), B)
    r = r.reshape(-1, 6)
    squared = np.einsum("ja,ja->j", r, np.linalg.solve(V, r[..., None])[..., 0])
    return np.asarray(squared < GROSS * np.median(squared))


def fit_pose_noise(
    problem: Problem,
    measured: Sequence[gtsam.Pose3],
    information: Array,
    sound: BoolArray,
    values: gtsam.Values,
    config: NoiseConfig,
) -> tuple[PoseNoise, float]:
    """Variances of the given poses and the scale of the registration's sigmas.

    What the config states is kept. Where a pose's message states a covariance, that is the white
    part of its error: only the Gauss-Markov part is fitted. If all poses state one, the white
    figures returned are the root mean square of theirs.

    Args:
        problem: the clouds and poses.
        measured: registered pose of each cloud.
        information: (J, 6, 6), without robust weights.
        sound: (J,) the clouds to go by.
        values: the current extrinsics and targets, and the poses *as given*: estimated poses
            have taken up the errors that are to be measured.
        config: what is given there is kept.
    """
    first = first_pose_noise(config)
    likelihood = _RestrictedLikelihood.at(problem, measured, information, sound, values, first)
    # What the config states is kept; without given poses there are no pose errors to estimate.
    free = np.array([g is None for g in _configured(config)])
    fitted = problem.given() & ~problem.stated()
    free &= np.array([fitted.any()] * 2 + [problem.given().any()] * 2 + [True])

    def logarithms(x: Array) -> Array:
        full = likelihood.prior.copy()
        full[free] = x
        return full

    def cost(x: Array) -> float:
        return likelihood.cost(logarithms(x))

    found = minimize(
        cost,
        likelihood.prior[free],
        # Nelder-Mead stops short in the valleys between white and Gauss-Markov errors.
        method="Powell",
        options={"maxfev": 300, "xtol": 1e-2, "ftol": 1e-5},
    )
    bounded = np.clip(logarithms(found.x), np.log(FLOORS), np.log(CEILINGS))
    value = np.exp(bounded).tolist()
    if problem.stated_cov is not None and problem.stated().any() and not fitted.any():
        variances = np.diagonal(problem.stated_cov[problem.stated()], axis1=1, axis2=2)
        value[:2] = np.sqrt([variances[:, :3].mean(), variances[:, 3:].mean()]).tolist()
    noise = PoseNoise(value[0], value[1], value[2], value[3], first.drift_time_s)
    return noise, float(value[4])


def fit_scale(
    problem: Problem,
    lines: CloudLinearisation,
    clouds: tuple[Array, Array],
    values: gtsam.Values,
    noise: PoseNoise,
) -> float:
    """Scale of the registration's sigmas by the joint quadratic of shape and graph.

    The gradient of the clouds at the poses as given is `g = n + H (B e + A d)`: n of covariance
    s^2 H, of the clouds; e the errors of the poses; d those of extrinsics, targets and offsets,
    which are integrated out. The shape is eliminated in H: what it takes up of the clouds' noise
    does not make s too small.

    Args:
        problem: the clouds and poses.
        lines: at `values`.
        clouds: (6 J, 6 J) and (6 J,) their joint quadratic at `values`, scale 1.
        values: the solution.
        noise: of given poses.
    """
    every = np.arange(problem.clouds)
    given = with_given_poses(problem, values)
    there = linearise_clouds(problem, given).predicted
    H, gradient = clouds
    r, A, B = _stacked(problem, lines, there, values, every)
    # From the solved to the given poses: the gradient follows.
    y = gradient - H @ r
    K = pose_covariance(problem, values, every, B, noise)
    chosen = evenly_over_drives(problem, np.trace(own_blocks(H), axis1=1, axis2=2) > 0.0)
    rows = (6 * chosen[:, None] + np.arange(6)).ravel()
    across = H[rows]
    spread = across @ K @ across.T
    own, axes = scipy.linalg.eigh(H[np.ix_(rows, rows)])
    known = own > KNOWN_PART * own[-1]
    white = axes[:, known] / np.sqrt(own[known])
    variance, turned = scipy.linalg.eigh(white.T @ spread @ white)
    white = white @ turned
    z, design = white.T @ y[rows], white.T @ (across @ A)
    ridge = _ridge(problem, A.shape[1])

    def cost(logarithm: float) -> float:
        weight = 1.0 / (np.exp(2.0 * logarithm) + np.maximum(variance, 0.0))
        N = design.T @ (weight[:, None] * design) + ridge
        L = scipy.linalg.cholesky(N, lower=True)
        pull = scipy.linalg.solve_triangular(L, design.T @ (weight * z), lower=True)
        surprise = ((logarithm - math.log(TYPICAL_SCALE)) / LOG_SPREAD) ** 2
        return float(
            np.log(np.diag(L)).sum()
            + 0.5 * (z @ (weight * z) - pull @ pull - np.log(weight).sum() + surprise)
        )

    bounds = (math.log(FLOORS[-1]), math.log(CEILINGS[-1]))
    found = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-2})
    return math.exp(float(found.x))


@dataclass(frozen=True)
class _RestrictedLikelihood:
    """The restricted likelihood of the noise levels of m clouds, with its prior.

    Attributes:
        stacked: (6m, p + 1) derivatives of the residuals of the clouds with respect to extrinsics,
            targets and time offsets, and the residuals at the given poses.
        known: (36 m^2,) covariance (6m, 6m) that smoothed poses bring, and the stated white errors.
        parts: (5, 36 m^2) what the variances multiply: white rotation and position, Gauss-Markov
            rotation and position, registration.
        ridge: (p, p) weak information on what the design multiplies.
        prior: (5,) medians of the prior on the logarithms of the sigmas.
    """

    stacked: Array
    known: Array
    parts: Array
    ridge: Array
    prior: Array

    @classmethod
    def at(
        cls,
        problem: Problem,
        measured: Sequence[gtsam.Pose3],
        information: Array,
        sound: BoolArray,
        values: gtsam.Values,
        first: PoseNoise,
    ) -> _RestrictedLikelihood:
        """Linearised at `values`; arguments as in `fit_pose_noise`."""
        chosen = evenly_over_drives(problem, sound)
        lines = linearise_clouds(problem, values)
        r, A, B = _stacked(problem, lines, measured, values, chosen)
        known, parts = pose_parts(problem, values, chosen, B, first)
        of_clouds = scipy.linalg.block_diag(*np.linalg.inv(information[chosen]))
        return cls(
            stacked=np.asfortranarray(np.column_stack([A, r])),
            known=known.ravel(),
            parts=np.array([part.ravel() for part in (*parts, of_clouds)]),
            ridge=_ridge(problem, A.shape[1]),
            prior=np.log([*astuple(first)[:4], TYPICAL_SCALE]),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """(6m, 6m)."""
        return len(self.stacked), len(self.stacked)

    def cost(self, logarithms: Array) -> float:
        """Minus the logarithm of likelihood times prior, of the logarithms (5,) of the sigmas."""
        scale = np.exp(2.0 * np.clip(logarithms, np.log(FLOORS), np.log(CEILINGS)))
        # LAPACK itself: this runs hundreds of times, and scipy's checks take as long. V is
        # symmetric, and its transpose is in LAPACK's order.
        L, failed = dpotrf((self.known + scale @ self.parts).reshape(self.shape).T, lower=1)
        if failed:
            return 1e12
        white, _ = dtrtrs(L, self.stacked, lower=1)
        A, r = white[:, :-1], white[:, -1]
        LN, failed = dpotrf(A.T @ A + self.ridge, lower=1)
        if failed:
            return 1e12
        y, _ = dtrtrs(LN, A.T @ r, lower=1)
        misfit = r @ r - y @ y
        surprise = np.sum(((logarithms - self.prior) / LOG_SPREAD) ** 2)
        return float(
            np.log(np.diag(L)).sum() + np.log(np.diag(LN)).sum() + 0.5 * (misfit + surprise)
        )


def evenly_over_drives(problem: Problem, sound: BoolArray, most: int | None = None) -> IntArray:
    """About so many sound clouds, evenly over the drives and over the LiDARs.

    Clouds of one moment, at most one of each LiDAR and target, stay together: clouds of one pose
    tell its errors from those of the clouds. Every second or fourth cloud would be of the same
    LiDAR where two take turns; moments are taken by the golden ratio, which has no period.

    `most` None: `CLOUDS_USED`. The order of the clouds and of the LiDARs does not matter.
    """
    most = CLOUDS_USED if most is None else most
    usable = np.flatnonzero(sound)
    if len(usable) <= most:
        return usable
    usable = usable[np.argsort(problem.cloud_pose[usable], kind="stable")]
    turn = np.mod(_moments(problem, usable) * GOLDEN_RATIO, 1.0)
    return np.sort(usable[turn < most / len(usable)])


def _moments(problem: Problem, clouds: IntArray) -> IntArray:
    """(n,) which moment each cloud is of; the clouds are in the order of their poses.

    A moment ends before a pose with a cloud of a LiDAR and target that it has already.
    """
    out, now = [], 0
    seen: set[tuple[int, int]] = set()
    for _, group in itertools.groupby(clouds.tolist(), key=lambda j: problem.cloud_pose[j]):
        here = [(int(problem.cloud_lidar[j]), int(problem.cloud_placement[j])) for j in group]
        if not seen.isdisjoint(here):
            now, seen = now + 1, set()
        seen.update(here)
        out += [now] * len(here)
    return np.array(out, dtype=np.int64)


def squares_without_own_pose(
    problem: Problem,
    lines: CloudLinearisation,
    residuals: Array,
    information: Array,
    values: gtsam.Values,
    noise: PoseNoise,
) -> Array:
    """Squared residuals (J,) of the clouds, the white error of their own pose integrated out.

    A solved pose follows its cloud within the noise of the given pose, also a cloud that is 0.3 m
    off. So the white error that the solve found is taken back and counted as noise; the
    Gauss-Markov error stays, for its neighbours in time determine it. `residuals` (J, 6) are
    `Log(predicted measured^-1)` at `values`, `information` (J, 6, 6) is without robust weights.
    """
    white = np.array([noise.white_rotation_rad] * 3 + [noise.white_position_m] * 3)
    B = pose_effects(problem, lines, values, np.arange(problem.clouds))
    found = np.zeros((len(problem.poses), 6))
    for i in np.flatnonzero(problem.given()).tolist():
        given = problem.T_map_vehicle[i]
        X = values.atPose3(key_vehicle(i))
        turn = gtsam.Rot3.Logmap(given.rotation().between(X.rotation()))
        error = np.concatenate([turn, X.translation() - given.translation()])
        found[i] = error - values.atVector(key_pose_error(i))
        if problem.given_rates is not None:
            found[i] -= problem.given_rates[i] * values.atVector(KEYS[POSE_TIME_OFFSET])[0]
    r = residuals - np.einsum("jax,jx->ja", B, found[problem.cloud_pose])
    stated = stated_effect(problem, B, np.arange(problem.clouds))
    fitted = problem.given() & ~problem.stated()
    B = B * fitted[problem.cloud_pose][:, None, None]
    V = np.linalg.inv(information) + np.einsum("jax,x,jbx->jab", B, white**2, B) + stated
    return np.asarray(np.einsum("ja,ja->j", r, np.linalg.solve(V, r[..., None])[..., 0]))


def _stacked(
    problem: Problem,
    lines: CloudLinearisation,
    measured: Sequence[gtsam.Pose3],
    values: gtsam.Values,
    chosen: IntArray,
) -> tuple[Array, Array, Array]:
    """Residuals (6m,) of the chosen clouds, and what they depend on.

    (6m, p) by extrinsics, targets, offsets and the clock of given poses; (m, 6, 6) by pose errors.
    """
    keys = (*problem.extrinsic_keys(), *problem.target_keys())
    columns = {key: 6 * i for i, key in enumerate(keys)}
    columns |= {key: 6 * len(keys) + i for i, key in enumerate(problem.offset_keys())}
    r = np.zeros(6 * len(chosen))
    A = np.zeros((6 * len(chosen), 6 * len(keys) + len(problem.offset_keys())))
    B = pose_effects(problem, lines, values, chosen)
    for row, j in enumerate(chosen):
        block = slice(6 * row, 6 * row + 6)
        r[block] = gtsam.Pose3.Logmap(lines.predicted[j].compose(measured[j].inverse()))
        for key, jacobian in zip(lines.keys[j], lines.jacobians[j], strict=True):
            if key in columns:
                A[block, columns[key] : columns[key] + jacobian.shape[1]] = jacobian
    if problem.given_rates is not None:
        late = np.einsum("mij,mj->mi", B, problem.given_rates[problem.cloud_pose[chosen]])
        A = np.column_stack([A, late.ravel()])
    return r, A, B


def _ridge(problem: Problem, size: int) -> Array:
    """Information that keeps undetermined directions finite: the weakest of the guesses."""
    sigmas = np.max([problem.prior_sigmas[n] for n in problem.lidars], axis=0)
    count = 6 * len(problem.lidars)
    ridge = np.full(size, 1e-2)
    ridge[:count] = np.tile(sigmas**-2.0, len(problem.lidars))
    return np.diag(ridge)
