"""What the data determine: directions, names for them, and a solve that respects them (SPEC 4).

Works on information matrices over the extrinsics, in vehicle axes, six coordinates per LiDAR; knows
no graph. Directions are looked at in scaled coordinates, so that 1 mrad and 10 mm compare.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.conventions import AXES
from caliv_graph.geometry.se3 import skew
from caliv_graph.products import Array, BoolArray, Direction, Uncertainty

UNIT = np.array([1e-3] * 3 + [1e-2] * 3)
"""One scaled unit: 1 mrad, 10 mm."""

UNDETERMINED_RATIO = 0.5
"""The data's sigma over the prior's from which a direction counts as undetermined (SPEC 4)."""

WEAK_RATIO = 0.1
"""The same for weak (SPEC 4)."""

NOTABLE = 0.2
"""Part of a direction's largest coordinate from which an axis is mentioned."""

RIGID_MISFIT = 0.2
"""Relative misfit up to which LiDARs count as moving together."""

STOOD_TWISTS = 5
"""Undetermined motions of all LiDARs as one from which nothing is known to the vehicle: driving
straight ahead loses four."""

STOOD_COSINE = 0.98
"""Of the angle between the undetermined subspace and such a motion, up to which it is in it."""

AXIS_SHARE = 0.05
LIDAR_SHARE = 0.01
"""An axis is undetermined if it has this share of its LiDAR's part of the undetermined subspace,
and that part is not negligible (SPEC 4)."""


@dataclass(frozen=True)
class Spectrum:
    """Eigenvectors of the scaled data information, best determined first.

    Attributes:
        vectors: (6n, 6n), columns orthonormal in scaled coordinates.
        information: (6n,) eigenvalues, at least zero.
        sigma_data: (6n,) in scaled units; inf where the data say nothing.
        sigma_prior: (6n,) of the guesses along the same directions.
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
    """Splits the space of all extrinsics by what the data say.

    Args:
        D: (6n, 6n) data information, vehicle axes.
        prior: (6n, 6n) information of the guesses, vehicle axes.
        undetermined: number of undetermined directions if it was decided before: those with the
            largest ratio of sigmas.
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
        lost = np.zeros(len(ratio), dtype=bool)
        if undetermined:
            lost[np.argsort(ratio, kind="stable")[-undetermined:]] = True
    weak = (ratio > WEAK_RATIO) & ~lost
    return Spectrum(vectors, values, sigma_data, sigma_prior, lost, weak)


