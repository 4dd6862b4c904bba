"""Calibrations made up from what a drive would say: information, truth and noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from caliv_graph.config.guesses import DEFAULT_GUESS_SIGMAS
from caliv_graph.conventions import AXES
from caliv_graph.fusion.terms import fuse
from caliv_graph.geometry.se3 import retract_vehicle_axes, right_to_vehicle_axes
from caliv_graph.products import Array, Calibration, DataTerm, Guess, LidarResult
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
        changes: of the calibration.
    """
    true = {name: truth[name] for name in names}
    zero = np.zeros(6 * len(names))
    centre = moved(true, zero if error is None else error)
    start = moved(true, zero if guess_error is None else guess_error)
    guesses = {name: Guess(start[name], DEFAULT_GUESS_SIGMAS) for name in names}
    fused = fuse([DataTerm((source,), centre, D, zero)], guesses)
    uncertainty = assess(D, fused.prior, fused.T_vehicle_lidar)
    to_right = np.zeros((len(D), len(D)))
    for i, T in enumerate(fused.T_vehicle_lidar.values()):
        to_right[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = right_to_vehicle_axes(T).T
    cov = to_right @ fused.cov @ to_right.T
    lidars = {
        name: LidarResult(
            T_vehicle_lidar=T,
            cov=cov[6 * i : 6 * i + 6, 6 * i : 6 * i + 6],
            determined=uncertainty.determined[name],
            scans_used=50,
            saw_target=bool(np.any(D[6 * i : 6 * i + 6])),
            guess=guesses[name],
        )
        for i, (name, T) in enumerate(fused.T_vehicle_lidar.items())
    }
    calibration = Calibration(
        status="ok"
        if all(all(r.determined[a] for a in AXES) for r in lidars.values())
        else "partial",
        reference=reference or names[-1],
        lidars=lidars,
        cov_joint=cov,
        information_data=to_right @ fused.information @ to_right.T,
        undetermined=uncertainty.undetermined,
        weak=uncertainty.weak,
        unmet=(),
        provenance={"mode": "auto", "drive_sha256": [source]},
        gradient_data=to_right @ fused.gradient,
    )
    return replace(calibration, **changes)


def shift(names: Sequence[str], lidar: str, **axes: float) -> Array:
    """(6n,) perturbation of one LiDAR: `yaw=0.001` (rad), `x=0.01` (m)."""
    e = np.zeros(6 * len(names))
    for axis, value in axes.items():
        e[6 * names.index(lidar) + AXES.index(axis)] = value
    return e


DEGREE = math.radians(1.0)
