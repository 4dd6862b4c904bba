"""Score tests on the solved graph: is an extrinsic the same in all parts of the data?

A wrong stamp or a moved mount shows as a difference between parts of the data that should agree;
the difference is a parameter that the model leaves out (Rao 1948). The derivation is in
`caliv_graph/calibration/README.md`, "Score tests".
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg

from caliv_graph.errors import SolveError
from caliv_graph.geometry.se3 import right_to_vehicle_axes
from caliv_graph.products import Array, LinearisedGraph, Solution
from caliv_graph.trajectory.select import VehicleTrajectory, twists_at
from caliv_graph.uncertainty.consistency import ScoreTest, ScoreTestKind
from caliv_graph.uncertainty.suspects import RIDGE

MIN_YAW_RATE_RAD_S = 0.02
"""A cloud with a larger yaw rate was taken in a turn: 2 m/s on a radius of 100 m."""

MIN_CLOUDS = 4
"""In each of two parts, for a test of their difference."""


def score_tests(
    solution: Solution,
    trajectories: Sequence[VehicleTrajectory],
    trusted: Sequence[str] = (),
) -> tuple[ScoreTest, ...]:
    """Tests parameters that the model leaves out (Rao 1948).

    Per LiDAR the difference of its extrinsic between the first and the second half of its clouds,
    and between left and right turns; the offset of its clock, unless it was estimated; and, if it
    is one of `trusted` (`fixed: true`), the correction of its extrinsic that its clouds ask for. A
    test for which there are too few clouds is left out. `trajectories` are one per drive.

    Raises:
        SolveError: the graph is singular.
    """
    clouds = CloudParts(solution, trajectories)
    parameters = [
        (name, kind, columns)
        for name in solution.lidars
        for kind, columns in clouds.parameters(name, name in trusted)
    ]
    if not parameters:
        return ()
    D, c = _score(solution.linearised, np.concatenate([p[-1] for p in parameters], axis=1))
    out, start = [], 0
    for name, kind, columns in parameters:
        part = slice(start, start + columns.shape[1])
        start = part.stop
        out.append(ScoreTest(name, kind, D[part, part], c[part]))
    return tuple(out)


def _score(graph: LinearisedGraph, columns: Array) -> tuple[Array, Array]:
    """Information (k, k) and gradient (k,) of left-out parameters, all variables eliminated.

    `columns` (6 J, k): derivatives of the clouds' poses. The guesses add information, no gradient.
    """
    H = graph.information + graph.information_guesses
    seen = graph.cloud_information @ columns
    # Units differ by a million: the ridge is relative to each variable's own information.
    unit = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-12))
    H = H * np.outer(unit, unit)
    H[np.diag_indices_from(H)] += RIDGE
    try:
        factor = scipy.linalg.cho_factor(H, lower=True, overwrite_a=True, check_finite=False)
    except scipy.linalg.LinAlgError:
        raise SolveError("the graph at the estimate is singular") from None
    cross = np.column_stack([graph.cloud_jacobian.T @ seen, graph.gradient]) * unit[:, None]
    solved = scipy.linalg.cho_solve(factor, cross, check_finite=False)
    D = columns.T @ seen - cross[:, :-1].T @ solved[:, :-1]
    c = -columns.T @ graph.cloud_gradient - cross[:, :-1].T @ solved[:, -1]
    return 0.5 * (D + D.T), c


class CloudParts:
    """When and by which LiDAR the clouds were taken, and the derivatives of their poses."""

    def __init__(self, solution: Solution, trajectories: Sequence[VehicleTrajectory]) -> None:
        """Of a solved graph; `trajectories` are one per drive."""
        self.solution = solution
        observed = [c for r in solution.registrations for c in r.observation.clouds]
        self.lidar = np.array([solution.lidars.index(c.lidar) for c in observed], np.int64)
        self.place = [(c.drive, c.stamp_ns) for c in observed]
        self.weighs = np.concatenate([np.zeros(0), *solution.cloud_weights]) > 0.01
        self.twists = np.zeros((len(observed), 6))
        for drive in sorted({d for d, _ in self.place}):
            mine = [j for j, (d, _) in enumerate(self.place) if d == drive]
            stamps = [self.place[j][1] for j in mine]
            self.twists[mine] = twists_at(trajectories[drive], stamps)

    def parameters(self, name: str, trusted: bool) -> list[tuple[ScoreTestKind, Array]]:
        """(6 J, k) derivatives of all clouds' poses with respect to each test's parameters."""
        own = self.lidar == self.solution.lidars.index(name)
        mine = np.flatnonzero(own & self.weighs)
        if len(mine) < 2 * MIN_CLOUDS:
            return []
        out: list[tuple[ScoreTestKind, Array]] = []
        order = sorted(mine.tolist(), key=lambda j: self.place[j])
        side = np.zeros(len(own))
        side[order[: len(order) // 2]], side[order[len(order) // 2 :]] = 0.5, -0.5
        out.append(("halves", self._by_extrinsic(name, side)))
        rate = np.where(own & self.weighs, self.twists[:, 2], 0.0)
        side = 0.5 * np.sign(rate) * (np.abs(rate) > MIN_YAW_RATE_RAD_S)
        if min((side > 0.0).sum(), (side < 0.0).sum()) >= MIN_CLOUDS:
            out.append(("turns", self._by_extrinsic(name, side)))
        if trusted:
            out.append(("trust", self._by_extrinsic(name, own * 1.0)))
        if name not in self.solution.time_offsets:
            # A cloud whose stamp is late was taken where the vehicle was before.
            by_vehicle = self.solution.linearised.by_vehicle
            late = -np.einsum("jab,jb->ja", by_vehicle, self.twists) * (own & self.weighs)[:, None]
            out.append(("clock", late.reshape(-1, 1)))
        return out

    def _by_extrinsic(self, name: str, side: Array) -> Array:
        """(6 J, 6) by the LiDAR's extrinsic, vehicle axes, times (J,) a factor of each cloud."""
        to_right = right_to_vehicle_axes(self.solution.T_vehicle_lidar[name]).T
        columns = side[:, None, None] * (self.solution.linearised.by_extrinsic @ to_right)
        return np.asarray(columns.reshape(-1, 6))
