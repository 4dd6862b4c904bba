"""One calibration from matrices: for the result of a solve, and for a predicted covariance."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import gtsam
import numpy as np

from caliv_graph.conventions import AXES
from caliv_graph.geometry.se3 import right_to_vehicle_axes
from caliv_graph.products import Array, Calibration, Guess, LidarResult, Uncertainty
from caliv_graph.uncertainty.observability import UNDETERMINED_RATIO, known_sigmas, unguessed

_NO_OFFSETS: Mapping[str, tuple[float, float]] = {}


def assemble_matrices(
    solved: Mapping[str, gtsam.Pose3],
    guesses: Mapping[str, Guess],
    cov: Array,
    information: Array,
    uncertainty: Uncertainty,
    reference: str,
    scans: Mapping[str, int],
    gradient: Array | None = None,
    time_offsets: Mapping[str, tuple[float, float]] = _NO_OFFSETS,
    structure: Collection[str] = (),
    information_data: Array | None = None,
) -> Calibration:
    """A calibration of every LiDAR, without requirements and provenance.

    Args:
        solved: extrinsics of the n LiDARs in the graph, in the order of the matrices.
        guesses: of every LiDAR, in the order of the result; one that is not in the graph keeps it.
        cov: (6n, 6n) vehicle axes.
        information: (6n, 6n) of the data and of trusted guesses (`fixed: true`), vehicle axes: what
            is determined without the other guesses.
        uncertainty: verdicts on the solved LiDARs.
        reference: name of the reference LiDAR.
        scans: LiDAR -> clouds of a target that carry weight; absent: none.
        gradient: (6n,) of the data's log-likelihood, vehicle axes.
        time_offsets: LiDAR -> value and sigma in seconds, where estimated.
        structure: names of the LiDARs that saw structure.
        information_data: (6n, 6n) of the data alone, which is reported; None: `information`.
    """
    names = list(guesses)
    poses = {name: solved.get(name, guesses[name].T_vehicle_lidar) for name in names}
    to_right = _to_right(names, solved)
    cov_joint = np.zeros((6 * len(names), 6 * len(names)))
    for row, name in enumerate(names):
        if name not in solved:
            block = slice(6 * row, 6 * row + 6)
            axes = right_to_vehicle_axes(poses[name])
            cov_joint[block, block] = axes.T @ np.diag(known_sigmas(guesses[name]) ** 2) @ axes
    own = [guesses[name] for name in solved]
    cov_joint += to_right @ (cov + unguessed(information, own)) @ to_right.T
    reported = information if information_data is None else information_data
    information_joint = to_right @ reported @ to_right.T
    nothing = dict.fromkeys(AXES, False)
    lidars = {
        name: LidarResult(
            T_vehicle_lidar=poses[name],
            cov=cov_joint[6 * row : 6 * row + 6, 6 * row : 6 * row + 6],
            determined=determined_axes(
                uncertainty.determined.get(name, nothing),
                guesses[name],
                poses[name],
                cov_joint[6 * row : 6 * row + 6, 6 * row : 6 * row + 6],
            ),
            scans_used=scans.get(name, 0),
            saw_target=scans.get(name, 0) > 0,
            time_offset=time_offsets.get(name),
            guess=guesses[name],
            saw_structure=name in structure,
        )
        for row, name in enumerate(names)
    }
    complete = not uncertainty.undetermined and all(
        all(lidar.determined.values()) for lidar in lidars.values()
    )
    return Calibration(
        status="ok" if complete else "partial",
        reference=reference,
        lidars=lidars,
        cov_joint=0.5 * (cov_joint + cov_joint.T),
        information_data=0.5 * (information_joint + information_joint.T),
        undetermined=uncertainty.undetermined,
        weak=uncertainty.weak,
        unmet=(),
        provenance={},
        gradient_data=None if gradient is None else to_right @ gradient,
    )


def determined_axes(
    found: Mapping[str, bool], guess: Guess, T_vehicle_lidar: gtsam.Pose3, cov: Array
) -> dict[str, bool]:
    """Whether the data determine each axis.

    Where nobody gave a guess, an undetermined direction may be off so far that the other axes take
    part in it: y, after half a turn about the centre of an arc. Where the tangent of that arc is
    along x the sigma of y knows nothing of it, so what a turn adds in second order counts as well.

    Args:
        found: verdict on each axis by the directions that the data determine.
        guess: of the LiDAR.
        T_vehicle_lidar: its extrinsic.
        cov: (6, 6) of it, right perturbation, with what `unguessed` adds.
    """
    if not guess.found:
        return dict(found)
    axes = right_to_vehicle_axes(T_vehicle_lidar)
    in_vehicle = axes @ cov @ axes.T
    sigmas = np.sqrt(np.diag(in_vehicle) + second_order(in_vehicle))
    known = sigmas <= UNDETERMINED_RATIO * guess.sigmas
    return {axis: found[axis] and bool(k) for axis, k in zip(AXES, known, strict=True)}


def second_order(cov: Array) -> Array:
    """(6,) mean squares of what turns add to the place of a LiDAR in second order, rad^2 and m^2.

    A turn w moves a place by v, and by w x v / 2 beyond it. For normal errors along one direction
    with variance s^2 that has a mean square of 3 s^4 |w x v|^2 / 4, and s^2 w x v is in the
    covariance (6, 6) of turn and place, vehicle axes.
    """
    crossed = cov[:3, 3:] - cov[:3, 3:].T
    mean = 0.5 * np.array([crossed[1, 2], crossed[2, 0], crossed[0, 1]])
    return np.concatenate([np.zeros(3), 3.0 * mean**2])


def _to_right(names: Sequence[str], solved: Mapping[str, gtsam.Pose3]) -> Array:
    """(6N, 6n) from vehicle axes of the solved LiDARs to right perturbations of all."""
    out = np.zeros((6 * len(names), 6 * len(solved)))
    for column, (name, T) in enumerate(solved.items()):
        row = names.index(name)
        axes = right_to_vehicle_axes(T).T
        out[6 * row : 6 * row + 6, 6 * column : 6 * column + 6] = axes
    return out
