"""Cutting the target out of the clouds: pre-alignment, ground, region, cluster, outliers.

Paper III-D.2 and, for the voxel and outlier filters, its real-world section. The region is widened
by what the initial guess may be off: 3 degrees at 20 m move the target by a metre.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config, ExtractionConfig, TargetRegion
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import TargetError
from caliv_graph.geometry.se3 import skew
from caliv_graph.products import (
    Array,
    BoolArray,
    IntArray,
    LidarScan,
    Recording,
    TargetCloud,
    TargetObservation,
)
from caliv_graph.targets.cloud.moved import Sightings, periods
from caliv_graph.targets.cloud.views import evenly_spread, view_weights
from caliv_graph.targets.ground.fit import fit_ground, height_above
from caliv_graph.targets.search import find_target
from caliv_graph.trajectory.deskew import deskew
from caliv_graph.trajectory.select import VehicleTrajectory

GUESS_SIGMAS = 2.0
"""Standard deviations of the initial guess that the region is widened by; a uniform error ends at
1.7 of them."""

TRUSTED_MARGIN_M = 0.1
"""The same for a mounting that is trusted: what the vehicle's poses may be off."""

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

MOST_CANDIDATES = 4
"""Objects of one scan that are kept until it is known which of them stands still."""

SEEDS = 24
"""Candidates from which the object that stands still is sought."""

STANDS_STILL_M = 0.35
"""The middle of what one sees of a target wanders by this as one passes it."""

GATE_STEPS = (1.0, 0.5, 0.2, 0.05, 0.0)
"""Parts of what the guess may be off by that are allowed for while its error is being found."""

PLACE_SIGMA_M = 0.1
"""The same wandering, 1 sigma."""

EDGE_RAD = math.radians(0.4)
"""A target within this angle of the edge of the field of view may be cut off by it."""

FULL_TURN_GAP_RAD = math.radians(20.0)
"""A LiDAR whose azimuths leave no gap larger than this looks all around: it has no edge."""


FEW_SCANS = 150
"""Of so few scans all are read."""

SAMPLED_SCANS = 8
"""Scans that the field of view and the resolution are read off."""

DECODED_PER_SCAN_USED = 5
"""Scans of a LiDAR that are decoded at most, for each that may be used in the end."""

TOTAL_PER_LIDARS = 2.5
"""Scans of one target that are used at most, in `extraction.max_scans`: with more LiDARs there are
fewer of each, since what they tell of each other is in all of them, and the cost grows with the
square."""

SCANS_OF_A_PLACE = 10
"""Scans of each place of a target that is moved about while the vehicle stands. Each shows the same
spots of it: more of them would average the noise, but not what no beam hits, and claim both."""

CELL_DEG = 5.0
"""Cells of direction in which points are counted for the resolution."""

