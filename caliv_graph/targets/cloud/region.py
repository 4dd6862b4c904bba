"""Candidates for the target in one scan: pre-alignment, region, ground, clusters, outlier filter.

Paper III-D.2 and, for the voxel and outlier filters, its real-world section. The region is widened
by the error that the initial guess may have: 3 degrees at 20 m displace the target by 1 m.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from caliv_graph.common.sorting import first_of_cells
from caliv_graph.config.model import Config, ExtractionConfig, TargetRegion
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, IntArray, LidarScan, TargetCloud
from caliv_graph.targets.cloud.beams import (
    Linking,
    beam_spacing,
    elevations,
)
from caliv_graph.targets.cloud.field_of_view import MOST_OF_A_SCAN, SeenEdges
from caliv_graph.targets.cloud.groups import (
    MAX_EXTENT_M,
    Standing,
    completed_groups,
    extent_m,
    groups_of,
)
from caliv_graph.targets.cloud.tally import EMPTY, MOVED, NOTHING, OUTSIDE, Tally
from caliv_graph.targets.cloud.track import CandidateSet
from caliv_graph.targets.ground.fit import fit_ground
from caliv_graph.trajectory.deskew import checked_times, deskewed_with_origins
from caliv_graph.trajectory.select import VehicleTrajectory

GUESS_SIGMAS = 2.0
"""Standard deviations of the initial guess that the region is widened by; a uniform error ends at
1.7 of them."""

TRUSTED_MARGIN_M = 0.1
"""Margin for an extrinsic that is fixed: the error of the vehicle's poses."""

MIN_EXTENT_M = 0.2
"""Least largest horizontal extent of a candidate; at most it has `groups.MAX_EXTENT_M`. Targets are
0.3 to 1.5 m wide; partial views are smaller."""

OUTSIDE_M = 0.2
"""Decay length of the score of an object outside the region: at this distance a factor of 1/e."""

RIM_M = 0.1
"""Width of the rim of the widened region, half its margin at most: beams of common LiDARs are 2 to
10 cm apart at 10 m, and what is cut off there has points in it."""

FEWEST_NEAR = 3
"""A scan with fewer points near the region is outside of it; with more, its objects are counted."""

MOST_CANDIDATES = 4
"""Objects of one scan that are kept until the static one is known."""

RINGS = 3.0
"""The ground is looked for so many distances between its rings around the region: no ring may be in
it, and a single row on a target is as level as a ring. Below the lowest channel there is none."""

LIDAR_HEIGHT_M = 1.5
"""Height of a LiDAR over the ground, by which the distance between the rings is estimated: low on a
roof, so that it is rather overestimated."""

NEAR_RINGS_M = 0.5
FARTHEST_RING_M = 6.0
"""Where the rings are nearer than the first, the ground in the region is enough; beyond the second
it may be another ground."""


@dataclass(frozen=True)
class Candidate:
    """An object in a scan that may be the target.

    Attributes:
        cloud: its points.
        centre_lidar: (3,) metres, middle of its extent.
        R_region_lidar: (3, 3) at the guess.
        t_region_lidar: (3,) metres, at the guess.
        measured_lidar: (n, 3) metres, its points without motion compensation.
        row_rad: spacing of the rows of beams about it.
        top_m: height of its highest point above the ground; inf without ground in the region.
        is_cut_off: whether the points near the region end within it: it goes on outside.
    """

    cloud: TargetCloud
    centre_lidar: Array
    R_region_lidar: Array
    t_region_lidar: Array
    measured_lidar: Array
    row_rad: float
    top_m: float
    is_cut_off: bool

    @property
    def points_region(self) -> Array:
        """(N, 3) metres, region frame, at the guess."""
        return self.cloud.points_lidar @ self.R_region_lidar.T + self.t_region_lidar

    def joined(self, other: Candidate) -> Candidate:
        """This one and another one of the same scan as one object."""
        points = np.vstack([self.cloud.points_lidar, other.cloud.points_lidar])
        swept, more = self.cloud.swept, other.cloud.swept
        origins, others = self.cloud.origins_lidar, other.cloud.origins_lidar
        both = None if origins is None or others is None else np.vstack([origins, others])
        if swept is not None and more is not None:
            # Only clouds whose points have times are kept as they were swept.
            points_s = np.concatenate([swept.point_times_s, more.point_times_s])
            measured = np.vstack([swept.points_lidar, more.points_lidar])
            swept = replace(swept, points_lidar=measured, point_times_s=points_s)
        return replace(
            self,
            cloud=replace(self.cloud, points_lidar=points, swept=swept, origins_lidar=both),
            centre_lidar=_middle(points),
            measured_lidar=np.vstack([self.measured_lidar, other.measured_lidar]),
            top_m=max(self.top_m, other.top_m),
            is_cut_off=self.is_cut_off or other.is_cut_off,
        )


