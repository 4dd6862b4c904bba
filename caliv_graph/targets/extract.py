"""Cutting the target out of the clouds: pre-alignment, ground, region, cluster, outliers.

Paper III-D.2 and, for the voxel and outlier filters, its real-world section. The region is widened
by what the initial guess may be off: 3 degrees at 20 m move the target by a metre.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from caliv_graph.config import Config, ExtractionConfig, TargetRegion
from caliv_graph.errors import TargetError
from caliv_graph.geometry.se3 import pose_from_mounting
from caliv_graph.products import (
    Array,
    IntArray,
    LidarScan,
    Recording,
    TargetCloud,
    TargetObservation,
    Trajectory,
)
from caliv_graph.progress import Progress
from caliv_graph.targets.ground import fit_ground, height_above

GUESS_SIGMAS = 2.0
"""Standard deviations of the initial guess that the region is widened by; a uniform error ends at
1.7 of them."""

MAX_HEIGHT_M = 2.5
"""A target is at most 2 m high (SPEC 6); the rest is for a ground plane that is off at the rim."""

MIN_EXTENT_M = 0.2
MAX_EXTENT_M = 2.0
"""Largest horizontal extent of a target's points in one scan; partial views are smaller, an error
of the ground's tilt and noise make them larger than the 0.3 to 1.5 m of SPEC 6."""

LINK_M = 0.3
"""Points nearer than this belong to one object, at least; sparse clouds link farther."""

OUTSIDE_M = 0.2
"""An object this far outside the region counts for a third of one inside it."""

EDGE_RAD = math.radians(0.4)
"""A target within this angle of the edge of the field of view may be cut off by it."""

FULL_TURN_GAP_RAD = math.radians(20.0)
"""A LiDAR whose azimuths leave no gap larger than this looks all around: it has no edge."""


@dataclass
class _Tally:
    """What became of the scans of one LiDAR, and how near its returns came to the region."""

    scans: int = 0
    kept: int = 0
    nearest_m: float = math.inf
    most_points: int = 0
    rejected: Counter[str] = field(default_factory=Counter)


def widened_margin_m(config: Config, lidar: str, range_m: float) -> float:
    """How far the initial guess of a LiDAR may displace a target at `range_m`, in metres."""
    sigma = config.lidars[lidar].sigma
    if config.lidars[lidar].fixed:
        return 0.1
    return GUESS_SIGMAS * (max(sigma.xyz_m()) + max(sigma.rpy_rad()) * range_m)


def _clusters(points: Array, link_m: float) -> IntArray:
    """Labels (N,) of connected components: points nearer than `link_m` are connected."""
    pairs = cKDTree(points).query_pairs(link_m, output_type="ndarray")
    graph = coo_array(
        (np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])),
        shape=(len(points), len(points)),
    )
    _, labels = connected_components(graph, directed=False)
    return np.asarray(labels, dtype=np.int64)


def _filtered(points: Array, extraction: ExtractionConfig) -> IntArray:
    """Indices of the points that survive the voxel and the statistical outlier filter."""
    keep = np.arange(len(points))
    if extraction.voxel > 0.0:
        cells = np.floor(points / extraction.voxel).astype(np.int64)
        keep = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    k = extraction.outlier_neighbours
    if k and len(keep) > k + 1:
        distances, _ = cKDTree(points[keep]).query(points[keep], k + 1)
        distance = np.asarray(distances)[:, 1:].mean(axis=1)
        limit = distance.mean() + extraction.outlier_ratio * distance.std()
        keep = keep[distance <= limit]
    return keep


def _azimuth_edges(points_lidar: Array) -> tuple[float, float] | None:
    """First and last azimuth (rad) of a cloud's field of view, counted from its middle.

    Returns:
        (centre, half width), or None if it looks all around.
    """
    azimuth = np.arctan2(points_lidar[:, 1], points_lidar[:, 0])
    # Tenths of a degree: finer than EDGE_RAD, and far cheaper than sorting every point.
    bins = np.unique(((azimuth + math.pi) * (1800.0 / math.pi)).astype(np.int64))
    gaps = np.diff(np.append(bins, bins[0] + 3600))
    widest = int(gaps.argmax())
    gap = float(gaps[widest]) * math.pi / 1800.0
    if gap < FULL_TURN_GAP_RAD:
        return None
    half = math.pi - 0.5 * gap
    first = bins[(widest + 1) % len(bins)] * math.pi / 1800.0 - math.pi
    return float(first) + half, half


