"""Sentences about raw data that contradict what the user gave: what, by how much, what to check."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal

import gtsam
import numpy as np

from caliv_graph.config.model import Config
from caliv_graph.products import Array, Finding
from caliv_graph.readers.frames import pose_text
from caliv_graph.readers.pose_frame import poses_source
from caliv_graph.targets.cloud.copies import Copy
from caliv_graph.targets.ground.guesses import Misfit
from caliv_graph.trajectory.alignment import level
from caliv_graph.trajectory.axes import Axes
from caliv_graph.trajectory.given_physics import (
    MAX_OFF_RAD,
    MAX_SPEED_M_S,
    MAX_TILT_RAD,
    MIN_SPREAD_RAD,
    PosesPhysics,
)
from caliv_graph.trajectory.heading import HeadingDisagreement
from caliv_graph.trajectory.outliers import LostFixes
from caliv_graph.trajectory.physics import (
    Gravity,
    Misheading,
    MotionPhysics,
    Ratio,
    known_rotation,
)
from caliv_graph.trajectory.tilt import VehicleTilt, body_sigma_rad
from caliv_graph.uncertainty.consistency import CONTRADICTION_P, CONTRADICTION_SIGMAS

WARNING_SIGMAS = 3.0
"""From here a disagreement is said."""

MAX_GRAVITY_TILT_RAD = math.radians(20.0)
"""Between gravity and the vehicle's z: more is a wrong axis. Slopes and accelerations of a drive
are below."""

MIN_TILT_RAD = math.radians(1.0)
"""A smaller tilt of the vehicle's axes is not said: load and springs do as much."""

TURNED_RAD, REVERSED_RAD = math.radians(60.0), math.radians(135.0)
"""Yaw of the IMU's axes from which they are others, and from which they point backwards."""

MIN_YAW_RAD = math.radians(20.0)
"""A smaller angle between axes and path is left to the heading of the smoothed trajectory, which
knows it better: a wrong lever arm turns the path of an antenna by some degrees."""

GROSS_RATIO = 0.2
"""Part by which a rate may be off by scale and slip: more is another unit or axis."""

SMALL_RATIO = 0.05
"""A smaller one is not said: the scale error of a cheap gyroscope, or of a worn tyre."""

MIN_DELAY_S = 0.1
"""A smaller clock offset is said by the solve, which knows it better."""

SAID_TO_FOLLOW = 0.5
"""Part of a deviation from the course that another reading of poses may leave, to be said with it.
A frame ahead of the rear axle keeps all of it, in every reading."""

KNOWN_PART = 0.1
"""A ratio this near to that of two units is taken for it."""

GYRO_UNITS = {math.degrees(1.0): "degrees per second", -1.0: "the opposite sign"}
SPEED_UNITS = {3.6: "km/h", 2.23694: "miles per hour", 1.94384: "knots"}
"""Ratio of the measured to the true value -> what has that effect."""


def motion_findings(found: MotionPhysics, config: Config) -> tuple[Finding, ...]:
    """What the raw sensors of a drive say against each other and against `T_vehicle_imu`."""
    axes = found.axes
    heading = () if found.heading is None else tuple(_antennas(found.name, found.heading, config))
    if found.gravity is None:
        return (*_rates(found), *heading)
    if found.gravity.tilt_rad > MAX_GRAVITY_TILT_RAD:
        reversed_force = _reversed_force(found, found.gravity)
        if reversed_force is not None:
            return (reversed_force,)  # the gyroscope about this up is reversed by it
        # Nothing else can be judged about wrong axes, but units can.
        return (_gravity(found, config), *_rates(found))
    mirrored = _mirrored_fixes(found)
    if mirrored is not None:
        return (mirrored,)  # what else such fixes contradict has that cause
    out = [*_rates(found), *heading]
    if axes is not None:
        told = found.oriented or config.topics.heading is not None
        out += _axes(found.name, axes, config, told)
    return tuple(out)


