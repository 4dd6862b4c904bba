"""The information of a drive's data on the extrinsics: a quadratic that can be moved and summed.

All matrices are in vehicle axes (see `conventions`), with LiDARs in the order of a term's
extrinsics.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace

import gtsam
import numpy as np

from caliv_graph.calibration.assemble import DRIVES
from caliv_graph.config.guesses import DEFAULT_GUESS_SIGMAS, prior_sigmas, trust_information
from caliv_graph.errors import ConfigError
from caliv_graph.geometry.se3 import (
    joint_right_to_vehicle_axes,
    retract_vehicle_axes,
    vehicle_axes_difference,
)
from caliv_graph.products import Array, Calibration, DataTerm, GivenPoses, Guess, MotionData
from caliv_graph.trajectory.odometry import OdometryPoses
from caliv_graph.uncertainty.observability import (
    by_twist,
    covariance_with_prior_in_null_space,
    scaling,
    spectrum,
    step_with_prior_in_null_space,
    undetermined_motions,
)

_STEPS = 20
_STEP_TOLERANCE = 1e-12
"""Most steps of `fuse`, and the step (rad, m) at which it has converged."""

_STEPS_UNDECIDED = 3
"""Steps of `fuse` after which the number of undetermined directions is fixed."""

_LEAST_EIGENVALUE = 1e-12
"""Eigenvalues of an information scaled to a unit diagonal count as zero below this: files keep
twelve digits."""

_DIGESTED_ROWS = 65_536
"""Rows of an array that are digested at once, to bound the memory of their copy."""


def drive_digest(motion: MotionData) -> str:
    """Digest of a drive, the same for every calibration of it.

    It is the digest of the vehicle's motion data. The noise makes it different for every drive, and
    calibrations from the same motion data share its errors, whichever LiDARs they use.

    Args:
        motion: motion data of the recording; its name is left out.
    """
    digest = hashlib.sha256()
    motion = replace(motion, name="")
    if isinstance(motion.poses, OdometryPoses):
        # Without what the guess of the mounting makes of them.
        own = GivenPoses(motion.poses.stamps_ns, motion.poses.T_map_lidar)
        motion = replace(motion, poses=own)
    _feed(digest, motion)
    return digest.hexdigest()


_LATER = frozenset({"yaw_rate", "yaw_rate_var", "heading", "frame"})
"""Fields that came after digests had been written: the rest tells one drive from another."""


def _feed(digest: hashlib._Hash, value: object) -> None:
    if is_dataclass(value):
        for item in fields(value):
            if item.name in _LATER:
                continue
            digest.update(item.name.encode())
            _feed(digest, getattr(value, item.name))
    elif isinstance(value, tuple):
        for part in value:
            _feed(digest, part)
    elif isinstance(value, gtsam.Pose3):
        digest.update(np.ascontiguousarray(value.matrix()).tobytes())
    elif isinstance(value, np.ndarray):
        # In parts, because bytes are a copy, and a broadcast array would be expanded as a whole.
        rows = np.atleast_1d(value)
        for begin in range(0, len(rows), _DIGESTED_ROWS):
            digest.update(np.ascontiguousarray(rows[begin : begin + _DIGESTED_ROWS]).tobytes())
    else:
        digest.update(repr(value).encode())


def own_term(calibration: Calibration, label: str) -> DataTerm:
    """The information of a calibration's data, without guesses and earlier calibrations.

    A file without gradient (by another program) is assumed to be at the optimum of its data, except
    along the directions that it names as undetermined. Its data have no information along these.

    Args:
        calibration: the calibration.
        label: its name in messages.

    Raises:
        ConfigError: the gradient is missing from a result in two stages, which is not at the
            optimum of its data.
    """
    poses = {name: lidar.T_vehicle_lidar for name, lidar in calibration.lidars.items()}
    axes = joint_right_to_vehicle_axes(poses.values())
    information = axes @ calibration.information_data @ axes.T
    if calibration.gradient_data is not None:
        gradient = axes @ calibration.gradient_data
    elif calibration.provenance.get("mode") == "staged":
        raise ConfigError(
            f"{label}: joint.data_gradient is missing, and a result in two stages cannot be "
            "compared or merged without it. Calibrate again"
        )
    else:
        gradient = np.zeros(len(information))
        information = _without(information, calibration, list(poses))
    return DataTerm(_sources(calibration), poses, 0.5 * (information + information.T), gradient)


def _without(information: Array, calibration: Calibration, names: Sequence[str]) -> Array:
    """The information without the directions that a file names as undetermined."""
    if not calibration.undetermined:
        return information
    unit = scaling(len(names))
    named = [
        np.concatenate([direction.vector.get(name, np.zeros(6)) for name in names])
        for direction in calibration.undetermined
    ]
    basis = np.linalg.qr((np.array(named) / unit).T)[0]
    keep = (np.eye(len(unit)) - basis @ basis.T) * np.outer(unit, 1.0 / unit)
    return np.asarray(keep.T @ information @ keep)


def _sources(calibration: Calibration) -> tuple[str, ...]:
    """Digests of the drives; for a file that names none, a digest of its content."""
    named = calibration.provenance.get(DRIVES)
    if isinstance(named, list | tuple) and named:
        return tuple(str(item) for item in named)
    digest = hashlib.sha256(np.ascontiguousarray(calibration.information_data).tobytes())
    for name, lidar in calibration.lidars.items():
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(lidar.T_vehicle_lidar.matrix()).tobytes())
    return (f"result:{digest.hexdigest()}",)


def moved_to(term: DataTerm, T_vehicle_lidar: Mapping[str, gtsam.Pose3]) -> DataTerm:
    """The same quadratic about other extrinsics of its LiDARs, to first order in rotations.

    From `Exp(w_old) R_old = Exp(w_new) R_new`, the old perturbation is the difference of the
    extrinsics plus the Jacobian of the logarithm times the new perturbation.
    """
    jacobian = np.eye(len(term.gradient))
    difference = np.zeros(len(term.gradient))
    poses = {}
    for i, (name, T_old) in enumerate(term.T_vehicle_lidar.items()):
        poses[name] = T_vehicle_lidar[name]
        d = vehicle_axes_difference(T_old, poses[name])
        difference[6 * i : 6 * i + 6] = d
        jacobian[6 * i : 6 * i + 3, 6 * i : 6 * i + 3] = gtsam.Rot3.LogmapDerivative(d[:3])
    information = jacobian.T @ term.information @ jacobian
    gradient = jacobian.T @ (term.gradient + term.information @ difference)
    return DataTerm(term.sources, poses, 0.5 * (information + information.T), gradient)


def slid(
    term: DataTerm, T_vehicle_lidar: Mapping[str, gtsam.Pose3], guesses: Mapping[str, Guess]
) -> DataTerm:
    """The same quadratic nearer to other extrinsics, along what its data leave undetermined.

    Data that do not determine a motion of the whole sensor set, such as a turn about the centre of
    an arc, look the same after any amount of it: extrinsics and axes of the quadratic turn with it.
    A straight step in its place leaves the circle, by 11 mm after 50 mrad about a centre 9 m away.

    Args:
        term: the term.
        T_vehicle_lidar: extrinsics of its LiDARs to come near to.
        guesses: of its LiDARs. They only decide what counts as undetermined.
    """
    diagonal = np.diag(term.information).reshape(-1, 6)
    names = [n for n, own in zip(term.T_vehicle_lidar, diagonal, strict=True) if own.any()]
    seen = only(term, names)
    sigmas = np.array([prior_sigmas(guesses[name]) for name in names]).ravel()
    motions = undetermined_motions(seen.information, np.diag(sigmas**-2.0), seen.T_vehicle_lidar)
    if not motions.shape[1]:
        return term
    unit = scaling(len(names))
    turned, amount = seen.T_vehicle_lidar, np.zeros(motions.shape[1])
    motion = gtsam.Pose3()
    for _ in range(_STEPS):
        left = np.concatenate(
            [vehicle_axes_difference(T_vehicle_lidar[name], T) for name, T in turned.items()]
        )
        step = np.linalg.lstsq(by_twist(turned.values()) @ motions, left / unit)[0]
        amount = amount + step
        motion = gtsam.Pose3.Expmap(motions @ amount)
        turned = {name: motion.compose(T) for name, T in seen.T_vehicle_lidar.items()}
        if np.abs(motions @ step).max() < _STEP_TOLERANCE:
            break
    axes = np.kron(np.eye(2 * len(names)), motion.rotation().matrix())
    way = unit * (by_twist(seen.T_vehicle_lidar.values()) @ motions @ amount)
    information = axes @ seen.information @ axes.T
    known = list(term.T_vehicle_lidar)
    rows = np.array([6 * known.index(name) + a for name in names for a in range(6)])
    D, c = np.zeros_like(term.information), np.zeros_like(term.gradient)
    D[np.ix_(rows, rows)] = 0.5 * (information + information.T)
    c[rows] = axes @ (seen.gradient - seen.information @ way)
    return DataTerm(term.sources, {**term.T_vehicle_lidar, **turned}, D, c)


def brought_to(
    term: DataTerm, T_vehicle_lidar: Mapping[str, gtsam.Pose3], guesses: Mapping[str, Guess]
) -> DataTerm:
    """The same quadratic about other extrinsics: `slid` near to them, then `moved_to` them."""
    return moved_to(slid(term, T_vehicle_lidar, guesses), T_vehicle_lidar)


def arranged(term: DataTerm, names: Sequence[str]) -> tuple[Array, Array]:
    """Information and gradient over the LiDARs `names`, in their order.

    LiDARs that the term lacks get zeros. LiDARs of the term that are not in `names` are eliminated.

    Args:
        term: the term.
        names: n LiDARs.

    Returns:
        (6n, 6n) and (6n,).
    """
    known = list(term.T_vehicle_lidar)
    kept, gone = (
        np.array(
            [6 * i + a for i, n in enumerate(known) if (n in names) is wanted for a in range(6)]
        ).astype(np.int64)
        for wanted in (True, False)
    )
    information, gradient = term.information[np.ix_(kept, kept)], term.gradient[kept]
    if len(gone):
        across = term.information[np.ix_(kept, gone)]
        inverse = _pseudo_inverse(term.information[np.ix_(gone, gone)])
        information = information - across @ inverse @ across.T
        gradient = gradient - across @ inverse @ term.gradient[gone]
    D, c = np.zeros((6 * len(names), 6 * len(names))), np.zeros(6 * len(names))
    order = [name for name in known if name in names]
    rows = np.array([6 * names.index(n) + a for n in order for a in range(6)], dtype=np.int64)
    D[np.ix_(rows, rows)], c[rows] = 0.5 * (information + information.T), gradient
    return D, c


def _pseudo_inverse(information: Array) -> Array:
    """Pseudo-inverse of an information matrix, over the directions with information."""
    diagonal = np.diag(information)
    scale = np.where(diagonal > 0.0, diagonal, 1.0) ** -0.5
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    kept = values > _LEAST_EIGENVALUE * len(values)
    half = scale[:, None] * vectors[:, kept] / np.sqrt(values[kept])
    return np.asarray(half @ half.T)


@dataclass(frozen=True)
class Fused:
    """The extrinsics estimated from several terms and one set of guesses.

    Attributes:
        T_vehicle_lidar: the estimate.
        information: (6n, 6n) information of all data, vehicle axes.
        gradient: (6n,) gradient of all data at the estimate.
        trusted: (6n, 6n) information of the guesses that are `fixed`.
        prior: (6n, 6n) information of all guesses, with default sigmas for the fixed ones.
        cov: (6n, 6n) covariance of the estimate, with the guesses as `mode` uses them.
    """

    T_vehicle_lidar: Mapping[str, gtsam.Pose3]
    information: Array
    gradient: Array
    trusted: Array
    prior: Array
    cov: Array


def fuse(terms: Sequence[DataTerm], guesses: Mapping[str, Guess], mode: str = "auto") -> Fused:
    """Estimates the extrinsics from the data of several drives and one set of guesses.

    Gauss-Newton on the sum of the quadratics, each brought to the current estimate. This equals the
    joint solve of the drives as far as each is quadratic about its own estimate.

    Args:
        terms: the data, every drive once.
        guesses: guess of every LiDAR, in the order of the result.
        mode: `auto`: the guesses decide only along directions that all data together leave
            undetermined (caliv_graph/calibration/README.md). `joint`: they are one more
            measurement.
    """
    names = list(guesses)
    trusted = trust_information([guesses[name] for name in names])
    prior = np.diag(np.concatenate([prior_sigmas(guesses[name]) for name in names]) ** -2.0)
    poses = {name: _start(name, terms, guesses[name]) for name in names}
    undetermined: int | None = None
    for step_number in range(_STEPS):
        D, c = _total(terms, poses, guesses)
        offset = np.concatenate(
            [vehicle_axes_difference(poses[n], guesses[n].T_vehicle_lidar) for n in names]
        )
        measured, pull = D + trusted, c - trusted @ offset
        if mode == "joint":
            step = np.linalg.solve(measured + prior, pull - prior @ offset)
        else:
            split = spectrum(measured, prior, undetermined)
            if step_number >= _STEPS_UNDECIDED:
                undetermined = int(split.undetermined.sum())
            step = step_with_prior_in_null_space(measured, pull, prior, offset, split)
        poses = {
            n: retract_vehicle_axes(poses[n], step[6 * i : 6 * i + 6]) for i, n in enumerate(names)
        }
        if np.abs(step).max() < _STEP_TOLERANCE:
            break
    D, c = _total(terms, poses, guesses)
    if mode == "joint":
        cov = np.asarray(np.linalg.inv(D + trusted + prior), np.float64)
    else:
        cov = covariance_with_prior_in_null_space(prior, spectrum(D + trusted, prior, undetermined))
    return Fused(poses, D, c, trusted, prior, 0.5 * (cov + cov.T))


def _start(name: str, terms: Sequence[DataTerm], guess: Guess) -> gtsam.Pose3:
    """The extrinsic of a LiDAR in the term with the most information on it."""
    best, pose = 0.0, guess.T_vehicle_lidar
    for term in terms:
        for i, (known, T) in enumerate(term.T_vehicle_lidar.items()):
            amount = float(np.diag(term.information)[6 * i : 6 * i + 6] @ scaling(1) ** 2)
            if known == name and amount > best:
                best, pose = amount, T
    return pose


def _total(
    terms: Sequence[DataTerm], poses: Mapping[str, gtsam.Pose3], guesses: Mapping[str, Guess]
) -> tuple[Array, Array]:
    """Sum of all terms at common extrinsics."""
    names = list(poses)
    D, c = np.zeros((6 * len(names), 6 * len(names))), np.zeros(6 * len(names))
    for term in terms:
        information, gradient = arranged(brought_to(only(term, names), poses, guesses), names)
        D, c = D + information, c + gradient
    return D, c


def only(term: DataTerm, names: Sequence[str]) -> DataTerm:
    """A term without the LiDARs that are not in `names`: they are eliminated."""
    known = [name for name in term.T_vehicle_lidar if name in names]
    if len(known) == len(term.T_vehicle_lidar):
        return term
    information, gradient = arranged(term, known)
    poses = {name: term.T_vehicle_lidar[name] for name in known}
    return DataTerm(term.sources, poses, information, gradient)


def guess_of(calibration: Calibration, name: str) -> Guess:
    """The guess of a LiDAR; if the file has none, the reported extrinsic with default sigmas."""
    lidar = calibration.lidars[name]
    return lidar.guess or Guess(lidar.T_vehicle_lidar, DEFAULT_GUESS_SIGMAS)
