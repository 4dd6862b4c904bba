"""Coordinates of a vehicle's poses in which a turn of the vehicle frame is a straight line."""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array


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
        return np.concatenate([turn, T.translation() + R @ c - c - np.cross(turn, c)])

    def pose(self, d: Array) -> gtsam.Pose3:
        """The pose with coordinates d (6,)."""
        R, c = gtsam.Rot3.Expmap(d[:3]), self.pivot_vehicle
        return gtsam.Pose3(R, d[3:] - R.matrix() @ c + c + np.cross(d[:3], c))

    def derivative(self, T: gtsam.Pose3) -> Array:
        """(6, 6) of the coordinates of a pose by a right perturbation of it."""
        R, across = T.rotation().matrix(), skew(self.pivot_vehicle)
        by_turn = np.asarray(gtsam.Rot3.LogmapDerivative(gtsam.Rot3.Logmap(T.rotation())))
        out = np.zeros((6, 6))
        out[:3, :3] = by_turn
        out[3:, :3] = across @ by_turn - R @ across
        out[3:, 3:] = R
        return out