def _reversed_force(found: MotionPhysics, gravity: Gravity) -> Finding | None:
    """A specific force of the opposite sign: gravity is down, about which the gyroscope turns back.

    An IMU that hangs upside down turns as fast as the course about what it has for up.
    """
    ratios = [r for r in found.gyroscope if r.against == "course"] or list(found.gyroscope)
    if math.pi - gravity.tilt_rad > MAX_GRAVITY_TILT_RAD or not ratios:
        return None
    ratio = ratios[0]
    if abs(ratio.value + 1.0) > max(KNOWN_PART, WARNING_SIGMAS * ratio.sigma):
        return None
    sigmas = (1.0 - ratio.value) / ratio.sigma
    if sigmas < CONTRADICTION_SIGMAS:
        return None
    turns = f"{-ratio.value:.3g} +- {ratio.sigma:.1g} times as fast as the"
    return Finding(
        "topics.imu",
        (),
        ratio.sigma,
        sigmas,
        "fatal",
        f"{found.name}: the specific force of the IMU points down, "
        f"{math.degrees(gravity.tilt_rad):.0f} degrees from the vehicle's +z, and the gyroscope "
        f"turns {turns} {_SOURCES[ratio.against]} about +z: the sign of the acceleration is "
        "reversed. At rest the axis that is up must read +9.8 m/s^2: multiply linear_acceleration "
        "by -1",
    )


_SOURCES = {"course": "course over ground", "orientation": "orientation of the same messages"}


def _mirrored_fixes(found: MotionPhysics) -> Finding | None:
    """Fixes whose path turns left where the IMU turns right, by its rates and its accelerations."""
    by_course = next((ratio for ratio in found.gyroscope if ratio.against == "course"), None)
    if by_course is None or found.axes is None or not found.axes.mirrored:
        return None
    sigmas = -by_course.value / by_course.sigma
    if sigmas < WARNING_SIGMAS:  # the accelerations are evidence of their own
        return None
    return Finding(
        "topics.gnss",
        (),
        0.0,
        sigmas,
        "fatal",
        f"{found.name}: the path of the GNSS fixes turns left where the IMU turns right, by its "
        "rates and its accelerations. Either latitude and longitude are swapped in topics.gnss, or "
        "the axes of the IMU's messages are left-handed",
    )


def gravity_problem(up_imu: Array, R_vehicle_imu: Array, hangs: bool = False) -> str:
    """What is wrong with an IMU whose gravity is not along the vehicle's +z; empty: nothing.

    `hangs`: the gyroscope agrees with this direction of gravity.
    """
    gravity = Gravity(up_imu, R_vehicle_imu @ up_imu)
    if gravity.tilt_rad <= MAX_GRAVITY_TILT_RAD:
        return ""
    roll, pitch = (f"{round(v) + 0.0:.0f}" for v in gravity.roll_pitch_deg)
    down = math.pi - gravity.tilt_rad < MAX_GRAVITY_TILT_RAD and not hangs
    unless = ", unless the sign of the acceleration is reversed" if down else ""
    return (
        f"gravity is {_gravity_axis(up_imu)}, {math.degrees(gravity.tilt_rad):.0f} degrees from "
        f"the vehicle's +z: imu.T_vehicle_imu rpy_deg about ({roll}, {pitch}, yaw) would "
        f"fit{unless}"
    )


def _gravity_axis(up_imu: Array) -> str:
    """The axis of the IMU that gravity is along, in words."""
    i = int(np.abs(up_imu).argmax())
    if abs(up_imu[i]) > math.cos(MAX_GRAVITY_TILT_RAD):
        return f"along {'+' if up_imu[i] > 0.0 else '-'}{'xyz'[i]} of the IMU"
    return f"along ({', '.join(f'{v:.2f}' for v in up_imu)}) of the IMU"


def _rpy(values: Sequence[float], digits: int = 0) -> str:
    """Roll, pitch, yaw in degrees as a config has them."""
    # Rounded first, so that no minus sign stands before zero.
    return f"({', '.join(f'{round(v, digits) + 0.0:.{digits}f}' for v in values)})"


