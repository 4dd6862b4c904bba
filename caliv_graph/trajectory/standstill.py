"""A vehicle that stands does not turn: what the gyroscope reads then is its bias.

`README.md`, section 4a. Used where nothing else measures the heading.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, BoolArray, TwistSamples
from caliv_graph.trajectory.inputs import TWIST_CLOCK, SmootherInput
from caliv_graph.trajectory.wheels import STANDING_M_S

YAW_RATE_RAD_S = 0.005
"""Yaw rate up to which a vehicle stands, where an odometry has one: robots turn on the spot."""

LEAST_NS, EDGE_NS = 500_000_000, 150_000_000
"""Shortest standstill; and what is left out at both of its ends, where encoders still read zero or
read it already, and the body swings."""

MIN_SPEEDS = 4
"""Messages in a row that say so."""

MOST_APART_NS = 500_000_000
"""Longest time between two of them."""

TURN_RAD = 5e-4
"""1 sigma of a turn of the body meanwhile, about each axis: a person who steps in or out."""

STEADY_SIGMAS = 5.0
"""Difference of the rates of both halves at which a vehicle does not stand."""


@dataclass(frozen=True)
class Standstill:
    """A time at which a vehicle stands.

    Attributes:
        middle_ns: its middle.
        rate: (3,) mean angular velocity that the gyroscope read, rad/s, imu frame.
        sigmas: (3,) of it as a measurement of the bias, rad/s.
    """

    middle_ns: int
    rate: Array
    sigmas: Array


def standstills(data: SmootherInput) -> tuple[Standstill, ...]:
    """The standstills of a drive whose heading nothing else measures, by its speeds.

    None with fixes or orientations, or without an IMU or speeds.
    """
    twist = data.motion.twist
    measured = data.positions is not None or data.orientation or data.headings is not None
    if twist is None or data.wheels is not None or measured:
        return ()
    out, samples = [], data.inertial
    variance = np.diagonal(data.noise.gyro_density)
    late_ns = data.late_ns.get(TWIST_CLOCK, 0)
    for begin, end in _standing_ns(replace(twist, stamps_ns=twist.stamps_ns - late_ns)):
        first, last = np.searchsorted(samples.stamps_ns, [begin, end])
        rates = samples.gyro[first:last]
        if len(rates) < 2 * MIN_SPEEDS:
            continue
        seconds = (end - begin) / NANOSECONDS_PER_SECOND
        white = variance / seconds
        half = len(rates) // 2
        apart = rates[:half].mean(axis=0) - rates[half:].mean(axis=0)
        # Each half has twice the variance of all.
        allowed = 4.0 * (white + (TURN_RAD / seconds) ** 2)
        if (apart**2 > STEADY_SIGMAS**2 * allowed).any():
            continue
        sigmas = np.sqrt(white + (TURN_RAD / seconds) ** 2)
        out.append(Standstill((begin + end) // 2, rates.mean(axis=0), sigmas))
    return tuple(out)


def _standing_ns(twist: TwistSamples) -> list[tuple[int, int]]:
    """Begin and end of each time at which the speeds are zero, without its edges."""
    with np.errstate(invalid="ignore"):
        standing: BoolArray = np.asarray((np.abs(twist.velocity) <= STANDING_M_S).all(axis=1))
        if twist.yaw_rate is not None:
            standing &= ~(np.abs(twist.yaw_rate) > YAW_RATE_RAD_S)
    stamps, out = twist.stamps_ns, []
    apart = np.diff(stamps) > MOST_APART_NS
    cuts = np.flatnonzero((np.diff(standing.astype(np.int8)) != 0) | apart) + 1
    for run in np.split(np.arange(len(stamps)), cuts):
        if len(run) < MIN_SPEEDS or not standing[run[0]]:
            continue
        begin, end = int(stamps[run[0]]) + EDGE_NS, int(stamps[run[-1]]) - EDGE_NS
        if end - begin >= LEAST_NS - 2 * EDGE_NS:
            out.append((begin, end))
    return out
