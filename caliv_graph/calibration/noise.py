"""How good the given poses are, read off the data themselves.

Filtered poses come without a usable covariance, and their errors are correlated in time; a wrong
guess of either costs accuracy and makes every sigma a lie. The variances (white and slow, rotation
and position) and one scale on the registration's sigmas are estimated by restricted maximum
likelihood: the extrinsics and the targets are integrated out, so that what they absorb is not
taken for precision (Patterson & Thompson 1971).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import gtsam
import numpy as np
import scipy.linalg
from scipy.optimize import minimize

from caliv_graph.calibration.graph import CloudLinearisation, linearise_clouds
from caliv_graph.calibration.problem import Problem
from caliv_graph.config.model import NoiseConfig
from caliv_graph.conventions import key_pose_error, key_vehicle
from caliv_graph.products import Array, BoolArray, IntArray, PoseNoise

TYPICAL = PoseNoise(
    white_rotation_rad=2e-4,
    white_position_m=2e-3,
    drift_rotation_rad=3e-4,
    drift_position_m=3e-3,
    drift_time_s=4.0,
)
"""What is assumed before the data speak: a filter of a good GNSS/INS."""

TYPICAL_SCALE = 1.5
"""Sigmas of a registration against what its mixture claims, before the data speak."""

LOG_SPREAD = math.log(10.0)
"""One sigma of how far the truth may be from `TYPICAL`: a factor of ten."""

FLOORS = np.array([2e-5, 2e-4, 1e-5, 1e-4, 0.5])
"""Smallest values: rotation rad, position m (white, slow), scale. Below them nothing changes."""

CEILINGS = np.array([0.05, 1.0, 0.1, 2.0, 10.0])

GROSS = 30.0
"""A cloud whose squared residual is this many times the median's has no say in the noise levels."""

CLOUDS_USED = 50
"""Clouds that the variances are estimated from, spread evenly: the cost grows with their cube."""


def _names(noise: NoiseConfig) -> list[float | None]:
    """What the user gave, in SI units, in the order of the parameters."""
    rad = [
        None if v is None else math.radians(v)
        for v in (noise.pose_rotation_deg, noise.pose_drift_rotation_deg)
    ]
    return [
        rad[0],
        noise.pose_position_m,
        rad[1],
        noise.pose_drift_position_m,
        None,
    ]


def first_pose_noise(noise: NoiseConfig) -> PoseNoise:
    """What the config says, and `TYPICAL` where it is silent."""
    given = _names(noise)
    typical = [
        TYPICAL.white_rotation_rad,
        TYPICAL.white_position_m,
        TYPICAL.drift_rotation_rad,
        TYPICAL.drift_position_m,
    ]
    values = [t if g is None else g for g, t in zip(given, typical, strict=False)]
    return PoseNoise(values[0], values[1], values[2], values[3], noise.pose_drift_time_s)


