"""Poses between given poses: cubic Hermite interpolation of positions and of rotation vectors.

Between two poses a straight line cuts every curve by `a T^2 / 8`, to the inside, in every scan: at
2 m/s^2 and 10 Hz by 2.5 mm, at 5 Hz by 10 mm.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from caliv_graph.geometry.se3 import cross
from caliv_graph.products import Array

MOST_M_S3, MOST_RAD_S3 = 20.0, 20.0
"""Accelerations of neighbouring poses that differ by more than this for each second between them,
and by more than `MOST_TIMES_USUAL`, are no motion of a vehicle but a jump of its poses: pieces
beside it do not know of each other. A body that heaves by 2 m/s^2 at 1.5 Hz has as much."""

MOST_TIMES_USUAL = 4.0
"""Times the median over a drive: noise of the poses has its own such differences, and is exceeded
once in 10^8. Chords would cut curves there as well."""

MOST_TIMES_LONGER = 2.5
"""A piece that is longer than its neighbour by more has no velocity from it: noise of the poses
in that, times its own length, is more than what it bends. One missing pose makes white noise 1.07
times that of a pose, two would make it 1.22."""


class PoseCurve:
    """Continuous poses with continuous velocities through given ones.

    The velocity at a pose is that of the parabola through it and its neighbours; between two poses
    a cubic polynomial has their values and velocities, of the position and of the rotation vector
    from the first. Where poses jump (`MOST_M_S3`, `MOST_RAD_S3`), or pieces are too unlike
    (`MOST_TIMES_LONGER`), each has its own mean velocity.
    """

    def __init__(self, seconds: Array, R: Array, t: Array) -> None:
        """Binds n poses, two at least.

        Args:
            seconds: (n,) their times, strictly ascending.
            R: (n, 3, 3) R_map_vehicle.
            t: (n, 3) t_map_vehicle, metres.
        """
        self._seconds, self._R, self._t = seconds, R, t
        self._steps = np.diff(seconds)
        turns = np.swapaxes(R[:-1], 1, 2) @ R[1:]
        self._turned = Rotation.from_matrix(turns).as_rotvec()
        # Rotation vectors from a pose to its neighbours: minus the turn since the one before.
        begin, end = _velocities(self._turned / self._steps[:, None], self._steps, MOST_RAD_S3)
        self._turning = begin, _as_change(self._turned, end)
        self._moved = np.diff(t, axis=0)
        self._moving = _velocities(self._moved / self._steps[:, None], self._steps, MOST_M_S3)

    def at(self, seconds: Array) -> tuple[Array, Array]:
        """R_map_vehicle (m, 3, 3) and t_map_vehicle (m, 3) at times (m,) within the poses' span."""
        k = np.clip(np.searchsorted(self._seconds, seconds, "right") - 1, 0, len(self._steps) - 1)
        step = self._steps[k][:, None]
        s = (seconds - self._seconds[k])[:, None] / step
        t = self._t[k] + _cubic(s, step, self._moved[k], *(v[k] for v in self._moving))
        turn = _cubic(s, step, self._turned[k], *(v[k] for v in self._turning))
        return self._R[k] @ Rotation.from_rotvec(turn).as_matrix().reshape(-1, 3, 3), t


def _cubic(s: Array, step: Array, change: Array, begin: Array, end: Array) -> Array:
    """(m, 3) from zero to `change` (m, 3) over `step` (m, 1) seconds, at parts s (m, 1) of it.

    `begin`, `end` (m, 3) are the velocities there.
    """
    square, cube = s * s, s * s * s
    by_speed = (cube - 2.0 * square + s) * begin + (cube - square) * end
    return np.asarray((3.0 * square - 2.0 * cube) * change + step * by_speed)


def _velocities(mean: Array, steps: Array, most: float) -> tuple[Array, Array]:
    """(n - 1, 3) velocities where pieces begin and where they end, of their means (n - 1, 3).

    The outermost are those of the parabola through three poses, too.
    """
    begin, end = mean.copy(), mean.copy()
    if len(mean) < 2:
        return begin, end
    h0, h1 = steps[:-1, None], steps[1:, None]
    half = (mean[1:] - mean[:-1]) / (h0 + h1)  # of the acceleration
    change = 2.0 * np.linalg.norm(np.diff(half, axis=0), axis=1)
    usual = float(np.median(change)) if len(change) else 0.0
    jumps = change > np.maximum(most * steps[1:-1], MOST_TIMES_USUAL * usual)
    half[np.append(jumps, False) | np.append(False, jumps)] = 0.0
    before = h0 * half * (h0 <= MOST_TIMES_LONGER * h1)
    after = h1 * half * (h1 <= MOST_TIMES_LONGER * h0)
    end[:-1] += before
    begin[1:] -= after
    begin[0] -= before[0]
    end[-1] += after[-1]
    return begin, end


def _as_change(turned: Array, rate: Array) -> Array:
    """(n, 3) changes per second of rotation vectors `turned` (n, 3), rad, by rates in body axes."""
    once = cross(turned, rate)
    return np.asarray(rate + 0.5 * once + cross(turned, once) / 12.0)
