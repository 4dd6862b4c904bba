"""Is the mounting the same in one part of the data as in the other? Score tests on the graph.

A wrong stamp or a cloud that is not where it was measured does not show in a residual that the
noise levels were fitted to. It shows as a difference between parts of the data that should tell the
same: the first half of a LiDAR's clouds against the second, left turns against right turns. Each
such difference is a parameter that the model leaves out. What it would come out as, were it let in,
follows from one linearisation at the estimate, all else free to follow (Rao 1948, score test).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np
import scipy.linalg
import scipy.sparse

from caliv_graph.calibration.graph import add_gauge_prior
from caliv_graph.calibration.robust import FAR_OFF
from caliv_graph.errors import SolveError
from caliv_graph.geometry.se3 import right_to_vehicle_axes
from caliv_graph.products import Array, IntArray, Solution
from caliv_graph.trajectory.select import VehicleTrajectory, twists_at
from caliv_graph.uncertainty.consistency import (
    Assumed,
    AssumedKind,
    CloudCount,
    ScoreTest,
    ScoreTestKind,
)

LEAST_TURN_RAD_S = 0.02
"""Yaw rate from which a cloud was taken in a turn: 2 m/s on a radius of 100 m."""

LEAST_CLOUDS = 4
"""Of each of two parts, for a difference between them to be one."""

_CLOUD, _GUESS = ("c", "x", "e"), (("e",), ("e", "s"))
"""Letters of the keys of a cloud's factor, time offset and S_a aside, and of a guess's."""

_RIDGE = 1e-9


def score_tests(
    solution: Solution,
    trajectories: Sequence[VehicleTrajectory],
    trusted: Sequence[str] = (),
) -> tuple[ScoreTest, ...]:
    """What differs between parts of the data that should tell the same.

    Args:
        solution: the solved graph.
        trajectories: one per drive, for the velocities.
        trusted: LiDARs whose mounting was taken as it stands (`fixed: true`).

    Returns:
        Per LiDAR: first against second half of its clouds; left against right turns; its clock
        against that of the vehicle, unless its offset was estimated; and, if it is trusted, its
        clouds against its mounting. What there are too few clouds for is left out.

    Raises:
        SolveError: the graph is singular.
    """
    clouds = _Clouds(solution, trajectories)
    kinds: list[tuple[str, ScoreTestKind, Array]] = []
    for name in solution.lidars:
        kinds += [(name, kind, columns) for kind, columns in clouds.columns(name, name in trusted)]
    if not kinds:
        return ()
    system = _System(solution, clouds)
    D, c = system.score(np.concatenate([columns for *_, columns in kinds], axis=1))
    out, start = [], 0
    for name, kind, columns in kinds:
        part = slice(start, start + columns.shape[1])
        start = part.stop
        out.append(ScoreTest(name, kind, D[part, part], c[part]))
    return tuple(out)


class _Clouds:
    """The clouds' factors: residuals, joint information, Jacobians."""

    def __init__(self, solution: Solution, trajectories: Sequence[VehicleTrajectory]) -> None:
        self.solution = solution
        observed = [c for r in solution.registrations for c in r.observation.clouds]
        self.lidar = np.array([solution.lidars.index(c.lidar) for c in observed])
        self.place = [(c.drive, c.stamp_ns) for c in observed]
        self.weights = np.concatenate(solution.cloud_weights)
        self.twists = np.zeros((len(observed), 6))
        for drive in sorted({d for d, _ in self.place}):
            mine = [j for j, (d, _) in enumerate(self.place) if d == drive]
            stamps = [self.place[j][1] for j in mine]
            self.twists[mine] = twists_at(trajectories[drive], stamps)
        scale2 = solution.registration_scale**2
        information = np.concatenate([r.information for r in solution.registrations]) / scale2
        white = np.concatenate(solution.residuals)
        root = np.linalg.cholesky(information)
        r = np.linalg.solve(np.swapaxes(root, 1, 2), white[..., None])[..., 0]
        weighted = information * self.weights[:, None, None]
        joint = scipy.linalg.block_diag(
            *(each.information_joint / scale2 for each in solution.registrations)
        )
        if solution.mode == "staged":
            each = np.repeat(np.sqrt(self.weights), 6)
            self.H = joint * np.outer(each, each)
            self.gradient = self.H @ r.ravel()
        else:
            # The shape's part has the weights in it, the clouds' own part has not.
            self.H = joint - scipy.linalg.block_diag(*(information - weighted))
            self.gradient = np.einsum("jab,jb->ja", weighted, r).ravel()
        self.keys, self.jacobians = self._jacobians(weighted)

    def _jacobians(self, weighted: Array) -> tuple[list[list[int]], list[list[Array]]]:
        """Per cloud the keys it depends on, and its pose's (6, size) left perturbation by each."""
        graph, values = self.solution.graph, self.solution.values
        keys, jacobians = [], []
        for j, index in enumerate(_cloud_factors(graph)):
            factor = graph.at(index)
            order = list(factor.keys())
            # `getA` may look into the factor's own memory: it has to live on.
            linear: Any = factor.linearize(values)
            A = np.linalg.solve(np.linalg.cholesky(weighted[j]).T, np.array(linear.getA()))
            sizes = [1 if gtsam.symbolChr(k) == ord("o") else 6 for k in order]
            keys.append(order)
            jacobians.append(np.split(A, np.cumsum(sizes)[:-1], axis=1))
        return keys, jacobians

    def columns(self, name: str, trusted: bool) -> list[tuple[ScoreTestKind, Array]]:
        """(6 J, k) derivatives of all clouds' poses by what a contrast lets differ."""
        lidar = self.solution.lidars.index(name)
        mine = np.flatnonzero((self.lidar == lidar) & (self.weights > 0.01))
        if len(mine) < 2 * LEAST_CLOUDS:
            return []
        turn_axes = right_to_vehicle_axes(self.solution.T_vehicle_lidar[name]).T
        out: list[tuple[ScoreTestKind, Array]] = []
        order = sorted(mine.tolist(), key=lambda j: self.place[j])
        side = np.zeros(len(self.lidar))
        side[order[: len(order) // 2]], side[order[len(order) // 2 :]] = 0.5, -0.5
        out.append(("halves", self._by_extrinsic(side, turn_axes)))
        rate = np.where(self.lidar == lidar, self.twists[:, 2], 0.0) * (self.weights > 0.01)
        side = 0.5 * np.sign(rate) * (np.abs(rate) > LEAST_TURN_RAD_S)
        if min((side > 0.0).sum(), (side < 0.0).sum()) >= LEAST_CLOUDS:
            out.append(("turns", self._by_extrinsic(side, turn_axes)))
        if trusted:
            out.append(("trust", self._by_extrinsic((self.lidar == lidar) * 1.0, turn_axes)))
        if name not in self.solution.time_offsets:
            late = np.zeros((len(self.lidar), 6, 1))
            for j in mine.tolist():
                # Stamps that are late were taken where the vehicle was before.
                late[j, :, 0] = -self.jacobians[j][1] @ self.twists[j]
            out.append(("clock", late.reshape(-1, 1)))
        return out

    def _by_extrinsic(self, side: Array, turn_axes: Array) -> Array:
        columns = np.zeros((len(side), 6, 6))
        for j in np.flatnonzero(side).tolist():
            columns[j] = side[j] * self.jacobians[j][-1] @ turn_axes
        return columns.reshape(-1, 6)


class _System:
    """The linearised graph at the estimate, the guesses as a ridge and without a pull.

    Along what the data determine the estimate does not heed the guesses (mode `auto`); along the
    rest something has to hold it.
    """

    def __init__(self, solution: Solution, clouds: _Clouds) -> None:
        graph = solution.graph
        of_clouds = set(_cloud_factors(graph))
        steady, guesses = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
        for index in range(graph.size()):
            if index not in of_clouds:
                factor = graph.at(index)
                (guesses if _letters(factor) in _GUESS else steady).add(factor)
        H, b, columns = _dense(steady, solution.values)
        size = len(b)
        for key in [*(k for keys in clouds.keys for k in keys), *guesses.keyVector()]:
            if key not in columns:  # a target, or a mounting that no ground ties
                columns[key] = slice(size, size + 6)
                size += 6
        self._H, self._b = np.zeros((size, size)), np.zeros(size)
        self._H[: len(b), : len(b)], self._b[: len(b)] = H, b
        H, _, of_guesses = _dense(guesses, solution.values)
        for first, at in of_guesses.items():
            for second, across in of_guesses.items():
                self._H[columns[first], columns[second]] += H[at, across]
        J = _stacked(clouds, columns, size)
        self._coupled = J.T @ clouds.H
        self._H += J.T @ self._coupled.T
        add_gauge_prior(self._H, {key: where.start for key, where in columns.items()})
        self._b -= J.T @ clouds.gradient
        self._clouds = clouds

    def score(self, columns: Array) -> tuple[Array, Array]:
        """Information (k, k) and gradient (k,) of parameters left out, all else eliminated.

        Args:
            columns: (6 J, k) derivatives of the clouds' poses by them.
        """
        cross = self._coupled @ columns
        own = columns.T @ self._clouds.H @ columns
        pull = -columns.T @ self._clouds.gradient
        # Units differ by a million: the ridge is relative to each variable's own information.
        unit = 1.0 / np.sqrt(np.maximum(np.diag(self._H), 1e-12))
        H = self._H * np.outer(unit, unit)
        H[np.diag_indices_from(H)] += _RIDGE
        try:
            factor = scipy.linalg.cho_factor(H, lower=True, overwrite_a=True, check_finite=False)
        except scipy.linalg.LinAlgError:
            raise SolveError("the graph at the estimate is singular") from None
        right = unit[:, None] * np.column_stack([cross, self._b])
        solved = scipy.linalg.cho_solve(factor, right, check_finite=False)
        D = own - right[:, :-1].T @ solved[:, :-1]
        return 0.5 * (D + D.T), pull - right[:, :-1].T @ solved[:, -1]


def _dense(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values
) -> tuple[Array, Array, dict[int, slice]]:
    """Hessian and right side of a graph, the slow errors of given poses eliminated.

    These form chains, which GTSAM eliminates sparsely.
    """
    if not graph.size():
        return np.zeros((0, 0)), np.zeros(0), {}
    linear = graph.linearize(values)
    drifts = [key for key in graph.keyVector() if gtsam.symbolChr(key) == ord("d")]
    if drifts:
        _, linear = linear.eliminatePartialMultifrontal(drifts)
    zero = values.zeroVectors()
    ordering, columns, size = gtsam.Ordering(), {}, 0
    for key in graph.keyVector():
        if gtsam.symbolChr(key) != ord("d"):
            ordering.push_back(key)
            columns[key] = slice(size, size + zero.at(key).size)
            size = columns[key].stop
    H, b = linear.hessian(ordering)
    return np.asarray(H), np.asarray(b).ravel(), columns


def _stacked(clouds: _Clouds, columns: dict[int, slice], size: int) -> scipy.sparse.csr_array:
    """(6 J, size) of all clouds' poses by all variables."""
    entries: dict[str, list[Array | IntArray]] = defaultdict(list)
    for j, (keys, jacobians) in enumerate(zip(clouds.keys, clouds.jacobians, strict=True)):
        for key, jacobian in zip(keys, jacobians, strict=True):
            row, column = np.indices(jacobian.shape)
            entries["row"].append((6 * j + row).ravel())
            entries["column"].append((columns[key].start + column).ravel())
            entries["value"].append(jacobian.ravel())
    place = tuple(np.concatenate(entries[axis]) for axis in ("row", "column"))
    return scipy.sparse.csr_array(
        (np.concatenate(entries["value"]), place), shape=(len(clouds.gradient), size)
    )


def _letters(factor: gtsam.NonlinearFactor) -> tuple[str, ...]:
    return tuple(chr(gtsam.symbolChr(key)) for key in factor.keys())  # noqa: SIM118


def _cloud_factors(graph: gtsam.NonlinearFactorGraph) -> list[int]:
    """Places of the clouds' factors in the graph, in the clouds' order."""
    return [
        index
        for index in range(graph.size())
        if tuple(letter for letter in _letters(graph.at(index)) if letter not in "os") == _CLOUD
    ]


# ------------------------------------------------------------------ what else the tests look at


def cloud_counts(
    solution: Solution, trajectories: Sequence[VehicleTrajectory]
) -> tuple[CloudCount, ...]:
    """Per LiDAR, how many of its clouds do not fit, where in the drive, and where they lie.

    Args:
        solution: the solved graph.
        trajectories: one per drive, for the yaw rates.
    """
    observed = [c for r in solution.registrations for c in r.observation.clouds]
    weights = np.concatenate(solution.cloud_weights)
    down = weights < 0.5
    if solution.mode != "staged":  # which puts the translation back to the guess: nothing fits
        down |= (np.concatenate(solution.residuals) ** 2).sum(axis=1) > FAR_OFF
    middles, turns, rates = _middles(solution), [], []
    for cloud in observed:
        rates.append(twists_at(trajectories[cloud.drive], [cloud.stamp_ns])[0, 2])
        turns.append(solution.T_map_vehicle[cloud.drive, cloud.stamp_ns].rotation().matrix())
    rate = np.array(rates)
    out = []
    for name in solution.lidars:
        mine = np.array([j for j, c in enumerate(observed) if c.lidar == name], np.int64)
        if not len(mine):
            continue
        mine = mine[np.argsort([observed[j].stamp_ns for j in mine], kind="stable")]

        def part(which: IntArray) -> tuple[int, int]:
            return len(which), int(down[which].sum())

        lost = mine[down[mine]]
        offset = None
        if len(lost) and not down.all():
            usual = np.median(middles[~down], axis=0)
            offset = np.median([turns[j].T @ (middles[j] - usual) for j in lost], axis=0)
        out.append(
            CloudCount(
                name,
                *part(mine),
                left=part(mine[rate[mine] > LEAST_TURN_RAD_S]),
                right=part(mine[rate[mine] < -LEAST_TURN_RAD_S]),
                early=part(mine[: len(mine) // 2]),
                late=part(mine[len(mine) // 2 :]),
                offset_vehicle=offset,
            )
        )
    return tuple(out)


def _middles(solution: Solution) -> Array:
    """(J, 3) middle of the extent of each cloud, map axes, from its target's origin."""
    out = []
    for T_target_map, registration in zip(
        solution.T_target_map, solution.registrations, strict=True
    ):
        centre = T_target_map.inverse().translation()
        for cloud in registration.observation.clouds:
            T = solution.T_map_vehicle[cloud.drive, cloud.stamp_ns]
            T = T.compose(solution.T_vehicle_lidar[cloud.lidar])
            points = T.transformFrom(cloud.points_lidar.T).T
            low, high = np.percentile(points, [5, 95], axis=0)
            out.append(0.5 * (low + high) - centre)
    return np.array(out)


def registration_sigma(solution: Solution) -> tuple[float, float]:
    """Sigma per axis of the median cloud's registration, scaled: rotation (rad), position (m)."""
    information = np.concatenate([r.information for r in solution.registrations])
    variance = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)
    sigma = np.sqrt(np.median(variance.reshape(-1, 2, 3).mean(axis=2), axis=0))
    turn, shift = (solution.registration_scale * sigma).tolist()
    return turn, shift


def assumptions(solution: Solution, drives: Sequence[str]) -> tuple[Assumed, ...]:
    """What the ground was assumed to tell of the vehicle, and what it came out as.

    Args:
        solution: the solved graph.
        drives: what to call them.
    """
    out = []
    for index in range(solution.graph.size()):
        factor: Any = solution.graph.at(index)
        letters = _letters(factor)
        if letters not in (("h",), ("p",)):
            continue
        drive = drives[gtsam.symbolIndex(factor.keys()[0])]
        raw = factor.unwhitenedError(solution.values)
        sigmas = raw / np.where(raw == 0.0, 1.0, factor.whitenedError(solution.values))
        if letters == ("h",):
            kinds: list[AssumedKind] = ["height"]
        else:
            kinds = ["tilt_x", "tilt_y"]
        for kind, value, sigma in zip(kinds, raw.tolist(), sigmas.tolist(), strict=True):
            if value:
                out.append(Assumed(drive, kind, value, abs(sigma)))
    return tuple(out)


def typical_speed(solution: Solution, trajectories: Sequence[VehicleTrajectory]) -> float:
    """Median speed of the vehicle over the clouds, m/s."""
    return float(
        np.median(
            [
                np.linalg.norm(twists_at(trajectories[drive], [stamp])[0, 3:])
                for drive, stamp in solution.T_map_vehicle
            ]
        )
    )