def sound_clouds(
    problem: Problem,
    measured: Sequence[gtsam.Pose3],
    information: Array,
    values: gtsam.Values,
    noise: PoseNoise,
) -> BoolArray:
    """Which clouds are not far off: (J,), those to estimate noise levels from.

    A cloud is judged where the given pose puts it. The solved pose would not do: it follows a cloud
    that is a third of a metre off, and the white error of the poses would be taken for as large.

    Args:
        problem: the clouds and poses.
        measured: registered pose of each cloud.
        information: (J, 6, 6), without robust weights.
        values: the current extrinsics and targets, and the poses as given.
        noise: what is assumed of the poses so far.
    """
    lines = linearise_clouds(problem, values)
    every = np.arange(problem.clouds)
    r, _, B, R = _stacked(problem, lines, measured, information, values, every)
    rotation = noise.white_rotation_rad**2 + noise.drift_rotation_rad**2
    position = noise.white_position_m**2 + noise.drift_position_m**2
    spread = np.array([rotation] * 3 + [position] * 3)
    given = problem.given()[problem.cloud_pose]
    V = R + np.einsum("jax,x,jbx->jab", B * given[:, None, None], spread, B)
    V += np.einsum("jax,jxy,jby->jab", B, _motion_covariance(problem, values, every), B)
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
    given = _names(config)
    chosen = _spread(problem, sound)
    lines = linearise_clouds(problem, values)
    r, A, B, R = _stacked(problem, lines, measured, information, values, chosen)
    times = problem.times_s()[problem.cloud_pose[chosen]]
    drives = problem.drives()[problem.cloud_pose[chosen]]
    apart = np.abs(times[:, None] - times[None])
    together = drives[:, None] == drives[None]
    same = ((apart < 1e-9) & together).astype(np.float64)
    slow = np.where(together, np.exp(-apart / first.drift_time_s), 0.0)
    joint = _motion_covariance(problem, values, chosen, together=True)
    known = np.einsum("pax,pqxy,qby->paqb", B, joint, B, optimize=True)
    known = known.reshape(6 * len(chosen), 6 * len(chosen))
    # Rotation and position parts of what a pose error does to the clouds' residuals.
    B = B * problem.given()[problem.cloud_pose[chosen]][:, None, None]
    effect = [B[:, :, :3].reshape(-1, 3), B[:, :, 3:].reshape(-1, 3)]
    spread = [e @ e.T for e in effect]
    ones = np.ones((6, 6))
    parts = [
        spread[0] * np.kron(same, ones),
        spread[1] * np.kron(same, ones),
        spread[0] * np.kron(slow, ones),
        spread[1] * np.kron(slow, ones),
        scipy.linalg.block_diag(*R),
    ]
    ridge = _ridge(problem, A.shape[1])
    start = np.log(
        [
            first.white_rotation_rad,
            first.white_position_m,
            first.drift_rotation_rad,
            first.drift_position_m,
            TYPICAL_SCALE,
        ]
    )
    # Without given poses there is nothing to be found out about their errors.
    free = np.array([g is None for g in given]) & (problem.given().any() | (np.arange(5) == 4))

    def cost(x: Array) -> float:
        full = start.copy()
        full[free] = x
        scale = np.exp(2.0 * np.clip(full, np.log(FLOORS), np.log(CEILINGS)))
        V = known + sum(s * p for s, p in zip(scale, parts, strict=True))
        try:
            L = scipy.linalg.cholesky(V, lower=True, check_finite=False)
        except scipy.linalg.LinAlgError:
            return 1e12
        white = scipy.linalg.solve_triangular(
            L, np.column_stack([A, r]), lower=True, check_finite=False
        )
        N = white[:, :-1].T @ white[:, :-1] + ridge
        LN = scipy.linalg.cholesky(N, lower=True, check_finite=False)
        y = scipy.linalg.solve_triangular(LN, white[:, :-1].T @ white[:, -1], lower=True)
        misfit = white[:, -1] @ white[:, -1] - y @ y
        surprise = np.sum(((full - start) / LOG_SPREAD) ** 2)
        return float(
            np.log(np.diag(L)).sum() + np.log(np.diag(LN)).sum() + 0.5 * (misfit + surprise)
        )

    found = minimize(
        cost,
        start[free],
        method="Powell",  # Nelder-Mead stops short in the valleys between white and slow errors
        options={"maxfev": 300, "xtol": 1e-2, "ftol": 1e-5},
    )
    full = start.copy()
    full[free] = found.x
    value = np.exp(np.clip(full, np.log(FLOORS), np.log(CEILINGS)))
    noise = PoseNoise(
        float(value[0]), float(value[1]), float(value[2]), float(value[3]), first.drift_time_s
    )
    return noise, float(value[4])


def _spread(problem: Problem, sound: BoolArray) -> IntArray:
    """Indices of at most CLOUDS_USED of the sound clouds, evenly over the drives.

    In the order of their poses: which LiDAR comes first in the config does not matter.
    """
    usable = np.flatnonzero(sound)
    usable = usable[np.argsort(problem.cloud_pose[usable], kind="stable")]
    step = max(1, math.ceil(len(usable) / CLOUDS_USED))
    return np.sort(usable[::step])


def squares_without_own_pose(
    problem: Problem,
    lines: CloudLinearisation,
    residuals: Array,
    information: Array,
    values: gtsam.Values,
    noise: PoseNoise,
) -> Array:
    """Squared residuals (J,) of the clouds, the white error of their own pose integrated out.

    A solved pose follows its cloud as far as the given pose lets it: a cloud that is a third of a
    metre off would be judged by a pose that has moved with it. So the white error that the solve
    found is taken back, and counted as noise. The slow error stays: the neighbours in time have a
    say in it.

    Args:
        problem: the clouds and poses.
        lines: Jacobians of the predicted poses at `values`.
        residuals: (J, 6) `Log(predicted measured^-1)` at `values`.
        information: (J, 6, 6) of the measured poses, without robust weights.
        values: the current estimate.
        noise: error model of the given poses.
    """
    white = np.array([noise.white_rotation_rad] * 3 + [noise.white_position_m] * 3)
    B = _pose_effects(problem, lines, values, np.arange(problem.clouds))
    found = np.zeros((len(problem.poses), 6))
    for i in np.flatnonzero(problem.given()).tolist():
        given = problem.T_map_vehicle[i]
        X = values.atPose3(key_vehicle(i))
        turn = gtsam.Rot3.Logmap(given.rotation().between(X.rotation()))
        error = np.concatenate([turn, X.translation() - given.translation()])
        found[i] = error - values.atVector(key_pose_error(i))
    r = residuals - np.einsum("jax,jx->ja", B, found[problem.cloud_pose])
    B = B * problem.given()[problem.cloud_pose][:, None, None]
    V = np.linalg.inv(information) + np.einsum("jax,x,jbx->jab", B, white**2, B)
    return np.asarray(np.einsum("ja,ja->j", r, np.linalg.solve(V, r[..., None])[..., 0]))


