"""A calibration against known extrinsics: errors, sigmas and NEES of the axes it determines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import gtsam
import numpy as np

from caliv_graph.common.exits import exit_code
from caliv_graph.conventions import AXES
from caliv_graph.geometry.covariance import parent_axes_covariance
from caliv_graph.products import Array, Calibration
from caliv_graph.uncertainty.evaluation import evaluate
from caliv_graph.uncertainty.pairs import pair_covariance, pair_determined


def judged(
    calibration: Calibration, T_vehicle_lidar: Mapping[str, gtsam.Pose3]
) -> dict[str, dict[str, Any]]:
    """Quantity (`S2V a`, `S2S a to b`) -> errors and sigmas (rad, m, vehicle axes), NEES."""
    found = evaluate(calibration, T_vehicle_lidar)
    errors = {}
    for name, of in found["lidars"].items():
        lidar = calibration.lidars[name]
        errors[f"S2V {name}"] = _judged(of["s2v"], name, lidar.cov, lidar.determined, calibration)
    for of in found["pairs"]:
        a, b = of["from"], of["to"]
        cov, determined = pair_covariance(calibration, a, b), pair_determined(calibration, a, b)
        errors[f"S2S {a} to {b}"] = _judged(of, a, cov, determined, calibration)
    return errors


def outcome_of(
    calibration: Calibration, T_vehicle_lidar: Mapping[str, gtsam.Pose3]
) -> dict[str, Any]:
    """Exit code, messages and errors of a calibration, as part of a run's line."""
    return {
        "exit": exit_code(calibration),
        "said": [*calibration.contradictions, *calibration.unmet],
        "undetermined": [direction.text for direction in calibration.undetermined],
        "errors": judged(calibration, T_vehicle_lidar),
    }


def worst(errors: Mapping[str, Mapping[str, Any]]) -> float:
    """Largest error of some quantities over its sigma; 0 if nothing is determined."""
    return max((s for of in errors.values() for s in sigmas_off(of)), default=0.0)


def sigmas_off(of: Mapping[str, Any]) -> list[float]:
    """Errors of the determined axes of a quantity over their sigmas, absolute."""
    pairs = zip(of["error"], of["sigma"], strict=True)
    return [abs(error) / sigma for error, sigma in pairs if error is not None]


def nees_text(of: Mapping[str, Any]) -> str:
    """The NEES of a quantity and its number of axes, after a comma; empty if there is none."""
    return "" if of["nees"] is None else f", NEES {of['nees']:.1f} of {of['axes']}"


def rows_of(outcome: Mapping[str, Any]) -> Iterator[str]:
    """A line per S2V and S2S, then what the calibration says of itself."""
    for name, of in outcome["errors"].items():
        cells = [
            f"{axis} {1e3 * error:.2f} ± {1e3 * sigma:.2f}"
            for axis, error, sigma in zip(AXES, of["error"], of["sigma"], strict=True)
            if error is not None
        ]
        far = f", worst {worst({name: of}):.1f} sigmas"
        yield f"  {name} (mrad, mm): {', '.join(cells)}{nees_text(of)}{far}"
    for text in outcome["undetermined"]:
        yield f"  not determined: {text}"
    for text in outcome["said"]:
        yield f"  {text}"


def _judged(
    of: Mapping[str, Any],
    lidar: str,
    cov: Array,
    determined: Mapping[str, bool],
    calibration: Calibration,
) -> dict[str, Any]:
    """Errors (rad, m), sigmas and NEES of the determined axes; None: an undetermined axis."""
    told = np.array([determined[axis] for axis in AXES])
    error = np.array([*of["rotation_rad"], *of["translation_m"]])
    cov = parent_axes_covariance(calibration.lidars[lidar].T_vehicle_lidar, cov)
    sigma = np.sqrt(np.diag(cov))
    part = cov[np.ix_(told, told)] / np.outer(sigma[told], sigma[told])
    whitened = error[told] / sigma[told]
    return {
        "error": [float(e) if t else None for e, t in zip(error, told, strict=True)],
        "sigma": sigma.tolist(),
        "nees": float(whitened @ np.linalg.solve(part, whitened)) if told.any() else None,
        "axes": int(told.sum()),
    }
