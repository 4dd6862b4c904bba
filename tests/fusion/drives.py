"""Calibrations made up from what a drive would say: information, truth and noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from caliv_graph.config.guesses import DEFAULT_GUESS_SIGMAS, FOUND_SIGMA
from caliv_graph.conventions import AXES
from caliv_graph.fusion.terms import fuse
from caliv_graph.geometry.se3 import retract_vehicle_axes
from caliv_graph.products import Array, Calibration, DataTerm, Guess
from caliv_graph.uncertainty.assemble import assemble_matrices
from caliv_graph.uncertainty.observability import assess
from tests.samples import MOUNTINGS, make_covariance, pose, turn_about_centre

TRUTH: Mapping[str, gtsam.Pose3] = {name: pose(*m) for name, m in MOUNTINGS.items()}


def information(names: Sequence[str], seed: int = 1) -> Array:
    """What a drive that determines everything says, vehicle axes: millimetres, milliradians."""
    return np.asarray(np.linalg.inv(make_covariance(len(names), seed)))


def arc_information(names: Sequence[str], seed: int = 1, left: bool = False) -> Array:
    """The same of a drive on an arc: nothing on the rotation of all about the turn's centre."""
    vector = turn_about_centre({name: TRUTH[name] for name in names}).vector
    direction = np.concatenate([vector[name] for name in names])
    if left:
        # The centre on the other side.
        for i, name in enumerate(names):
            y = TRUTH[name].translation()[1]
            direction[6 * i + 3] = -(y - 9.16)
    D = information(names, seed)
    along = D @ direction
    return np.asarray(D - np.outer(along, along) / (direction @ along))


def draw(D: Array, rng: np.random.Generator) -> Array:
    """An error that the information describes, zero where it says nothing."""
    unit = np.tile([1e-3] * 3 + [1e-2] * 3, len(D) // 6)
    values, vectors = np.linalg.eigh(D * np.outer(unit, unit))
    kept = values > 1e-9 * values.max()
    return np.asarray(
        unit * (vectors[:, kept] @ (rng.normal(size=int(kept.sum())) / np.sqrt(values[kept])))
    )


def moved(poses: Mapping[str, gtsam.Pose3], e: Array) -> dict[str, gtsam.Pose3]:
    """Extrinsics after a perturbation in vehicle axes."""
    return {
        name: retract_vehicle_axes(T, e[6 * i : 6 * i + 6])
        for i, (name, T) in enumerate(poses.items())
    }


def drive(
    D: Array,
    names: Sequence[str] = ("front", "rear"),
    *,
    source: str,
    error: Array | None = None,
    truth: Mapping[str, gtsam.Pose3] = TRUTH,
    guess_error: Array | None = None,
    reference: str | None = None,
    found: bool = False,
    **changes: Any,
) -> Calibration:
    """What `calibrate` would write of a drive.

    Args:
        D: (6n, 6n) information of its data, vehicle axes.
        names: LiDARs.
        source: digest of the drive.
        error: (6n,) of what its data say.
        truth: extrinsics.
        guess_error: (6n,) of the initial guess, by which the rest is decided.
        reference: LiDAR; absent: the last.
        found: nobody gave a guess.
        changes: of the calibration.
    """
    true = {name: truth[name] for name in names}
    zero = np.zeros(6 * len(names))
    centre = moved(true, zero if error is None else error)
    start = moved(true, zero if guess_error is None else guess_error)
    sigmas = FOUND_SIGMA.sigmas() if found else DEFAULT_GUESS_SIGMAS
    guesses = {name: Guess(start[name], sigmas, found=found) for name in names}
    fused = fuse([DataTerm((source,), centre, D, zero)], guesses)
    calibration = assemble_matrices(
        fused.T_vehicle_lidar,
        guesses,
        fused.cov,
        fused.information,
        assess(D, fused.prior, fused.T_vehicle_lidar),
        reference or names[-1],
        {name: 50 for i, name in enumerate(names) if np.any(D[6 * i : 6 * i + 6])},
        fused.gradient,
    )
    provenance = {"mode": "auto", "drive_sha256": [source]}
    return replace(calibration, **{"provenance": provenance, **changes})


def turned_on_its_arc(
    turn_rad: float, *, source: str, left: bool = False, error: Array | None = None
) -> Calibration:
    """A drive on an arc, without guesses: mountings found turned about the centre of the arc.

    Args:
        turn_rad: by which all LiDARs are off, which the drive does not tell.
        source: digest of the drive.
        left: arc to the left.
        error: (12,) of what its data say, in axes that are turned with the mountings.
    """
    names = ("front", "rear")
    centre = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 9.16 if left else -9.16, 0.0]))
    turn = gtsam.Pose3(gtsam.Rot3.Yaw(turn_rad), np.zeros(3))
    motion = centre.compose(turn).compose(centre.inverse())
    axes = np.kron(np.eye(4), turn.rotation().matrix())
    D = axes @ arc_information(names, 1 + left, left) @ axes.T
    truth = {name: motion.compose(TRUTH[name]) for name in names}
    return drive(D, names, source=source, error=error, truth=truth, found=True)


def shift(names: Sequence[str], lidar: str, **axes: float) -> Array:
    """(6n,) perturbation of one LiDAR: `yaw=0.001` (rad), `x=0.01` (m)."""
    e = np.zeros(6 * len(names))
    for axis, value in axes.items():
        e[6 * names.index(lidar) + AXES.index(axis)] = value
    return e


DEGREE = math.radians(1.0)
