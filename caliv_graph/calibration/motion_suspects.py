"""What motion data say about the inputs of the smoother that could be wrong.

By themselves, before any cloud is looked at (`motion_scores`), and with the vehicle's poses, for
the graph of a calibration (`motion_parts`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import scipy.linalg

from caliv_graph.errors import SolveError, TrajectoryError
from caliv_graph.products import Array, IntArray
from caliv_graph.structure.elimination import factor_of, solved
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.suspects import SuspectParameter, misfit, with_suspects
from caliv_graph.uncertainty.suspects import Candidate, Scores


@dataclass(frozen=True)
class MotionPart:
    """The motion data of a drive as a Gaussian on its m poses and K common parameters.

    Minus its logarithm is `(x - poses d)^T information (x - poses d) / 2 + d^T own d / 2 -
    gradient^T d`, x the right perturbations of `T_map_vehicle`, d the parameters less what the user
    typed.

    Attributes:
        T_map_vehicle: the m poses where the user's parameters put them.
        information: (6 m, 6 m).
        poses: (6 m, K).
        own: (K, K).
        gradient: (K,).
    """

    T_map_vehicle: tuple[gtsam.Pose3, ...]
    information: Array
    poses: Array
    own: Array
    gradient: Array


def motion_parts(
    trajectories: Mapping[int, SmoothedTrajectory], stamps_ns: Mapping[int, IntArray]
) -> tuple[tuple[Candidate, ...], dict[int, MotionPart]]:
    """The inputs of the smoothers of some drives, and each drive's Gaussian.

    Both arguments are by the index of the drive; the stamps (m,) have nodes.

    Raises:
        TrajectoryError: the motion data leave the poses undetermined.
    """
    with_them = {d: with_suspects(t) for d, t in trajectories.items()}
    known: dict[str, SuspectParameter] = {}
    for _, suspects in with_them.values():
        for s in suspects:
            known.setdefault(s.parameter.name, s)
    sizes = [s.parameter.size for s in known.values()]
    ends = np.cumsum(sizes, dtype=np.int64).tolist()
    where = {
        name: np.arange(end - size, end) for name, size, end in zip(known, sizes, ends, strict=True)
    }
    parts = {
        d: _part(smoothed, suspects, stamps_ns[d], where, sum(sizes))
        for d, (smoothed, suspects) in with_them.items()
    }
    candidates = tuple(Candidate(n, s.allowance, s.scale) for n, s in known.items())
    return candidates, parts


def motion_scores(trajectories: Sequence[VehicleTrajectory]) -> Scores:
    """What the motion data alone say; without any candidate where all poses were given.

    Raises:
        TrajectoryError: the motion data leave the trajectory undetermined.
    """
    smoothed = {d: t for d, t in enumerate(trajectories) if isinstance(t, SmoothedTrajectory)}
    # The parameters' information does not depend on which pose is eliminated last.
    candidates, parts = motion_parts(smoothed, {d: t.nodes_ns[:1] for d, t in smoothed.items()})
    size = sum(len(c.scale) for c in candidates)
    own, gradient = np.zeros((size, size)), np.zeros(size)
    for part in parts.values():
        own += part.own
        gradient += part.gradient
    return Scores(candidates, own, gradient, worst_misfit(trajectories))


def worst_misfit(trajectories: Sequence[VehicleTrajectory]) -> float:
    """Of all drives (`trajectory.suspects.misfit`)."""
    smoothed = [t for t in trajectories if isinstance(t, SmoothedTrajectory)]
    return max([1.0, *map(misfit, smoothed)])


def _solved(information: Array, right: Array) -> Array:
    """information^-1 right; under a ridge where rounding made it indefinite.

    Scans of two LiDARs may be milliseconds apart, and their heights known to each other to a
    micrometre, on a map whose own height nothing tells.

    Raises:
        TrajectoryError: it is singular.
    """
    try:
        return np.asarray(scipy.linalg.cho_solve(scipy.linalg.cho_factor(information), right))
    except scipy.linalg.LinAlgError:
        pass
    try:
        return solved(factor_of(information), right)
    except SolveError:
        raise TrajectoryError("the motion data leave the vehicle's poses undetermined") from None


def _part(
    smoothed: SmoothedTrajectory,
    suspects: Sequence[SuspectParameter],
    stamps_ns: IntArray,
    where: Mapping[str, IntArray],
    size: int,
) -> MotionPart:
    """The Gaussian of one drive; `where` each parameter is among `size` coordinates."""
    joint = smoothed.joint(stamps_ns, [s.parameter.name for s in suspects])
    split = 6 * len(joint.T_map_vehicle)
    at = np.concatenate([where[s.parameter.name] for s in suspects])
    offset = np.concatenate([s.offset for s in suspects])
    of_poses = joint.information[:split, :split]
    cross = joint.information[:split, split:]
    both = _solved(of_poses, np.column_stack([cross, joint.gradient[:split]]))
    follow, shift = -both[:, :-1], both[:, -1]
    own = joint.information[split:, split:] + cross.T @ follow
    gradient = joint.gradient[split:] - cross.T @ shift
    # From the estimate's parameters to those that the user typed.
    moved = shift - follow @ offset
    poses, out, c = np.zeros((split, size)), np.zeros((size, size)), np.zeros(size)
    poses[:, at] = follow
    out[np.ix_(at, at)] = own
    c[at] = gradient + own @ offset
    return MotionPart(
        T_map_vehicle=tuple(
            T.retract(moved[6 * i : 6 * i + 6]) for i, T in enumerate(joint.T_map_vehicle)
        ),
        information=of_poses,
        poses=poses,
        own=0.5 * (out + out.T),
        gradient=c,
    )
