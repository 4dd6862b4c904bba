"""Sentences about suspects: which input is most likely wrong, by how much, and what to do."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal

from caliv_graph.products import Finding, MountSlip, Suspect
from caliv_graph.uncertainty.consistency import (
    CLOCK_BIAS_S,
    CLOCK_JITTER_S,
    CLOCKS_APART_S,
    CONTRADICTION_SIGMAS,
    DOUBT_SIGMAS,
)

MOST_NEXT = 2
"""Suspects that are named after the first."""

LEAST_NEXT = 3.0
"""Sigmas that a suspect must still explain, once the first is freed, to be named after it."""

NEARLY = 0.75
"""Part of the first suspect's sigmas from which another that explains the same is named with it."""


def ranking_sentence(suspects: Sequence[Suspect], of_wheels: bool = False) -> str:
    """The first suspect, what it explains and what to do; then those that explain more.

    `of_wheels`: there was no IMU. Then an axle that is elsewhere looks like an antenna that is.
    """
    first, *rest = suspects
    following = sorted(
        (s for s in rest if s.sigmas_left > LEAST_NEXT), key=lambda s: -s.sigmas_left
    )[:MOST_NEXT]
    others = "; ".join(f"{s.input} ({s.sigmas_left:.0f} sigma)" for s in following)
    then = f"; next, with it freed: {others}" if others else ""
    return (
        f"most likely: {first.input}, {_by(first)}; it explains {100.0 * first.explains:.0f} "
        f"percent of the contradiction ({first.sigmas:.0f} sigma){then}"
        f"{_or_alike(first, rest)}. {remedy(first)}"
        f"{_or_axle(first) if of_wheels and first.input == 'gnss.lever_arm' else ''}"
    )


def _or_alike(first: Suspect, rest: Sequence[Suspect]) -> str:
    """The suspect that explains nearly as much, and nothing more once the first is freed.

    On an arc an antenna that is 1.5 m further ahead looks like a heading that is 9 degrees off. To
    free the first of both when it is the second gives a result that nothing contradicts.
    """
    alike = [s for s in rest if s.sigmas > NEARLY * first.sigmas and s.sigmas_left <= LEAST_NEXT]
    if not alike:
        return ""
    other = max(alike, key=lambda s: s.sigmas)
    return (
        f". {other.input}, {_by(other)}, explains it nearly as well ({other.sigmas:.0f} sigma): "
        "the drive hardly tells them apart, so check both before one is freed"
    )


def _or_axle(arm: Suspect) -> str:
    other = vector([0.0 - value for value in arm.change], arm.units, arm.determined, "-")
    return (
        f". Or the axle that does not steer is elsewhere: wheels.T_vehicle_wheels.xyz by {other}, "
        "if guesses of LiDARs are contradicted as well"
    )


def moved_sentence(sigmas: Mapping[str, float]) -> str:
    """Inputs that come out far from what is stated; otherwise empty. `sigmas` by their names."""
    moved = {name: of for name, of in sigmas.items() if of > DOUBT_SIGMAS}
    if not moved:
        return ""
    inputs = " and ".join(f"{name} ({of:.1f} sigma)" for name, of in moved.items())
    return (
        f"{inputs}: the result is that far from what the config states, as the LiDARs pull the "
        "vehicle frame there. S2V may be off by as much. Measure it again; if it is right, look at "
        "what holds the vehicle frame: ground.vehicle_height, ground that is none (lids, ramps, "
        "kerbs), the initial guesses"
    )


def doubt_sentence(suspects: Sequence[Suspect]) -> str:
    """The first suspect where it is no contradiction yet, but hardly chance; otherwise empty."""
    if not suspects or not DOUBT_SIGMAS < suspects[0].sigmas <= CONTRADICTION_SIGMAS:
        return ""
    first = suspects[0]
    return (
        f"{first.input} may be wrong, {_by(first)}: the data would rather have it so by "
        f"{first.sigmas:.1f} sigma, and {CONTRADICTION_SIGMAS:g} are a contradiction. "
        f"{remedy(first)}"
    )


