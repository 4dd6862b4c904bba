"""Noise of the given poses and scale of the registration, estimated from the data.

Restricted maximum likelihood: extrinsics and targets are integrated out, so that residuals which
they absorb do not count as precision (Patterson & Thompson 1971;
`caliv_graph/calibration/README.md`, "Noise levels").
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace

import gtsam
import numpy as np
import scipy.linalg
from scipy.optimize import minimize_scalar

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
from caliv_graph.calibration.variance_components import (
    Block,
    Component,
    Likelihood,
    Observed,
    Unknown,
    maximise_exactly,
    time_of_expected,
    together,
)
from caliv_graph.calibration.vehicle_parameters import KEYS, POSE_TIME_OFFSET
from caliv_graph.config.noise import NoiseConfig
from caliv_graph.conventions import key_pose_error, key_vehicle
from caliv_graph.products import Array, BoolArray, IntArray, PoseNoise

TYPICAL = PoseNoise(
    white_rotation_rad=2e-4,
    white_position_m=2e-3,
    drift_rotation_rad=3e-4,
    drift_position_m=3e-3,
    drift_time_s=10.0,
)
"""Median of the prior: the filter of a good GNSS/INS."""

LOG_SPREAD = math.log(10.0)
"""1 sigma of the log-normal prior about the sigmas of `TYPICAL`: a factor of ten."""

STATED_SPREAD = math.log(2.0)
"""The same about the sigmas of slow errors that messages state: a localiser knows them to that.
Over a short drive they pass for a clock of the poses, or for LiDARs that are apart."""

MOST_STATED = 10.0
"""Slow errors of poses that calibrate anything, in `TYPICAL`: what is stated beyond is no more than
that. One localiser states 0.3 m for 15 mm, which good walls made 30 of."""

TIME_SPREAD = math.log(3.0)
"""The same about its time."""

TIMES_S: tuple[float, ...] = (1.0, 3.0, 10.0, 30.0, 100.0)
"""Correlation times that are tried: a drive hardly tells them apart."""

FLOORS = (2e-5, 2e-4, 1e-5, 1e-4)
"""Smallest values: rotation rad, position m (white, Gauss-Markov)."""

CEILINGS = (0.05, 1.0, 0.1, 2.0)

TYPICAL_SCALE = 1.0
"""Median of the prior of the scale on the registration's sigmas."""

SCALE = Unknown(TYPICAL_SCALE, LOG_SPREAD, (0.5, 10.0))
"""Scale on the registration's sigmas."""

CLOUD = Unknown(1.0, math.log(2.0), (1e-2, 1e2))
"""Of one cloud's registration, as a factor on the level of all. A cloud of a few points can turn
about the target by a hundred of its sigmas: with one level for all, that of the others was then
eight times what it is, and hid errors of the fixes of 18 mm."""

KNOWN_PART = 1e-9
"""Eigenvalues of the joint information below this part of the largest are those of the gauge."""

GROSS = 30.0
"""A cloud whose squared residual is this many times the median is left out of the noise fit."""

CLOUDS_USED = 50
"""Clouds that the variances are estimated from, spread evenly: the cost grows with their cube."""

GOLDEN_RATIO = (1.0 + math.sqrt(5.0)) / 2.0


def _configured(noise: NoiseConfig) -> list[float | None]:
    """The sigmas of the config in SI units, in the order of `PoseNoise`."""
    white, drift = (
        None if v is None else math.radians(v)
        for v in (noise.pose_rotation_deg, noise.pose_drift_rotation_deg)
    )
    return [white, noise.pose_position_m, drift, noise.pose_drift_position_m]


def all_stated(noise: NoiseConfig) -> bool:
    """Whether a config leaves nothing open of the noise of given poses."""
    return None not in (*_configured(noise), noise.pose_drift_time_s)


def first_pose_noise(noise: NoiseConfig) -> PoseNoise:
    """The values of the config, and `TYPICAL` for the others."""
    *typical, time_s = astuple(TYPICAL)
    values = [t if g is None else g for g, t in zip(_configured(noise), typical, strict=True)]
    return PoseNoise(values[0], values[1], values[2], values[3], noise.pose_drift_time_s or time_s)


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


@dataclass(frozen=True)
class PoseResiduals:
    """Residuals that errors of given poses move.

    Attributes:
        observed: the residuals.
        white: their covariances (N, N) by white errors, rotation and position, at sigma 1.
        slow: the same of Gauss-Markov errors, by their correlation time in seconds.
        clouds: registrations of clouds among the residuals.
        unstated: whether there are poses whose messages do not state their white errors.
    """

    observed: Observed
    white: tuple[Array, Array]
    slow: Callable[[float], tuple[Array, Array]]
    clouds: Sequence[Block] = ()
    unstated: bool = True

    def likelihood(self, time_s: float, clouds: Sequence[Component]) -> Likelihood:
        """At a correlation time; the unknowns 0 to 3 are the sigmas of `PoseNoise`, in order."""
        parts = enumerate((*self.white, *self.slow(time_s)))
        errors = [Component(part, (number,)) for number, part in parts]
        return Likelihood(self.observed, [*errors, *clouds])