def _middle(points: Array) -> Array:
    """(3,) middle of the extent of points (n, 3), but for a few at its ends."""
    low, high = np.percentile(points, [2, 98], axis=0)
    return np.asarray(0.5 * (low + high))


def widened_margin_m(config: Config, lidar: str, range_m: float) -> float:
    """Displacement of a target at `range_m` that the guess of a LiDAR may cause, metres."""
    sigma = config.lidars[lidar].sigma
    if config.lidars[lidar].fixed:
        return TRUSTED_MARGIN_M
    return GUESS_SIGMAS * (max(sigma.xyz_m()) + max(sigma.rpy_rad()) * range_m)


def _filtered(points: Array, places: Array, extraction: ExtractionConfig) -> IntArray:
    """Indices of the points that survive the voxel and the statistical outlier filter.

    The outlier filter compares their `places` (`beams.Linking`): a row of beams is not lonely
    because the next one is far.
    """
    keep = np.arange(len(points))
    if extraction.voxel > 0.0:
        keep = first_of_cells(np.floor(points / extraction.voxel).astype(np.int64))
    k = extraction.outlier_neighbours
    if k and len(keep) > k + 1:
        distances, _ = cKDTree(places[keep]).query(places[keep], k + 1)
        distance = np.asarray(distances)[:, 1:].mean(axis=1)
        limit = distance.mean() + extraction.outlier_ratio * distance.std()
        keep = keep[distance <= limit]
    return keep


