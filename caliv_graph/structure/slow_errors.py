"""What structure says of slow errors of fixes and orientations (`README.md`, section 11b).

An error that wanders over seconds moves the smoothed poses as slowly, and the walls with them: they
do not lie on each other. Motion data alone take most of it for motion.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import gtsam
import numpy as np

from caliv_graph.config.model import Config
from caliv_graph.products import Array, IntArray
from caliv_graph.structure.elimination import covariance_of, factor_of, half_solved
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.prior import PosePrior
from caliv_graph.structure.problem import with_hold
from caliv_graph.structure.solve import Solved, solve_roughly
from caliv_graph.structure.term import aligned_start, problem_of, usable
from caliv_graph.structure.thinning import patches_of_scans, some_scans
from caliv_graph.trajectory.select import VehicleTrajectory

Tell = Callable[[Solved, PosePrior], tuple[Array, Array]]
"""A solved drive and the prior of its poses -> information and gradient on what is asked."""

ALIGNED_SCANS = 25
"""Scans of a LiDAR whose strips place it for all others too: fewer may be of one place."""


def scans_for_errors(patches: DrivePatches, until_ns: int) -> DrivePatches:
    """The patches of some scans of a drive, before a time: slow errors show in few."""
    within = patches_of_scans(patches, patches.stamps_ns <= until_ns)
    return patches_of_scans(within, some_scans(within))


def slow_errors(
    patches: Sequence[DrivePatches],
    priors: Sequence[PosePrior],
    tell: Sequence[Tell],
    trajectories: Sequence[VehicleTrajectory],
    start: Mapping[str, gtsam.Pose3],
    held: Mapping[str, gtsam.Pose3],
    config: Config,
    heave_m: float,
) -> tuple[tuple[tuple[Array, Array] | None, ...], Mapping[str, gtsam.Pose3]]:
    """What the structure of each drive says of errors of its sensors or poses.

    Args:
        patches: of each drive, of the scans that are to be used.
        priors: what the motion data of each drive say of the poses at the stamps of these scans,
            and of nothing else: parameters are eliminated.
        tell: of each drive, what is asked (`told_of_errors`, `told_of_poses`).
        trajectories: of each drive.
        start: rough T_vehicle_lidar.
        held: those of LiDARs that a target has placed.
        config: guesses and noise.
        heave_m: 1 sigma of the heave.

    Returns:
        Per drive the answer, information (c, c) and gradient (c,): minus its log-likelihood is
        `b^T information b / 2 - gradient^T b`. None: it has no structure. And T_vehicle_lidar at
        which the strips lie on each other.

    Raises:
        SolveError: a system is singular.
    """
    aligned = aligned_start(patches, trajectories, start, config)
    out = []
    for own, prior, told, trajectory in zip(patches, priors, tell, trajectories, strict=True):
        used = usable(own, trajectory, aligned, config)
        found = None
        if len(used.scan):
            followed = used.followed(aligned)
            problem = problem_of(
                followed, prior, trajectory, config, heave_m, held, config.free_offsets()
            )
            found = solve_roughly(problem, aligned)
        out.append(None if found is None else told(found, prior))
        if found is not None:
            aligned = {**aligned, **seeing_lidars(found)}
    return tuple(out), aligned


def place_all(used: Sequence[DrivePatches], patches: Sequence[DrivePatches]) -> bool:
    """Whether strips that lie on each other in some scans place every LiDAR of all drives.

    Not one that starts late, is of another drive, or has hardly a scan among those used.
    """
    those, every = _scans_of_lidars(used), _scans_of_lidars(patches)
    return all(those[name] >= min(count, ALIGNED_SCANS) for name, count in every.items())


def _scans_of_lidars(patches: Sequence[DrivePatches]) -> Counter[str]:
    """LiDAR -> number of its scans that have patches."""
    return Counter(
        of.lidars[lidar] for of in patches for lidar in of.scan_lidar[np.unique(of.scan)].tolist()
    )


def seeing_lidars(found: Solved) -> dict[str, gtsam.Pose3]:
    """T_vehicle_lidar of the LiDARs that have sightings; the others are only at their guesses."""
    patches = found.problem.patches
    seeing = np.unique(patches.scan_lidar[found.sightings.scan]).tolist()
    return {patches.lidars[i]: found.state.T_vehicle_lidar[i] for i in seeing}


def poses_found(found: Solved, prior: PosePrior) -> tuple[Array, Array]:
    """T_map_vehicle (m, 4, 4) of a solved drive, and 1 sigma (m,) of each heading, rad.

    At the poses of `prior`. The heading is that about the vehicle's z, relative to the map.
    """
    m = len(prior.stamps_ns)
    T = np.tile(np.eye(4), (m, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = found.state.R_map_vehicle, found.state.t_map_vehicle
    headings = 6 * np.arange(m) + 2
    return T, np.sqrt(np.diag(covariance_of(found.factor, headings)))


def told_of_poses(found: Solved, prior: PosePrior, chosen: IntArray) -> tuple[Array, Array]:
    """Information (6 k, 6 k) and gradient (6 k,) on k chosen poses, without their prior.

    Right perturbations of the poses of `prior`, which has no parameters. Other poses are eliminated
    under it, as weak as it is.
    """
    H, b = with_hold(found.problem, found.state, found.system)
    own = (6 * chosen[:, None] + np.arange(6)).ravel()
    columns = np.zeros((len(H), len(own) + 1))
    columns[own, np.arange(len(own))] = 1.0
    columns[:, -1] = b
    half = half_solved(factor_of(H), columns)
    together = np.asarray(np.linalg.inv(half[:, :-1].T @ half[:, :-1]), np.float64)
    mean = found.state.moved[own] + half[:, :-1].T @ half[:, -1]
    of_prior = np.linalg.inv(np.linalg.inv(prior.information)[np.ix_(own, own)])
    information = together - of_prior
    return np.asarray(0.5 * (information + information.T)), np.asarray(together @ mean)


def told_of_errors(found: Solved, prior: PosePrior, gain: Array) -> tuple[Array, Array]:
    """Information (c, c) and gradient (c,) on errors of sensors, from a solved drive.

    `prior` (m poses) is that of the drive, without rates: the poses that its motion data mean are
    at minus `gain` (6 m, c) per unit of an error.
    """
    H, b = with_hold(found.problem, found.state, found.system)
    moved = found.state.moved[: len(gain)]
    information, pull = prior.at(moved)
    by_now, size = prior.by_now(moved), 6 * len(prior.stamps_ns)
    of_poses = np.linalg.solve(by_now, gain[:size].reshape(len(by_now), 6, -1))
    gain = np.vstack([of_poses.reshape(size, -1), gain[size:]])
    return of_moved_prior(H, b, information, pull, gain)


def of_moved_prior(
    H: Array, b: Array, information: Array, pull: Array, gain: Array
) -> tuple[Array, Array]:
    """A Gaussian on what moves the mean of a prior, by a quadratic that contains this prior.

    Args:
        H: (R, R) of the quadratic `d^T H d / 2 - b^T d`.
        b: (R,).
        information: (P, P) of the prior, on the first P coordinates.
        pull: (P,) of the prior where d is zero.
        gain: (P, c): the mean of the prior is at minus this per unit.
    """
    across: Array = information @ gain
    coupling = np.zeros((len(H), gain.shape[1] + 1))
    coupling[: len(across), :-1] = across
    coupling[:, -1] = b
    half = half_solved(factor_of(H), coupling)
    known = half[:, :-1].T @ half
    told = gain.T @ across - known[:, :-1]
    return np.asarray(0.5 * (told + told.T)), np.asarray(gain.T @ pull - known[:, -1])