LARGEST_TARGET_M2 = 3.0
"""Area that a target shows a LiDAR at most: 1.5 m wide and 2 m high (SPEC 6)."""


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
        return TRUSTED_MARGIN_M
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
    """Azimuths that a cloud's field of view spans.

    Returns:
        (centre, half width) in radians, or None if it looks all around.
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

    def __init__(self, region: TargetRegion, config: Config, trajectory: VehicleTrajectory) -> None:
        """Binds the region to a drive."""
        self._region = region
        self._config = config
        self._trajectory = trajectory
        self._low = np.array(region.min)
        self._high = np.array(region.max)
        self.centre = 0.5 * (self._low + self._high)
        R, t = np.eye(3), np.zeros(3)
        if region.frame == "start":
            begin, _ = trajectory.span_ns
            R, t = (part[0] for part in trajectory.poses_at([begin]))
        self._R_map_region, self._t_map_region = R, t
        self._guess = {name: lidar.initial.pose() for name, lidar in config.lidars.items()}
        self.tallies: dict[str, _Tally] = {name: _Tally() for name in config.lidars}

    @property
    def trajectory(self) -> VehicleTrajectory:
        """Of the drive."""
        return self._trajectory

    def fresh(self) -> RegionExtractor:
        """The same, with nothing counted yet."""
        return RegionExtractor(self._region, self._config, self._trajectory)

    @property
    def centre_map(self) -> Array:
        """(3,) metres, middle of the region in the map."""
        return np.asarray(self._R_map_region @ self.centre + self._t_map_region)

    def extract(self, scan: LidarScan, drive: int) -> TargetCloud | None:
        """The target's points in a scan, or None if it does not see the target.

        Of several objects the largest that is best inside the region.
        """
        candidates = self.candidates(scan, drive)
        return self.accept(candidates[0]) if candidates else None

    def accept(self, candidate: Candidate) -> TargetCloud | None:
        """The cloud of a candidate, unless the edge of the field of view cuts it off."""
        tally = self.tallies[candidate.cloud.lidar]
        if candidate.cut:
            tally.rejected["cut off by the edge of the field of view"] += 1
            return None
        tally.kept += 1
        return candidate.cloud

    def candidates(self, scan: LidarScan, drive: int) -> list[Candidate]:
        """The objects in a scan that may be the target, at most MOST_CANDIDATES, best first."""
        tally = self.tallies[scan.lidar]
        tally.scans += 1
        extraction = self._config.extraction
        T_vehicle_lidar = self._guess[scan.lidar]
        rotations, translations = self._lidar_poses(scan.lidar, [scan.stamp_ns])
        R, t = rotations[0], translations[0]
        if len(scan.points_lidar) == 0:
            tally.rejected["empty within the range limits"] += 1
            return []
        range_m = float(np.linalg.norm(self.centre - t))
        margin = widened_margin_m(self._config, scan.lidar, range_m)
        points, near = self._near_region(scan.points_lidar, R, t, margin, tally)
        if len(near) < extraction.min_points:
            tally.rejected["outside the region"] += 1
            return []
        plane = fit_ground(points, extraction.ground_distance)
        if plane is None:
            # No ground inside the region: what there is, is the target or nothing.
            height = np.full(len(near), extraction.ground_distance * 2.0)
        else:
            height = height_above(plane, points)
        above = (height > extraction.ground_distance) & (height < MAX_HEIGHT_M)
        points, near = points[above], near[above]
        objects = self._objects(points, range_m)
        if not objects:
            tally.rejected["nothing above the ground that is 0.2 to 2 m wide"] += 1
            return []
        edges = _azimuth_edges(scan.points_lidar)
        out = []
        for chosen in objects:
            kept = near[chosen][_filtered(points[chosen], extraction)]
            tally.most_points = max(tally.most_points, len(kept))
            if len(kept) < extraction.min_points:
                continue
            times = None if scan.point_times_s is None else scan.point_times_s[kept]
            compact = replace(scan, points_lidar=scan.points_lidar[kept], point_times_s=times)
            target = deskew(compact, T_vehicle_lidar, self._trajectory).points_lidar
            low, high = np.percentile(target, [2, 98], axis=0)
            out.append(
                Candidate(
                    cloud=TargetCloud(
                        scan.lidar,
                        drive,
                        scan.stamp_ns,
                        target,
                        scan.source,
                        swept=None if times is None else compact,
                    ),
                    centre_lidar=0.5 * (low + high),
                    R_region_lidar=R,
                    t_region_lidar=t,
                    cut=_is_cut(target, edges, len(scan.points_lidar)),
                )
            )
        if not out:
            tally.rejected[f"under {extraction.min_points} points"] += 1
        return out

    def _lidar_poses(self, lidar: str, stamps_ns: Sequence[int]) -> tuple[Array, Array]:
        """Rotations (m, 3, 3) and translations (m, 3) of T_region_lidar, at the guess."""
        R_map_vehicle, t_map_vehicle = self._trajectory.poses_at(stamps_ns)
        guess = self._guess[lidar]
        R = self._R_map_region.T @ R_map_vehicle @ guess.rotation().matrix()
        t = t_map_vehicle + R_map_vehicle @ guess.translation() - self._t_map_region
        return R, t @ self._R_map_region

    def directions(self, lidar: str, stamps_ns: Sequence[int]) -> Array:
        """Where a LiDAR has the middle of the region, at the guess; (m, 3) metres, lidar frame."""
        R, t = self._lidar_poses(lidar, stamps_ns)
        return np.asarray(np.einsum("mji,mj->mi", R, self.centre - t))

    def reach_m(self) -> float:
        """Half the diagonal of the region, metres."""
        return 0.5 * float(np.linalg.norm(self._high - self._low))

    def _near_region(
        self, points_lidar: Array, R: Array, t: Array, margin: float, tally: _Tally
    ) -> tuple[Array, IntArray]:
        """Points within `margin` of the region, in its frame, and their indices.

        A ball around the region is tested first: most of a cloud is nowhere near.
        """
        centre_lidar = R.T @ (self.centre - t)
        offset = points_lidar - centre_lidar
        distance2 = np.einsum("ni,ni->n", offset, offset)
        radius = self.reach_m() + margin
        near = np.flatnonzero(distance2 < radius**2)
        if len(near) == 0:
            near = np.array([distance2.argmin()])
        points = points_lidar[near] @ R.T + t
        outside = np.maximum(np.maximum(self._low - points, points - self._high), 0.0)
        distance = np.sqrt(np.einsum("ni,ni->n", outside, outside))
        tally.nearest_m = min(tally.nearest_m, float(distance.min()))
        inside = distance <= margin
        return points[inside], near[inside]

    def _objects(self, points: Array, range_m: float) -> list[IntArray]:
        """Indices of the objects of the right size, the best inside the region first."""
        if len(points) < 3:
            return []
        # Beams fan out: what is one object at 20 m has gaps that are two objects at 5 m.
        labels = _clusters(points, max(LINK_M, 0.02 * range_m))
        scored = []
        for label in np.unique(labels):
            member = np.flatnonzero(labels == label)
            extent = np.ptp(points[member, :2], axis=0).max()
            if not MIN_EXTENT_M <= extent <= MAX_EXTENT_M:
                continue
            centre = points[member].mean(axis=0)
            off = np.maximum(np.maximum(self._low - centre, centre - self._high), 0.0)
            scored.append((len(member) * math.exp(-float(np.linalg.norm(off)) / OUTSIDE_M), member))
        scored.sort(key=lambda pair: -pair[0])
        return [member for _, member in scored[:MOST_CANDIDATES]]

    def choose(self, found: Sequence[Sequence[Candidate]], lidar: str) -> list[TargetCloud]:
        """One cloud per scan of a LiDAR: those of the object that stands still.

        The guess is off, so that even what stands still wanders; but one error of the mounting,
        small by its sigma, must explain it (least squares of its place and that error). Somebody
        who walks past, or another object now and then, does not fit.

        Args:
            found: the candidates of each scan, best first.
            lidar: its name.
        """
        scans = [candidates for candidates in found if candidates]
        if not scans:
            return []
        sigma = self._config.lidars[lidar].sigma
        prior = np.array([max(sigma.rpy_rad())] * 3 + [max(sigma.xyz_m())] * 3)
        if self._config.lidars[lidar].fixed:
            prior = np.full(6, 1e-3)
        flat = [(i, c) for i, candidates in enumerate(scans) for c in candidates]
        index = np.array([i for i, _ in flat])
        track = _Track.of([c for _, c in flat], index, prior)
        seeds = np.linspace(0, len(flat) - 1, min(len(flat), SEEDS)).round().astype(int)
        # The best candidates first: among equals the larger object wins.
        best: IntArray = max((track.follow(int(seed)) for seed in seeds), key=len)
        lost = len(scans) - len(best)
        if lost:
            self.tallies[lidar].rejected["something else stood there"] += lost
        clouds = [self.accept(flat[n][1]) for n in best.tolist()]
        return [cloud for cloud in clouds if cloud is not None]


@dataclass(frozen=True)
class Candidate:
    """An object in a scan that may be the target.

    Attributes:
        cloud: its points.
        centre_lidar: (3,) metres, middle of its extent.
        R_region_lidar: (3, 3) at the guess.
        t_region_lidar: (3,) at the guess, metres.
        cut: whether the edge of the field of view may cut it off.
    """

    cloud: TargetCloud
    centre_lidar: Array
    R_region_lidar: Array
    t_region_lidar: Array
    cut: bool


@dataclass(frozen=True)
class _Track:
    """Where the candidates of all scans of a LiDAR are, and how its mounting moves them.

    Attributes:
        scan: (n,) index of the scan of each candidate.
        places: (n, 3) metres, region frame, at the guess.
        moves: (n, 3, 6) derivative of the place by a right perturbation of the mounting.
        reach_m: (n,) how far the guess may be off there.
        prior: (6,) sigmas of the guess.
    """

    scan: IntArray
    places: Array
    moves: Array
    reach_m: Array
    prior: Array

    @classmethod
    def of(cls, candidates: Sequence[Candidate], scan: IntArray, prior: Array) -> _Track:
        """Of candidates, and the scan of each."""
        R = np.array([c.R_region_lidar for c in candidates])
        centre = np.array([c.centre_lidar for c in candidates])
        places = np.einsum("nij,nj->ni", R, centre) + [c.t_region_lidar for c in candidates]
        moves = np.concatenate([-R @ skew(centre), R], axis=2)
        reach_m = 2.0 * (prior[3] + prior[0] * np.linalg.norm(centre, axis=1))
        return cls(scan, places, moves, reach_m, prior)

    def follow(self, seed: int) -> IntArray:
        """Candidates, one per scan at most, of the object that candidate `seed` is of."""
        place, error = self.places[seed], np.zeros(6)
        gates = STANDS_STILL_M + np.outer(GATE_STEPS, self.reach_m + self.reach_m[seed])
        members = np.array([seed])
        for gate_m in gates:
            off = np.linalg.norm(self.places + self.moves @ error - place, axis=1)
            order = np.lexsort([off, self.scan])
            first = order[np.unique(self.scan[order], return_index=True)[1]]
            members = first[off[first] < gate_m[first]]
            if len(members) < 2:
                return np.asarray(members, np.int64)
            place, error = self._fit(members)
        return np.asarray(members, np.int64)

    def _fit(self, members: IntArray) -> tuple[Array, Array]:
        """The place (3,) of what the members are of, and the error (6,) of the guess."""
        A = np.concatenate(
            [np.tile(np.eye(3), (len(members), 1, 1)), -self.moves[members]], axis=2
        ).reshape(-1, 9)
        prior = np.hstack([np.zeros((6, 3)), np.diag(PLACE_SIGMA_M / self.prior)])
        rows = np.vstack([A, prior])
        right = np.concatenate([self.places[members].ravel(), np.zeros(6)])
        x = np.linalg.lstsq(rows, right, rcond=None)[0]
        return x[:3], x[3:]


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
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
) -> tuple[TargetObservation, ...]:
    """Reads every scan once and keeps the points of the targets.

    Args:
        recordings: the drives.
        trajectories: one per drive; scans outside its span are left out.
        config: regions, initial guesses, ranges, filters.
        progress: told of every scan.

    Returns:
        One observation per drive and region, clouds in order of LiDAR and stamp; of a target that
        was moved while the vehicle stood, one per place. LiDARs that saw the target in fewer than
        `extraction.min_scans` scans are left out with a warning.

    Raises:
        TargetError: no LiDAR sees a target, or none was found.
        RecordingError: a cloud could not be read.
    """
    regions, labels, hints = _regions(recordings, trajectories, config, progress)
    observations: list[TargetObservation] = []
    wanted = [
        {name: _wanted(r, t, name, config, of_drive) for name in config.lidars}
        for r, t, of_drive in zip(recordings, trajectories, regions, strict=True)
    ]
    total = sum(len(stamps) for drive in wanted for stamps in drive.values())
    with progress.stage("reading clouds", total) as advance:
        for drive, (recording, trajectory) in enumerate(zip(recordings, trajectories, strict=True)):
            extractors = [RegionExtractor(r, config, trajectory) for r in regions[drive]]
            seen: list[dict[str, list[list[Candidate]]]] = [
                {name: [] for name in config.lidars} for _ in extractors
            ]
            for name in config.lidars:
                for scan in recording.scans(name, wanted[drive][name]):
                    for extractor, of_lidar in zip(extractors, seen, strict=True):
                        of_lidar[name].append(extractor.candidates(scan, drive))
                    advance()
            for index, (extractor, of_lidar) in enumerate(zip(extractors, seen, strict=True)):
                label = labels[drive] if len(extractors) == 1 else f"target {index + 1}"
                if len(recordings) > 1:
                    label += f" of {recording.name}"
                for found in _placements(label, extractor, of_lidar, config, hints[drive]):
                    observations.append(replace(found, placement=len(observations)))
    if not any(o.clouds for o in observations):
        raise TargetError(observations[0].warnings[-1])
    return tuple(observations)


def _regions(
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
) -> tuple[list[tuple[TargetRegion, ...]], list[str], list[tuple[str, ...]]]:
    """Per drive the regions, given or found; what to call a target; and what to tell of it."""
    count = len(recordings)
    if config.target is not None:
        return [config.target] * count, ["target"] * count, [()] * count
    regions: list[tuple[TargetRegion, ...]] = []
    labels: list[str] = []
    hints: list[tuple[str, ...]] = []
    for found in find_target(recordings, trajectories, config, progress):
        x, y, _ = found.centre_map
        label = f"target found at ({x:.1f}, {y:.1f}) m of the map"
        regions.append((found.region,))
        labels.append(label)
        lines = [
            f"{label}: lidar '{name}' does not see it in any of {found.looked_at[name]} scans "
            "looked at"
            for name, scans in found.scans.items()
            if scans == 0 and found.looked_at[name]
        ]
        if found.others:
            lines.append(
                f"{label}: {found.extent_m:.1f} m wide, {found.height_m:.1f} m high; it might as "
                f"well be {', '.join(found.others)}. Give a target region to choose"
            )
        hints.append(tuple(lines))
    return regions, labels, hints


def _thinned(clouds: list[TargetCloud], most: int) -> list[TargetCloud]:
    """At most so many of a LiDAR's clouds, those of a standing vehicle first of all left out."""
    if len(clouds) <= most:
        return clouds
    centres = np.array([c.points_lidar.mean(axis=0) for c in clouds])
    return [clouds[i] for i in evenly_spread(view_weights(centres), most).tolist()]


