"""Sentences about suspects: which input is most likely wrong, by how much, and what to do."""

from __future__ import annotations

from collections.abc import Sequence

from caliv_graph.products import Suspect
from caliv_graph.uncertainty.consistency import CONTRADICTION_SIGMAS

MOST_NEXT = 2
"""Suspects that are named after the first."""

LEAST_NEXT = 3.0
"""Sigmas that a suspect must still explain, once the first is freed, to be named after it."""


def ranking_sentence(suspects: Sequence[Suspect]) -> str:
    """The first suspect, what it explains and what to do; then those that explain more."""
    first, *rest = suspects
    following = sorted(
        (s for s in rest if s.sigmas_left > LEAST_NEXT), key=lambda s: -s.sigmas_left
    )[:MOST_NEXT]
    others = "; ".join(f"{s.input} ({s.sigmas_left:.0f} sigma)" for s in following)
    then = f"; next, with it freed: {others}" if others else ""
    return (
        f"most likely: {first.input}, {_by(first)}; it explains {100.0 * first.explains:.0f} "
        f"percent of the contradiction ({first.sigmas:.0f} sigma){then}. {remedy(first)}"
    )


def motion_sentence(suspects: Sequence[Suspect]) -> str:
    """What the motion data alone contradict; empty if nothing is beyond 5 sigma."""
    if not suspects or suspects[0].sigmas <= CONTRADICTION_SIGMAS:
        return ""
    return f"The motion data contradict each other, {ranking_sentence(suspects)}"


def suspect_row(suspect: Suspect) -> tuple[str, str, str, str, str]:
    """Of a table: input, change with its sigma, value, sigmas, and sigmas with the first freed."""
    return (
        suspect.input,
        f"{vector(suspect.change, suspect.units)} (sigma {vector(suspect.sigma, suspect.units)})",
        vector(suspect.value, suspect.units),
        f"{suspect.sigmas:.1f}",
        f"{suspect.sigmas_left:.1f}",
    )


def _by(suspect: Suspect) -> str:
    """By how much the input is off, and the value that it would take."""
    by = f"by {vector(suspect.change, suspect.units)}"
    late = suspect.change[0]
    if suspect.input.endswith("time_offset"):
        way = "late" if late > 0.0 else "early"
        return f"the stamps are {abs(late):.3f} +- {suspect.sigma[0]:.3f} s {way}"
    value = ""
    if suspect.value != suspect.change:
        value = f", so that it is {vector(suspect.value, suspect.units)}"
    return f"{by}{value} (sigma {vector(suspect.sigma, suspect.units)})"


def vector(numbers: Sequence[float], units: Sequence[str]) -> str:
    """Numbers with their units, those of one unit in brackets together."""
    out = []
    for unit in dict.fromkeys(units):
        digits = {"m": 2, "deg": 1, "s": 3, "1": 3}[unit]
        some = [f"{x:.{digits}f}" for x, u in zip(numbers, units, strict=True) if u == unit]
        text = some[0] if len(some) == 1 else f"({', '.join(some)})"
        out.append(text if unit == "1" else f"{text} {unit}")
    return " and ".join(out)


def remedy(suspect: Suspect) -> str:
    """What to check or to set."""
    name = suspect.input
    lidar = name.removeprefix("lidars.").rsplit(".", 1)[0]
    if name == "gnss.lever_arm":
        return "Measure the antenna in the vehicle frame again, or set gnss.lever_arm: null"
    if name == "imu.T_vehicle_imu":
        return "Check imu.T_vehicle_imu, or set its rpy_deg: null"
    if name == "ground.vehicle_height":
        return "Measure the height of the vehicle frame above the ground again"
    if name == "lidars.*.time_offset":
        return (
            "Check the clocks of the LiDARs against those of IMU and GNSS or of the poses, or set "
            "solve.time_offset"
        )
    if name == "gnss.time_offset":
        return "Check the clock of the GNSS receiver against that of the IMU"
    if name.endswith(".time_offset"):
        return f"Correct the clock of lidar '{lidar}', or set solve.time_offset"
    if name.endswith(".initial"):
        return (
            f"Check the initial guess of lidar '{lidar}' (metres, degrees, signs, T_vehicle_lidar "
            "and not its inverse) and that the topic is its"
        )
    if ".mount." in name:
        lidar, part = name.removeprefix("lidars.").split(".mount.")
        when = {"halves": "during the drive", "turns": "in turns"}[part]
        return f"Check whether the mount of lidar '{lidar}' or the target moved {when}"
    if ".drift" in name:
        source = "given poses" if name.startswith("poses") else "GNSS positions"
        return f"The {source} drift by this range over the drive: use better ones"
    if name == "poses.frame":
        return "Check that topics.pose has the poses of the vehicle frame"
    if name == "twist.scale":
        return "Check the unit and the scale of the velocities in topics.twist"
    if name == "imu.yaw_bias":
        return "Check the heading of the IMU's orientation, or set imu.yaw_bias"
    return "Check the unit and the axes of the IMU's messages"
