"""Rough alignment: extrinsics at which the patches of all scans lie on each other.

The poses of the vehicle are held at the smoothed trajectory. A patch is compared with the nearest
patch of similar normal in other scans, of its own LiDAR and of others: with n, p the normal and
centre of the other patch, q, m the centre and normal of the first in the other's frame, the
residuals are `n . (q - p)` and `m - n`. Normals need no overlap in place and pull rotations in from
afar. Unknown are the right perturbations of all T_vehicle_lidar together, under the guesses as a
prior: what structure does not determine, as a common height, stays at the guess.

The result is a start for the association of strips, never evidence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import (
    retract_vehicle_axes,
    right_to_vehicle_axes,
    skew,
    vehicle_axes_difference,
)
from caliv_graph.products import Array
from caliv_graph.structure.pairs import Matches, Pairs, PatchCloud, gathered
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.trajectory.select import VehicleTrajectory

STEPS = 16
"""Gauss-Newton steps, in which the gates narrow; every one draws other pairs."""

LAST_STEPS = 4
"""Of these at the narrowest gate."""

GATE_SIGMAS = 2.5
"""Widest gate in units of what the prior sigmas make of a patch's place and normal."""

MIN_GATE_M = 0.2
MIN_GATE_RAD = 0.15
"""Narrowest gates: half the spacing of patches would find none, and their normals are known to 15
to 30 mrad."""

SIGMA_M = 0.05
SIGMA_RAD = 0.05
"""Sigmas of the residuals beside the prior: errors of poses, and of normals on uneven walls."""

PER_SCAN = 100.0
"""Residuals of a scan that count at most, about as many as it has patches of upright surfaces. More
pairs say nothing new: against thousands of them the prior would not hold what they leave open."""

MIN_MATCHES = 100
"""Fewest matches of a LiDAR that is aligned: with fewer it sees no structure."""

HELD = 1e-9
"""Smallest prior sigma: what is held has zero."""

MIN_AGREEMENT = 0.6
"""Smallest part of the pairs within the widest gate that agree, at an alignment."""

WORSE = 0.02
"""A part of the pairs that may agree less than at guesses that were good already."""

SETTLED_M = 0.01
SETTLED_RAD = 1e-3
"""Largest last step of an alignment that has settled; drawing other pairs moves it by less."""


@dataclass(frozen=True)
class PatchAlignment:
    """A rough alignment of extrinsics.

    Attributes:
        T_vehicle_lidar: LiDAR -> its extrinsic; the guess unless `converged`, and of LiDARs
            with few matches.
        converged: whether the patches lie on each other there, better than at the guesses.
        matches: LiDAR -> pairs with one of its patches that agree.
        agreement: part of the pairs within the widest gate that agree.
        before: the same at the guesses.
        step: (2,) size of the last step of any LiDAR, rad and metres.
    """

    T_vehicle_lidar: Mapping[str, gtsam.Pose3]
    converged: bool
    matches: Mapping[str, int]
    agreement: float
    before: float
    step: Array


def align_patches(
    patches: Sequence[DrivePatches],
    trajectories: Sequence[VehicleTrajectory],
    guesses: Mapping[str, gtsam.Pose3],
    prior_sigmas: Mapping[str, Array],
) -> PatchAlignment:
    """Aligns the extrinsics of all LiDARs.

    Args:
        patches: of each drive, those of the ground included: it determines roll and pitch.
        trajectories: of each drive.
        guesses: LiDAR -> T_vehicle_lidar.
        prior_sigmas: LiDAR -> (6,) of its guess, vehicle axes, rotation then translation, rad and
            m. Zeros hold it.

    Raises:
        TrajectoryError: a patch is from outside the span of its trajectory.
    """
    names = list(guesses)
    rng = np.random.default_rng(0)
    cloud = gathered(patches, trajectories, names, rng)
    sigmas = np.array([np.maximum(prior_sigmas[name], HELD) for name in names])
    start = [guesses[name] for name in names]
    pairs = Pairs(cloud, rng)
    widest = _widest_gate(cloud, sigmas)
    before, _ = pairs.agreement(start, widest)
    poses, step = start, np.zeros(2)
    for k in range(STEPS):
        part = min(k / (STEPS - 1 - LAST_STEPS), 1.0)
        gate = widest ** (1.0 - part) * np.array([MIN_GATE_M, MIN_GATE_RAD]) ** part
        matches = _of_matched_lidars(cloud, pairs.matched(poses, gate))
        if not len(matches.residual):
            break
        poses, step = _stepped(cloud, matches, poses, start, sigmas, gate)
    agreement, agreeing = pairs.agreement(poses, widest)
    count = cloud.per_lidar(agreeing, len(names))
    converged = bool(
        count.max(initial=0) >= MIN_MATCHES
        and step[0] < SETTLED_RAD
        and step[1] < SETTLED_M
        and agreement > max(MIN_AGREEMENT, before - WORSE)
    )
    return PatchAlignment(
        T_vehicle_lidar=dict(zip(names, poses if converged else start, strict=True)),
        converged=converged,
        matches=dict(zip(names, count.tolist(), strict=True)),
        agreement=agreement,
        before=before,
        step=step,
    )