def motion_sentence(suspects: Sequence[Suspect]) -> str:
    """What the motion data alone contradict; empty if nothing is beyond 5 sigma."""
    if not suspects or suspects[0].sigmas <= CONTRADICTION_SIGMAS:
        return ""
    return f"The motion data contradict each other, {ranking_sentence(suspects)}"


def suspect_row(suspect: Suspect) -> tuple[str, str, str, str, str]:
    """Of a table: input, change with its sigma, value, sigmas, and sigmas with the first freed."""
    told = suspect.determined
    sigma = vector(suspect.sigma, suspect.units, told, "-")
    return (
        suspect.input,
        f"{vector(suspect.change, suspect.units, told)} (sigma {sigma})",
        vector(suspect.value, suspect.units, told),
        f"{suspect.sigmas:.1f}",
        f"{suspect.sigmas_left:.1f}",
    )


def _lateness(late_s: float, sigma_s: float) -> str:
    way = "late" if late_s > 0.0 else "early"
    return f"the stamps are {abs(late_s):.3f} +- {sigma_s:.3f} s {way}"


def clock_finding(drive: str, lidar: str, late_s: float, sigma_s: float) -> Finding | None:
    """A clock that the walls and the ground of a drive contradict; None if they do not.

    They are seen in curves to both sides and at several speeds, and lie on each other only if each
    scan was taken where the vehicle was.
    """
    sigma_s = math.hypot(sigma_s, CLOCK_BIAS_S)
    sigmas = abs(late_s) / sigma_s
    if sigmas < DOUBT_SIGMAS:
        return None
    key = f"lidars.{lidar}.time_offset"
    told = _REMEDIES_OF_LIDAR["time_offset"].format(lidar=lidar)
    return Finding(
        key,
        (late_s,),
        sigma_s,
        sigmas,
        "contradiction" if sigmas > CONTRADICTION_SIGMAS else "warning",
        f"{drive}: {key}: by the surfaces around, {_lateness(late_s, sigma_s)} ({sigmas:.0f} "
        f"sigma). {told}",
    )


def apart_finding(
    drive: str, lidars: tuple[str, str], apart_s: float, sigma_s: float
) -> Finding | None:
    """Clocks of two LiDARs that the walls and ground of a drive contradict; None if they do not.

    `apart_s` is how much later the stamps of the second are. Milliseconds are a warning: where
    structure is strong, jitter of the stamps takes them up, and S2S is right.
    """
    beyond_jitter = abs(apart_s) > CONTRADICTION_SIGMAS * math.hypot(sigma_s, CLOCK_JITTER_S)
    sigma_s = math.hypot(sigma_s, CLOCKS_APART_S)
    sigmas = abs(apart_s) / sigma_s
    if sigmas < DOUBT_SIGMAS:
        return None
    first, second = lidars
    way = "later" if apart_s > 0.0 else "earlier"
    return Finding(
        f"lidars.{second}.time_offset",
        (apart_s,),
        sigma_s,
        sigmas,
        "contradiction" if beyond_jitter else "warning",
        f"{drive}: lidars '{first}' and '{second}': by the surfaces around, the stamps of "
        f"'{second}' are {1e3 * abs(apart_s):.2f} +- {1e3 * sigma_s:.2f} ms {way} than those of "
        f"'{first}' ({sigmas:.0f} sigma), and S2S may be off by how far the vehicle moves "
        "meanwhile. Synchronise their clocks, or set solve.time_offset; clouds of a whole sweep "
        "without a time per point look the same, and no offset mends them. A LiDAR whose mount "
        "moved during the drive may look like this, too: 'caliv-graph validate' then contradicts "
        "the result on held-out structure",
    )