def fit_pose_noise(
    problem: Problem,
    measured: Sequence[gtsam.Pose3],
    information: Array,
    sound: BoolArray,
    values: gtsam.Values,
    config: NoiseConfig,
    of_poses: PoseResiduals | None = None,
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
        of_poses: what structure says of them; None: nothing.
    """
    chosen = evenly_over_drives(problem, sound)
    r, A, B = _stacked(problem, linearise_clouds(problem, values), measured, values, chosen)
    known, white, slow = pose_parts(problem, values, chosen, B)
    observed = Observed(r, A, np.diagonal(_ridge(problem, A.shape[1])), known)
    clouds = [
        Block(slice(6 * row, 6 * row + 6), cov)
        for row, cov in enumerate(np.linalg.inv(information[chosen]))
    ]
    given, stated = problem.given(), problem.stated()
    of_messages, evidence = None, [PoseResiduals(observed, white, slow, clouds)]
    unstated, some = bool((given & ~stated).any()), bool(given.any())
    if of_poses is not None:
        evidence.append(of_poses)
        unstated, some = unstated or of_poses.unstated, True
    if problem.stated_cov is not None and stated.any() and not unstated:
        of_messages = problem.stated_cov[stated]
    noise = expected_noise(
        evidence,
        config,
        open_levels=(unstated, some),
        of_messages=of_messages,
        slow_stated=problem.slow_stated,
    )
    if not clouds:
        return noise, TYPICAL_SCALE
    # Solves by all clouds need one scale: a factor for each is for the poses' noise.
    sigmas = np.array(astuple(noise)[:4])
    poses = observed.covariance((*white, *slow(noise.drift_time_s)), np.log(sigmas))
    alike = Likelihood(replace(observed, known=poses), [Component(cloud, (0,)) for cloud in clouds])
    (scale,), _ = maximise_exactly(alike.cost, [SCALE], np.array([TYPICAL_SCALE]))
    return noise, float(scale)


def expected_noise(
    evidence: Sequence[PoseResiduals],
    config: NoiseConfig,
    *,
    open_levels: tuple[bool, bool] = (True, True),
    of_messages: Array | None = None,
    slow_stated: tuple[float | None, float | None] = (None, None),
) -> PoseNoise:
    """The noise of given poses by residuals that it moves.

    A drive hardly tells the correlation time. Sigmas are fitted at some times; the result has the
    expected variances, and the same change over short times. Over any time the errors then change
    by at least as much as these hypotheses together (Jensen).

    Args:
        evidence: the residuals. Those of clouds and of structure count as independent of each
            other, though the same errors move both.
        config: what is stated there is kept.
        open_levels: whether white and whether Gauss-Markov sigmas are to be found; else they are
            `TYPICAL` or `slow_stated`.
        of_messages: (n, 6, 6) white errors of all poses, if messages state them.
        slow_stated: sigmas of Gauss-Markov errors, rotation (rad) and position (m), that messages
            state; None: nothing.
    """
    fixed, unknowns = _configured(config), list[Unknown]()
    needed = np.repeat(open_levels, 2).tolist()
    for need, value, typical, told, low, high in zip(
        needed,
        fixed,
        astuple(TYPICAL)[:4],
        (None, None, *slow_stated),
        FLOORS,
        CEILINGS,
        strict=True,
    ):
        median, spread = typical, LOG_SPREAD
        if told is not None and told < high:  # beyond, it stands for "not known"
            median, spread = min(told, MOST_STATED * typical), STATED_SPREAD
        kept = median if value is None else value
        free = need and value is None
        unknowns.append(Unknown(kept, spread, (low, high) if free else (kept, kept)))
    levels, of_clouds = len(unknowns), list[list[Component]]()
    for of in evidence:
        if not of.clouds:
            of_clouds.append([])
            continue
        scale = len(unknowns)
        numbered = enumerate(of.clouds, start=scale + 1)
        of_clouds.append([Component(block, (scale, number)) for number, block in numbered])
        unknowns += [SCALE, *([CLOUD] * len(of.clouds))]
    time_s = config.pose_drift_time_s or TYPICAL.drift_time_s
    given_time = config.pose_drift_time_s is not None or not open_levels[1]
    times_s = np.array([time_s] if given_time else TIMES_S)
    found, costs = np.array([u.median for u in unknowns]), np.zeros(len(times_s))
    variances = np.zeros((len(times_s), levels))
    for row, time in enumerate(times_s.tolist()):
        likelihoods = [
            of.likelihood(time, more) for of, more in zip(evidence, of_clouds, strict=True)
        ]
        found, cost = maximise_exactly(together(likelihoods), unknowns, found)
        surprise = math.log(time / TYPICAL.drift_time_s) / TIME_SPREAD
        costs[row], variances[row] = cost + 0.5 * surprise**2, found[:levels] ** 2
    weight = np.exp(costs.min() - costs)
    weight /= weight.sum()
    expected = weight @ variances
    if of_messages is not None:
        of_each = np.diagonal(of_messages, axis1=1, axis2=2)
        expected[:2] = of_each[:, :3].mean(), of_each[:, 3:].mean()
    if not given_time:
        drift = weight[:, None] * variances[:, 2:] / np.square(astuple(TYPICAL)[2:4])
        time_s = time_of_expected(drift.T, times_s)
    fits = zip(fixed, np.sqrt(expected).tolist(), strict=True)
    a, b, c, d = (fit if value is None else value for value, fit in fits)
    return PoseNoise(a, b, c, d, time_s)


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

    low, high = SCALE.bounds
    bounds = (math.log(low), math.log(high))
    found = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-2})
    return math.exp(float(found.x))


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
