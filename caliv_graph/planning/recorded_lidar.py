"""A recorded LiDAR as a scenario describes it: fields of view and beams, read off some clouds.

A prediction needs the solid angle of a beam, which is what divides the area of a target into
points, and the sides of the field of view. Beams that never return are not known: below an empty
sky the highest channel that returned is the edge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import RecordingError
from caliv_graph.products import Array, IntArray
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.targets.cloud.beams import elevations
from caliv_graph.targets.cloud.field_of_view import ELEVATION_BLUR_RAD, FieldOfView, azimuth_edges

NEAREST_M = 2.0
"""Nearer points are left out: beams do not begin in the LiDAR's origin, which shifts their angles
by some hundredths of a degree from here on."""

LEAST_POINTS = 100
"""Of all clouds together, below which no beams are read off them."""

LEAST_OF_A_CHANNEL = 5
"""Points of a channel in all clouds together; fewer are strays."""

WIDEST_CHANNEL = 4.0
"""Spread of a channel's elevations over `ELEVATION_BLUR_RAD`. Most points of a LiDAR without
channels, whose beams never repeat an elevation, are in wider groups."""

EVEN_PART = 0.25
"""Channels are evenly spaced if no gap differs from the median by more than this part of it."""

LEAST_COLUMN_RAD = math.radians(0.01)
"""Nearer points of one channel are two returns of one beam. No LiDAR has columns as near."""

COLUMN_QUANTILE = 0.25
"""Of the gaps between neighbours in a channel: larger ones are beams without a return."""


@dataclass(frozen=True)
class SeenBeams:
    """The beams of a LiDAR, as its clouds show them; degrees.

    Attributes:
        horizontal_fov_deg: azimuth, from and to.
        elevations_deg: (c,) of the channels, ascending.
        column_deg: between two beams of a channel.
        even: whether the channels are evenly spaced.
        reach_m: the farthest return.
    """

    horizontal_fov_deg: tuple[float, float]
    elevations_deg: Array
    column_deg: float
    even: bool
    reach_m: float

    @classmethod
    def of(cls, clouds: Sequence[Array], source: str) -> SeenBeams:
        """Reads them off some clouds (N, 3), metres, lidar frame; `source` is for the message.

        Raises:
            RecordingError: the clouds have too few points.
        """
        far = [c[np.linalg.norm(c, axis=1) >= NEAREST_M] for c in clouds]
        every = np.concatenate([*far, np.zeros((0, 3))])
        if len(every) < LEAST_POINTS:
            raise RecordingError(
                f"{source}: {len(clouds)} clouds have {len(every)} points beyond {NEAREST_M:g} m: "
                "too few to tell the LiDAR's field of view. Check its topic"
            )
        edges = azimuth_edges(every)
        azimuths = (-180.0, 180.0)
        if edges is not None:
            middle = math.remainder(edges[0], 2.0 * math.pi)
            half = max(edges[1], LEAST_COLUMN_RAD)
            azimuths = (math.degrees(middle - half), math.degrees(middle + half))
        reach_m = float(np.linalg.norm(every, axis=1).max())
        channels = _channels(elevations(every))
        if channels is not None:
            column = _column(far, channels)
            if column is not None:
                gaps = np.diff(channels)
                even = bool((np.abs(gaps / np.median(gaps) - 1.0) <= EVEN_PART).all())
                return cls(azimuths, np.degrees(channels), math.degrees(column), even, reach_m)
        return cls(azimuths, *_without_channels(far, every), True, reach_m)


def _channels(elevation: Array) -> Array | None:
    """(c,) elevations of the channels in radians; None if there are none to be told apart."""
    ordered = np.sort(elevation)
    groups = np.split(ordered, np.flatnonzero(np.diff(ordered) > ELEVATION_BLUR_RAD) + 1)
    wide = sum(len(g) for g in groups if g[-1] - g[0] > WIDEST_CHANNEL * ELEVATION_BLUR_RAD)
    rows = np.array([np.median(g) for g in groups if len(g) >= LEAST_OF_A_CHANNEL])
    return rows if wide < 0.5 * len(ordered) and len(rows) >= 2 else None


def _column(clouds: Sequence[Array], channels: Array) -> float | None:
    """Angle between two beams of a channel; None if no channel has two points in a cloud."""
    gaps = []
    middles = 0.5 * (channels[1:] + channels[:-1])
    for cloud in clouds:
        azimuth = np.arctan2(cloud[:, 1], cloud[:, 0])
        row = np.searchsorted(middles, elevations(cloud))
        order = np.lexsort([azimuth, row])
        gap = np.diff(azimuth[order])[np.diff(row[order]) == 0]
        gaps.append(gap[gap > LEAST_COLUMN_RAD])
    every = np.concatenate([*gaps, np.zeros(0)])
    return float(np.quantile(every, COLUMN_QUANTILE)) if len(every) else None


def _without_channels(clouds: Sequence[Array], every: Array) -> tuple[Array, float]:
    """Elevations and distance of columns, degrees, with the density of a LiDAR without channels."""
    spacing = 1.0 / math.sqrt(FieldOfView.of([c for c in clouds if len(c)]).density)
    low, high = np.quantile(elevations(every), [0.001, 0.999])
    high = max(high, low + spacing)
    count = max(2, round((high - low) / spacing) + 1)
    return np.degrees(np.linspace(low, high, count)), math.degrees(spacing)


def lidar_model(
    beams: SeenBeams,
    config: LidarConfig,
    mounting: PoseConfig,
    range_sigma_m: float,
    stamps_ns: IntArray,
) -> LidarModel:
    """A LiDAR as a scenario describes it. What moves during a sweep is left out.

    Args:
        beams: of its clouds.
        config: for the ranges that are read.
        mounting: T_vehicle_lidar.
        range_sigma_m: noise along the beam.
        stamps_ns: (n,) of its clouds since the start of the drive, ascending, n at least 2.
    """
    channels = np.round(beams.elevations_deg, 4)
    low, high = float(channels[0]), float(channels[-1])
    period_ns = float(np.median(np.diff(stamps_ns)))
    azimuths = (round(beams.horizontal_fov_deg[0], 2), round(beams.horizontal_fov_deg[1], 2))
    return LidarModel(
        mounting=mounting,
        horizontal_fov_deg=azimuths,
        vertical_fov_deg=(low, high),
        channels=len(channels),
        elevations_deg=None if beams.even else tuple(channels.tolist()),
        horizontal_resolution_deg=min(round(beams.column_deg, 5), azimuths[1] - azimuths[0]),
        rate_hz=round(NANOSECONDS_PER_SECOND / period_ns, 3),
        range_sigma_m=range_sigma_m,
        min_range_m=config.min_range,
        max_range_m=max(min(round(beams.reach_m, 1), config.max_range), config.min_range + 1.0),
        phase_s=round(float(stamps_ns[0]) / NANOSECONDS_PER_SECOND, 6),
    )