def _motion_covariance(
    problem: Problem, values: gtsam.Values, chosen: IntArray, together: bool = False
) -> Array:
    """Covariance that motion data leave to the poses of the chosen clouds; zero for given poses.

    Returns:
        (m, 6, 6), or if `together` (m, m, 6, 6) of all of them, rotation in vehicle axes and
        position in map axes.
    """
    m = len(chosen)
    out = np.zeros((m, m, 6, 6) if together else (m, 6, 6))
    pose = problem.cloud_pose[chosen]
    for drive, information in problem.motion.items():
        of_drive = np.flatnonzero(problem.drives() == drive)
        axes = np.tile(np.eye(6), (len(of_drive), 1, 1))
        for n, i in enumerate(of_drive.tolist()):
            axes[n, 3:, 3:] = values.atPose3(key_vehicle(i)).rotation().matrix()
        n = len(of_drive)
        cov = np.linalg.inv(information).reshape(n, 6, n, 6).swapaxes(1, 2)
        mine = np.flatnonzero(np.isin(pose, of_drive))
        local = np.searchsorted(of_drive, pose[mine])
        A = axes[local]
        if together:
            out[np.ix_(mine, mine)] = np.einsum(
                "pax,pqxy,qby->pqab", A, cov[np.ix_(local, local)], A, optimize=True
            )
        else:
            out[mine] = A @ cov[local, local] @ np.swapaxes(A, 1, 2)
    return out


def _pose_effects(
    problem: Problem, lines: CloudLinearisation, values: gtsam.Values, chosen: IntArray
) -> Array:
    """What pose errors do to the residuals of the chosen clouds; (m, 6, 6).

    Rotation errors are in vehicle axes, position errors in map axes.
    """
    B = np.zeros((len(chosen), 6, 6))
    for row, j in enumerate(chosen):
        key = key_vehicle(int(problem.cloud_pose[j]))
        jacobian = lines.jacobians[j][lines.keys[j].index(key)]
        B[row, :, :3] = jacobian[:, :3]
        B[row, :, 3:] = jacobian[:, 3:] @ values.atPose3(key).rotation().matrix().T
    return B


def _stacked(
    problem: Problem,
    lines: CloudLinearisation,
    measured: Sequence[gtsam.Pose3],
    information: Array,
    values: gtsam.Values,
    chosen: IntArray,
) -> tuple[Array, Array, Array, Array]:
    """Residuals of the chosen clouds, and what they depend on.

    Returns:
        (6m,) residuals; (6m, p) Jacobians by extrinsics and targets; (m, 6, 6) by pose errors
        (rotation in vehicle axes, position in map axes); (m, 6, 6) registration covariances.
    """
    keys = (*problem.extrinsic_keys(), *problem.target_keys())
    columns = {key: 6 * i for i, key in enumerate(keys)}
    columns |= {key: 6 * len(keys) + i for i, key in enumerate(problem.offset_keys())}
    r = np.zeros(6 * len(chosen))
    A = np.zeros((6 * len(chosen), 6 * len(keys) + len(problem.offset_keys())))
    B = _pose_effects(problem, lines, values, chosen)
    for row, j in enumerate(chosen):
        block = slice(6 * row, 6 * row + 6)
        r[block] = gtsam.Pose3.Logmap(lines.predicted[j].compose(measured[j].inverse()))
        for key, jacobian in zip(lines.keys[j], lines.jacobians[j], strict=True):
            if key in columns:
                A[block, columns[key] : columns[key] + jacobian.shape[1]] = jacobian
    return r, A, B, np.asarray(np.linalg.inv(information[chosen]), dtype=np.float64)


def _ridge(problem: Problem, size: int) -> Array:
    """Information that keeps undetermined directions finite: the weakest of the guesses."""
    sigmas = np.max([problem.prior_sigmas[n] for n in problem.lidars], axis=0)
    count = 6 * len(problem.lidars)
    ridge = np.full(size, 1e-2)
    ridge[:count] = np.tile(sigmas**-2.0, len(problem.lidars))
    return np.diag(ridge)
