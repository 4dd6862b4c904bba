"""Which scans are decoded for a target, and which of its clouds are used."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caliv_graph.config.model import Config, TargetRegion
from caliv_graph.products import Recording, TargetCloud
from caliv_graph.targets.cloud.field_of_view import FieldOfView
from caliv_graph.targets.cloud.region import RegionExtractor, widened_margin_m
from caliv_graph.targets.cloud.views import evenly_spread, view_weights
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
    stamps = np.array([s for s in recording.scan_stamps_ns(lidar) if begin <= s <= end], np.int64)
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
    stamps, weights = stamps[possible], weights[possible]
    # A long drive passes the target many times: a part of it is enough.
    most = DECODED_PER_SCAN_USED * config.extraction.max_scans
    return frozenset(stamps[evenly_spread(weights, most)].tolist())


def thinned(clouds: list[TargetCloud], most: int) -> list[TargetCloud]:
    """At most `most` of a LiDAR's clouds; those of a standing vehicle are left out first."""
    if len(clouds) <= most:
        return clouds
    centres = np.array([c.points_lidar.mean(axis=0) for c in clouds])
    return [clouds[i] for i in evenly_spread(view_weights(centres), most).tolist()]
