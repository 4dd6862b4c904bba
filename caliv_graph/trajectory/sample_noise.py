"""The white noise that an IMU's own samples show.

White noise is as loud in every octave of the spectrum, and the vehicle's motion and the lines of an
engine only add to it: so it is no louder than the quietest octave. Road and engine shake the sensor
while the vehicle rolls; what a data sheet states is of a sensor that lies still (`README.md`,
section 9).
"""

from __future__ import annotations

import numpy as np

from caliv_graph.products import Array, IntArray
from caliv_graph.trajectory.imu import Inertial
from caliv_graph.trajectory.noise import ImuNoise

SEGMENT_S = 2.0
"""Length of the segments whose spectra are averaged: half a hertz from bin to bin."""

LOWEST_HZ = 5.0
"""Lower end of the octaves: a vehicle's body turns and rocks below."""

FEWEST = 10
"""Segments that tell a spectrum, of eleven seconds: the quietest octave of five comes out 7 percent
too quiet, of ten 4, of forty 2, by chance."""

KNOCK = 4.0
"""Power of a segment over the median from which it does not count: a bump or a door that is slammed
is as loud in all octaves, and a segment of five bins is three times as loud as usual by chance."""

STEADY = 1.1
"""A segment's length over that of evenly spaced samples, or its inverse, at most: a longer one has
a gap, a shorter one another rate."""


def levels_of_samples(inertial: Inertial, noise: ImuNoise, until_ns: int) -> dict[str, float]:
    """The quietest octave of each sensor, over the white noise that is taken.

    Args:
        inertial: samples, of which those up to `until_ns` are asked.
        noise: densities in which the spectra are measured.
        until_ns: last stamp.

    Returns:
        Scale on the sigma of "gyroscope" and "accelerometer"; empty where the samples are too few
        or too slow for a whole octave.
    """
    used = slice(0, int(np.searchsorted(inertial.stamps_ns, until_ns, "right")))
    stamps = inertial.stamps_ns[used]
    if len(stamps) < 2:
        return {}
    period_s = 1e-9 * float(np.median(np.diff(stamps)))
    length = round(SEGMENT_S / period_s)
    octaves = _octaves(length, period_s)
    if not octaves:
        return {}
    starts = _steady(stamps, length)
    if len(starts) < FEWEST:
        return {}
    out = {}
    for name, samples, density in (
        ("gyroscope", inertial.gyro[used], noise.gyro_density),
        ("accelerometer", inertial.force[used], noise.force_density),
    ):
        power = _powers(samples, starts, length, period_s) / np.diagonal(density)
        out[name] = float(np.sqrt(min(_level(power[:, octave]) for octave in octaves)))
    return out


def _steady(stamps_ns: IntArray, length: int) -> IntArray:
    """Starts of half overlapping segments of even samples."""
    starts = np.arange(0, len(stamps_ns) - length + 1, max(1, length // 2))
    took_ns = stamps_ns[starts + length - 1] - stamps_ns[starts]
    usual_ns = float(np.median(np.diff(stamps_ns))) * (length - 1)
    even = (took_ns <= STEADY * usual_ns) & (took_ns >= usual_ns / STEADY)
    return np.asarray(starts[even])


def _octaves(length: int, period_s: float) -> list[slice]:
    """Bins of the octaves from `LOWEST_HZ` to half the rate, from the top."""
    out, top = [], length // 2
    lowest = LOWEST_HZ * length * period_s - 0.5  # a rate of 20 Hz is one of 19.99 as well
    while top // 2 >= max(lowest, 1.0):
        out.append(slice(top // 2, top))
        top //= 2
    return out


def _level(power: Array) -> float:
    """Of (segments, bins, 3) powers of an octave the white noise, by the middle one of the axes.

    The mean over the segments, as noise that comes with the speed counts by its mean, without those
    that are loud by themselves; of the bins the median, as an engine is in a few.
    """
    of_segments = np.median(power, axis=1)
    knocked = of_segments > KNOCK * np.median(of_segments, axis=0)
    mean = np.nanmean(np.where(knocked[:, None], np.nan, power), axis=0)
    return float(np.median(np.median(mean, axis=0)))


def _powers(samples: Array, starts: IntArray, length: int, period_s: float) -> Array:
    """(segments, bins, 3) power per hertz of each segment, two-sided as densities are (Welch)."""
    window = np.hanning(length)[:, None]
    segments = samples[starts[:, None] + np.arange(length)]
    segments = (segments - segments.mean(axis=1, keepdims=True)) * window
    power = np.abs(np.fft.rfft(segments, axis=1)) ** 2
    return np.asarray(power * period_s / float((window**2).sum()))
