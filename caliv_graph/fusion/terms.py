"""What the data of a drive say about the extrinsics, as a quadratic that can be moved and summed.

Everything is in vehicle axes (see `conventions`), LiDARs in the order of a term's extrinsics.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace

import gtsam
import numpy as np
from scipy.linalg import block_diag

from caliv_graph.calibration.assemble import DRIVES
from caliv_graph.calibration.guesses import DEFAULT_GUESS_SIGMAS
from caliv_graph.errors import ConfigError
from caliv_graph.geometry.se3 import (
    retract_vehicle_axes,
    right_to_vehicle_axes,
    vehicle_axes_difference,
)
from caliv_graph.products import Array, Calibration, DataTerm, Guess, MotionData
from caliv_graph.uncertainty.observability import (
    covariance_with_prior_in_null_space,
    scaling,
    spectrum,
    step_with_prior_in_null_space,
)

_STEPS = 20
_STEP_TOLERANCE = 1e-12
"""Steps of `fuse`, and the step (rad, m) at which it has converged; each gains several digits."""

_STEPS_UNDECIDED = 3
"""Steps of `fuse` after which the number of undetermined directions is no longer changed."""

_LEAST_EIGENVALUE = 1e-12
"""Of an information scaled to ones on its diagonal, below which it is zero: files keep twelve
digits."""


_DIGESTED_ROWS = 65_536


def drive_digest(motion: MotionData) -> str:
    """Digest of a drive, the same for whatever is calibrated from it.

    It is taken of what the recording tells of the vehicle's motion: to the last digit of the noise
    no two drives are the same, and LiDARs that share the vehicle's poses share their errors.

    Args:
        motion: of the recording; its name is left out.
    """
    digest = hashlib.sha256()
    _feed(digest, replace(motion, name=""))
    return digest.hexdigest()


def _feed(digest: hashlib._Hash, value: object) -> None:
    if is_dataclass(value):
        for item in fields(value):
            digest.update(item.name.encode())
            _feed(digest, getattr(value, item.name))
    elif isinstance(value, tuple):
        for part in value:
            _feed(digest, part)
    elif isinstance(value, gtsam.Pose3):
        digest.update(np.ascontiguousarray(value.matrix()).tobytes())
    elif isinstance(value, np.ndarray):
        # In parts: bytes are a copy, and of what repeats one covariance they are all of it.
        rows = np.atleast_1d(value)
        for begin in range(0, len(rows), _DIGESTED_ROWS):
            digest.update(np.ascontiguousarray(rows[begin : begin + _DIGESTED_ROWS]).tobytes())
    else:
        digest.update(repr(value).encode())


def own_term(calibration: Calibration, label: str) -> DataTerm:
    """What the data of a calibration say, without guesses and without earlier calibrations.

    A file that does not state the gradient (another program's) is believed to be where its data
    are best met, except along the directions that it names as undetermined: of these, its data are
    taken to say nothing.

    Args:
        calibration: the calibration.
        label: what to call it in messages.

    Raises:
        ConfigError: the gradient is missing from a result in two stages, which is not where its
            data are best met.
    """
    poses = {name: lidar.T_vehicle_lidar for name, lidar in calibration.lidars.items()}
    axes = _axes(poses)
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


def _axes(poses: Mapping[str, gtsam.Pose3]) -> Array:
    """(6n, 6n) from right perturbations to vehicle axes."""
    return np.asarray(block_diag(*(right_to_vehicle_axes(T) for T in poses.values())))


def _without(information: Array, calibration: Calibration, names: Sequence[str]) -> Array:
    """The information with none along the directions that a file names as undetermined."""
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
    """Digests of the drives; where a file names none, one of what it says."""
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

    From `Exp(w_old) R_old = Exp(w_new) R_new`: the old perturbation is the new one, turned by the
    Jacobian of the logarithm, less the difference of the extrinsics.
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


def arranged(term: DataTerm, names: Sequence[str]) -> tuple[Array, Array]:
    """Information and gradient over the LiDARs `names`, in their order.

    Those that the term does not know get zeros; those that are not asked for are eliminated.

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
    """Of an information matrix: what it says nothing about is left out."""
    diagonal = np.diag(information)
    scale = np.where(diagonal > 0.0, diagonal, 1.0) ** -0.5
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    kept = values > _LEAST_EIGENVALUE * len(values)
    half = scale[:, None] * vectors[:, kept] / np.sqrt(values[kept])
    return np.asarray(half @ half.T)


@dataclass(frozen=True)
class Fused:
    """Where several terms and one set of guesses put the extrinsics.

    Attributes:
        T_vehicle_lidar: the estimate.
        information: (6n, 6n) of all data, vehicle axes.
        gradient: (6n,) of all data at the estimate.
        trusted: (6n, 6n) of the guesses that are `fixed`.
        prior: (6n, 6n) of all guesses, the fixed ones as if they were not.
        cov: (6n, 6n) of the estimate, guesses included as `mode` uses them.
    """

    T_vehicle_lidar: Mapping[str, gtsam.Pose3]
    information: Array
    gradient: Array
    trusted: Array
    prior: Array
    cov: Array


def fuse(terms: Sequence[DataTerm], guesses: Mapping[str, Guess], mode: str = "auto") -> Fused:
    """Solves for the extrinsics from what the data of several drives say, and the guesses once.

    Gauss-Newton on the sum of the quadratics, each moved to the current estimate: the joint solve
    of the drives, as far as each is quadratic about its own estimate.

    Args:
        terms: the data, every drive once.
        guesses: of every LiDAR, in the order of the result.
        mode: `auto`: the guesses decide along what all data together do not determine, and only
            there (SPEC 3). `joint`: they count as one more measurement.
    """
    names = list(guesses)
    # A trusted guess is a measurement: against itself it would look like nothing determined.
    fixed = np.repeat([guesses[name].fixed for name in names], 6)
    certainty = np.concatenate([guesses[name].sigmas for name in names]) ** -2.0
    trusted = np.diag(fixed * certainty)
    prior = np.diag(np.where(fixed, np.tile(DEFAULT_GUESS_SIGMAS, len(names)) ** -2.0, certainty))
    poses = {name: _start(name, terms, guesses[name]) for name in names}
    undetermined: int | None = None
    for step_number in range(_STEPS):
        D, c = _total(terms, poses)
        offset = np.concatenate(
            [vehicle_axes_difference(poses[n], guesses[n].T_vehicle_lidar) for n in names]
        )
        told, pull = D + trusted, c - trusted @ offset
        if mode == "joint":
            step = np.linalg.solve(told + prior, pull - prior @ offset)
        else:
            split = spectrum(told, prior, undetermined)
            if step_number >= _STEPS_UNDECIDED:
                undetermined = int(split.undetermined.sum())
            step = step_with_prior_in_null_space(told, pull, prior, offset, split)
        poses = {
            n: retract_vehicle_axes(poses[n], step[6 * i : 6 * i + 6]) for i, n in enumerate(names)
        }
        if np.abs(step).max() < _STEP_TOLERANCE:
            break
    D, c = _total(terms, poses)
    if mode == "joint":
        cov = np.asarray(np.linalg.inv(D + trusted + prior), np.float64)
    else:
        cov = covariance_with_prior_in_null_space(prior, spectrum(D + trusted, prior, undetermined))
    return Fused(poses, D, c, trusted, prior, 0.5 * (cov + cov.T))


def _start(name: str, terms: Sequence[DataTerm], guess: Guess) -> gtsam.Pose3:
    """The mounting of a LiDAR as the term that says most of it has it."""
    best, pose = 0.0, guess.T_vehicle_lidar
    for term in terms:
        for i, (known, T) in enumerate(term.T_vehicle_lidar.items()):
            said = float(np.diag(term.information)[6 * i : 6 * i + 6] @ scaling(1) ** 2)
            if known == name and said > best:
                best, pose = said, T
    return pose


def _total(terms: Sequence[DataTerm], poses: Mapping[str, gtsam.Pose3]) -> tuple[Array, Array]:
    """Sum of all terms at common extrinsics."""
    names = list(poses)
    D, c = np.zeros((6 * len(names), 6 * len(names))), np.zeros(6 * len(names))
    for term in terms:
        information, gradient = arranged(moved_to(term, poses), names)
        D, c = D + information, c + gradient
    return D, c


def guess_of(calibration: Calibration, name: str) -> Guess:
    """The guess of a LiDAR; where the file states none, the reported mounting, loosely."""
    lidar = calibration.lidars[name]
    return lidar.guess or Guess(lidar.T_vehicle_lidar, DEFAULT_GUESS_SIGMAS)