def _gravity(found: MotionPhysics, config: Config) -> Finding:
    gravity = found.gravity
    assert gravity is not None
    given = config.imu.T_vehicle_imu
    value: tuple[float, ...] = ()
    hangs = any(abs(ratio.value - 1.0) <= GROSS_RATIO for ratio in found.gyroscope)
    sentence = gravity_problem(gravity.up_imu, given.pose().rotation().matrix(), hangs)
    axes = found.axes
    if axes is not None and not axes.mirrored and axes.sigma_rad < MIN_YAW_RAD:
        R = given.pose().rotation().matrix()
        turned = gtsam.Rot3.Rz(axes.yaw_rad).matrix() @ level(gravity.up_vehicle) @ R
        value = _degrees(turned)
        sentence += f"; with the accelerations of the path {_rpy(value)}"
    sentence = f"{found.name}: {sentence}. Now it is {_rpy(given.rpy_deg or ())}"
    sigma = MAX_GRAVITY_TILT_RAD / CONTRADICTION_SIGMAS
    return Finding(
        "imu.T_vehicle_imu",
        value,
        math.degrees(sigma),
        gravity.tilt_rad / sigma,
        "fatal",
        sentence,
    )


def _degrees(R: Array) -> tuple[float, float, float]:
    roll, pitch, yaw = np.degrees(gtsam.Rot3(R).rpy()).tolist()
    return roll, pitch, yaw


def _rates(found: MotionPhysics) -> Iterator[Finding]:
    """Gyroscope and speed against what else measures them."""
    by_course = [r for r in found.gyroscope if r.against == "course"]
    by_orientation = [r for r in found.gyroscope if r.against == "orientation"]
    sound = [r for r in by_course if abs(r.value - 1.0) <= GROSS_RATIO]
    for ratio in by_course or by_orientation:
        yield from _ratio(found.name, ratio, "topics.imu", GYRO_UNITS)
    if sound:
        for ratio in by_orientation:
            if abs(ratio.value - 1.0) > GROSS_RATIO:
                yield from _ratio(found.name, ratio, "topics.imu", {})
    if found.yaw_rate is not None:
        turn = replace(found.yaw_rate, against="turn")
        yield from _ratio(found.name, turn, "topics.twist", GYRO_UNITS)
    if found.speed is not None:
        yield from _ratio(found.name, found.speed, "topics.twist", SPEED_UNITS)


_RATIOS = {
    "course": (
        "the gyroscope turns {value} times as fast as the course over ground",
        "Check the axes of the IMU and imu.T_vehicle_imu",
    ),
    "orientation": (
        "the gyroscope turns {value} times as fast as the orientation of the same messages",
        "One of the two is wrong: choose another topics.imu, or set its orientation_covariance[0] "
        "to -1",
    ),
    "turn": (
        "the yaw rate of the velocities is {value} times that of the course over ground",
        "Check the yaw rate in topics.twist",
    ),
    "gnss": (
        "the velocities are {value} times those of the GNSS",
        "Check topics.twist and the scale of its wheel speed",
    ),
}


def _ratio(name: str, ratio: Ratio, key: str, units: dict[float, str]) -> Iterator[Finding]:
    off = abs(ratio.value - 1.0)
    sigmas = off / ratio.sigma
    if off < SMALL_RATIO or sigmas < CONTRADICTION_SIGMAS:
        return
    what, remedy = _RATIOS[ratio.against]
    unit = next(
        (text for of, text in units.items() if abs(ratio.value / of - 1.0) < KNOWN_PART), ""
    )
    if unit:
        remedy = (
            f"This is {unit}: convert them"
            if "sign" not in unit
            else f"They have the opposite sign: check the axes of {key}, and that latitude and "
            "longitude are not swapped"
        )
    gross: Literal["contradiction", "warning"] = "contradiction" if off > GROSS_RATIO else "warning"
    value = f"{ratio.value:.3g} +- {ratio.sigma:.1g}"
    yield Finding(
        key,
        (ratio.value,),
        ratio.sigma,
        sigmas,
        "fatal" if unit else gross,
        f"{name}: {what.format(value=value)}. {remedy}",
    )


