"""Velocity and acceleration of the GNSS antenna, and what the IMU measured over the same windows.

Closed form, of the raw data: it works where nothing can be smoothed yet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.trajectory.gnss import Positions

HALF_WINDOW_NS = 1_000_000_000
"""Half of a window. Twenty fixes of 17 mm in 2 s give an acceleration to 0.03 m/s^2, and a vehicle
changes its acceleration in about that time."""

STEP_NS = 500_000_000
"""From one window to the next: a quarter of a window, so that four windows count as one sample."""

OVERLAP = 2.0 * HALF_WINDOW_NS / STEP_NS
"""Windows per independent sample."""

MIN_FIXES = 5
"""In a window: a parabola has three unknowns, and its fit must be judged."""

MIN_SPAN_S = 1.0
"""From the first fix of a window to its last: over less, an acceleration is noise."""

MAX_WINDOWS = 2000
"""Windows at most, evenly chosen: of a drive of hours every few seconds suffice."""

MIN_WINDOWS = 12
"""Windows that a comparison is made of: three independent samples."""

WORST = 5.0
"""Times the median scatter about its parabola: a window with more has an outlier or a jump."""


@dataclass(frozen=True)
class Windows:
    """The motion of the GNSS antenna in windows of time, and the IMU's mean readings in them.

    Attributes:
        stamps_ns: (n,) middles.
        position_map: (n, 3) metres.
        velocity_map: (n, 3) m/s.
        acceleration_map: (n, 3) m/s^2.
    """

    stamps_ns: IntArray
    position_map: Array
    velocity_map: Array
    acceleration_map: Array

    def where(self, which: BoolArray) -> Windows:
        """Some of the windows, by a mask (n,)."""
        return Windows(
            self.stamps_ns[which],
            self.position_map[which],
            self.velocity_map[which],
            self.acceleration_map[which],
        )

    @property
    def speed_m_s(self) -> Array:
        """(n,) horizontal."""
        return np.asarray(np.hypot(self.velocity_map[:, 0], self.velocity_map[:, 1]))

    @property
    def course_rate_rad_s(self) -> Array:
        """(n,) rate of the direction of travel about the vertical, positive to the left."""
        v, a = self.velocity_map, self.acceleration_map
        return np.asarray((v[:, 0] * a[:, 1] - v[:, 1] * a[:, 0]) / self.speed_m_s**2)


def antenna_windows(positions: Positions, begin_ns: int, end_ns: int) -> Windows:
    """Local parabolas through the fixes, every `STEP_NS` within a span; those that fit."""
    middles = np.arange(begin_ns + HALF_WINDOW_NS, end_ns - HALF_WINDOW_NS, STEP_NS, dtype=np.int64)
    if len(middles) > MAX_WINDOWS:
        middles = middles[np.linspace(0, len(middles) - 1, MAX_WINDOWS).astype(np.int64)]
    stamps = positions.stamps_ns
    kept: list[int] = []
    rows, scatter = [], []
    for middle in middles.tolist():
        first, last = np.searchsorted(stamps, [middle - HALF_WINDOW_NS, middle + HALF_WINDOW_NS])
        if last - first < MIN_FIXES:
            continue
        # The acceleration is that of the middle of the fixes.
        middle = int((stamps[first:last] - middle).mean()) + middle
        t = (stamps[first:last] - middle) * 1e-9
        # At the edge of a gap, the next window may have the same fixes.
        if t[-1] - t[0] < MIN_SPAN_S or (kept and middle <= kept[-1]):
            continue
        A = np.stack([np.ones(len(t)), t, 0.5 * t**2], axis=1)
        found, *_ = np.linalg.lstsq(A, positions.position_map[first:last])
        left = positions.position_map[first:last] - A @ found
        kept.append(middle)
        rows.append(found)
        scatter.append(float(np.sqrt((left[:, :2] ** 2).sum() / (len(t) - 3))))
    found = np.array(rows).reshape(-1, 3, 3)
    fits = np.array(scatter) <= WORST * np.median(scatter) if kept else np.zeros(0, dtype=bool)
    return Windows(np.array(kept, np.int64)[fits], found[fits, 0], found[fits, 1], found[fits, 2])


def means_over(
    stamps_ns: IntArray, values: Array, middles_ns: IntArray, delay_s: float = 0.0
) -> Array:
    """(m, d) means of (n, d) samples in windows about (m,) instants, NaN where there are none.

    Weighted as the parabola's second derivative weights accelerations: by (1 - x^2)^2, x from -1 to
    1 over the window. `delay_s`: the windows are later by so much.
    """
    out = np.full((len(middles_ns), values.shape[1]), np.nan)
    middles = middles_ns + round(1e9 * delay_s)
    begins = np.searchsorted(stamps_ns, middles - HALF_WINDOW_NS).tolist()
    ends = np.searchsorted(stamps_ns, middles + HALF_WINDOW_NS).tolist()
    for i, (middle, first, last) in enumerate(zip(middles.tolist(), begins, ends, strict=True)):
        if last - first < MIN_FIXES:
            continue
        x = (stamps_ns[first:last] - middle) / HALF_WINDOW_NS
        weight = (1.0 - x**2) ** 2
        out[i] = weight @ values[first:last] / weight.sum()
    return out
