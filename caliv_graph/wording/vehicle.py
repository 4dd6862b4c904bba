"""What was measured by hand on the vehicle, as a solve estimated it."""

from __future__ import annotations

import numpy as np

from caliv_graph.products import TURNS, VehicleParameter
from caliv_graph.wording.directions import PARAMETER_KEYS


def vehicle_text(name: str, found: VehicleParameter) -> str:
    """One line: value, sigma, what the drive determines, and which axes of S2V it limits."""
    if name == "speed_scale":
        scales, sigmas = _numbers(found.value, 4), _numbers(found.sigma, 5)
        return f"{PARAMETER_KEYS[name]}: ({scales}), sigma ({sigmas}), one per drive"
    if name == "heading_yaw":
        turns, sigmas = (_numbers(np.degrees(v), 3) for v in (found.value, found.sigma))
        return f"{PARAMETER_KEYS[name]}: ({turns}), sigma ({sigmas}) degrees, one per drive"
    turn = name in TURNS
    unit, digits = ("degrees", 2) if turn else ("m", 3)
    value, sigma = (
        (np.degrees(found.value), np.degrees(found.sigma))
        if turn
        else (
            found.value,
            found.sigma,
        )
    )
    axes = ("roll", "pitch", "yaw") if turn else ("x", "y", "z")
    told = [axis for axis, yes in zip(axes, found.determined, strict=True) if yes]
    drive = f"the drive determines {', '.join(told)}" if told else "the drive adds nothing"
    text = (
        f"{PARAMETER_KEYS[name]}: ({_numbers(value, digits)}) {unit}, sigma "
        f"({_numbers(sigma, digits + 1)}) {unit}; {drive}"
    )
    if not found.limits:
        return text
    return f"{text}. Half or more of the variance of S2V {', '.join(found.limits)} comes from it"


def _numbers(values: np.typing.NDArray[np.float64], digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values.tolist())
