"""Coordinates of a vehicle's poses in which a turn of the vehicle frame is a straight line."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array

SMALL_RAD = 0.3
SERIES = (1.0 / 12.0, 1.0 / 720.0, 1.0 / 30240.0, 1.0 / 1209600.0, 1.0 / 47900160.0)
"""Angle below which `(1 - angle cot(angle / 2) / 2) / angle^2` is a series in its square: to the
last digit, where the closed form loses some."""


@dataclass(frozen=True)
class PoseChart:
    """Coordinates d (6,) of poses `T0^-1 T`, to the first order right perturbations of T0.

    With the rotation R and the translation t of such a pose and c the pivot,
    `d = (phi, t + (R - I - [phi]x) c)`, `phi = Log R`. A turn a of the vehicle frame about c, which
    moves all poses from T to T a, changes t + R c of none: it moves all d alike, however far apart
    their shifts are. Logarithms of poses curve with the shift: the heave of each pose, held to the
    vertical, would tell a of 60 mrad to 6.

    Attributes:
        pivot_vehicle: (3,) c, metres: where the IMU is, which stays while its axes turn.
    """

    pivot_vehicle: Array = field(default_factory=lambda: np.zeros(3))

    def coordinates(self, T: gtsam.Pose3) -> Array:
        """(6,) of a pose: rad and m."""
        R, c = T.rotation().matrix(), self.pivot_vehicle
        turn = gtsam.Rot3.Logmap(T.rotation())
        return np.concatenate([turn, T.translation() + R @ c - c + self._across @ turn])

    def pose(self, d: Array) -> gtsam.Pose3:
        """The pose with coordinates d (6,)."""
        R, c = gtsam.Rot3.Expmap(d[:3]), self.pivot_vehicle
        return gtsam.Pose3(R, d[3:] - R.matrix() @ c + c - self._across @ d[:3])

    @cached_property
    def _across(self) -> Array:
        return skew(self.pivot_vehicle)

    def derivatives(self, d: Array) -> Array:
        """(m, 6, 6) of the coordinates of poses by right perturbations of them.

        All at once: the graph asks for those of every pose of a drive at every step.

        Args:
            d: (m, 6) the coordinates.
        """
        W = skew(d[:, :3])
        square = W @ W
        angle = np.sqrt(np.einsum("mi,mi->m", d[:, :3], d[:, :3]))[:, None, None]
        # sin(angle) / angle, and (1 - cos(angle)) / angle^2.
        by_once, by_twice = np.sinc(angle / np.pi), 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
        R = np.eye(3) + by_once * W + by_twice * square
        # The inverse of the right Jacobian of SO(3); its last factor cancels at small angles.
        of_square = np.polynomial.polynomial.polyval(np.minimum(angle, SMALL_RAD) ** 2, SERIES)
        exact = (1.0 - 0.5 * by_once / by_twice) / np.maximum(angle, SMALL_RAD) ** 2
        of_square = np.where(angle < SMALL_RAD, of_square, exact)
        out = np.zeros((len(d), 6, 6))
        out[:, :3, :3] = by_turn = np.eye(3) + 0.5 * W + of_square * square
        out[:, 3:, :3] = self._across @ by_turn - R @ self._across
        out[:, 3:, 3:] = R
        return out