def _wanted(
    recording: Recording,
    trajectory: VehicleTrajectory,
    lidar: str,
    config: Config,
    regions: Sequence[TargetRegion],
) -> frozenset[int]:
    """Stamps of the scans of a LiDAR that may see a target; the others are not decoded.

    What a LiDAR's field of view and resolution are, a few of its scans tell.
    """
    begin, end = trajectory.span_ns
    stamps = np.array([s for s in recording.scan_stamps_ns(lidar) if begin <= s <= end], np.int64)
    if len(stamps) <= FEW_SCANS:
        return frozenset(stamps.tolist())
    some = stamps[np.linspace(0, len(stamps) - 1, SAMPLED_SCANS).astype(np.int64)]
    seen = [scan.points_lidar for scan in recording.scans(lidar, frozenset(some.tolist()))]
    seen = [points for points in seen if len(points)]
    if not seen:
        return frozenset(stamps.tolist())
    view = _FieldOfView.of(seen)
    possible = np.zeros(len(stamps), dtype=np.bool_)
    share = np.zeros(len(stamps))
    for region in regions:
        extractor = RegionExtractor(region, config, trajectory)
        towards = extractor.directions(lidar, stamps.tolist())
        range_m = np.linalg.norm(towards, axis=1)
        margin_m = extractor.reach_m() + np.array(
            [widened_margin_m(config, lidar, r) for r in range_m.tolist()]
        )
        sees = view.may_see(towards, margin_m, config.extraction.min_points)
        share[sees] = np.maximum(share[sees], view_weights(towards[sees]))
        possible |= sees
    stamps, share = stamps[possible], share[possible]
    # A long drive passes the target many times over: a part of it is enough.
    most = DECODED_PER_SCAN_USED * config.extraction.max_scans
    return frozenset(stamps[evenly_spread(share, most)].tolist())


