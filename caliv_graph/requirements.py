"""What exit code 0 promises: `require` and `limits` against what was determined."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import permutations

import numpy as np

from caliv_graph.config import LIMIT_KEY, Config
from caliv_graph.conventions import AXES
from caliv_graph.geometry.covariance import parent_axes_covariance, relative_covariance
from caliv_graph.products import Array, Calibration


def unmet_requirements(calibration: Calibration, config: Config) -> Calibration:
    """The calibration with `unmet` filled in, a sentence for every promise not kept."""
    unmet = [
        f"lidar '{name}' never saw the target"
        for name, lidar in calibration.lidars.items()
        if not lidar.saw_target and not config.lidars[name].fixed
    ]
    for requirement in config.require:
        unmet += _unmet(calibration, requirement)
    for key, limit in config.limits.items():
        unmet += _over_limit(calibration, key, limit)
    return replace(calibration, unmet=tuple(dict.fromkeys(unmet)))


def _unmet(calibration: Calibration, requirement: str) -> list[str]:
    seen = {n: r for n, r in calibration.lidars.items() if r.saw_target}
    if requirement == "s2s":
        # What moves all LiDARs as one rigid body leaves sensor-to-sensor alone.
        apart = [d.text for d in calibration.undetermined if not d.together]
        return [f"require s2s: not determined: {text}" for text in apart]
    axes = AXES[:3] if requirement == "s2v_rotation" else AXES
    out = []
    for name, lidar in seen.items():
        lost = [axis for axis in axes if not lidar.determined[axis]]
        if lost:
            out.append(f"require {requirement}: {', '.join(lost)} of '{name}' not determined")
    return out


def sigmas_s2v(calibration: Calibration, name: str) -> Array:
    """(6,) sigmas of a LiDAR's mounting in vehicle axes, rad and m."""
    lidar = calibration.lidars[name]
    return np.sqrt(np.diag(parent_axes_covariance(lidar.T_vehicle_lidar, lidar.cov)))


def sigmas_s2s(calibration: Calibration, first: str, second: str) -> Array:
    """(6,) sigmas of `first` against `second` in vehicle axes, rad and m."""
    names = list(calibration.lidars)
    i, k = names.index(first), names.index(second)
    T_a = calibration.lidars[first].T_vehicle_lidar
    T_b = calibration.lidars[second].T_vehicle_lidar
    index = [*range(6 * i, 6 * i + 6), *range(6 * k, 6 * k + 6)]
    cov = relative_covariance(T_a, T_b, calibration.cov_joint[np.ix_(index, index)])
    return np.sqrt(np.diag(parent_axes_covariance(T_a, cov)))


def _over_limit(calibration: Calibration, key: str, limit: float) -> list[str]:
    match = LIMIT_KEY.match(key)
    if match is None:
        return []
    kind, angle, length = match.groups()
    axis = AXES.index(angle or length)
    unit, name_of_unit = (math.degrees(1.0), "degrees") if angle else (1.0, "m")
    seen = [n for n, r in calibration.lidars.items() if r.saw_target]
    out = []
    if kind == "s2v":
        sigmas = {f"'{n}'": sigmas_s2v(calibration, n)[axis] for n in seen}
    else:
        sigmas = {
            f"'{a}' to '{b}'": sigmas_s2s(calibration, a, b)[axis] for a, b in permutations(seen, 2)
        }
    for what, sigma in sigmas.items():
        if sigma * unit > limit:
            out.append(
                f"limits {key}: sigma of {what} is {sigma * unit:.3g} {name_of_unit}, "
                f"limit {limit:g}"
            )
    return out
