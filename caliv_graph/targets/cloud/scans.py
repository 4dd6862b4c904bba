"""Which scans are decoded for a target, and which of its clouds are used."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from caliv_graph.config.model import Config, TargetRegion
from caliv_graph.products import Array, IntArray, Recording, TargetCloud
from caliv_graph.targets.cloud.field_of_view import FieldOfView
from caliv_graph.targets.cloud.region import RegionExtractor, widened_margin_m
from caliv_graph.targets.cloud.views import (
    chosen,
    evenly_spread,
    preference,
    view_weights,
)
from caliv_graph.trajectory.select import VehicleTrajectory

FEW_SCANS = 150
"""Up to this number of scans, all are decoded."""

SAMPLED_SCANS = 8
"""Scans from which the field of view and the resolution are estimated."""

DECODED_PER_SCAN_USED = 5
"""Scans of a LiDAR that are decoded at most, per scan that may be used in the end."""


def scans_to_decode(
    recording: Recording,
    trajectory: VehicleTrajectory,
    lidar: str,
    config: Config,
    regions: Sequence[TargetRegion],
) -> frozenset[int]:
    """Stamps of the scans of a LiDAR that may see a target; the others are not decoded."""
    begin, end = trajectory.span_ns
    stamps = np.array(recording.scan_stamps_ns(lidar), np.int64)
    preferences = preference(np.arange(len(stamps)), len(stamps))
    within = (begin <= stamps) & (stamps <= end)
    stamps, preferences = stamps[within], preferences[within]
    if len(stamps) <= FEW_SCANS:
        return frozenset(stamps.tolist())
    some = stamps[np.linspace(0, len(stamps) - 1, SAMPLED_SCANS).astype(np.int64)]
    seen = [scan.points_lidar for scan in recording.scans(lidar, frozenset(some.tolist()))]
    seen = [points for points in seen if len(points)]
    if not seen:
        return frozenset(stamps.tolist())
    field_of_view = FieldOfView.of(seen)
    possible = np.zeros(len(stamps), dtype=np.bool_)
    weights = np.zeros(len(stamps))
    for region in regions:
        extractor = RegionExtractor(region, config, trajectory)
        towards = extractor.directions(lidar, stamps.tolist())
        range_m = np.linalg.norm(towards, axis=1)
        margin_m = extractor.reach_m() + np.array(
            [widened_margin_m(config, lidar, r) for r in range_m.tolist()]
        )
        sees = field_of_view.may_see(towards, margin_m, config.extraction.min_points)
        weights[sees] = np.maximum(weights[sees], view_weights(towards[sees]))
        possible |= sees
    # A long drive passes the target many times: a part of it is enough.
    most = DECODED_PER_SCAN_USED * config.extraction.max_scans
    some = chosen(preferences[possible], weights[possible], most)
    return frozenset(stamps[possible][some].tolist())


@dataclass(frozen=True)
class ScanOrder:
    """In which order the scans of a drive are preferred, whatever they show.

    `of_stamps` are those of all its scans, ascending, by LiDAR.
    """

    of_stamps: Mapping[str, IntArray]

    @staticmethod
    def of(recording: Recording, lidars: Iterable[str]) -> ScanOrder:
        """The order of the scans of these LiDARs."""
        return ScanOrder(
            {name: np.array(recording.scan_stamps_ns(name), np.int64) for name in lidars}
        )

    def thinned(self, clouds: list[TargetCloud], most: int) -> list[TargetCloud]:
        """At most `most` of a LiDAR's clouds; those of a standing vehicle are left out first."""
        if len(clouds) <= most:
            return clouds
        stamps = self.of_stamps[clouds[0].lidar]
        numbers = np.searchsorted(stamps, [c.stamp_ns for c in clouds])
        first = chosen(preference(numbers, len(stamps)), _weights(clouds), most)
        return [clouds[i] for i in first.tolist()]


def thinned(clouds: list[TargetCloud], most: int) -> list[TargetCloud]:
    """At most `most` of a LiDAR's clouds that have been chosen already, for a first look."""
    if len(clouds) <= most:
        return clouds
    return [clouds[i] for i in evenly_spread(_weights(clouds), most).tolist()]


def _weights(clouds: Sequence[TargetCloud]) -> Array:
    return view_weights(np.array([c.points_lidar.mean(axis=0) for c in clouds]))
