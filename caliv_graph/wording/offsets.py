"""Sentences about time offsets that the data do not determine."""

from __future__ import annotations

from collections.abc import Iterator, Mapping


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