def _is_cut(target_lidar: Array, edges: tuple[float, float] | None, points: int) -> bool:
    """Whether the edge of the field of view may cut the target's points (N, 3) off.

    Args:
        target_lidar: the target's points.
        edges: of the field of view.
        points: size of the whole cloud.
    """
    if edges is None or len(target_lidar) > 0.5 * points:
        # A cloud of little else than the target shows no field of view.
        return False
    centre, half = edges
    azimuth = np.arctan2(target_lidar[:, 1], target_lidar[:, 0])
    off = np.abs((azimuth - centre + math.pi) % (2.0 * math.pi) - math.pi)
    return bool(off.max() > half - EDGE_RAD)


class RegionExtractor:
    """Cuts the target of one region out of scans, one at a time."""

    def __init__(self, region: TargetRegion, config: Config, trajectory: Trajectory) -> None:
        """Binds the region to a drive."""
        self._config = config
        self._trajectory = trajectory
        self._low = np.array(region.min)
        self._high = np.array(region.max)
        self.centre = 0.5 * (self._low + self._high)
        R, t = np.eye(3), np.zeros(3)
        if region.frame == "start":
            start = trajectory.T_map_vehicle[0]
            R, t = start.rotation().matrix(), start.translation()
        self._R_map_region, self._t_map_region = R, t
        self._guess = {
            name: pose_from_mounting(lidar.initial) for name, lidar in config.lidars.items()
        }
        self.tallies: dict[str, _Tally] = {name: _Tally() for name in config.lidars}

    @property
    def centre_map(self) -> Array:
        """(3,) metres, middle of the region in the map."""
        return np.asarray(self._R_map_region @ self.centre + self._t_map_region)

    def extract(self, scan: LidarScan, drive: int) -> TargetCloud | None:
        """The target's points in a scan, or None if it does not see the target."""
        tally = self.tallies[scan.lidar]
        tally.scans += 1
        extraction = self._config.extraction
        T_map_vehicle = self._trajectory.pose_at(scan.stamp_ns)
        T = T_map_vehicle.compose(self._guess[scan.lidar])
        R = self._R_map_region.T @ T.rotation().matrix()
        t = self._R_map_region.T @ (T.translation() - self._t_map_region)
        if len(scan.points_lidar) == 0:
            tally.rejected["empty within the range limits"] += 1
            return None
        range_m = float(np.linalg.norm(self.centre - t))
        margin = widened_margin_m(self._config, scan.lidar, range_m)
        points, near = self._near_region(scan.points_lidar, R, t, margin, tally)
        if len(near) < extraction.min_points:
            tally.rejected["outside the region"] += 1
            return None
        plane = fit_ground(points, extraction.ground_distance)
        if plane is None:
            # No ground inside the region: what there is, is the target or nothing.
            height = np.full(len(near), extraction.ground_distance * 2.0)
        else:
            height = height_above(plane, points)
        above = (height > extraction.ground_distance) & (height < MAX_HEIGHT_M)
        points, near = points[above], near[above]
        chosen = self._pick_object(points, range_m)
        if chosen is None:
            tally.rejected["nothing above the ground that is 0.2 to 2 m wide"] += 1
            return None
        near = near[chosen][_filtered(points[chosen], extraction)]
        tally.most_points = max(tally.most_points, len(near))
        if len(near) < extraction.min_points:
            tally.rejected[f"under {extraction.min_points} points"] += 1
            return None
        target = scan.points_lidar[near]
        if _is_cut(target, _azimuth_edges(scan.points_lidar), len(scan.points_lidar)):
            tally.rejected["cut off by the edge of the field of view"] += 1
            return None
        tally.kept += 1
        return TargetCloud(scan.lidar, drive, scan.stamp_ns, target, scan.source)

    def _near_region(
        self, points_lidar: Array, R: Array, t: Array, margin: float, tally: _Tally
    ) -> tuple[Array, IntArray]:
        """Points within `margin` of the region, in its frame, and their indices.

        A ball around the region is tested first: most of a cloud is nowhere near.
        """
        centre_lidar = R.T @ (self.centre - t)
        offset = points_lidar - centre_lidar
        distance2 = np.einsum("ni,ni->n", offset, offset)
        radius = 0.5 * float(np.linalg.norm(self._high - self._low)) + margin
        near = np.flatnonzero(distance2 < radius**2)
        if len(near) == 0:
            near = np.array([distance2.argmin()])
        points = points_lidar[near] @ R.T + t
        outside = np.maximum(np.maximum(self._low - points, points - self._high), 0.0)
        distance = np.sqrt(np.einsum("ni,ni->n", outside, outside))
        tally.nearest_m = min(tally.nearest_m, float(distance.min()))
        inside = distance <= margin
        return points[inside], near[inside]

    def _pick_object(self, points: Array, range_m: float) -> IntArray | None:
        """Indices of the object that is the target: of the right size, best inside the region."""
        if len(points) < 3:
            return None
        # Beams fan out: what is one object at 20 m has gaps that are two objects at 5 m.
        labels = _clusters(points, max(LINK_M, 0.02 * range_m))
        best, best_score = None, 0.0
        for label in np.unique(labels):
            member = np.flatnonzero(labels == label)
            extent = np.ptp(points[member, :2], axis=0).max()
            if not MIN_EXTENT_M <= extent <= MAX_EXTENT_M:
                continue
            centre = points[member].mean(axis=0)
            off = np.maximum(np.maximum(self._low - centre, centre - self._high), 0.0)
            score = len(member) * math.exp(-float(np.linalg.norm(off)) / OUTSIDE_M)
            if score > best_score:
                best, best_score = member, score
        return best