def slip_finding(drive: str, slip: MountSlip) -> Finding | None:
    """A mount that slips by the walls and the ground of a drive; None if none does."""
    if slip.sigmas < DOUBT_SIGMAS:
        return None
    contradiction = slip.sigmas > CONTRADICTION_SIGMAS
    first = slip.lidars[0]
    when = f"{slip.since_s:.0f} s after the first scan, of {slip.lasts_s:.0f} s"
    by = f"by the surfaces around ({slip.sigmas:.0f} sigma)"
    between = "One extrinsic cannot be right before and after it: S2S and S2V are in between"
    if len(slip.lidars) > 1:
        verb = "move" if contradiction else "may move"
        sentence = (
            f"{drive}: all lidars {verb} together against the motion data about {when}, {by}: "
            f"they are {_moved(slip)}. {between}. Check whether their common rack, the IMU or an "
            f"antenna moved, or load or tyres changed; {_RECORD_AGAIN}"
        )
    else:
        verb = "slips" if contradiction else "may slip"
        who = " or ".join(f"'{name}'" for name in (first, *slip.others))
        # What no other LiDAR tells has the errors of the motion data, its time too.
        size = f"it is {'roughly ' if slip.alone else ''}{_moved(slip)}"
        if slip.others:
            size = f"the drive does not tell which; if it is '{first}', {size}"
        sentence = (
            f"{drive}: the mount of lidar {who} {verb} about {when}, {by}: {size}. {between}. "
            f"Fasten the mount{', and those of IMU and antenna,' if slip.alone else ''} and "
            f"{_RECORD_AGAIN}. A cab or a rack on springs that leans in curves looks the same, and "
            "no part is right then: fix it to the frame, or drive more slowly"
        )
    severity: Literal["contradiction", "warning"] = "contradiction" if contradiction else "warning"
    # No suspect of the ranking: what a target says of the mount of one LiDAR is another value.
    return Finding("lidars.mounts", (), 0.0, slip.sigmas, severity, sentence)


_RECORD_AGAIN = "record again, or cut the recording there and calibrate each part by itself"


def _moved(slip: MountSlip) -> str:
    turn_deg = [math.degrees(angle) for angle in slip.change[:3]]
    shift_mm = [1e3 * way for way in slip.change[3:]]
    return (
        f"turned by {math.hypot(*turn_deg):.2f} degrees (roll, pitch, yaw "
        f"{', '.join(f'{angle:+.2f}' for angle in turn_deg)}) and shifted by "
        f"{math.hypot(*shift_mm):.0f} mm (x, y, z {', '.join(f'{way:+.0f}' for way in shift_mm)})"
    )


def _by(suspect: Suspect) -> str:
    """By how much the input is off, and the value that it would take."""
    told, units = suspect.determined, suspect.units
    late = suspect.change[0]
    if suspect.input.endswith("time_offset"):
        return _lateness(late, suspect.sigma[0])
    by = f"by {vector(suspect.change, units, told)}"
    if suspect.value != suspect.change:
        change = vector(suspect.change, units, told, "-")
        by = f"by {change}, so that it is {vector(suspect.value, units, told)}"
    return f"{by} (sigma {vector(suspect.sigma, units, told, '-')})"


def vector(
    numbers: Sequence[float],
    units: Sequence[str],
    determined: Sequence[bool] = (),
    otherwise: str = "not determined",
) -> str:
    """Numbers with their units, those of one unit in brackets together.

    `otherwise` stands where a coordinate is not `determined`; empty: all are.
    """
    out = []
    known = determined or (True,) * len(numbers)
    for unit in dict.fromkeys(units):
        digits = {"m": 2, "deg": 1, "s": 3, "1": 3}[unit]
        some = [
            f"{x:.{digits}f}" if told else otherwise
            for x, u, told in zip(numbers, units, known, strict=True)
            if u == unit
        ]
        text = some[0] if len(some) == 1 else f"({', '.join(some)})"
        out.append(text if unit == "1" else f"{text} {unit}")
    return " and ".join(out)