@dataclass(frozen=True)
class _FieldOfView:
    """Where a LiDAR looks, and how densely, as far as some of its scans tell.

    Attributes:
        edges: (centre, half width) of its azimuths in radians, or None if it looks all around.
        density: points per steradian, at most.
    """

    edges: tuple[float, float] | None
    density: float

    @classmethod
    def of(cls, clouds: Sequence[Array]) -> _FieldOfView:
        """Of the points (N, 3) of some scans, lidar frame."""
        directions = [c / np.maximum(np.linalg.norm(c, axis=1), 1e-9)[:, None] for c in clouds]
        density = 0.0
        for d in directions:
            azimuth = np.floor(np.degrees(np.arctan2(d[:, 1], d[:, 0])) / CELL_DEG)
            elevation = np.floor(np.degrees(np.arcsin(np.clip(d[:, 2], -1.0, 1.0))) / CELL_DEG)
            cells = azimuth * 1000.0 + elevation
            density = max(density, float(np.unique(cells, return_counts=True)[1].max()))
        return cls(_azimuth_edges(np.concatenate(clouds)), density / math.radians(CELL_DEG) ** 2)

    def may_see(self, towards: Array, margin_m: Array, min_points: int) -> BoolArray:
        """Whether something as large as a target may have enough points, (m,).

        Args:
            towards: (m, 3) middle of the region, lidar frame, metres.
            margin_m: (m,) how far from there it may be.
            min_points: that are enough.
        """
        range_m = np.linalg.norm(towards, axis=1)
        nearest = np.maximum(range_m - margin_m, 0.1)
        enough = self.density * LARGEST_TARGET_M2 / nearest**2 >= min_points
        if self.edges is None:
            return np.asarray(enough)
        centre, half = self.edges
        off = np.arctan2(towards[:, 1], towards[:, 0]) - centre
        off = np.abs((off + math.pi) % (2.0 * math.pi) - math.pi)
        widened = np.where(range_m > margin_m, np.arcsin(np.minimum(margin_m / range_m, 1.0)), 4.0)
        return np.asarray(enough & (off <= half + widened))


