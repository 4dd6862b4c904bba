"""What the motion data say of the vehicle's poses: the prior under which structure is solved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
import scipy.sparse

from caliv_graph.geometry.chart import PoseChart
from caliv_graph.products import Array, IntArray
from caliv_graph.structure.elimination import marginal
from caliv_graph.trajectory.rates import rate_rows, with_rates

POSES_TOGETHER = 32
"""Poses whose rows are turned at a time: temporary memory is small."""


@dataclass(frozen=True)
class PosePrior:
    """What the motion data of one drive say of m poses and of parameters of the vehicle.

    Minus the log-likelihood is `d^T information d / 2 - gradient^T d`. d are coordinates of the
    poses (`chart`; rotation then translation, rad and m), then p of the parameters: metres of the
    lever arm, right perturbation of R_vehicle_imu, seconds of a clock; and, where points were moved
    by the rates of the trajectory, of the errors of these (`trajectory.rates.RATES`). Heave of the
    body, a sigma of its own at each pose, is part of the poses; the priors of the parameters are
    apart.

    Attributes:
        stamps_ns: (m,) of the poses, strictly increasing.
        T_map_vehicle: m poses at which d is zero, the drive's map.
        parameters: name of the input (`gnss.lever_arm`, `imu.T_vehicle_imu`) -> the value at which
            d is zero: (3,) metres, R_vehicle_imu, or (1,) seconds. Empty: none is uncertain.
        information: (6 m + p, 6 m + p), positive definite with `parameter_information` added; with
            rates RATES more.
        gradient: (6 m + p,), or RATES more.
        parameter_information: (p, p) of the priors of the parameters, one for all drives.
        parameter_offset: (p,) the present values less the means of these priors: the priors add
            `parameter_information` and `-parameter_information parameter_offset`.
        chart: of the poses.
    """

    stamps_ns: IntArray
    T_map_vehicle: tuple[gtsam.Pose3, ...]
    parameters: Mapping[str, Array | gtsam.Rot3]
    information: Array
    gradient: Array
    parameter_information: Array
    parameter_offset: Array
    chart: PoseChart = field(default_factory=PoseChart)

    @property
    def rates(self) -> int:
        """Number of coordinates of the errors of the rates, the last ones: RATES or none."""
        poses, parameters = 6 * len(self.stamps_ns), len(self.parameter_information)
        return len(self.gradient) - poses - parameters

    def with_rates(self) -> PosePrior:
        """The same with the errors of the rates (`trajectory.rates`), where the poses tell them."""
        # Residuals turn the axes about that pivot (`residuals._turned`): what it makes of the
        # velocity of the origin is in them already.
        rows = rate_rows(self.stamps_ns, self.T_map_vehicle, self.chart.pivot_vehicle)
        if rows is None:
            return self
        information, gradient = with_rates(self.information, self.gradient, rows)
        return replace(self, information=information, gradient=gradient)

    def at(self, moved: Array) -> tuple[Array, Array]:
        """H and b of `e^T H e / 2 - b^T e`, e from d = `moved`: of poses right perturbations there.

        The derivative of d is not 1 where a pose is turned.
        """
        if not moved.any():
            return self.information, self.gradient
        H, b = np.zeros_like(self.information), np.zeros_like(self.gradient)
        self.add_to(H, b, moved)
        return H, b

    def add_to(self, H: Array, b: Array, moved: Array) -> None:
        """Adds `at(moved)` to the first coordinates of a quadratic, in place."""
        size, poses = len(self.gradient), 6 * len(self.stamps_ns)
        by_now = self.by_now(moved)
        b[:size] += _turned((self.gradient - self.information @ moved)[None], by_now)[0]
        # Some rows at a time: temporary memory is small.
        for begin in range(0, len(by_now), POSES_TOGETHER):
            some = by_now[begin : begin + POSES_TOGETHER]
            own = slice(6 * begin, 6 * (begin + len(some)))
            rows = np.swapaxes(some, 1, 2) @ self.information[own].reshape(-1, 6, size)
            H[own, :size] += _turned(rows.reshape(-1, size), by_now)
        H[poses:size, :size] += _turned(self.information[poses:], by_now)

    def marginal_at(self, moved: Array, kept: IntArray) -> tuple[Array, Array]:
        """`at(moved)` on the poses `kept` (k,) and the p parameters, all else eliminated.

        Information (6 k + p, 6 k + p) and gradient. What is eliminated may be in any coordinates:
        no copy of all of it is made.
        """
        m, p = len(self.stamps_ns), len(self.parameter_information)
        poses = (6 * kept[:, None] + np.arange(6)).ravel()
        own = np.concatenate([poses, 6 * m + np.arange(p)])
        rest = np.setdiff1d(np.arange(len(self.gradient)), own)
        H, b = marginal(self.information, self.gradient, own, rest)
        blocks = [*self.by_now(moved)[kept], np.eye(p)]
        J = scipy.sparse.csr_array(scipy.sparse.block_diag(blocks))
        at = J.T @ (J.T @ H).T
        return 0.5 * (at + at.T), J.T @ (b - H @ moved[own])

    def by_now(self, moved: Array) -> Array:
        """(m, 6, 6) derivatives of the poses' part of d at `moved`."""
        return self.chart.derivatives(moved[: 6 * len(self.stamps_ns)].reshape(-1, 6))


def _turned(rows: Array, by_now: Array) -> Array:
    """Rows (n, 6 m + k) with the columns of each pose multiplied by its derivatives."""
    size = 6 * len(by_now)
    of_poses = rows[:, :size].reshape(len(rows), len(by_now), 6).swapaxes(0, 1) @ by_now
    return np.hstack([of_poses.swapaxes(0, 1).reshape(len(rows), size), rows[:, size:]])