def _complain(region: str, config: Config, tallies: dict[str, _Tally]) -> str:
    """Why no LiDAR saw the target, in one line."""
    parts = []
    for name, tally in tallies.items():
        reasons = ", ".join(f"{n} {why}" for why, n in tally.rejected.most_common(3))
        near = (
            f"nearest return {tally.nearest_m:.2f} m from the region"
            if 0.0 < tally.nearest_m < math.inf
            else f"at most {tally.most_points} target points in a scan"
        )
        parts.append(
            f"lidar '{name}' in {tally.kept} of {tally.scans} scans, needs "
            f"{config.extraction.min_scans} ({near}; {reasons or 'nothing rejected'})"
        )
    return (
        f"{region}: no LiDAR sees the target: {'; '.join(parts)}. Move or widen target.min/max, "
        "check the initial guesses, or run 'caliv-graph inspect' with the config"
    )


def extract_targets(
    recordings: Sequence[Recording],
    trajectories: Sequence[Trajectory],
    config: Config,
    progress: Progress,
) -> tuple[TargetObservation, ...]:
    """Reads every scan once and keeps the points of the targets.

    Args:
        recordings: the drives.
        trajectories: one per drive, with a pose at every scan's stamp.
        config: regions, initial guesses, ranges, filters.
        progress: told of every scan.

    Returns:
        One observation per drive and region, clouds in order of LiDAR and stamp. LiDARs that saw
        the target in fewer than `extraction.min_scans` scans are left out with a warning.

    Raises:
        TargetError: no LiDAR sees a target, or no region was given.
        RecordingError: a cloud could not be read.
    """
    if config.target is None:
        raise TargetError(
            "target: no region given, and finding the target without one is not built yet. "
            "Add target: {min: [x, y, z], max: [x, y, z]} in metres, frame map, to the config"
        )
    observations: list[TargetObservation] = []
    total = sum(len(r.scan_stamps_ns(name)) for r in recordings for name in config.lidars)
    with progress.stage("reading clouds", total) as advance:
        for drive, (recording, trajectory) in enumerate(zip(recordings, trajectories, strict=True)):
            extractors = [RegionExtractor(r, config, trajectory) for r in config.target]
            clouds: list[list[TargetCloud]] = [[] for _ in extractors]
            for name in config.lidars:
                for scan in recording.scans(name):
                    for extractor, found in zip(extractors, clouds, strict=True):
                        cloud = extractor.extract(scan, drive)
                        if cloud is not None:
                            found.append(cloud)
                    advance()
            for index, (extractor, found) in enumerate(zip(extractors, clouds, strict=True)):
                label = "target" if len(extractors) == 1 else f"target {index + 1}"
                if len(recordings) > 1:
                    label += f" of {recording.name}"
                observations.append(
                    _observation(len(observations), label, extractor, found, config)
                )
    if not any(o.clouds for o in observations):
        raise TargetError(observations[0].warnings[-1])
    return tuple(observations)


def _observation(
    placement: int,
    label: str,
    extractor: RegionExtractor,
    found: list[TargetCloud],
    config: Config,
) -> TargetObservation:
    """Drops the LiDARs that saw too little, and says so."""
    warnings = []
    kept = []
    for name, tally in extractor.tallies.items():
        if tally.kept >= config.extraction.min_scans:
            kept += [c for c in found if c.lidar == name]
        elif not tally.scans:
            warnings.append(f"{label}: lidar '{name}' has no scans in this drive")
        else:
            reasons = ", ".join(f"{n} {why}" for why, n in tally.rejected.most_common(3))
            warnings.append(
                f"{label}: lidar '{name}' sees it in {tally.kept} scans, needs "
                f"{config.extraction.min_scans} (extraction.min_scans). Of {tally.scans} scans: "
                f"{reasons}. Widen target.min/max or run 'caliv-graph inspect'"
            )
    if not kept:
        warnings = [_complain(label, config, extractor.tallies)]
    return TargetObservation(placement, label, extractor.centre_map, tuple(kept), tuple(warnings))
