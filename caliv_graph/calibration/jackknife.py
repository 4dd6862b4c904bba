"""Scale of the registration's sigmas by a jackknife over views.

The joint information of the clouds holds responsibilities and surfels' widths, and takes the errors
of different clouds for independent. What that makes of the sigmas the clouds themselves tell: parts
of them are left out in turn, shape and extrinsics estimated again, and the scatter of the estimates
compared with what the information claims (Tukey 1958; `caliv_graph/calibration/README.md`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.calibration.linear import CloudLinearisation
from caliv_graph.calibration.problem import Problem
from caliv_graph.config.guesses import DEFAULT_GUESS_SIGMAS
from caliv_graph.geometry.se3 import retract_vehicle_axes, right_to_vehicle_axes, stack
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.registration.moments import Responsibilities
from caliv_graph.registration.register import JointRegistration

GROUPS = 4
"""Parts of the clouds that are left out in turn: three degrees of freedom for each of twelve
coordinates of two LiDARs give the scale to a tenth."""

TOGETHER = 2
"""Clouds of a LiDAR in a row that are left out together: neighbours have beams on nearly the same
spots. One by one where a LiDAR has fewer than `MANY_VIEWS`."""

MANY_VIEWS = 3 * GROUPS * TOGETHER
"""Different views of a LiDAR that give three pairs to each part."""

ROUNDS = 5
"""Rounds of expectation-maximisation without a part: what is missing of the way to its end is a
tenth on sparse clouds. Fewer where the scale will not come to 1, below which it does not count."""

LEAST_LIDAR_CLOUDS = 2 * GROUPS
"""Clouds of every LiDAR for a jackknife: two of each part. As many views, too."""

NO_SAY = 1e-3
"""Robust weight up to which a cloud is none to the jackknife: without it nothing changes. One of
0.05 to 0.5 has less of a say, but leaving it out tells something."""

SCANS_OF_A_VIEW = 1.5
"""Scans of each view at most, in the mean, where a LiDAR has fewer than `MANY_VIEWS`: left out one
by one, scans of one view are in all parts, and what they share does not show."""


def jackknife_scale(
    problem: Problem,
    extrinsics: Sequence[gtsam.Pose3],
    states: Sequence[JointRegistration],
    lines: CloudLinearisation,
) -> float:
    """Factor on the registration's sigmas, at least 1, by leaving out parts of the clouds.

    The poses of the vehicle stay: their noise is not the registration's. 1 if there are few clouds,
    or few different views: scans of one view share their errors, and leaving out some of them does
    not show these.

    Args:
        problem: LiDARs and clouds.
        extrinsics: T_vehicle_lidar of its LiDARs, the solution.
        states: the registration of each placement at the solution; they stay as they are.
        lines: predicted poses of the clouds there.
    """
    say = np.concatenate([state.weights > NO_SAY for state in states])
    if not _tell(problem, say):
        return 1.0
    # Where the data tell nothing, wide guesses would let the parts wander off along what they do
    # not determine, and the way is curved.
    usual = np.tile(DEFAULT_GUESS_SIGMAS**-2.0, len(problem.lidars))
    prior = np.maximum(problem.guess_information(), np.diag(usual))
    parts = _parts(problem, states, lines, say)
    every = _placements(problem, extrinsics, states, lines, parts)
    H, _ = _system(every, extrinsics)
    known = np.linalg.solve(H + prior, H)
    claimed = float(np.trace(known @ known))
    if claimed <= 1.0:
        return 1.0
    rests = []
    for g in range(GROUPS):
        kept = [[part for part in of if part.group != g] for of in parts]
        placements = _placements(problem, extrinsics, states, lines, kept)
        rests.append(_Rest(placements, extrinsics, prior))
    scales: list[float] = []
    while len(scales) < ROUNDS and not _stays_below_one(scales):
        ends = np.array([rest.further() for rest in rests])
        scatter = ends - ends.mean(axis=0)
        found = (GROUPS - 1) / GROUPS * float(np.einsum("ga,ab,gb->", scatter, H, scatter))
        scales.append(math.sqrt(found / claimed))
    return max(scales[-1], 1.0)


def _stays_below_one(scales: Sequence[float]) -> bool:
    """Whether the rounds that are left cannot bring the scale to 1, by those before.

    The parts come to rest: a round moves them by less than the one before it.
    """
    if len(scales) < 2:
        return False
    left = ROUNDS - len(scales)
    return scales[-1] + left * max(scales[-1] - scales[-2], 0.0) < 1.0


def _distinct_views(problem: Problem, say: BoolArray) -> Array:
    """(n,) different views of each LiDAR: scans of one view count as one.

    Clouds (J,) that have no `say` are none.
    """
    each = say / problem.all_views()
    distinct = np.bincount(problem.cloud_lidar, each, minlength=len(problem.lidars))
    return np.asarray(np.round(distinct, 6))  # three thirds are one


def _tell(problem: Problem, say: BoolArray) -> bool:
    """Whether every LiDAR with clouds has enough of different views for a jackknife."""
    distinct = _distinct_views(problem, say)
    count = np.bincount(problem.cloud_lidar, say, minlength=len(problem.lidars))
    few = (distinct >= LEAST_LIDAR_CLOUDS) & (count <= SCANS_OF_A_VIEW * distinct)
    return bool(((distinct >= MANY_VIEWS) | few)[count > 0].all())


def _groups(problem: Problem, say: BoolArray) -> IntArray:
    """(J,) part that each cloud belongs to: runs of `TOGETHER` clouds of a LiDAR, in turn.

    From placement to placement the turn goes on. Clouds that have no `say` are in the first.
    """
    out = np.zeros(problem.clouds, dtype=np.int64)
    in_a_row = np.where(_distinct_views(problem, say) < MANY_VIEWS, 1, TOGETHER)
    for a, together in enumerate(in_a_row.tolist()):
        runs = 0
        for m in range(problem.placements):
            of_lidar = say & (problem.cloud_lidar == a)
            own = np.flatnonzero(of_lidar & (problem.cloud_placement == m))
            own = own[np.argsort(problem.cloud_pose[own], kind="stable")]
            number = runs + np.arange(len(own)) // together
            out[own] = number % GROUPS
            runs = int(number.max(initial=runs - 1)) + 1
    return out


@dataclass(frozen=True)
class _Part:
    """The clouds of a placement that are left out together.

    Attributes:
        group: number of the part.
        which: (n,) their indices in the placement.
        expected: their E-step at the solution, where they do not depend on the other clouds.
    """

    group: int
    which: IntArray
    expected: Responsibilities


def _parts(
    problem: Problem,
    states: Sequence[JointRegistration],
    lines: CloudLinearisation,
    say: BoolArray,
) -> list[list[_Part]]:
    """The parts of every placement, without those that are empty."""
    group = _groups(problem, say)
    out = []
    for own, state in zip(problem.clouds_of_placements(), states, strict=True):
        R, t = stack(lines.predicted[own])
        of_placement = []
        for g in range(GROUPS):
            which = np.flatnonzero(group[own] == g)
            if len(which):
                expected = state.only(which).responsibilities(R[which], t[which])
                of_placement.append(_Part(g, which, expected))
        out.append(of_placement)
    return out


@dataclass(frozen=True)
class _Placement:
    """Clouds of a placement, and where the vehicle was.

    Attributes:
        state: their registration, a copy.
        lidar: (J,) index of the LiDAR of each.
        T_target_vehicle: J poses.
        expected: their E-step at the solution.
    """

    state: JointRegistration
    lidar: IntArray
    T_target_vehicle: tuple[gtsam.Pose3, ...]
    expected: Responsibilities

    def poses(self, extrinsics: Sequence[gtsam.Pose3]) -> tuple[Array, Array, Array]:
        """Poses of the clouds (J, 3, 3) and (J, 3), and (J, 6, 6 n) their derivatives.

        Left perturbations by those of the extrinsics in vehicle axes.
        """
        axes = [right_to_vehicle_axes(T).T for T in extrinsics]
        J = np.zeros((len(self.lidar), 6, 6 * len(extrinsics)))
        predicted = []
        for j, (a, T) in enumerate(zip(self.lidar.tolist(), self.T_target_vehicle, strict=True)):
            Z = T.compose(extrinsics[a])
            predicted.append(Z)
            J[j, :, 6 * a : 6 * a + 6] = Z.AdjointMap() @ axes[a]
        return (*stack(predicted), J)


def _placements(
    problem: Problem,
    extrinsics: Sequence[gtsam.Pose3],
    states: Sequence[JointRegistration],
    lines: CloudLinearisation,
    kept: Sequence[Sequence[_Part]],
) -> list[_Placement]:
    """Every placement with those of its parts that are kept; none without clouds."""
    out = []
    for own, state, parts in zip(problem.clouds_of_placements(), states, kept, strict=True):
        if parts:
            which = np.concatenate([part.which for part in parts])
            lidar = problem.cloud_lidar[own][which]
            T_target_vehicle = tuple(
                lines.predicted[own.start + j].compose(extrinsics[a].inverse())
                for j, a in zip(which.tolist(), lidar.tolist(), strict=True)
            )
            expected = Responsibilities.joined([part.expected for part in parts])
            out.append(_Placement(state.only(which), lidar, T_target_vehicle, expected))
    return out


class _Rest:
    """What is left without a part of the clouds, on its way to where expectation-maximisation ends.

    Attributes:
        total: (6 n,) how far it has taken the extrinsics, vehicle axes.
    """

    def __init__(
        self, placements: Sequence[_Placement], extrinsics: Sequence[gtsam.Pose3], prior: Array
    ) -> None:
        self._placements, self._moved, self._prior = placements, list(extrinsics), prior
        self._begun = False
        self.total: Array = np.zeros(len(prior))

    def further(self) -> Array:
        """`total` after one more round."""
        H, gradient = _system(self._placements, self._moved, at_solution=not self._begun)
        self._begun = True
        step = -np.asarray(np.linalg.solve(H + self._prior, gradient), np.float64)
        self._moved = [
            retract_vehicle_axes(T, d)
            for T, d in zip(self._moved, step.reshape(-1, 6), strict=True)
        ]
        self.total = self.total + step
        for placement in self._placements:
            R, t, _ = placement.poses(self._moved)
            placement.state.maximise(R, t)
        return self.total


def _system(
    placements: Sequence[_Placement], extrinsics: Sequence[gtsam.Pose3], at_solution: bool = True
) -> tuple[Array, Array]:
    """(6 n, 6 n) information and (6 n,) gradient over the extrinsics, vehicle axes, by an E-step.

    `at_solution`: that of the placements, whose shape and poses are still those of the solution.
    """
    H = np.zeros((6 * len(extrinsics), 6 * len(extrinsics)))
    gradient = np.zeros(len(H))
    for placement in placements:
        R, t, J = placement.poses(extrinsics)
        who = placement.expected if at_solution else placement.state.responsibilities(R, t)
        quadratic = placement.state.quadratic(R, t, who)
        H += quadratic.along(J)
        gradient += np.einsum("jab,ja->b", J, quadratic.gradient)
    return H, gradient
