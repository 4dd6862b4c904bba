"""What errors of the vehicle's poses do to the residuals of clouds: effects and covariances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple

import gtsam
import numpy as np

from caliv_graph.calibration.linear import CloudLinearisation
from caliv_graph.calibration.problem import Problem
from caliv_graph.conventions import key_vehicle
from caliv_graph.products import Array, IntArray, PoseNoise


def pose_parts(
    problem: Problem, values: gtsam.Values, chosen: IntArray, B: Array
) -> tuple[Array, tuple[Array, Array], Callable[[float], tuple[Array, Array]]]:
    """What pose errors do to the residuals of m clouds: (6m, 6m) covariances.

    That of smoothed poses and stated white errors; what the variances of white rotation and
    position multiply; and what those of Gauss-Markov rotation and position do, by their time in
    seconds. B (m, 6, 6) are the effects of pose errors.
    """
    times = problem.times_s()[problem.cloud_pose[chosen]]
    drives = problem.drives()[problem.cloud_pose[chosen]]
    apart = np.abs(times[:, None] - times[None])
    together = drives[:, None] == drives[None]
    same = ((apart < 1e-9) & together).astype(np.float64)
    joint = motion_covariance(problem, values, chosen, together=True)
    known = np.einsum("pax,pqxy,qby->paqb", B, joint, B, optimize=True)
    known += stated_effect(problem, B, chosen, same)
    # Rotation and position parts of what a pose error does to the clouds' residuals.
    unstated = ~problem.stated()[problem.cloud_pose[chosen]]
    B = B * problem.given()[problem.cloud_pose[chosen]][:, None, None]
    effect = [B[:, :, :3].reshape(-1, 3), B[:, :, 3:].reshape(-1, 3)]
    rotation, position = (e @ e.T for e in effect)
    ones = np.ones((6, 6))

    def of_both(correlation: Array) -> tuple[Array, Array]:
        every = np.kron(correlation, ones)
        return rotation * every, position * every

    def slow(time_s: float) -> tuple[Array, Array]:
        return of_both(np.where(together, np.exp(-apart / time_s), 0.0))

    white = of_both(same * np.outer(unstated, unstated))
    return known.reshape(6 * len(chosen), 6 * len(chosen)), white, slow


def pose_covariance(
    problem: Problem, values: gtsam.Values, chosen: IntArray, B: Array, noise: PoseNoise
) -> Array:
    """(6m, 6m) covariance of the residuals of m clouds by pose errors; see `pose_parts`."""
    known, white, slow = pose_parts(problem, values, chosen, B)
    parts = (*white, *slow(noise.drift_time_s))
    for sigma, part in zip(astuple(noise)[:4], parts, strict=True):
        known = known + sigma**2 * part
    return np.asarray(known)


def stated_effect(problem: Problem, B: Array, chosen: IntArray, same: Array | None = None) -> Array:
    """(m, 6, 6) added to the covariance of the chosen clouds' residuals by stated white errors.

    `B` (m, 6, 6): effects of pose errors. With `same` (m, m), 1 where two clouds share a pose:
    (m, 6, m, 6).
    """
    m, pose = len(chosen), problem.cloud_pose[chosen]
    stated = problem.stated()[pose]
    if problem.stated_cov is None or not stated.any():
        return np.zeros((m, 6, 6) if same is None else (m, 6, m, 6))
    cov = np.zeros((m, 6, 6))
    cov[stated] = problem.stated_cov[pose[stated]]
    if same is None:
        return np.asarray(np.einsum("jax,jxy,jby->jab", B, cov, B))
    return np.asarray(np.einsum("pax,pxy,qby,pq->paqb", B, cov, B, same, optimize=True))


def motion_covariance(
    problem: Problem, values: gtsam.Values, chosen: IntArray, together: bool = False
) -> Array:
    """(m, 6, 6) covariance that motion data leave to the poses of clouds; zero for given poses.

    If `together` (m, m, 6, 6). Rotation in vehicle axes, position in map axes.
    """
    m = len(chosen)
    out = np.zeros((m, m, 6, 6) if together else (m, 6, 6))
    pose = problem.cloud_pose[chosen]
    for drive, cov in problem.motion_cov.items():
        of_drive = np.flatnonzero(problem.drives() == drive)
        axes = np.tile(np.eye(6), (len(of_drive), 1, 1))
        for n, i in enumerate(of_drive.tolist()):
            axes[n, 3:, 3:] = values.atPose3(key_vehicle(i)).rotation().matrix()
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


def pose_effects(
    problem: Problem, lines: CloudLinearisation, values: gtsam.Values, chosen: IntArray
) -> Array:
    """(m, 6, 6) residuals of clouds by pose errors: rotation in vehicle, position in map axes."""
    B = np.zeros((len(chosen), 6, 6))
    for row, j in enumerate(chosen):
        key = key_vehicle(int(problem.cloud_pose[j]))
        jacobian = lines.jacobians[j][lines.keys[j].index(key)]
        B[row, :, :3] = jacobian[:, :3]
        B[row, :, 3:] = jacobian[:, 3:] @ values.atPose3(key).rotation().matrix().T
    return B
