"""What exit code 0 promises: `require` and `limits` against what was determined."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from caliv_graph.config.model import LIMIT_KEY, Config
from caliv_graph.conventions import AXES
from caliv_graph.products import Calibration
from caliv_graph.uncertainty.pairs import pair_determined, sensor_pairs, sigmas_s2s, sigmas_s2v


def unmet_requirements(calibration: Calibration, config: Config) -> Calibration:
    """The calibration with `unmet` filled in, a sentence for every promise not kept."""
    unmet = [
        f"lidar '{name}' never saw the target"
        for name, lidar in calibration.lidars.items()
        if not lidar.has_data and not config.lidars[name].fixed
    ]
    for requirement in config.require:
        unmet += _unmet(calibration, requirement)
    for key, limit in config.limits.items():
        unmet += _over_limit(calibration, key, limit)
    return replace(calibration, unmet=tuple(dict.fromkeys(unmet)))


def _placed(calibration: Calibration) -> list[str]:
    return [name for name, lidar in calibration.lidars.items() if lidar.placed]


def _unmet(calibration: Calibration, requirement: str) -> list[str]:
    verdicts: dict[str, tuple[Sequence[str], Mapping[str, bool]]]
    if requirement == "s2s":
        verdicts = {
            f"'{a}' to '{b}'": (AXES, pair_determined(calibration, a, b))
            for a, b in sensor_pairs(_placed(calibration), calibration.reference)
        }
    else:
        axes = AXES[:3] if requirement == "s2v_rotation" else AXES
        verdicts = {
            f"'{name}'": (axes, calibration.lidars[name].determined)
            for name in _placed(calibration)
        }
    out = []
    for what, (needed, determined) in verdicts.items():
        lost = [axis for axis in needed if not determined[axis]]
        if lost:
            out.append(f"require {requirement}: {', '.join(lost)} of {what} not determined")
    return out


def _over_limit(calibration: Calibration, key: str, limit: float) -> list[str]:
    match = LIMIT_KEY.match(key)
    if match is None:
        return []
    kind, angle, length = match.groups()
    axis = AXES.index(angle or length)
    unit, name_of_unit = (math.degrees(1.0), "degrees") if angle else (1.0, "m")
    placed = _placed(calibration)
    if kind == "s2v":
        sigmas = {f"'{name}'": sigmas_s2v(calibration, name) for name in placed}
    else:
        sigmas = {
            f"'{a}' to '{b}'": sigmas_s2s(calibration, a, b)
            for a, b in sensor_pairs(placed, calibration.reference)
        }
    return [
        f"limits {key}: sigma of {what} is {sigma[axis] * unit:.3g} {name_of_unit}, limit {limit:g}"
        for what, sigma in sigmas.items()
        if sigma[axis] * unit > limit
    ]
