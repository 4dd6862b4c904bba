"""Sentences about time offsets: what the data do not determine, and clocks that are late."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from caliv_graph.products import TIME_OFFSETS, VehicleParameter
from caliv_graph.wording.directions import PARAMETER_KEYS

LATE_SIGMAS, LATE_S = 4.0, 2e-3
"""Sigmas and seconds from which the user hears that a clock is off: less matters to nobody who
merges sensors, and of the noise of a sound drive one in 16,000 is 4 sigmas."""


def late_clock_sentences(vehicle: Mapping[str, VehicleParameter]) -> Iterator[str]:
    """A sentence per sensor of the motion whose clock is off, by name of `VehicleParameter`."""
    for name in (name for name in TIME_OFFSETS if name in vehicle):
        value_s, sigma_s = float(vehicle[name].value[0]), float(vehicle[name].sigma[0])
        if abs(value_s) > max(LATE_SIGMAS * sigma_s, LATE_S):
            way = "late" if value_s > 0.0 else "early"
            yield (
                f"{PARAMETER_KEYS[name]}: the stamps are {1e3 * abs(value_s):.1f} +- "
                f"{1e3 * sigma_s:.1f} ms {way} against the other sensors. The extrinsics count "
                "that; whatever else merges these sensors has to: correct the clock"
            )


def undetermined_offset_sentences(sigmas_s: Mapping[str, float], limit_s: float) -> Iterator[str]:
    """A sentence per LiDAR whose time offset has a sigma (seconds) of the limit or more."""
    for name, sigma in sigmas_s.items():
        if sigma >= limit_s:
            yield (
                f"lidar '{name}': the drive does not determine its time offset (sigma "
                f"{1e3 * sigma:.0f} ms, limit {1e3 * limit_s:.0f} ms), and the sigmas of its "
                "extrinsics count that. Drive a figure-eight, or vary the speed; if its clock is "
                "synchronised, set solve.time_offset: false"
            )
