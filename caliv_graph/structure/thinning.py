"""The same drive on fewer poses, and back: what the other poses are follows from the motion data.

Poses of a drive without a scan, such as those of the target's clouds, are in the Gaussian of the
motion data only: the solve does without them, exactly. While extrinsics are rough, every third scan
is enough.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.elimination import factor_of, marginal, solved
from caliv_graph.structure.layout import State
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.prior import PosePrior
from caliv_graph.structure.problem import Problem
from caliv_graph.structure.views import Views

FEW_SCANS = 50
"""Scans of a LiDAR that rounds with wide gates use at least: enough for strips to be found, and for
extrinsics that are good to a millimetre."""


def some_scans(patches: DrivePatches) -> BoolArray:
    """(S,) scans for the first rounds, each n-th of a LiDAR: at least `FEW_SCANS` if there are."""
    keep = np.zeros(len(patches.stamps_ns), dtype=bool)
    for lidar in range(len(patches.lidars)):
        own = np.flatnonzero(patches.scan_lidar == lidar)
        keep[own[:: max(len(own) // FEW_SCANS, 1)]] = True
    return keep


def patches_of_scans(patches: DrivePatches, keep: BoolArray) -> DrivePatches:
    """The patches of some of the scans (S,)."""
    number = np.cumsum(keep) - 1
    fewer = patches.part(keep[patches.scan])
    return replace(
        fewer,
        stamps_ns=patches.stamps_ns[keep],
        scan_lidar=patches.scan_lidar[keep],
        scan=number[fewer.scan],
    )


def with_scans(problem: Problem, keep: BoolArray) -> tuple[Problem, IntArray]:
    """The drive with the scans of a mask (S,) and their poses only.

    Also returns the indices of these poses among those of `problem`.
    """
    poses = np.unique(problem.pose_of_scan[keep])
    turns = problem.turn_rad_s
    if len(turns):
        turns = turns[np.searchsorted(np.unique(problem.pose_of_scan), poses)]
    own = replace(
        problem,
        prior=_on(problem.prior, poses),
        pose_of_scan=np.searchsorted(poses, problem.pose_of_scan[keep]),
        twists=None if problem.twists is None else problem.twists[poses],
        accelerations=None if problem.accelerations is None else problem.accelerations[poses],
        turn_rad_s=turns,
    )
    if keep.all():
        return own, poses
    patches = problem.patches
    seen = keep[patches.scan]
    fewer = patches_of_scans(patches, keep)
    views = Views.numbered(problem.views.of_scan[keep])
    return replace(own, patches=fewer, relative=problem.relative[seen], views=views), poses


def _on(prior: PosePrior, poses: IntArray) -> PosePrior:
    """The Gaussian of some of the poses (p,), and of the parameters."""
    if len(poses) == len(prior.stamps_ns):
        return prior
    information, gradient = marginal(prior.information, prior.gradient, *_coordinates(prior, poses))
    return replace(
        prior,
        stamps_ns=prior.stamps_ns[poses],
        T_map_vehicle=tuple(prior.T_map_vehicle[i] for i in poses),
        information=information,
        gradient=gradient,
    )


def on_all_poses(prior: PosePrior, poses: IntArray, state: State) -> State:
    """An estimate on the poses (p,) with all of a prior's: the others are as these say."""
    m, p = len(prior.stamps_ns), len(poses)
    if m == p:
        return state
    keep, rest = _coordinates(prior, poses)
    moved = np.zeros(len(prior.gradient))
    moved[keep] = state.moved
    H = prior.information
    pull = prior.gradient[rest] - H[np.ix_(rest, keep)] @ state.moved
    moved[rest] = solved(factor_of(H[np.ix_(rest, rest)]), pull)
    steps = moved[: 6 * m].reshape(m, 6)
    R, t = stack(
        [T.compose(prior.chart.pose(d)) for T, d in zip(prior.T_map_vehicle, steps, strict=True)]
    )
    more = np.zeros(6 * (m - p) if len(state.errors) else 0)
    return replace(
        state,
        R_map_vehicle=R,
        t_map_vehicle=t,
        moved=moved,
        errors=np.concatenate([more, state.errors]),
    )


def _coordinates(prior: PosePrior, poses: IntArray) -> tuple[IntArray, IntArray]:
    """Those of some poses and of the parameters, and those of all other poses."""
    size = len(prior.gradient)
    own = (6 * poses[:, None] + np.arange(6)).ravel()
    keep = np.concatenate([own, np.arange(6 * len(prior.stamps_ns), size)])
    rest = np.ones(size, dtype=bool)
    rest[keep] = False
    return keep, np.flatnonzero(rest)


def on_all_coordinates(values: Array, prior: PosePrior, poses: IntArray) -> Array:
    """Values (..., R) at the coordinates that remain, zero at those of the other poses."""
    more = 6 * (len(prior.stamps_ns) - len(poses))
    out = np.zeros(len(values) + more)
    keep, _ = _coordinates(prior, poses)
    out[keep] = values[: len(keep)]
    out[len(prior.gradient) :] = values[len(keep) :]
    return out
