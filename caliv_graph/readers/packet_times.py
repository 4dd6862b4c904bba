"""Times of points that start anew with every packet of a turning LiDAR, as of old Velodyne drivers.

Within a packet the times are right. The packets of a turn follow one another evenly, so that the
azimuth at which each begins tells which one it is, also where packets without a return are left
out. Points must come in the order in which they were measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caliv_graph.products import Array, IntArray

PACKET_PART = 0.25
"""Of the time between two clouds: a packet is shorter. The longest, of a 16-channel LiDAR, takes
1.33 ms."""

_LEAST_RESTARTS = 8
"""Fewer do not show that the packets follow one another evenly."""

_OFF_GRID = 0.35
"""Of a packet's duration: the largest distance of its start from the even grid; beyond it, a start
may belong to the neighbour on the grid."""

_DURATIONS = (0.9, 1.6)
"""Time from packet to packet over the span of the times in one: its last shot comes somewhat before
the next packet, and both are measured."""


@dataclass(frozen=True)
class Continued:
    """Times that run through the cloud, or why they cannot be told.

    Attributes:
        times_s: (N,) from the first packet's zero; None: they cannot be told.
        packets: how many the cloud is made of, without those left out.
        problem: why the times cannot be told, a sentence without a subject; empty: they can.
    """

    times_s: Array | None
    packets: int
    problem: str = ""


def continued_times(points_lidar: Array, times_s: Array, period_s: float) -> Continued | None:
    """Times of points that start anew with every packet, continued through the cloud.

    Args:
        points_lidar: (N, 3) in the order of measurement, of a LiDAR that turns about its z axis.
        times_s: (N,) as they are in the cloud.
        period_s: seconds of a turn: the usual time between two clouds.

    Returns:
        None: the times do not start anew with packets.
    """
    if len(times_s) < 2:
        return None
    span_s = float(np.ptp(times_s))
    starts = 1 + np.flatnonzero(np.diff(times_s) < -0.5 * span_s)
    if len(starts) < _LEAST_RESTARTS or span_s > PACKET_PART * period_s:
        return None
    azimuth = np.arctan2(points_lidar[:, 1], points_lidar[:, 0])
    packet = np.zeros(len(times_s), np.int64)
    packet[starts] = 1
    packet = np.cumsum(packet)
    if _widest(azimuth, packet) > 0.5 * _span(azimuth):
        return None  # rows of a narrow view, each of which spans all of it
    packets = len(starts) + 1
    seen = f"its times start anew {len(starts)} times in a cloud and span {1e3 * span_s:.3g} ms"
    begins_s = _begins(azimuth, times_s, packet, packets, period_s)
    steps_s = np.diff(begins_s)
    step_s = float(np.median(steps_s))
    low, high = (factor * span_s for factor in _DURATIONS)
    if not low <= step_s <= high:
        return Continued(
            None,
            packets,
            f"{seen}, but by azimuth and {1.0 / period_s:.3g} turns per second a packet takes "
            f"{1e3 * step_s:.3g} ms",
        )
    counts = np.maximum(np.rint(steps_s / step_s), 1.0)
    step_s = float(begins_s[-1] / counts.sum())
    if np.abs(steps_s - counts * step_s).max() > _OFF_GRID * step_s:
        return Continued(None, packets, f"{seen}, but its packets do not follow evenly by azimuth")
    offsets_s = step_s * np.concatenate([[0.0], np.cumsum(counts)])
    return Continued(times_s + offsets_s[packet], packets)


def _widest(azimuth: Array, packet: IntArray) -> float:
    """Radians of azimuth that the median packet spans."""
    edges = np.flatnonzero(np.diff(packet)) + 1
    return float(np.median([_span(part) for part in np.split(azimuth, edges)]))


def _span(azimuth: Array) -> float:
    """Radians from the first to the last of some azimuths that may pass +-pi."""
    middle = np.angle(np.exp(1j * azimuth).mean())
    return float(np.ptp(np.angle(np.exp(1j * (azimuth - middle)))))


def _begins(
    azimuth: Array, times_s: Array, packet: IntArray, packets: int, period_s: float
) -> Array:
    """(packets,) seconds after the first at which each packet begins, by its azimuth.

    The turn within the packet is taken off each point first: packets then differ by whole steps
    whichever of their beams returned.
    """
    rate = 2.0 * np.pi / period_s
    best = np.zeros(packets)
    least = np.inf
    for way in (-1.0, 1.0):  # clockwise as Velodyne turns, and the other way
        turned = np.exp(1j * (way * azimuth - rate * times_s))
        sums = np.bincount(packet, turned.real) + 1j * np.bincount(packet, turned.imag)
        steps = np.mod(np.angle(sums[1:] / sums[:-1]), 2.0 * np.pi)
        total = float(steps.sum())
        if total < least:  # the wrong way is almost a turn per packet
            least, best = total, np.concatenate([[0.0], np.cumsum(steps)]) / rate
    return best
