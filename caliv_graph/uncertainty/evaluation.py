"""Errors of a calibration against the truth, as the paper's Evaluation section defines them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gtsam
import numpy as np

from caliv_graph.products import Array, Calibration
from caliv_graph.uncertainty.pairs import pair_covariance, sensor_pairs

_MIN_EIGENVALUE = 1e-10
"""Of a covariance scaled to ones on its diagonal. Below it an inverse has no correct digits: files
keep twelve digits."""


def evaluate(
    calibration: Calibration,
    truth: Mapping[str, gtsam.Pose3],
    cov_pairs: Mapping[tuple[str, str], Array] | None = None,
) -> dict[str, Any]:
    """Errors in vehicle axes and NEES, as the paper's Evaluation section defines them.

    S2V: `t_est - t_true` and roll, pitch, yaw of `R_est R_true^T`. A pair (from a, to b):
    `T_vehicle_a` against `T_vehicle_b T_b_a(true)`, both extrinsics as estimated.

    Args:
        calibration: the estimate.
        truth: true `T_vehicle_lidar` per LiDAR. LiDARs that only one of the two has are left out.
        cov_pairs: per (from, to) the (6, 6) covariance of `T_to_from`, right perturbation, as a
            file states it; absent: every pair, from the joint covariance.

    Returns:
        Plain values: `{lidars: {<name>: {s2v: {translation_m: [3], rotation_rad: [3], nees}}},
        pairs: [{from, to, translation_m, rotation_rad, nees}]}`. A `nees` is None where the
        covariance has no inverse.
    """
    if cov_pairs is None:
        cov_pairs = {
            (source, to): pair_covariance(calibration, source, to)
            for source, to in sensor_pairs(calibration.lidars, calibration.reference)
        }
    estimates = {name: result.T_vehicle_lidar for name, result in calibration.lidars.items()}
    lidars = {
        name: {
            "s2v": _errors(estimates[name], truth[name], estimates[name], truth[name], lidar.cov)
        }
        for name, lidar in calibration.lidars.items()
        if name in truth
    }
    pairs = []
    for (source, to), cov in cov_pairs.items():
        if source not in truth or to not in truth:
            continue
        T_to_from = estimates[to].between(estimates[source])
        true_T_to_from = truth[to].between(truth[source])
        errors = _errors(
            estimates[source],
            estimates[to].compose(true_T_to_from),
            T_to_from,
            true_T_to_from,
            cov,
        )
        pairs.append({"from": source, "to": to, **errors})
    return {"lidars": lidars, "pairs": pairs}


def _errors(
    T_vehicle_estimated: gtsam.Pose3,
    T_vehicle_expected: gtsam.Pose3,
    T_est: gtsam.Pose3,
    T_true: gtsam.Pose3,
    cov: Array,
) -> dict[str, Any]:
    translation = T_vehicle_estimated.translation() - T_vehicle_expected.translation()
    R = T_vehicle_estimated.rotation().compose(T_vehicle_expected.rotation().inverse())
    return {
        "translation_m": [float(v) for v in translation],
        "rotation_rad": [float(v) for v in R.rpy()],
        "nees": _nees(np.asarray(gtsam.Pose3.Logmap(T_est.between(T_true))), cov),
    }


def _nees(error: Array, cov: Array) -> float | None:
    """Normalised estimation error squared; None if the covariance has no inverse."""
    sigma = np.sqrt(np.diag(cov))
    if not np.all(sigma > 0.0):
        return None
    # Variances of radians and metres differ by orders of magnitude; correlations do not.
    correlation = cov / np.outer(sigma, sigma)
    if np.linalg.eigvalsh(correlation)[0] < _MIN_EIGENVALUE:
        return None
    whitened = error / sigma
    return float(whitened @ np.linalg.solve(correlation, whitened))