def _antennas(name: str, found: Misheading, config: Config) -> Iterator[Finding]:
    """The heading of two antennas against the course."""
    steady = found.spread_rad < MIN_YAW_RAD
    if steady and abs(found.off_rad) < MIN_YAW_RAD:
        return
    now = config.heading
    key = "heading.yaw_deg"
    value: tuple[float, ...] = (_turn(now.yaw_deg + math.degrees(found.off_rad)),)
    what = f"is off the course by {math.degrees(found.off_rad):.0f} degrees"
    # A driver that counts the other way has all angles mirrored: they do not keep to the course.
    if not steady:
        what = f"does not follow the course, by {math.degrees(found.spread_rad):.0f} degrees"
        key, value = "heading.axes", ()
    remedy = "Choose another topics.heading, or leave it out"
    if found.other_spread_rad < min(found.spread_rad, MIN_YAW_RAD):
        other = now.yaw_deg + math.degrees(found.other_off_rad)
        axes = "ned" if now.axes == "enu" else "enu"
        remedy = f"It counts the other way: set heading.axes: {axes}"
        if abs(found.other_off_rad) > MIN_YAW_RAD:
            remedy += f", and heading.yaw_deg to about {_turn(other):.0f}"
    elif steady:
        remedy = f"Set heading.yaw_deg to about {value[0]:.0f}"
    off = max(abs(found.off_rad), found.spread_rad)
    sigma = MIN_YAW_RAD / CONTRADICTION_SIGMAS
    sentence = f"{name}: the heading of topics.heading {what}. {remedy}"
    yield Finding(key, value, math.degrees(sigma), off / sigma, "fatal", sentence)


def _turn(degrees: float) -> float:
    """An angle within half a turn."""
    return math.remainder(degrees, 360.0) + 0.0


def _axes(name: str, axes: Axes, config: Config, told: bool) -> Iterator[Finding]:
    """The accelerometer's horizontal axes against the path of the GNSS antenna.

    `told`: something else tells the heading. Nothing can be smoothed with an IMU that is turned by
    60 degrees and more, if it is all that does; without velocities it may be a drive in reverse.
    """
    if axes.mirrored:
        yield Finding(
            "topics.imu",
            (),
            0.0,
            axes.ratio[0] / axes.ratio[1],
            "contradiction",
            f"{name}: accelerometer and GNSS agree only if left and right are exchanged: the axes "
            "of the IMU's messages are left-handed, or two of them are swapped",
        )
        return
    sigmas = abs(axes.yaw_rad) / axes.sigma_rad
    R = known_rotation(config)
    if R is not None and abs(axes.yaw_rad) > MIN_YAW_RAD and sigmas > CONTRADICTION_SIGMAS:
        value = _degrees(gtsam.Rot3.Rz(axes.yaw_rad).matrix() @ R)
        unless, fatal = "", not told and abs(axes.yaw_rad) > TURNED_RAD
        if abs(axes.yaw_rad) > REVERSED_RAD and config.topics.twist is not None:
            unless = ", unless the velocities in topics.twist have the wrong sign"
        elif abs(axes.yaw_rad) > REVERSED_RAD:
            unless, fatal = ", unless the vehicle reverses all the way", False
        yield Finding(
            "imu.T_vehicle_imu",
            value,
            math.degrees(axes.sigma_rad),
            sigmas,
            "fatal" if fatal else "contradiction",
            f"{name}: the IMU's axes are turned by {math.degrees(axes.yaw_rad):+.0f} +- "
            f"{math.degrees(axes.sigma_rad):.0f} degrees of yaw against the accelerations of the "
            f"path: imu.T_vehicle_imu rpy_deg about {_rpy(value)} would fit{unless}",
        )
    delay = axes.certain_delay_s
    most_s = max(MIN_DELAY_S, CONTRADICTION_SIGMAS * config.gnss.time_offset_sigma_s)
    if delay is not None and abs(delay[0]) > most_s:
        delay_s, sigma_s = delay
        way = "late" if delay_s > 0.0 else "early"
        yield Finding(
            "topics.gnss",
            (delay_s,),
            sigma_s,
            abs(delay_s) / sigma_s,
            "contradiction",
            f"{name}: the stamps of the GNSS are {abs(delay_s):.2f} +- {sigma_s:.2f} s {way} "
            "against those of the IMU, by the accelerations of both: correct its clock, or set "
            "gnss.time_offset_sigma_s to as much. If clocks of LiDARs seem wrong as well, that of "
            "the IMU is",
        )


