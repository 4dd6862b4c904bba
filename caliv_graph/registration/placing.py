"""Where the motion puts the middles of the clouds, seen from the target's centre.

Middles alone (`centring`) put the faces of a wide target on each other: what a LiDAR sees of it has
its middle before the target's, by more from the broad side than from the end. What the motion and
the guesses say of the places is wrong by an error of the guess, the same for all clouds of a LiDAR.
`README.md` of this folder, section 9, "Where the clouds begin".
"""

from __future__ import annotations

import gtsam
import numpy as np

from caliv_graph.common.statistics import MAD
from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array, IntArray
from caliv_graph.registration.centring import Middles

LEAST_MOTION_M = 0.03
"""1 sigma of a place by the motion, at least: half of what the registration draws a cloud in
from."""

MOST_MOTION_M = 0.1
"""And at most: where it errs by more, it is no nearer than the middles, which the registration of
a compact target always starts well from."""

DISTINCT = 10.0
"""All clouds of a LiDAR together count as so many at most: neighbouring views err alike."""

HUBER_SIGMAS = 2.0
"""Middles that are farther off pull no harder: some clouds are of something else."""

FARTHEST = 3.0
"""Sigmas beyond which a middle is not where the motion has it: its cloud begins in the centre."""

STEPS = 8
"""Gauss-Newton steps; the problem is almost linear."""


def placed_by_motion(
    middles: Middles, R: Array, t: Array, lidar: IntArray, guess_sigmas: Array
) -> Array:
    """(J, 3) where the middles are, from the target's centre, axes of the map.

    Least squares: the centre, and an error of each LiDAR's guess, by which all middles are in the
    centre. What is left of them is where the motion has each. They keep that as far as it is known
    better than the middle is: what middles scatter across the view by more than their sigmas is an
    error of the motion. Where that is more than `MOST_MOTION_M`, all middles are in the centre, and
    so is one that is farther off than both allow.

    Args:
        middles: of the clouds.
        R: (J, 3, 3) prealigned, map from lidar.
        t: (J, 3) metres.
        lidar: (J,) index of the LiDAR of each.
        guess_sigmas: (L, 2) 1 sigma of each LiDAR's guess, rad and metres.
    """
    count, lidars = len(t), len(guess_sigmas)
    prior = np.zeros(6 * lidars + 3)
    prior[: 6 * lidars] = np.repeat(guess_sigmas**-2.0, 3, axis=1).ravel()
    whitened = middles.axes / middles.sigmas_m[..., None]
    distinct = np.minimum(DISTINCT / np.bincount(lidar, minlength=lidars), 1.0)[lidar]
    moved = np.zeros((lidars, 6))
    now_R, now_t = R, t
    columns = 6 * lidar[:, None] + np.arange(6)
    for step in range(STEPS):
        points = np.einsum("jab,jb->ja", now_R, middles.points) + now_t
        if not step:
            centre = np.median(points, axis=0)
        r = np.einsum("jab,jb->ja", whitened, points - centre)
        norm = np.linalg.norm(r, axis=1)
        weight = distinct * np.minimum(HUBER_SIGMAS / np.maximum(norm, 1e-12), 1.0)
        J = np.zeros((count, 3, 6 * lidars + 3))
        by_guess = np.concatenate(
            [-np.einsum("jab,jbc->jac", now_R, skew(middles.points)), now_R], axis=2
        )
        J[np.arange(count)[:, None], :, columns] = np.swapaxes(whitened @ by_guess, 1, 2)
        J[:, :, -3:] = -whitened
        N = np.einsum("jai,j,jak->ik", J, weight, J) + np.diag(prior)
        g = np.einsum("jai,j,ja->i", J, weight, r)
        g[: 6 * lidars] += prior[: 6 * lidars] * moved.ravel()
        d = -np.linalg.solve(N, g)
        centre = centre + d[-3:]
        moved = moved + d[:-3].reshape(lidars, 6)
        errors = [gtsam.Pose3(gtsam.Rot3.Expmap(of[:3]), of[3:]) for of in moved]
        turn = np.array([T.rotation().matrix() for T in errors])[lidar]
        shift = np.array([T.translation() for T in errors])[lidar]
        now_R, now_t = R @ turn, t + np.einsum("jab,jb->ja", R, shift)
    points = np.einsum("jab,jb->ja", now_R, middles.points) + now_t
    left = np.einsum("jab,jb->ja", middles.axes, points - centre)
    motion = _excess(left[:, 1:], middles.sigmas_m[:, 1:])
    if motion is None:
        return np.zeros_like(t)
    total = middles.sigmas_m**2 + motion
    kept = middles.sigmas_m**2 / total
    # A pose that is off by itself, as after a jump of the fixes, says nothing of its cloud.
    kept[(np.abs(left) > FARTHEST * np.sqrt(total)).any(axis=1)] = 0.0
    return np.asarray(np.einsum("jba,jb->ja", middles.axes, kept * left))


def _excess(residuals: Array, sigmas: Array) -> float | None:
    """Variance of the motion, square metres: what residuals scatter more than by their sigmas.

    None: more than that of `MOST_MOTION_M`.
    """
    variances = np.square(np.geomspace(LEAST_MOTION_M, MOST_MOTION_M, 10))
    over = np.abs(residuals).ravel() / np.sqrt(sigmas.ravel() ** 2 + variances[:, None])
    fits = np.median(over, axis=1) < 1.0 / MAD
    return float(variances[int(fits.argmax())]) if fits.any() else None
