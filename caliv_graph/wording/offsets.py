"""Sentences about time offsets: what the data do not determine, and clocks that are late."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from caliv_graph.products import TIME_OFFSETS, VehicleParameter
from caliv_graph.wording.directions import PARAMETER_KEYS

LATE_SIGMAS, LATE_S = 4.0, 2e-3
"""Sigmas and seconds from which the user hears that a clock is off: less matters to nobody who
merges sensors, and of the noise of a sound drive one in 16,000 is 4 sigmas."""


_LOOKS_THE_SAME = {
    "gnss_time_offset": "gnss.lever_arm",
    "imu_time_offset": "imu.T_vehicle_imu",
    "twist_time_offset": "wheels.T_vehicle_wheels",
    "pose_time_offset": "the frame of the poses",
}
"""What else moves the same measurements along the course while the speed hardly changes."""


def late_clock_sentences(vehicle: Mapping[str, VehicleParameter]) -> Iterator[str]:
    """A sentence per sensor of the motion whose clock is off, by name of `VehicleParameter`.

    An offset that the drive does not determine may as well be an error of the arm.
    """
    for name in (name for name in TIME_OFFSETS if name in vehicle):
        value_s, sigma_s = float(vehicle[name].value[0]), float(vehicle[name].sigma[0])
        if abs(value_s) <= max(LATE_SIGMAS * sigma_s, LATE_S):
            continue
        size = f"{1e3 * abs(value_s):.1f} +- {1e3 * sigma_s:.1f} ms"
        way, key = "late" if value_s > 0.0 else "early", PARAMETER_KEYS[name]
        if vehicle[name].determined[0]:
            yield (
                f"{key}: the stamps are {size} {way} against the other sensors. The extrinsics "
                "count that; whatever else merges these sensors has to: correct the clock"
            )
        else:
            yield (
                f"{key}: the stamps seem {size} {way} against the other sensors, or "
                f"{_LOOKS_THE_SAME[name]} is wrong: this drive hardly tells them apart, and the "
                "extrinsics count either. Check both"
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