def _placements(
    label: str,
    extractor: RegionExtractor,
    seen: Mapping[str, Sequence[Sequence[Candidate]]],
    config: Config,
    hints: Sequence[str],
) -> list[TargetObservation]:
    """One observation of a target, or one of each of its places if somebody moved it."""
    flat = {name: [c for scan in scans for c in scan] for name, scans in seen.items()}
    sightings = {name: _sightings(found) for name, found in flat.items()}
    moved = periods(sightings, extractor.trajectory, config.extraction.min_scans)
    if not moved:
        clouds = [c for name, scans in seen.items() for c in extractor.choose(scans, name)]
        return [_observation(0, label, extractor, clouds, config, hints)]
    out = []
    begin_ns, _ = extractor.trajectory.span_ns
    for number, period in enumerate(moved, start=1):
        own = extractor.fresh()
        clouds = []
        for name, found in flat.items():
            clouds += own.choose(_of_period(found, period.members[name]), name)
        times_ns = (period.begin_ns, period.end_ns)
        from_s, to_s = (max(ns - begin_ns, 0) / NANOSECONDS_PER_SECOND for ns in times_ns)
        name = f"{label} at place {number} of {len(moved)} ({from_s:.1f} to {to_s:.1f} s)"
        most = config.extraction.max_scans // len(moved) if period.drove else 0
        most = max(most, SCANS_OF_A_PLACE, config.extraction.min_scans)
        extraction = config.extraction.model_copy(update={"max_scans": most})
        fewer = config.model_copy(update={"extraction": extraction})
        observation = _observation(0, name, own, clouds, fewer, ())
        if observation.clouds:
            out.append(observation)
    if not out:
        return [_observation(0, label, extractor, [], config, hints)]
    told = [*hints, *_told_of_moves(label, extractor, out, len(moved), config)]
    out = [replace(o, warnings=()) for o in out]
    return [replace(out[0], warnings=tuple(told)), *out[1:]]


