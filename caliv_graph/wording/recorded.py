"""Sentences on a recorded drive that a prediction takes its vehicle from."""

from __future__ import annotations

import math

_SENSORS = {"gnss": "the fixes", "orientation": "the IMU's orientation"}

_SHAPES = {
    "thin_chair": "thin chair",
    "boxes": "stack of boxes",
    "cones": "group of cones",
    "stroller": "pram",
}

INSTEAD = (
    "'caliv-graph observability' tells what this drive determines. For a next drive give plan a "
    "scenario with the vehicle's sensors, such as one of configs/scenarios"
)
"""What to do where a recorded drive cannot be planned with."""


def slow_error_sentence(kind: str, sigma: float, time_s: float) -> str:
    """An error that changes slowly; `sigma` in metres of a fix, radians of an orientation."""
    what = f"{sigma:.3f} m" if kind == "gnss" else f"{math.degrees(sigma):.3f} degrees"
    return (
        f"errors of {_SENSORS[kind]} are correlated over time, {what} over {time_s:.0f} s, "
        "which no predicted sigma includes"
    )


def heading_sentence() -> str:
    """Two antennas give a heading."""
    return "the heading of two antennas is not in the prediction: its sigmas are then too large"


def no_target_sentence(why: str, walls: bool | None) -> str:
    """The recorded drive shows no target; whether it has walls, None: they are not to be used."""
    because = f" ({why})" if why else ""
    instead = "it is predicted by walls and ground"
    if not walls:
        none = "walls are not used" if walls is None else "it passes no walls"
        instead = f"and {none}: there are no sigmas of it here"
    return (
        f"no target is known in the recorded drive{because}, {instead}. Next drives are planned "
        "past a chair"
    )


def walls_sentence() -> str:
    """The config uses structure, and the drive has none."""
    return (
        "the recorded drive shows no walls: its sigmas are those of target and ground alone "
        "(structure.use)"
    )


def target_sentence(name: str, shape: str, width_m: tuple[float, float], height_m: float) -> str:
    """What a target is taken for; its widths from the narrowest to the widest side."""
    return (
        f"'{name}' is planned as a {_SHAPES.get(shape, shape)}, the nearest of the known shapes: "
        f"it looks {width_m[0]:.2f} to {width_m[1]:.2f} m wide and {height_m:.2f} m high"
    )


def height_sentence(height_m: float) -> str:
    """The vehicle's height is not in the config."""
    return (
        f"the vehicle frame is {height_m:.2f} m above ground by the ground that the LiDARs see "
        "(ground.vehicle_height gives none)"
    )


def unknown_height_sentence() -> str:
    """Nor do the LiDARs show it."""
    return (
        "ground.vehicle_height gives no height of the vehicle frame, and no LiDAR shows the "
        "ground: the frame is taken to be on it"
    )
