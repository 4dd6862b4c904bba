"""Channels of a spinning LiDAR: found by the elevations of its points, and their points summed.

No field of the points is needed. A LiDAR whose channels cannot be told apart by their elevations,
such as one with a rosette, or one whose clouds are in another frame, has none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.targets.cloud.beams import elevations

MOST_CHANNELS = 64
"""Channels of a LiDAR at most that have errors of their own: each has three variables, as half a
pose has. Of more, neighbours see much the same."""

BIN_RAD = np.radians(0.02)
"""Elevations in one bin are the same: the nearest channels of common LiDARs are 0.17 degrees
apart."""

WIDEST_RAD = np.radians(0.4)
"""Greatest width of the elevations of a channel. Beams that begin 30 mm from the origin are seen up
to 0.1 degrees beside their direction at 6 m, and coordinates are rounded to millimetres."""

NEAR_RAD = np.radians(0.5)
"""A channel has more points than there are between it and others within this angle."""

VALLEY = 0.05
"""Largest share of the points of a channel, for equal angles, that are between it and the next."""

LEAST_GAP = 0.5
"""Smallest angle between the elevations of two channels, in units of their own width."""

LEAST_OF_CHANNEL = 20
"""Points of a channel at least: of so few per degree no gap is by chance in all of them."""

LEAST_SHARE = 0.9
"""Share of the points, at least, that are of channels: the others are of no elevation."""


@dataclass(frozen=True)
class ChannelSums:
    """What the points of each channel add to N patches: G groups, of one patch and channel each.

    Attributes:
        patch: (G,) index of the patch.
        elevation_rad: (G,) mean of the channel in the scan of the patch, about the z axis, as
            measured.
        sums: (G, 4) sum of h over the points, as in `DrivePatches.moments`.
    """

    patch: IntArray
    elevation_rad: Array
    sums: Array

    def part(self, keep: BoolArray | IntArray, patches: int) -> ChannelSums:
        """Those of some of the N = `patches` patches: a mask (N,), or their indices."""
        number = np.full(patches, -1)
        number[keep] = np.arange(np.count_nonzero(keep) if keep.dtype == bool else len(keep))
        patch = number[self.patch]
        own = patch >= 0
        return ChannelSums(patch[own], self.elevation_rad[own], self.sums[own])

    @classmethod
    def joined(
        cls, parts: Sequence[ChannelSums | None], number: Sequence[int]
    ) -> ChannelSums | None:
        """Of all patches, `number` of each part; None if no part has channels."""
        first = np.cumsum([0, *number]).tolist()
        known = [(part, at) for part, at in zip(parts, first, strict=False) if part is not None]
        if not known:
            return None
        return cls(
            np.concatenate([part.patch + at for part, at in known]),
            np.concatenate([part.elevation_rad for part, _ in known]),
            np.concatenate([part.sums for part, _ in known]),
        )


def found_channels(elevation_rad: Array) -> Array | None:
    """(k,) elevations of the channels of points at elevations (N,), ascending, rad.

    None if they cannot be told apart, or are more than `MOST_CHANNELS`.
    """
    found = found_rows(elevation_rad)
    return None if found is None or len(found) > MOST_CHANNELS else found


def found_rows(elevation_rad: Array) -> Array | None:
    """`found_channels`, however many they are."""
    if not len(elevation_rad):
        return None
    place = ((elevation_rad - elevation_rad.min()) / BIN_RAD).astype(np.int64)
    count = np.bincount(place)
    density = np.convolve(count, np.ones(3))[1:-1]
    near = round(NEAR_RAD / BIN_RAD)
    most = sliding_window_view(np.pad(density, near), 2 * near + 1).max(axis=1)
    inside = np.concatenate([[False], density > VALLEY * most, [False]])
    begin, end = np.flatnonzero(np.diff(inside.astype(np.int8))).reshape(-1, 2).T
    before = np.concatenate([[0], np.cumsum(count)])
    several = before[end] - before[begin] >= LEAST_OF_CHANNEL
    begin, end = begin[several], end[several]
    if not len(begin):
        return None
    width, between = end - begin, begin[1:] - end[:-1]
    gap = np.minimum(np.append(between, len(count)), np.append(len(count), between))
    alone = (gap >= LEAST_GAP * width) & (width * BIN_RAD <= WIDEST_RAD)
    if (before[end] - before[begin])[alone].sum() < LEAST_SHARE * len(elevation_rad):
        return None
    total = np.concatenate([[0.0], np.cumsum(np.bincount(place, elevation_rad))])
    return np.asarray((total[end] - total[begin]) / (before[end] - before[begin]))


def nearest_channels(channels_rad: Array, elevation_rad: Array) -> IntArray:
    """(N,) index of the channel (k,) that is nearest to each elevation (N,)."""
    return np.searchsorted(0.5 * (channels_rad[1:] + channels_rad[:-1]), elevation_rad)


@dataclass(frozen=True)
class PointChannels:
    """The channel of each of N points.

    Attributes:
        elevation_rad: (k,) of the channels, ascending.
        of_point: (N,) index of each point's.
    """

    elevation_rad: Array
    of_point: IntArray

    @classmethod
    def found(cls, points: Array) -> PointChannels | None:
        """Of the points (N, 3) of a scan; None: it has no channels."""
        elevation = elevations(points)
        channels = found_channels(elevation)
        if channels is None:
            return None
        return cls(channels, nearest_channels(channels, elevation))

    def only(self, keep: BoolArray | IntArray) -> PointChannels:
        """Those of some points."""
        return PointChannels(self.elevation_rad, self.of_point[keep])

    def number(self, first: IntArray) -> tuple[IntArray, Array]:
        """Channels (n,) of groups of the points, which begin at `first` (n,); and rad they span."""
        seen = np.bitwise_or.reduceat(np.uint64(1) << self.of_point.astype(np.uint64), first)
        low = np.minimum.reduceat(self.of_point, first)
        high = np.maximum.reduceat(self.of_point, first)
        span = self.elevation_rad[high] - self.elevation_rad[low]
        return np.bitwise_count(seen).astype(np.int64), span

    def sums(self, points: Array, patch: IntArray) -> ChannelSums:
        """What the points (3, N) add to the patches (N,) that they are of."""
        channels = len(self.elevation_rad)
        key = patch * channels + self.of_point
        count = np.bincount(key)
        (own,) = np.nonzero(count)
        sums = [np.bincount(key, of)[own] for of in points]
        of_patch, of_channel = np.divmod(own, channels)
        return ChannelSums(
            of_patch, self.elevation_rad[of_channel], np.column_stack([*sums, count[own]])
        )
