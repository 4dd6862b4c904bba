"""Whether the vehicle moved at all: what a recording of a parked vehicle lacks is a drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import TargetError
from caliv_graph.trajectory.odometry import OdometryPoses
from caliv_graph.trajectory.select import GivenTrajectory, VehicleTrajectory
from caliv_graph.wording.structure import standing_sentence

STILL_M = 0.5
"""Extent of a path below which the vehicle stood. Smoothed fixes of a parked vehicle wander by some
centimetres with RTK; past a target at 5 m, half a metre changes the view by 6 degrees."""

STILL_RAD = 0.1
"""Turn below which it did not turn on the spot either."""

_SAMPLES = 200
"""Poses of each drive that are looked at."""


@dataclass(frozen=True)
class _Extent:
    moved_m: float
    turned_rad: float
    lasts_s: float


def with_standing(
    error: TargetError, trajectories: Sequence[VehicleTrajectory]
) -> TargetError | None:
    """The error of drives in which the vehicle stood, with the remedy to drive; None: it moved."""
    extents = [extent for t in trajectories if (extent := _extent(t)) is not None]
    moved = [e for e in extents if e.moved_m > STILL_M or e.turned_rad > STILL_RAD]
    if not extents or moved or len(extents) < len(trajectories):
        return None
    most = max(extents, key=lambda extent: extent.moved_m)
    turned_deg = float(np.degrees(max(extent.turned_rad for extent in extents)))
    longest_s = max(extent.lasts_s for extent in extents)
    stands = standing_sentence(most.moved_m, turned_deg, longest_s)
    # A target may have been carried to several places, and its region be wrong.
    return TargetError(error.what, f"{stands}. {error.remedy}" if error.remedy else stands)


def _extent(trajectory: VehicleTrajectory) -> _Extent | None:
    """How far a vehicle moved and turned from its first pose; None by odometry, which may fail."""
    if isinstance(trajectory, GivenTrajectory) and isinstance(trajectory.odometry, OdometryPoses):
        return None
    begin, end = trajectory.span_ns
    stamps = np.linspace(0, end - begin, _SAMPLES).astype(np.int64) + begin
    R, t = trajectory.poses_at(stamps)
    cosines = 0.5 * (np.einsum("kij,ij->k", R, R[0]) - 1.0)
    return _Extent(
        float(np.linalg.norm(t - t[0], axis=1).max()),
        float(np.arccos(np.clip(cosines, -1.0, 1.0)).max()),
        (end - begin) / NANOSECONDS_PER_SECOND,
    )