_READINGS = {
    "wxyz": (
        "with the quaternions in the order w x y z",
        "Write them in the order x y z w",
    ),
    "frd": (
        "with the z axis of the vehicle down",
        "Set data.pose_axes: frd",
    ),
    "ned": (
        "with the z axis of the map down",
        "Turn the map, so that its z is up, or set data.pose_axes: ned if the vehicle's z is down "
        "too",
    ),
    "inverse": (
        "as the map in the vehicle frame",
        "Invert them: they must be the vehicle in the map",
    ),
    "compass": (
        "with rotations for a map of north, east, down",
        "Give rotations and positions for one map, with z up",
    ),
    "y": ("with y the other way", "Change the sign of y, so that the map is right-handed"),
    "x": ("with x the other way", "Change the sign of x, so that the map is right-handed"),
    "xy": ("with x and y exchanged", "Exchange them: east is x, and north is y"),
    "camera": (
        "as a camera's, x to the right, y down, z ahead",
        "Give poses of the vehicle frame, x forward, y left, z up: those of the camera times "
        "T_camera_vehicle, from the right",
    ),
    "camera_map": (
        "as a camera's, x to the right, y down, z ahead, in a map with the same axes",
        "Turn the map, so that its z is up, and give poses of the vehicle frame, x forward, y "
        "left, z up: those of the camera times T_camera_vehicle, from the right",
    ),
    "rfu": (
        "with x of the vehicle to the right and y ahead, or with yaw counted from north",
        "Turn them by +90 degrees of yaw about the vehicle's z (x forward, y left), if the initial "
        "guesses are not in these axes, too",
    ),
}
"""How given poses are read (`trajectory.given_physics.READINGS`), and what to do."""


def fast_finding(name: str, speed_m_s: float, config: Config) -> Finding:
    """Given poses that are as fast as no vehicle is: positions are in another unit."""
    where = poses_source(config)
    sigma = MAX_SPEED_M_S / CONTRADICTION_SIGMAS
    return Finding(
        "topics.pose",
        (),
        sigma,
        speed_m_s / sigma,
        "fatal",
        f"{name}: by the poses in {where}, the vehicle goes {speed_m_s:.0f} m/s (median; "
        f"{MAX_SPEED_M_S:g} at most). Give positions in metres (of centimetres it would be "
        f"{0.01 * speed_m_s:.2g} m/s, of millimetres {0.001 * speed_m_s:.2g}), and check the unit "
        "of their stamps",
    )


def poses_finding(found: PosesPhysics, config: Config) -> Finding:
    """Given poses of a vehicle that does not stand upright or not go where it points.

    Axes with z down, or x to the right, are a choice that guesses may share: then they are no
    contradiction. Nor is a vehicle frame that the config says to lean.
    """
    now, then = found.now, found.then
    limits = [(now.tilt_rad, MAX_TILT_RAD)]
    parts, mended = [], []
    if not now.upright:
        parts.append(
            f"z of the vehicle is {math.degrees(now.tilt_rad):.0f} degrees from z of the map"
        )
        mended.append(f"{math.degrees(then.tilt_rad):.1f} degrees")
    if now.strays and then.spread_rad < SAID_TO_FOLLOW * now.spread_rad:
        limits.append((now.spread_rad, MIN_SPREAD_RAD))
        parts.append(
            "the direction of travel strays from where the vehicle points by "
            f"{math.degrees(now.spread_rad):.0f} degrees"
        )
        mended.append(f"{math.degrees(then.spread_rad):.1f} degrees")
    elif now.aside_rad > MAX_OFF_RAD:
        limits.append((now.aside_rad, MAX_OFF_RAD))
        parts.append(
            f"the direction of travel is {math.degrees(now.aside_rad):.0f} degrees off where the "
            "vehicle points"
        )
        mended.append(f"{math.degrees(then.aside_rad):.1f} degrees")
    ways, remedies = zip(*(_READINGS[reading] for reading in found.readings), strict=True)
    where = poses_source(config)
    if config.data.format == "caliv" and "frd" in found.readings:
        remedies = ("Convert them to a vehicle with x forward, y left, z up, in a map with z up",)
    off, limit = max(limits, key=lambda of: of[0] / of[1])
    leans = not now.upright and now.tilt_rad < CONTRADICTION_SIGMAS * body_sigma_rad(config)
    chosen = leans or not {"frd", "rfu"}.isdisjoint(found.readings)
    sigma = limit / CONTRADICTION_SIGMAS
    of_frame, known = "", ""
    if found.frame is not None:
        of_frame = f" of the frame '{found.frame.name}'"
    if found.frame is not None and found.frame.T_vehicle_frame is not None:
        back = found.frame.T_vehicle_frame.inverse()
        known = f". By /tf_static T_{found.frame.name}_{found.frame.vehicle} is {pose_text(back)}"
    return Finding(
        "topics.pose",
        (),
        math.degrees(sigma),
        off / sigma,
        "warning" if chosen else "fatal",
        f"{found.name}: by the poses in {where}{of_frame}, {' and '.join(parts)} (median). Read "
        f"{' or '.join(ways)}, they have {' and '.join(mended)}. {'; or '.join(remedies)}{known}",
    )