def _sightings(found: Sequence[Candidate]) -> Sightings:
    return Sightings(
        np.array([c.cloud.stamp_ns for c in found], dtype=np.int64),
        np.array([c.centre_lidar for c in found], dtype=np.float64).reshape(-1, 3),
    )


def _of_period(found: Sequence[Candidate], members: IntArray) -> list[list[Candidate]]:
    """The candidates at these indices, scan by scan."""
    out: dict[int, list[Candidate]] = {}
    for index in members.tolist():
        out.setdefault(found[index].cloud.stamp_ns, []).append(found[index])
    return list(out.values())


def _told_of_moves(
    label: str,
    extractor: RegionExtractor,
    observations: Sequence[TargetObservation],
    places: int,
    config: Config,
) -> Iterator[str]:
    """What a person should know of a target that was moved."""
    groups: dict[tuple[str, ...], int] = {}
    for o in observations:
        lidars = tuple(n for n in config.lidars if any(c.lidar == n for c in o.clouds))
        groups[lidars] = groups.get(lidars, 0) + 1
    said = [
        f"{count} seen by {' and '.join(repr(n) for n in lidars)}"
        + (" alone" if len(lidars) == 1 else "")
        for lidars, count in groups.items()
    ]
    line = (
        f"{label}: it was moved while the vehicle stood: {places} places, each solved for by "
        f"itself: {', '.join(said)}"
    )
    seeing = {name for lidars in groups for name in lidars}
    if len(seeing) > 1 and all(len(lidars) == 1 for lidars in groups):
        line += ". No place tells how LiDARs are to each other: put it where two of them see it"
    yield line
    for name in config.lidars:
        if name not in seeing and extractor.tallies[name].scans:
            yield (
                f"{label}: lidar '{name}' sees it at no place in "
                f"{config.extraction.min_scans} scans (extraction.min_scans) of its "
                f"{extractor.tallies[name].scans}"
            )


def _observation(
    placement: int,
    label: str,
    extractor: RegionExtractor,
    found: list[TargetCloud],
    config: Config,
    hints: Sequence[str],
) -> TargetObservation:
    """Drops the LiDARs that saw too little, and says so."""
    warnings = list(hints)
    kept: list[TargetCloud] = []
    seen_ns: dict[str, tuple[int, ...]] = {}
    seeing = sum(t.kept >= config.extraction.min_scans for t in extractor.tallies.values())
    most = config.extraction.max_scans
    most = min(most, max(round(TOTAL_PER_LIDARS * most / max(seeing, 1)), 10))
    for name, tally in extractor.tallies.items():
        if tally.kept >= config.extraction.min_scans:
            of_lidar = [c for c in found if c.lidar == name]
            seen_ns[name] = tuple(sorted(c.stamp_ns for c in of_lidar))
            kept += _thinned(of_lidar, most)
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
    return TargetObservation(
        placement, label, extractor.centre_map, tuple(kept), tuple(warnings), seen_ns
    )