class RegionExtractor:
    """Finds the target of one region in the scans of a drive.

    Attributes:
        centre: (3,) metres, middle of the region in its own frame.
        tallies: counts of each LiDAR, for messages.
        trajectory: the vehicle's poses in the drive.
    """

    def __init__(self, region: TargetRegion, config: Config, trajectory: VehicleTrajectory) -> None:
        """Binds the region to a drive."""
        self._region = region
        self._config = config
        self.trajectory = trajectory
        self._low = np.array(region.min)
        self._high = np.array(region.max)
        self.centre = 0.5 * (self._low + self._high)
        R, t = np.eye(3), np.zeros(3)
        if region.frame == "start":
            begin, _ = trajectory.span_ns
            R, t = (part[0] for part in trajectory.poses_at([begin]))
        self._R_map_region, self._t_map_region = R, t
        self._guess = {name: lidar.guess() for name, lidar in config.lidars.items()}
        self.tallies: dict[str, Tally] = {name: Tally() for name in config.lidars}
        self._edges: dict[str, SeenEdges] = {name: SeenEdges() for name in config.lidars}
        self._looked_up: tuple[str, IntArray, Array, Array] | None = None

    def look_up(self, lidar: str, stamps_ns: Collection[int]) -> None:
        """Looks up the poses of the scans of a LiDAR at once, in front of their `candidates`.

        A call for one takes as long as for hundreds. Those of another LiDAR are forgotten.
        """
        stamps = np.array(sorted(stamps_ns), dtype=np.int64)
        self._looked_up = (lidar, stamps, *self._lidar_poses(lidar, stamps))

    def fresh(self) -> RegionExtractor:
        """The same extractor with empty tallies; it knows the fields of view."""
        out = RegionExtractor(self._region, self._config, self.trajectory)
        out._edges = self._edges
        return out

    @property
    def centre_map(self) -> Array:
        """(3,) metres, middle of the region in the map."""
        return np.asarray(self._R_map_region @ self.centre + self._t_map_region)

    def candidates(self, scan: LidarScan, drive: int) -> list[Candidate]:
        """The objects in a scan that may be the target, at most `MOST_CANDIDATES`, best first."""
        tally = self.tallies[scan.lidar]
        tally.scans += 1
        extraction = self._config.extraction
        R, t = self._lidar_pose(scan.lidar, scan.stamp_ns)
        if len(scan.points_lidar) == 0:
            tally.rejected[EMPTY] += 1
            return []
        range_m = float(np.linalg.norm(self.centre - t))
        margin = widened_margin_m(self._config, scan.lidar, range_m)
        if self._config.lidars[scan.lidar].fixed:
            margin += self._swept_m(scan)
        middle = R.T @ (self.centre - t)
        distance2 = np.zeros(len(scan.points_lidar))  # to the middle of the region
        for side, of_middle in zip(scan.points_lidar.T.copy(), middle, strict=True):
            side -= of_middle
            side *= side
            distance2 += side

        def near_region(margin: float) -> tuple[Array, IntArray]:
            return self._near_region(scan.points_lidar, distance2, R, t, margin, tally)

        points, near = near_region(margin)
        if len(near) < min(FEWEST_NEAR, extraction.min_points):
            tally.rejected[OUTSIDE] += 1
            return []
        scan_elevations = elevations(scan.points_lidar)
        spacing = beam_spacing(scan.points_lidar[near], scan_elevations)
        around = points
        rings_m = min(RINGS * spacing.row * range_m**2 / LIDAR_HEIGHT_M, FARTHEST_RING_M)
        if rings_m > NEAR_RINGS_M:
            around, _ = near_region(margin + rings_m)
        plane = fit_ground(around, extraction.ground_distance)
        standing = Standing.of(points, near, plane, extraction)
        linking = Linking.of(scan.points_lidar[standing.near], spacing, range_m)
        groups = groups_of(standing.points, linking) if len(standing.near) >= FEWEST_NEAR else []
        cut_off = [self._reaches_rim(standing.points[g], margin, linking.link_m) for g in groups]
        # By a trusted extrinsic a target is where the region was drawn.
        if any(cut_off) and not self._config.lidars[scan.lidar].fixed:
            wide = near_region(margin + MAX_EXTENT_M)
            if plane is None:  # little of it is near the region
                plane = fit_ground(wide[0], extraction.ground_distance)
            beyond = Standing.of(*wide, plane, extraction)
            linking = Linking.of(scan.points_lidar[beyond.near], spacing, range_m)
            groups, cut_off = completed_groups(standing, groups, cut_off, beyond, linking)
            standing = beyond
        objects = self._objects(standing.points, groups, cut_off)
        if not objects:
            tally.rejected[NOTHING] += 1
            return []
        points, near, height = standing.points, standing.near, standing.height_m
        if len(objects[0][0]) <= MOST_OF_A_SCAN * len(scan.points_lidar):
            self._edges[scan.lidar].add(scan.points_lidar, scan_elevations)
        out, sizes = [], []
        for chosen, is_cut_off in objects:
            kept = near[chosen][_filtered(points[chosen], linking.places[chosen], extraction)]
            sizes.append(len(kept))
            if len(kept) < extraction.min_points:
                continue
            times = None if scan.point_times_s is None else scan.point_times_s[kept]
            compact = replace(scan, points_lidar=scan.points_lidar[kept], point_times_s=times)
            guess = self._guess[scan.lidar]
            target, origins = deskewed_with_origins(compact, guess, self.trajectory)
            cloud = TargetCloud(scan.lidar, drive, scan.stamp_ns, target, scan.source)
            if times is not None:
                cloud = replace(cloud, swept=compact, origins_lidar=origins)
            centre, measured = _middle(target), compact.points_lidar
            top_m = math.inf if plane is None else float(height[chosen].max())
            out.append(Candidate(cloud, centre, R, t, measured, spacing.row, top_m, is_cut_off))
        tally.most_points = max(tally.most_points, *sizes)
        if not out:
            tally.rejected[f"under {extraction.min_points} points"] += 1
            tally.sparse.append(max(sizes))
        return out

    def _lidar_pose(self, lidar: str, stamp_ns: int) -> tuple[Array, Array]:
        """Rotation (3, 3) and translation (3,) of T_region_lidar, at the guess."""
        if self._looked_up is not None and self._looked_up[0] == lidar:
            _, stamps, R, t = self._looked_up
            at = int(np.searchsorted(stamps, stamp_ns))
            if at < len(stamps) and stamps[at] == stamp_ns:
                return R[at], t[at]
        R, t = self._lidar_poses(lidar, [stamp_ns])
        return R[0], t[0]

    def _lidar_poses(self, lidar: str, stamps_ns: Sequence[int] | IntArray) -> tuple[Array, Array]:
        """Rotations (m, 3, 3) and translations (m, 3) of T_region_lidar, at the guess."""
        R_map_vehicle, t_map_vehicle = self.trajectory.poses_at(stamps_ns)
        guess = self._guess[lidar]
        R = self._R_map_region.T @ R_map_vehicle @ guess.rotation().matrix()
        t = t_map_vehicle + R_map_vehicle @ guess.translation() - self._t_map_region
        return R, t @ self._R_map_region

    def _swept_m(self, scan: LidarScan) -> float:
        """How far the target is from where it was at the stamp, at most, within a sweep; metres.

        Points are chosen before their motion is compensated. The margins of guesses cover this.
        """
        times_s = checked_times(scan)
        if times_s is None:
            return 0.0
        ends_s = (float(times_s.min()), 0.0, float(times_s.max()))
        stamps = [scan.stamp_ns + round(at * NANOSECONDS_PER_SECOND) for at in ends_s]
        within = np.clip(stamps, *self.trajectory.span_ns).tolist()
        first, at_stamp, last = self.directions(scan.lidar, within)
        return max(float(np.linalg.norm(end - at_stamp)) for end in (first, last))

    def directions(self, lidar: str, stamps_ns: Sequence[int]) -> Array:
        """(m, 3) metres, lidar frame: middle of the region at the stamps, at the guess."""
        R, t = self._lidar_poses(lidar, stamps_ns)
        return np.asarray(np.einsum("mji,mj->mi", R, self.centre - t))

    def reach_m(self) -> float:
        """Half the diagonal of the region, metres."""
        return 0.5 * float(np.linalg.norm(self._high - self._low))

    def _near_region(
        self,
        points_lidar: Array,
        distance2: Array,
        R: Array,
        t: Array,
        margin: float,
        tally: Tally,
    ) -> tuple[Array, IntArray]:
        """Points within `margin` of the region, in its frame, and their indices.

        A ball around the region is tested first: most of a scan is far away. `distance2` (N,) are
        squared distances to the region's middle.
        """
        radius = self.reach_m() + margin
        near = np.flatnonzero(distance2 < radius**2)
        if len(near) == 0:
            near = np.array([distance2.argmin()])
        points = points_lidar.take(near, axis=0) @ R.T + t
        outside = np.maximum(np.maximum(self._low - points, points - self._high), 0.0)
        distance = np.sqrt(np.einsum("ni,ni->n", outside, outside))
        tally.nearest_m = min(tally.nearest_m, float(distance.min()))
        inside = distance <= margin
        return points.compress(inside, axis=0), near.compress(inside)

    def _objects(
        self, points: Array, groups: Sequence[IntArray], cut_off: Sequence[bool]
    ) -> list[tuple[IntArray, bool]]:
        """The groups of points (n, 3), region frame, that have the size of a target.

        The best inside the region first; and whether they are cut off.
        """
        scored = []
        for member, is_cut_off in zip(groups, cut_off, strict=True):
            extent = extent_m(points[member])
            if not MIN_EXTENT_M <= extent <= MAX_EXTENT_M:
                continue
            centre = points[member].mean(axis=0)
            score = len(member) * math.exp(-float(self.outside_m(centre[None])[0]) / OUTSIDE_M)
            scored.append((score, member, is_cut_off))
        scored.sort(key=lambda found: -found[0])
        return [(member, is_cut_off) for _, member, is_cut_off in scored[:MOST_CANDIDATES]]

    def choose(self, found: Sequence[Sequence[Candidate]], lidar: str) -> list[TargetCloud]:
        """The clouds of the static object among the candidates of a LiDAR's scans, best first.

        They are marked where the edge of the field of view may cut them off.
        With a wrong guess even a static object moves in the map; but one error of the extrinsic,
        small by its sigma, must explain that motion (`track`).
        """
        scans = [candidates for candidates in found if candidates]
        if not scans:
            return []
        flat, candidate_set = self.candidate_set(scans, lidar)
        best = candidate_set.longest_track()
        return self.clouds([flat[n] for n in best.tolist()], len(scans), lidar)

    def clouds(self, chosen: Sequence[Candidate], scans: int, lidar: str) -> list[TargetCloud]:
        """The clouds of one object's candidates, of `candidate_set`, at most one per scan."""
        tally = self.tallies[lidar]
        lost = scans - len(chosen)
        if lost:
            tally.rejected[MOVED] += lost
        tally.kept += len(chosen)
        tally.cut += sum(bool(candidate.cloud.cut) for candidate in chosen)
        return [candidate.cloud for candidate in chosen]

    def candidate_set(
        self, scans: Sequence[Sequence[Candidate]], lidar: str
    ) -> tuple[list[Candidate], CandidateSet]:
        """The candidates of a LiDAR's scans, none of them empty, in one list; and as a set.

        They are marked where the edge of the field of view may cut them off.
        """
        sigma = self._config.lidars[lidar].sigma
        prior = np.array([max(sigma.rpy_rad())] * 3 + [max(sigma.xyz_m())] * 3)
        if self._config.lidars[lidar].fixed:
            prior = np.full(6, 1e-3)
        # The edges as all scans of which candidates were asked for show them.
        edges = self._edges[lidar]
        flat = [
            replace(c, cloud=replace(c.cloud, cut=edges.cuts(c.measured_lidar, c.row_rad)))
            for candidates in scans
            for c in candidates
        ]
        index = np.repeat(np.arange(len(scans)), [len(candidates) for candidates in scans])
        centres = np.array([c.centre_lidar for c in flat])
        R = np.array([c.R_region_lidar for c in flat])
        t = np.array([c.t_region_lidar for c in flat])
        is_cut = np.array([bool(c.cloud.cut) for c in flat])
        return flat, CandidateSet(centres, R, t, index, prior, is_cut)

    def outside_m(self, places: Array) -> Array:
        """(n,) metres, distance of places (n, 3), region frame, from the region."""
        off = np.maximum(np.maximum(self._low - places, places - self._high), 0.0)
        return np.asarray(np.linalg.norm(off, axis=1))

    def _reaches_rim(self, points: Array, margin: float, link_m: float) -> bool:
        """Whether an object (n, 3), region frame, may go on where the points near the region end.

        What it would go on with is within `link_m`, the distance of linked points.
        """
        if extent_m(points) > MAX_EXTENT_M:
            return False
        rim_m = min(max(RIM_M, link_m), 0.5 * margin)
        return float(self.outside_m(points).max()) > margin - rim_m

    def in_map(self, place: Array) -> Array:
        """(3,) metres, a place (3,) of the region frame in the map."""
        return np.asarray(self._R_map_region @ place + self._t_map_region)