def tilt_finding(tilt: VehicleTilt, config: Config) -> Finding | None:
    """Vehicle axes that are not level over the drive; None if they are."""
    off, sigma = np.abs(tilt.roll_pitch_rad), tilt.sigma_rad
    said = (off > MIN_TILT_RAD) & (off > WARNING_SIGMAS * sigma)
    R = known_rotation(config)
    if not said.any() or (R is None and not tilt.given):
        return None
    i = int(np.argmax(np.where(said, off / sigma, 0.0)))
    sigmas = float(off[i] / sigma[i])
    parts = " and ".join(
        f"{axis} {value:+.2f} +- {spread:.2f} degrees"
        for axis, value, spread in zip(
            ("roll", "pitch"), np.degrees(tilt.roll_pitch_rad), np.degrees(sigma), strict=True
        )
    )
    key, remedy = "topics.pose", "check the frame of the poses"
    value: tuple[float, ...] = ()
    if not tilt.given and R is not None:
        value = _degrees(level(tilt.up_vehicle) @ R)
        key = "imu.T_vehicle_imu"
        remedy = f"imu.T_vehicle_imu rpy_deg about {_rpy(value, 1)} would fit"
    return Finding(
        key,
        value,
        math.degrees(float(sigma[i])),
        sigmas,
        "contradiction" if sigmas > CONTRADICTION_SIGMAS else "warning",
        f"{tilt.name}: the vehicle's axes are not level with the ground over the drive: {parts} "
        f"({sigmas:.0f} sigma). Roll and pitch of every LiDAR to the vehicle are off by as much: "
        f"{remedy}; if the vehicle frame is meant to lean, set ground.parallel_sigma_deg",
    )


def fixes_finding(name: str, found: LostFixes, has_imu: bool) -> Finding:
    """Fixes of which the motion contradicts most."""
    return Finding(
        "topics.gnss or the motion data",
        (),
        0.0,
        found.sigmas,
        "contradiction",
        found.sentence(name, has_imu),
    )


def heading_finding(found: HeadingDisagreement, config: Config) -> Finding | None:
    """A heading that disagrees with the course over ground, in the words of the check after it."""
    if not found.warning:
        return None
    R = known_rotation(config)
    return Finding(
        "imu.T_vehicle_imu",
        () if R is None else _degrees(gtsam.Rot3.Rz(found.yaw_rad).matrix() @ R),
        math.degrees(found.sigma_rad),
        abs(found.yaw_rad) / found.sigma_rad,
        "warning",
        found.warning,
    )


def guess_findings(name: str, found: Sequence[Misfit], config: Config) -> tuple[Finding, ...]:
    """Guesses and vehicle height that do not fit the ground that the LiDARs see."""
    out = []
    for misfit in found:
        contradicted = misfit.p_value < CONTRADICTION_P or misfit.sigmas > CONTRADICTION_SIGMAS
        if misfit.sigmas < WARNING_SIGMAS and not contradicted:
            continue
        key, value, sigma, text = (
            _height(misfit, config) if misfit.quantity == "height" else _level(misfit, config)
        )
        out.append(
            Finding(
                key,
                value,
                sigma,
                misfit.sigmas,
                "contradiction" if contradicted else "warning",
                f"{name}: {text}",
            )
        )
    return tuple(out)