def step_with_prior_in_null_space(
    D: Array, c: Array, prior: Array, offset: Array, split: Spectrum
) -> Array:
    """The step of `auto`: data alone where they can tell, the joint prior alone where not.

    Minimises `e^T D e / 2 - c^T e` over the determined directions; along the others the step is
    the one at which the guesses of all LiDARs together are best met, `U^T prior (offset + e) = 0`.

    Args:
        D: quadratic of the data in a step e, vehicle axes.
        c: its linear part.
        prior: information of the guesses.
        offset: (6n,) where the current estimate is from the guesses.
        split: of D.

    Returns:
        (6n,) the step e.
    """
    unit = scaling(len(D) // 6)
    W, U = split.vectors[:, ~split.undetermined], split.vectors[:, split.undetermined]
    step = W @ ((W.T @ (unit * c)) / split.information[~split.undetermined])
    if U.shape[1]:
        P = prior * np.outer(unit, unit)
        step -= U @ np.linalg.solve(U.T @ P @ U, U.T @ P @ (offset / unit + step))
    return np.asarray(unit * step)


def covariance_with_prior_in_null_space(prior: Array, split: Spectrum) -> Array:
    """Covariance of the estimate that `step_with_prior_in_null_space` arrives at.

    The determined directions carry the data's covariance; along the others the joint prior's, and
    what of the data's errors its condition drags along.
    """
    unit = scaling(len(prior) // 6)
    W, U = split.vectors[:, ~split.undetermined], split.vectors[:, split.undetermined]
    cov = (W / split.information[~split.undetermined]) @ W.T
    if U.shape[1]:
        P = prior * np.outer(unit, unit)
        inner = np.linalg.inv(U.T @ P @ U)
        carry = np.eye(len(P)) - U @ inner @ U.T @ P
        cov = carry @ cov @ carry.T + U @ inner @ U.T
    return np.asarray(0.5 * (cov + cov.T) * np.outer(unit, unit))


def assess(
    D: Array,
    prior: Array,
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
    held: Sequence[str] = (),
) -> Uncertainty:
    """Verdicts per direction and per axis.

    Args:
        D: (6n, 6n) data information, vehicle axes, LiDARs in the order of `T_vehicle_lidar`.
        prior: (6n, 6n) of the guesses.
        T_vehicle_lidar: the estimates.
        held: axes that the solve did not estimate for any LiDAR (staged).
    """
    names = list(T_vehicle_lidar)
    split = spectrum(D, prior)
    undetermined = _directions(split, split.undetermined, D, prior, T_vehicle_lidar)
    weak = _directions(split, split.weak, D, prior, T_vehicle_lidar)
    U = split.vectors[:, split.undetermined]
    share = np.sum(U**2, axis=1).reshape(len(names), 6)
    determined = {}
    for name, part in zip(names, share, strict=True):
        total = float(part.sum())
        lost = (part > AXIS_SHARE * total) & (total > LIDAR_SHARE)
        determined[name] = {
            axis: not (bool(lost[i]) or axis in held) for i, axis in enumerate(AXES)
        }
    return Uncertainty(undetermined, weak, determined, np.sort(split.sigma_data))


def _directions(
    split: Spectrum,
    mask: BoolArray,
    D: Array,
    prior: Array,
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
) -> tuple[Direction, ...]:
    """Named directions that span the masked subspace."""
    if not mask.any():
        return ()
    names = list(T_vehicle_lidar)
    unit = scaling(len(names))
    stood = (
        _standing_text(split.vectors[:, mask], T_vehicle_lidar)
        if mask is split.undetermined
        else ""
    )
    out = []
    for column in simplified(split.vectors[:, mask]).T:
        vector = unit * column
        information = float(vector @ D @ vector)
        sigma_data = information**-0.5 if information > 0.0 else math.inf
        sigma_prior = float(vector @ prior @ vector) ** -0.5
        parts = {n: vector[6 * i : 6 * i + 6] for i, n in enumerate(names)}
        # The largest coordinate is one unit (1 rad or 1 m), so that numbers can be read.
        scale = 1.0 / float(np.abs(vector).max())
        sign = math.copysign(1.0, vector[int(np.abs(column).argmax())])
        text, together = describe(parts, T_vehicle_lidar)
        advice = remedy(parts, T_vehicle_lidar, weak=mask is split.weak)
        if stood and together:
            text, advice = stood, REMEDY_STOOD
        out.append(
            Direction(
                {n: sign * scale * v for n, v in parts.items()},
                sigma_data / scale,
                sigma_prior / scale,
                text,
                together,
                advice,
            )
        )
    return tuple(out)


def simplified(basis: Array) -> Array:
    """Turns a basis (6n, k) of a subspace so that each vector has few coordinates (varimax).

    Eigenvectors of equal eigenvalues come out in any mixture; people say "height" and "rotation
    about the turn centre", not 0.7 of one and 0.7 of the other.
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

    Args:
        parts: per LiDAR (6,), vehicle axes, rad and m, any common scale.
        T_vehicle_lidar: where the LiDARs sit.

    Returns:
        Rotation about and shift at the vehicle's origin; None if the LiDARs move apart.
    """
    rows, values = [], []
    for name, part in parts.items():
        arm = -skew(T_vehicle_lidar[name].translation())
        rows.append(np.block([[np.eye(3), np.zeros((3, 3))], [arm, np.eye(3)]]) / UNIT[:, None])
        values.append(part / UNIT)
    A, y = np.concatenate(rows), np.concatenate(values)
    twist = np.linalg.lstsq(A, y, rcond=None)[0]
    misfit = np.linalg.norm(A @ twist - y) / np.linalg.norm(y)
    return np.asarray(twist) if misfit < RIGID_MISFIT else None


def describe(
    parts: Mapping[str, Array], T_vehicle_lidar: Mapping[str, gtsam.Pose3]
) -> tuple[str, bool]:
    """How a person says a direction, and whether all LiDARs move together in it.

    Args:
        parts: per LiDAR (6,), vehicle axes, rad and m, any common scale.
        T_vehicle_lidar: where the LiDARs sit.
    """
    twist = rigid_twist(parts, T_vehicle_lidar)
    names = list(parts)
    if twist is None:
        return _describe_apart(parts), False
    whole = "all LiDARs" if len(names) > 1 else f"lidar '{names[0]}'"
    return _describe_twist(twist, whole, len(names) > 1), True


REMEDY_STOOD = "drive past the target on a path whose curvature changes, such as a figure-eight"
REMEDY_HEIGHT = (
    "measure the height of the vehicle frame above the ground as well as you can and state it "
    "(ground.vehicle_height, ground.sigma), or cross a ramp while the target is in view"
)
REMEDY_TURN_CENTRE = (
    "change the curvature while the target is in view: drive an S-curve or a figure-eight, or add "
    "a drive that turns the other way"
)
REMEDY_STRAIGHT = (
    "turn while the target is in view: an arc adds y and roll, an S-curve or a figure-eight x as "
    "well"
)
REMEDY_TILT = "turn while the target is in view, so that the heading changes; use the ground"
REMEDY_APART = (
    "let these LiDARs see the same side of the target, at any time: pass it in both directions, "
    "as in a figure-eight, or add a second target"
)
REMEDY_MORE = (
    "pass the target again, closer and at other places, so that each LiDAR sees it in more scans; "
    "better poses of the vehicle (IMU, GNSS) help as well"
)
REMEDY_SYMMETRY = (
    "take a target that no turn maps onto itself, such as a chair, and let these LiDARs see the "
    "same side of it: pass it in both directions, or add a second target"
)


def remedy(
    parts: Mapping[str, Array], T_vehicle_lidar: Mapping[str, gtsam.Pose3], weak: bool = False
) -> str:
    """What would determine a direction: a manoeuvre, or a setting.

    Args:
        parts: per LiDAR (6,), vehicle axes, rad and m, any common scale.
        T_vehicle_lidar: where the LiDARs sit.
        weak: the data do tell it, but not well.
    """
    twist = rigid_twist(parts, T_vehicle_lidar)
    if twist is None and weak:
        return REMEDY_MORE
    if twist is None:
        size = np.max([np.abs(part / UNIT) for part in parts.values()], axis=0)
        return REMEDY_SYMMETRY if size.argmax() == AXES.index("yaw") else REMEDY_APART
    scaled = np.abs(twist / UNIT)
    big = {a for a, s in zip(AXES, scaled / scaled.max(), strict=True) if s > NOTABLE}
    if big == {"z"}:
        return REMEDY_HEIGHT
    if "yaw" in big and big <= {"yaw", "x", "y"}:
        return REMEDY_TURN_CENTRE
    if big & {"x", "y"}:
        return REMEDY_STRAIGHT
    return REMEDY_TILT if big <= {"roll", "pitch"} else REMEDY_STOOD


def _standing_text(basis: Array, T_vehicle_lidar: Mapping[str, gtsam.Pose3]) -> str:
    """How to say that nothing is known to the vehicle; empty if something is.

    Args:
        basis: (6n, k) orthonormal, scaled, of what is undetermined.
        T_vehicle_lidar: where the LiDARs sit.
    """
    rows = []
    for T in T_vehicle_lidar.values():
        arm = -skew(T.translation())
        rows.append(np.block([[np.eye(3), np.zeros((3, 3))], [arm, np.eye(3)]]) / UNIT[:, None])
    twists, back = np.linalg.qr(np.concatenate(rows))
    _, cosines, within = np.linalg.svd(basis.T @ twists)
    lost = int((cosines > STOOD_COSINE).sum())
    if lost < STOOD_TWISTS:
        return ""
    if lost == len(AXES):
        return "everything to the vehicle: it never moved"
    # What is told: the motion that is left, as a twist.
    told = np.abs(np.linalg.solve(back, within[-1]) / UNIT)
    height = told.argmax() == AXES.index("z")
    return f"everything to the vehicle but {'its height' if height else 'one part'}: it never moved"


def _describe_twist(twist: Array, whole: str, several: bool) -> str:
    """A motion of the whole sensor set relative to the vehicle."""
    scaled = np.abs(twist / UNIT)
    together = " together" if several else ""
    leading = scaled / scaled.max()
    big = [axis for axis, size in zip(AXES, leading, strict=True) if size > NOTABLE]
    if big == ["z"]:
        return f"height of {whole}{together}"
    if len(big) == 1 and big[0] in ("x", "y"):
        way = "forward" if big[0] == "x" else "sideways"
        return f"shift of {whole}{together} {way}: {big[0]}"
    if "yaw" in big and set(big) <= {"yaw", "x", "y"}:
        radius = float(np.hypot(twist[3], twist[4]) / abs(twist[2]))
        shift = " and ".join(axis for axis in ("x", "y") if axis in big)
        if not shift:
            return f"rotation of {whole} about the vertical through the vehicle frame: yaw"
        return (
            f"rotation of {whole} about the turn centre: {shift} and yaw together, "
            f"{radius:.2f} m per rad"
        )
    if len(big) == 1:
        return f"{big[0]} of {whole}{together}"
    return f"{' and '.join(big)} of {whole}, moving as one"


def _describe_apart(parts: Mapping[str, Array]) -> str:
    """A direction in which LiDARs move against each other."""
    largest = max(float(np.abs(p / UNIT).max()) for p in parts.values())
    said = {}
    for name, part in parts.items():
        size = part / UNIT / largest
        axes = [
            (axis, value) for axis, value in zip(AXES, size, strict=True) if abs(value) > NOTABLE
        ]
        if axes:
            said[name] = axes
    if len(said) == 1:
        name, axes = next(iter(said.items()))
        together = " together" if len(axes) > 1 else ""
        return f"{' and '.join(a for a, _ in axes)} of lidar '{name}'{together}"
    # Which way each one moves stands in the vector; a person wants to know what is affected.
    largest_of = dict.fromkeys(AXES, 0.0)
    for axes in said.values():
        for axis, value in axes:
            largest_of[axis] = max(largest_of[axis], abs(value))
    affected = sorted((a for a in AXES if largest_of[a] > 0.0), key=lambda a: -largest_of[a])
    names = " and ".join(f"'{name}'" for name in said)
    return f"{', '.join(affected)} of lidars {names} against each other"