def _widest_gate(cloud: PatchCloud, sigmas: Array) -> Array:
    """The gate (metres, radians) that patches of one surface pass at the guesses."""
    turn, shift = sigmas[:, :3].max(initial=0.0), sigmas[:, 3:].max(initial=0.0)
    return np.array(
        [
            max(GATE_SIGMAS * (shift + cloud.reach_m * turn), 2.0 * MIN_GATE_M),
            max(2.0 * GATE_SIGMAS * turn, 2.0 * MIN_GATE_RAD),
        ]
    )


def _of_matched_lidars(cloud: PatchCloud, matches: Matches) -> Matches:
    """Without those of LiDARs that have fewer than `MIN_MATCHES`: they stay at their guesses."""
    count = cloud.per_lidar(matches, int(cloud.lidar.max(initial=0)) + 1)
    enough = count >= MIN_MATCHES
    return matches.part(enough[cloud.lidar[matches.i]] & enough[cloud.lidar[matches.j]])


def _stepped(
    cloud: PatchCloud,
    matches: Matches,
    poses: Sequence[gtsam.Pose3],
    start: Sequence[gtsam.Pose3],
    sigmas: Array,
    gate: Array,
) -> tuple[list[gtsam.Pose3], Array]:
    """The extrinsics after a Gauss-Newton step, and its greatest rotation and translation."""
    sigma = np.maximum(gate / 3.0, [SIGMA_M, SIGMA_RAD])
    by_i, by_j = _jacobians(cloud, matches)
    rows = np.column_stack([matches.residual, matches.turned]) / sigma[[0, 1, 1, 1]]
    # Geman-McClure; place and normal of a wrong match are wrong together.
    weight = 1.0 / (1.0 + np.einsum("mk,mk->m", rows, rows)) ** 2
    scans = len(cloud.target_scans)
    weight *= min(PER_SCAN * scans / len(weight), 1.0)
    scale = np.sqrt(weight)[:, None] / sigma[[0, 1, 1, 1]]
    by_i, by_j = by_i * scale[:, :, None], by_j * scale[:, :, None]
    residual = np.sqrt(weight)[:, None] * rows
    n = 6 * len(poses)
    information, gradient = np.zeros((n, n)), np.zeros(n)
    of_i, of_j = cloud.lidar[matches.i], cloud.lidar[matches.j]
    for a in range(len(poses)):
        for b in range(len(poses)):
            mine = (of_i == a) & (of_j == b)
            J = np.concatenate([by_i[mine], by_j[mine]], axis=2).reshape(-1, 12)
            at = np.concatenate([6 * a + np.arange(6), 6 * b + np.arange(6)])
            np.add.at(information, (at[:, None], at[None, :]), J.T @ J)
            np.add.at(gradient, at, J.T @ residual[mine].ravel())
    # The prior is in vehicle axes, and so is the step.
    to_vehicle = [right_to_vehicle_axes(T) for T in poses]
    turn = np.zeros((n, n))
    for a, block in enumerate(to_vehicle):
        turn[6 * a : 6 * a + 6, 6 * a : 6 * a + 6] = block
    away = np.concatenate(
        [vehicle_axes_difference(T, T0) for T, T0 in zip(poses, start, strict=True)]
    )
    prior = sigmas.ravel() ** -2.0
    information = turn @ information @ turn.T + np.diag(prior)
    gradient = turn @ gradient + prior * away
    d = -np.linalg.solve(information, gradient).reshape(-1, 6)
    size = np.array([np.abs(d[:, :3]).max(), np.abs(d[:, 3:]).max()])
    return [retract_vehicle_axes(T, di) for T, di in zip(poses, d, strict=True)], size


def _jacobians(cloud: PatchCloud, matches: Matches) -> tuple[Array, Array]:
    """(m, 4, 6) of residual and difference of normals by the extrinsics of i and of j."""
    n = cloud.normal[matches.j]
    n_i, p_i = cloud.normal[matches.i], cloud.centre[matches.i]
    back = matches.R.transpose(0, 2, 1)
    by_i, by_j = np.zeros((2, len(n), 4, 6))
    n_in_i = np.einsum("mij,mj->mi", back, n)
    by_i[:, 0, :3], by_i[:, 0, 3:] = np.cross(p_i, n_in_i), n_in_i
    by_j[:, 0, :3], by_j[:, 0, 3:] = -np.cross(matches.q, n), -n
    by_i[:, 1:, :3] = -matches.R @ skew(n_i)
    by_j[:, 1:, :3] = skew(matches.m)
    return by_i, by_j
