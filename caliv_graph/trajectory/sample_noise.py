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

FEWEST = 5
"""Segments that tell a spectrum: 10 bins of 5 of them on three axes err by 10 percent."""

STEADY = 1.1
"""Most of a segment's length over that of evenly spaced samples: a longer one has a gap."""


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
    starts = _steady(stamps, length)
    octaves = _octaves(length, period_s)
    if len(starts) < FEWEST or not octaves:
        return {}
    out = {}
    for name, samples, density in (
        ("gyroscope", inertial.gyro[used], noise.gyro_density),
        ("accelerometer", inertial.force[used], noise.force_density),
    ):
        spectrum = _spectrum(samples, starts, length, period_s) / np.diagonal(density)
        out[name] = float(np.sqrt(min(np.median(spectrum[octave]) for octave in octaves)))
    return out


def _steady(stamps_ns: IntArray, length: int) -> IntArray:
    """Starts of half overlapping segments without a gap."""
    starts = np.arange(0, len(stamps_ns) - length + 1, max(1, length // 2))
    took_ns = stamps_ns[starts + length - 1] - stamps_ns[starts]
    usual_ns = float(np.median(np.diff(stamps_ns))) * (length - 1)
    return np.asarray(starts[took_ns <= STEADY * usual_ns])


def _octaves(length: int, period_s: float) -> list[slice]:
    """Bins of the octaves from `LOWEST_HZ` to half the rate, from the top."""
    out, top = [], length // 2
    while top // 2 >= LOWEST_HZ * length * period_s:
        out.append(slice(top // 2, top))
        top //= 2
    return out


def _spectrum(samples: Array, starts: IntArray, length: int, period_s: float) -> Array:
    """(bins, 3) mean power per hertz, both signs of the frequency counted (Welch 1967)."""
    window = np.hanning(length)[:, None]
    total = np.zeros((length // 2 + 1, samples.shape[1]))
    for start in starts.tolist():
        segment = samples[start : start + length]
        total += np.abs(np.fft.rfft((segment - segment.mean(axis=0)) * window, axis=0)) ** 2
    return np.asarray(total * period_s / (len(starts) * float((window**2).sum())))