def _height(misfit: Misfit, config: Config) -> tuple[str, tuple[float, ...], float, str]:
    """Key, value, sigma and sentence of a misfit of the heights above the ground."""
    text = (
        f"the ground that the LiDARs see, the z of their guesses and ground.vehicle_height do not "
        f"fit together (chi2 {misfit.chi2:.1f} of {misfit.dof}): "
    )
    fits = f"would fit ({misfit.sigmas:.1f} sigma)"
    if misfit.lidar:
        key = f"lidars.{misfit.lidar}.initial.xyz"
        value = float(config.lidars[misfit.lidar].guess().z()) + misfit.value
        text += f"lidar '{misfit.lidar}' alone is off, z {value:.2f} +- {misfit.sigma:.2f} m {fits}"
    else:
        key = "ground.vehicle_height"
        value = (config.ground.vehicle_height or 0.0) + misfit.value
        text += f"vehicle_height {value:.2f} +- {misfit.sigma:.2f} m {fits}"
        if misfit.dof == 1:
            text += f", or z of lidar '{next(iter(config.lidars))}' is wrong"
        else:
            text += f", or z of all guesses, {misfit.value:+.2f} m: both count from one frame"
    if _fit_inversely(misfit, config):
        text += (
            "; with the other sign z fits as well. Check that guesses say where a LiDAR is in the "
            "vehicle frame, z up (T_vehicle_lidar), and are not the inverse"
        )
    return key, (value,), misfit.sigma, text


INVERSE_M = 0.3
"""Largest z of a guess's inverse off the height that the ground asks for: tilts of both guesses."""


def _fit_inversely(misfit: Misfit, config: Config) -> bool:
    """Whether guesses that are off lie below the vehicle, and their inverses fit."""
    names = [misfit.lidar] if misfit.lidar else list(config.lidars)
    if any(config.lidars[name].initial is None for name in names):
        return False
    guesses = [config.lidars[name].guess() for name in names]
    now = np.array([T.z() for T in guesses])
    inverse = np.array([T.inverse().z() for T in guesses])
    fits = np.abs(inverse - now - misfit.value) < INVERSE_M
    return bool(fits.all() and misfit.value > 2.0 * INVERSE_M)


def _level(misfit: Misfit, config: Config) -> tuple[str, tuple[float, ...], float, str]:
    """Key, value, sigma and sentence of a misfit of roll or pitch."""
    value, sigma = math.degrees(misfit.value), math.degrees(misfit.sigma)
    off = f"{misfit.quantity} by {-value:+.1f} +- {sigma:.1f} degrees ({misfit.sigmas:.1f} sigma)"
    if misfit.lidar:
        key = f"lidars.{misfit.lidar}.initial.rpy_deg"
        turn = gtsam.Rot3.Rx if misfit.quantity == "roll" else gtsam.Rot3.Ry
        guess = config.lidars[misfit.lidar].guess().rotation()
        fits = _degrees(turn(misfit.value).compose(guess).matrix())
        text = (
            f"with its guess, the ground that lidar '{misfit.lidar}' sees is not level: {off}. "
            f"rpy_deg about {_rpy(fits)} would be level. Check it: signs, degrees, T_vehicle_lidar "
            "and not its inverse"
        )
        return key, fits, sigma, text
    text = (
        f"with their guesses, the ground that the LiDARs see is not level, all alike: {off}. "
        "Check the vehicle frame that the guesses were measured in"
    )
    return "lidars", (), sigma, text


def copies_sentence(name: str, found: Copy, config: Config) -> str:
    """Two topics with the same clouds."""
    first, second = found.lidars
    topics = [config.lidars[lidar].topic for lidar in found.lidars]
    how = "the same clouds"
    if found.moved_m > 1e-3 or found.turned_rad > 1e-3:
        how = (
            f"the same clouds in two frames, {found.moved_m:.3f} m and "
            f"{math.degrees(found.turned_rad):.2f} degrees apart"
        )
    return (
        f"{name}: '{topics[0]}' (lidar '{first}') and '{topics[1]}' (lidar '{second}') hold {how}: "
        "they are one LiDAR. Give the topic of the other LiDAR, or remove one of the two"
    )
