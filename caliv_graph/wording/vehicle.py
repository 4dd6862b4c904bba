"""What was measured on the vehicle, and clocks of its sensors, as a solve estimated them."""

from __future__ import annotations

import numpy as np

from caliv_graph.products import TIME_OFFSETS, TURNS, VehicleParameter
from caliv_graph.wording.directions import PARAMETER_KEYS


def vehicle_text(name: str, found: VehicleParameter) -> str:
    """One line: value, sigma, what the drive determines, and which axes of S2V it limits."""
    if name == "speed_scale":
        scales, sigmas = _numbers(found.value, 4), _numbers(found.sigma, 5)
        return f"{PARAMETER_KEYS[name]}: ({scales}), sigma ({sigmas}), one per drive"
    if name == "heading_yaw":
        turns, sigmas = (_numbers(np.degrees(v), 3) for v in (found.value, found.sigma))
        return f"{PARAMETER_KEYS[name]}: ({turns}), sigma ({sigmas}) degrees, one per drive"
    if name in TIME_OFFSETS:
        late = f"{1e3 * found.value[0]:+.2f} ms" if found.determined[0] else "not determined"
        sigma_ms = 1e3 * float(found.sigma[0])
        return f"{PARAMETER_KEYS[name]}: {late}, sigma {sigma_ms:.2f} ms{_limits(found)}"
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
    return f"{text}{_limits(found)}"


def _limits(found: VehicleParameter) -> str:
    if not found.limits:
        return ""
    return f". Half or more of the variance of S2V {', '.join(found.limits)} comes from it"


def _numbers(values: np.typing.NDArray[np.float64], digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values.tolist())
