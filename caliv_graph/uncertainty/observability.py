"""What the data determine: spectrum, the projection of `auto`, directions and verdicts per axis.

Works on information matrices over the extrinsics, in vehicle axes, six coordinates per LiDAR.
`caliv_graph/uncertainty/README.md` derives it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import eigh

from caliv_graph.config.guesses import prior_sigmas
from caliv_graph.conventions import AXES
from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array, BoolArray, Direction, Guess, Uncertainty

UNIT = np.array([1e-3] * 3 + [1e-2] * 3)
"""One scaled unit: 1 mrad, 10 mm. At 10 m from the target both move a point by 10 mm."""

UNDETERMINED_RATIO = 0.5
"""Sigma of the data over sigma of the guesses above which a direction is undetermined (README,
"The hard switch")."""

NOTHING_RATIO = 100.0
"""The same ratio above which a direction is lost however many were before: the data say nothing of
it any more, as where the robust weights have left a LiDAR without clouds."""

WEAK_RATIO = 0.1
"""The same ratio above which a determined direction is weak."""

UNKNOWN_SIGMAS = np.array([np.pi] * 3 + [10.0] * 3)
"""(6,) sigmas of an extrinsic of which nobody said anything: any rotation, within 10 m."""

RIGID_MISFIT = 0.2
"""Relative misfit up to which LiDARs count as moving together."""

RIGID_COSINE = 0.98
"""Of the angle between a rigid motion and the undetermined subspace, above which the motion is
undetermined."""

SAME_SHARE = 0.5
"""An uncertain parameter of the vehicle is named where it makes up half of a variance or more."""

AXIS_SHARE = 0.05
LIDAR_SHARE = 0.01
"""An axis is undetermined if it has more than the first fraction of its LiDAR's part of the
undetermined subspace, and that part exceeds the second (1 = one whole direction)."""


@dataclass(frozen=True)
class Spectrum:
    """Eigenvectors of the scaled data information, best determined first.

    Attributes:
        vectors: (6n, 6n), columns orthonormal in scaled coordinates.
        information: (6n,) eigenvalues, at least zero.
        sigma_data: (6n,) in scaled units; inf where the data have no information.
        sigma_prior: (6n,) of the guesses along the same directions, scaled units: `(v^T P v)^-1/2`.
        undetermined: (6n,) bool.
        weak: (6n,) bool.
    """

    vectors: Array
    information: Array
    sigma_data: Array
    sigma_prior: Array
    undetermined: BoolArray
    weak: BoolArray


def scaling(lidars: int) -> Array:
    """(6n,) physical size of one scaled unit of each coordinate."""
    return np.tile(UNIT, lidars)


def spectrum(D: Array, prior: Array, undetermined: int | None = None) -> Spectrum:
    """Splits the space of all extrinsics into determined and undetermined directions.

    Args:
        D: (6n, 6n) data information, vehicle axes, all other variables eliminated.
        prior: (6n, 6n) information of the guesses, vehicle axes.
        undetermined: their number if it was decided before: those of the largest ratio of sigmas;
            more, where the data have lost all that they knew since.
    """
    unit = scaling(len(D) // 6)
    values, vectors = np.linalg.eigh(D * np.outer(unit, unit))
    order = np.argsort(-values)
    values, vectors = np.maximum(values[order], 0.0), vectors[:, order]
    scaled_prior = prior * np.outer(unit, unit)
    prior_information = np.einsum("ij,ik,kj->j", vectors, scaled_prior, vectors)
    sigma_prior = prior_information**-0.5
    with np.errstate(divide="ignore"):
        sigma_data = values**-0.5
    ratio = sigma_data / sigma_prior
    if undetermined is None:
        lost = ratio > UNDETERMINED_RATIO
    else:
        lost = ratio > NOTHING_RATIO
        if undetermined:
            lost[np.argsort(ratio, kind="stable")[-undetermined:]] = True
    weak = (ratio > WEAK_RATIO) & ~lost
    return Spectrum(vectors, values, sigma_data, sigma_prior, lost, weak)


def step_with_prior_in_null_space(
    D: Array, c: Array, prior: Array, offset: Array, split: Spectrum
) -> Array:
    """The step (6n,) of `auto`: the prior has weight in the undetermined subspace only.

    With W the determined and U the undetermined directions, minimises `e^T D e / 2 - c^T e` over
    W; along U the prior's cost given that: `U^T P (offset + e) = 0`.

    Args:
        D: (6n, 6n) quadratic of the data in a step e, vehicle axes.
        c: (6n,) its linear part.
        prior: (6n, 6n) information P of the guesses.
        offset: (6n,) current estimate less the guesses.
        split: of D.
    """
    unit = scaling(len(D) // 6)
    W, U = split.vectors[:, ~split.undetermined], split.vectors[:, split.undetermined]
    step = W @ ((W.T @ (unit * c)) / split.information[~split.undetermined])
    if U.shape[1]:
        P = prior * np.outer(unit, unit)
        step -= U @ np.linalg.solve(U.T @ P @ U, U.T @ P @ (offset / unit + step))
    return np.asarray(unit * step)


def covariance_with_prior_in_null_space(prior: Array, split: Spectrum) -> Array:
    """Covariance (6n, 6n) of the estimate at which `step_with_prior_in_null_space` converges."""
    unit = scaling(len(prior) // 6)
    W, U = split.vectors[:, ~split.undetermined], split.vectors[:, split.undetermined]
    cov = (W / split.information[~split.undetermined]) @ W.T
    if U.shape[1]:
        P = prior * np.outer(unit, unit)
        inner = np.linalg.inv(U.T @ P @ U)
        transfer = np.eye(len(P)) - U @ inner @ U.T @ P
        cov = transfer @ cov @ transfer.T + U @ inner @ U.T
    return np.asarray(0.5 * (cov + cov.T) * np.outer(unit, unit))


def known_sigmas(guess: Guess) -> Array:
    """(6,) what is known of an extrinsic before the drive, 1 sigma, vehicle axes, rad and m."""
    return UNKNOWN_SIGMAS if guess.found else guess.sigmas


def unguessed(D: Array, guesses: Sequence[Guess]) -> Array:
    """What a covariance in which guesses decide lacks where a LiDAR had none: (6n, 6n).

    The prior of a found guess keeps the solve where the drive determines nothing. It is no
    knowledge: along these directions the variance becomes that of what is known before the drive.

    Args:
        D: (6n, 6n) information of the data and of trusted guesses (`fixed: true`), vehicle axes.
        guesses: of the n LiDARs.
    """
    if not any(guess.found for guess in guesses):
        return np.zeros_like(D)
    # As in the solve: trust is in D, and the prior of a trusted guess has the usual sigmas.
    priors = [prior_sigmas(guess) for guess in guesses]
    of_nothing = [
        UNKNOWN_SIGMAS if guess.found else prior
        for guess, prior in zip(guesses, priors, strict=True)
    ]
    held, known = (np.diag(np.concatenate(s) ** -2.0) for s in (priors, of_nothing))
    split = spectrum(D, held)
    U = split.vectors[:, split.undetermined] * scaling(len(guesses))[:, None]
    if not U.shape[1]:
        return np.zeros_like(D)
    more = np.linalg.inv(U.T @ known @ U) - np.linalg.inv(U.T @ held @ U)
    return np.asarray(U @ more @ U.T)


def assess(
    D: Array,
    prior: Array,
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
    held: Sequence[str] = (),
) -> Uncertainty:
    """Verdicts per direction and per axis. `wording.directions.named` adds texts.

    Args:
        D: (6n, 6n) data information, vehicle axes, LiDARs in the order of `T_vehicle_lidar`.
        prior: (6n, 6n) of the guesses.
        T_vehicle_lidar: the estimates.
        held: axes that the solve did not estimate for any LiDAR (staged).
    """
    names = list(T_vehicle_lidar)
    split = spectrum(D, prior)
    U = split.vectors[:, split.undetermined]
    # Diagonal of the projector U U^T.
    share = np.sum(U**2, axis=1).reshape(len(names), 6)
    determined = {}
    for name, part in zip(names, share, strict=True):
        total = float(part.sum())
        lost = (part > AXIS_SHARE * total) & (total > LIDAR_SHARE)
        determined[name] = {
            axis: not (bool(lost[i]) or axis in held) for i, axis in enumerate(AXES)
        }
    return Uncertainty(
        undetermined=_directions(U, D, prior, T_vehicle_lidar),
        weak=_directions(split.vectors[:, split.weak], D, prior, T_vehicle_lidar),
        determined=determined,
        spectrum=np.sort(split.sigma_data),
    )


def _directions(
    basis: Array, D: Array, prior: Array, T_vehicle_lidar: Mapping[str, gtsam.Pose3]
) -> tuple[Direction, ...]:
    """Directions with few coordinates that span a subspace, given by (6n, k) scaled columns."""
    if not basis.shape[1]:
        return ()
    names = list(T_vehicle_lidar)
    unit = scaling(len(names))
    out = []
    for column in simplified(basis).T:
        vector = unit * column
        information = float(vector @ D @ vector)
        sigma_data = information**-0.5 if information > 0.0 else math.inf
        sigma_prior = float(vector @ prior @ vector) ** -0.5
        parts = {n: vector[6 * i : 6 * i + 6] for i, n in enumerate(names)}
        # The largest coordinate is one unit (1 rad or 1 m), so that numbers can be read.
        scale = 1.0 / float(np.abs(vector).max())
        sign = math.copysign(1.0, vector[int(np.abs(column).argmax())])
        out.append(
            Direction(
                {n: sign * scale * v for n, v in parts.items()},
                sigma_data / scale,
                sigma_prior / scale,
                text="",
                together=rigid_twist(parts, T_vehicle_lidar) is not None,
            )
        )
    return tuple(out)


def looks_the_same(direction: Direction, D: Array, D_knowing: Array) -> bool:
    """Whether an undetermined direction is one because a parameter of the vehicle is uncertain.

    `D` and `D_knowing` (6n, 6n) are the information of the data, the parameter free and known, over
    the LiDARs of the direction.
    """
    vector = np.concatenate(list(direction.vector.values()))
    return float(vector @ D @ vector) < SAME_SHARE * float(vector @ D_knowing @ vector)


def limited_axes(D: Array, D_knowing: Array, prior: Array) -> tuple[str, ...]:
    """Axes of S2V with `SAME_SHARE` of their variance or more from a parameter, of any LiDAR.

    All (6n, 6n): information of the data, the same if the parameter were known, of the guesses.
    """
    known, free = (np.diag(np.linalg.inv(A + prior)).reshape(-1, 6) for A in (D_knowing, D))
    limited = np.asarray((known < (1.0 - SAME_SHARE) * free).any(axis=0))
    return tuple(axis for axis, yes in zip(AXES, limited.tolist(), strict=True) if yes)


def simplified(basis: Array) -> Array:
    """Rotates a basis (6n, k) of a subspace so that each vector has few coordinates.

    Eigenvectors of equal eigenvalues are any mixture of each other (varimax, Kaiser 1958).
    """
    k = basis.shape[1]
    turn = np.eye(k)
    if k == 1:
        return basis
    for _ in range(200):
        rotated = basis @ turn
        target = rotated**3 - rotated * (rotated**2).mean(axis=0)
        u, _, vt = np.linalg.svd(basis.T @ target)
        new = u @ vt
        if np.abs(new - turn).max() < 1e-10:
            break
        turn = new
    rotated = basis @ turn
    order = np.argsort(-np.abs(rotated).max(axis=0), kind="stable")
    return np.asarray(rotated[:, order])


def rigid_twist(
    parts: Mapping[str, Array], T_vehicle_lidar: Mapping[str, gtsam.Pose3]
) -> Array | None:
    """The twist (6,) of the whole sensor set that a direction amounts to.

    `parts` has per LiDAR (6,), vehicle axes, rad and m, at any common scale. Returns rotation about
    and shift at the vehicle's origin; None if the LiDARs move apart.
    """
    A = by_twist(T_vehicle_lidar[name] for name in parts)
    y = np.concatenate([part / UNIT for part in parts.values()])
    twist = np.linalg.lstsq(A, y, rcond=None)[0]
    misfit = np.linalg.norm(A @ twist - y) / np.linalg.norm(y)
    return np.asarray(twist) if misfit < RIGID_MISFIT else None


def undetermined_twists(
    undetermined: Sequence[Direction], T_vehicle_lidar: Mapping[str, gtsam.Pose3]
) -> tuple[int, Array]:
    """How many rigid motions of the whole sensor set against the vehicle are undetermined, 0 to 6.

    And the best determined motion as a twist (6,), any scale.
    """
    if not undetermined:
        return 0, np.zeros(6)
    basis = undetermined_basis(undetermined, list(T_vehicle_lidar))
    twists, back = np.linalg.qr(by_twist(T_vehicle_lidar.values()))
    _, cosines, within = np.linalg.svd(basis.T @ twists)
    return int((cosines > RIGID_COSINE).sum()), np.linalg.solve(back, within[-1])


def undetermined_motions(
    D: Array, prior: Array, T_vehicle_lidar: Mapping[str, gtsam.Pose3]
) -> Array:
    """Rigid motions of the whole sensor set that data leave to the guesses, by the hard switch.

    Args:
        D: (6n, 6n) data information, vehicle axes, LiDARs in the order of `T_vehicle_lidar`.
        prior: (6n, 6n) of the guesses.
        T_vehicle_lidar: the extrinsics.

    Returns:
        (6, m) twists: rotation about (rad) and shift at the vehicle's origin (m). Any scale.
    """
    if not T_vehicle_lidar:
        return np.zeros((6, 0))
    moved = scaling(len(T_vehicle_lidar))[:, None] * by_twist(T_vehicle_lidar.values())
    information, twists = eigh(moved.T @ D @ moved, moved.T @ prior @ moved)
    return np.asarray(twists[:, information < UNDETERMINED_RATIO**-2.0])


def undetermined_basis(undetermined: Sequence[Direction], lidars: Sequence[str]) -> Array:
    """(6n, k) orthonormal basis, in scaled units, of what directions span over some LiDARs."""
    vectors = [
        np.concatenate([direction.vector.get(name, np.zeros(6)) for name in lidars])
        for direction in undetermined
    ]
    basis, _ = np.linalg.qr((np.array(vectors) / scaling(len(lidars))).T)
    return np.asarray(basis)


def by_twist(poses: Iterable[gtsam.Pose3]) -> Array:
    """(6n, 6) derivative of the extrinsics, scaled, by a twist at the vehicle's origin."""
    rows = []
    for T in poses:
        arm = -skew(T.translation())
        rows.append(np.block([[np.eye(3), np.zeros((3, 3))], [arm, np.eye(3)]]) / UNIT[:, None])
    return np.concatenate(rows)