_REMEDIES = {
    "gnss.lever_arm": "Measure the antenna in the vehicle frame again, or set gnss.lever_arm: null",
    "gnss.time_offset": (
        "Check the clock of the GNSS receiver against those of IMU and LiDARs, or set "
        "gnss.time_offset_sigma_s to as much"
    ),
    "imu.time_offset": (
        "Check the clock of the IMU against those of GNSS and LiDARs, or set "
        "imu.time_offset_sigma_s to as much. Clouds that were deskewed before they were recorded "
        "look the same (lidars.<name>.deskewed: true)"
    ),
    "twist.time_offset": (
        "Check the clock of the velocities against those of GNSS and LiDARs, or set "
        "wheels.time_offset_sigma_s to as much"
    ),
    "imu.T_vehicle_imu": "Check imu.T_vehicle_imu, or set its rpy_deg: null",
    "heading.yaw_deg": "Check heading.yaw_deg, where the baseline of the antennas points",
    "heading.lever_arm": "Measure the second antenna in the vehicle frame again",
    "wheels.T_vehicle_wheels": "Check wheels.T_vehicle_wheels and its rotation_sigma_deg",
    "imu.yaw_bias": "Check the heading of the IMU's orientation, or set imu.yaw_bias",
    "imu.gyroscope.scale": "Check the unit and the axes of the IMU's messages",
    "imu.accelerometer.scale": "Check the unit and the axes of the IMU's messages",
    "twist.scale": (
        "Check the unit and the scale of the velocities in topics.twist, or set "
        "wheels.speed_scale_sigma"
    ),
    "ground.vehicle_height": (
        "Measure the height of the vehicle frame above the ground again, and check that z of the "
        "guesses counts from that frame"
    ),
    "poses.frame": "Check that topics.pose has the poses of the vehicle frame",
    "poses.drift": (
        "The given poses drift by this range over the drive: use better ones. Of an odometry, "
        "record what it is made of: velocities and yaw rate as topics.twist, an IMU if there is "
        "one; walls in view then tell the heading"
    ),
    "gnss.drift": "The GNSS positions drift by this range over the drive: use better ones",
    "lidars.*.time_offset": (
        "Check the clocks of the LiDARs against those of IMU and GNSS or of the poses, or set "
        "solve.time_offset. Clouds that were deskewed before they were recorded look the same "
        "(lidars.<name>.deskewed: true)"
    ),
}
"""What to check or to set, by the name of the input; drifts of one of several drives likewise."""

_REMEDIES_OF_LIDAR = {
    "time_offset": (
        "Correct the clock of lidar '{lidar}', or set solve.time_offset; if it is off by a sweep, "
        "set lidars.{lidar}.stamp: start or end. Clouds of a whole sweep without a time per point "
        "look the same, and no offset mends them; so do clouds that were deskewed before they were "
        "recorded (lidars.{lidar}.deskewed: true)"
    ),
    "initial": (
        "Check the initial guess of lidar '{lidar}' (metres, degrees, signs, T_vehicle_lidar and "
        "not its inverse) and that the topic is its"
    ),
    "mount.halves": (
        "Check whether the mount of lidar '{lidar}' or the target moved during the drive"
    ),
    "mount.turns": "Check whether the mount of lidar '{lidar}' or the target moved in turns",
}


def remedy(suspect: Suspect) -> str:
    """What to check or to set."""
    name = suspect.input
    if name in _REMEDIES:
        return _REMEDIES[name]
    for kind, text in _REMEDIES_OF_LIDAR.items():
        if name.startswith("lidars.") and name.endswith(f".{kind}"):
            return text.format(lidar=name.removeprefix("lidars.").removesuffix(f".{kind}"))
    source, _, _ = name.rpartition(".")  # a drift of one of several drives ends with its number
    return _REMEDIES[source]
