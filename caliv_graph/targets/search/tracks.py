"""What one LiDAR saw at one place again and again, and whether it can be a target."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from caliv_graph.config.model import Config
from caliv_graph.products import Array, IntArray
from caliv_graph.targets.search.align import MIN_VIEWS, gate_m, tracks_at_places
from caliv_graph.targets.search.history import Alignment, LidarHistory
from caliv_graph.targets.search.objects import WIDE_M

MIN_EXTENT_M = 0.27
"""Minimum width of a target: 0.3 m, of which the outermost beams miss the edges."""

MAX_EXTENT_M = 1.5
"""Maximum width of a target."""

MIN_HEIGHT_M = 0.2
"""Lower objects are kerbs, drain covers, and errors of the ground surface."""

MAX_HEIGHT_M = 2.1
"""Maximum height of a target, 2 m, and the noise."""

MAX_BOTTOM_M = 0.45
"""Objects without points below this do not stand on the ground: a sign, a roof, a branch."""

PRESENT = 0.5
"""Minimum part of the scans with a place in view in which a static object is there; somebody who
walks past is in a tenth."""

SCATTER_M = 0.10
SCATTER_PER_EXTENT = 0.15
"""Maximum scatter of a static object about its place, third quartile: constant, plus this part of
its extent, since its visible side changes. Measured: at most 0.20 m for a chair 0.9 m wide with a
guess 10 degrees off; 0.3 to 0.4 m for somebody who strolls about or waits."""

WELL_SEEN_POINTS = 50
"""Width and height are judged by views with at least so many points, if there are enough."""

MOVING = "moving or seldom there"
"""Verdict on what does not stay where it is."""

FULL_POINTS = 300
"""Number of points above which a view is not better."""


@dataclass(frozen=True)
class Track:
    """An object that one LiDAR saw at one place in several scans.

    Attributes:
        lidar: its name.
        place: (3,) metres, map, its foot, with the corrected guess.
        gate_m: displacement of the place that the guess leaves possible.
        extent_m: largest horizontal extent.
        height_m: above ground.
        height_known: whether its top was ever inside the field of view.
        good: number of scans that extraction could use.
        score: quality of the view.
        verdict: why it is no target; empty if it may be one.
        doubtful: only what the guesses or somebody beside it may cause speaks against it: its place
            scatters, or is empty too often.
    """

    lidar: str
    place: Array
    gate_m: float
    extent_m: float
    height_m: float
    height_known: bool
    good: int
    score: float
    verdict: str
    doubtful: bool = False


def judged_tracks(history: LidarHistory, alignment: Alignment, config: Config) -> list[Track]:
    """All tracks of a LiDAR of at least `MIN_VIEWS` scans, judged."""
    if not history.objects:
        return []
    gate = gate_m(history, config)
    bases = history.bases(alignment)
    wide, wide_scan = history.outlines(history.extent_m >= WIDE_M, alignment)
    wide_tree, tree = cKDTree(wide[:, :2]), cKDTree(bases[:, :2])
    travelled = float(np.ptp(history.t_map_vehicle[:, :2], axis=0).max(initial=0.0))
    out = []
    for members in tracks_at_places(history, bases[:, :2], gate):
        place = np.average(bases[members], axis=0, weights=1.0 / history.range_m[members])
        scans = history.scan_of[members]
        in_wide = set(wide_scan[wide_tree.query_ball_point(place[:2], gate)].tolist())
        in_wide -= set(scans.tolist())
        met = set(history.scan_of[tree.query_ball_point(place[:2], 1.3 * gate)].tolist()) | in_wide
        centre_m = np.linalg.norm((bases[members] - history.t_map_vehicle[scans])[:, :2], axis=1)
        missed = _in_view(history, alignment, place, centre_m, gate) - met
        baseline = float(np.ptp(history.t_map_vehicle[scans][:, :2], axis=0).max())
        presence = len(scans) / (len(scans) + len(missed))
        good = members[history.points[members] >= config.extraction.min_points]
        well = good[history.points[good] >= WELL_SEEN_POINTS]
        judged = next((m for m in (well, good) if len(m) >= MIN_VIEWS), members)
        # Range noise makes the extent larger.
        noise_m = 2.0 * config.noise.lidar_range_m
        extent = max(float(np.quantile(history.extent_m[judged], 0.8)) - noise_m, 0.01)
        height, known = _height(history, judged)
        scatter = float(np.quantile(np.linalg.norm((bases[judged] - place)[:, :2], axis=1), 0.75))
        stays = scatter <= SCATTER_M + SCATTER_PER_EXTENT * extent and presence >= PRESENT
        # What rides on the vehicle stays at a place for as long as the vehicle does.
        rides = baseline < 3.0 * gate < 0.5 * travelled
        if len(in_wide) > 0.5 * len(scans):
            verdict = "part of something wide"
        else:
            verdict = _no_target(extent, height, _bottom(history, judged))
        if not verdict and (
            len(good) < 2 or len(good) * history.stride < config.extraction.min_scans
        ):
            verdict = "with too few points"
        doubtful = not (verdict or rides or stays)
        if rides or not stays:
            verdict = MOVING
        out.append(
            Track(
                lidar=history.name,
                place=place,
                gate_m=_displacement_m(history.name, float(np.quantile(centre_m, 0.3)), config),
                extent_m=extent,
                height_m=height,
                height_known=known,
                good=len(good),
                score=_score(history, good, place),
                verdict=verdict,
                doubtful=doubtful,
            )
        )
    return out


def _in_view(
    history: LidarHistory, alignment: Alignment, place: Array, centre_m: Array, gate: float
) -> set[int]:
    """Scans that should show an object at a place (3,), at ranges about `centre_m` (n,)."""
    slack = 0.5 * gate + float(np.linalg.norm(history.t_vehicle_lidar[:2]))
    ranges = (float(centre_m.min()) - slack, float(centre_m.max()) + slack)
    shows = history.should_show(place, ranges, alignment, gate)
    return set(np.flatnonzero(shows).tolist())


def _no_target(extent_m: float, height_m: float, bottom_m: float) -> str:
    """Why a static object of this size is no target; empty if it may be one."""
    if extent_m < MIN_EXTENT_M:
        return f"under {MIN_EXTENT_M:.1f} m wide"
    if extent_m > MAX_EXTENT_M:
        return f"over {MAX_EXTENT_M:.1f} m wide"
    if height_m > MAX_HEIGHT_M:
        return "over 2 m high"
    if height_m < MIN_HEIGHT_M:
        return f"under {MIN_HEIGHT_M:.1f} m high"
    if not bottom_m <= MAX_BOTTOM_M:
        return "not standing on the ground"
    return ""


def _bottom(history: LidarHistory, members: IntArray) -> float:
    """Height of the lowest points of an object above ground, metres; NaN if unknown."""
    bottoms = history.bottom_m[members]
    return float(np.nanquantile(bottoms, 0.2)) if np.isfinite(bottoms).any() else math.nan


def _height(history: LidarHistory, members: IntArray) -> tuple[float, bool]:
    """Height of an object above ground, metres; whether its top was in view, else a bound."""
    tops, cut = history.top_m[members], history.top_cut[members]
    known = np.isfinite(tops)
    if not known.any():
        return math.nan, False
    bound = float(np.quantile(tops[known], 0.8))
    whole = tops[known & ~cut]
    return max(bound, float(np.quantile(whole, 0.8)) if len(whole) else 0.0), len(whole) >= 2


def _score(history: LidarHistory, good: IntArray, place: Array) -> float:
    """Quality of the view of an object: scans, their points, and the span of bearings."""
    if not len(good):
        return 0.0
    views = np.minimum(history.points[good] / FULL_POINTS, 1.0).sum() * history.stride
    offset = history.t_map_vehicle[history.scan_of[good]][:, :2] - place[:2]
    bearing = np.sort(np.arctan2(offset[:, 1], offset[:, 0]))
    gaps = np.diff(np.append(bearing, bearing[0] + 2.0 * math.pi))
    span = 2.0 * math.pi - float(gaps.max())
    return float(views) * (0.2 + min(span / math.pi, 1.0))


def _displacement_m(lidar: str, range_m: float, config: Config) -> float:
    """Displacement of an object at `range_m` that the guess of a LiDAR may cause, metres."""
    if config.lidars[lidar].fixed:
        return 0.1
    sigma = config.lidars[lidar].sigma
    return 0.1 + 2.0 * (max(sigma.xyz_m()) + max(sigma.rpy_rad()) * range_m)


@dataclass(frozen=True)
class Proposal:
    """An object that may be the target: its track of each LiDAR that sees it, by name."""

    tracks: Mapping[str, Track]

    @property
    def place(self) -> Array:
        """(3,) metres, map: mean of the tracks, weighted by their gates."""
        weights = [track.gate_m**-2.0 for track in self.tracks.values()]
        return np.average([t.place for t in self.tracks.values()], axis=0, weights=weights)

    @property
    def extent_m(self) -> float:
        """Largest horizontal extent, metres."""
        return max(track.extent_m for track in self.tracks.values())

    @property
    def height_m(self) -> float:
        """Height above ground, metres, by the LiDARs that see the top; NaN if none does."""
        known = [track.height_m for track in self.tracks.values() if track.height_known]
        return max(known) if known else math.nan

    def rank(self) -> tuple[int, float]:
        """Number of LiDARs that see it, and the lowest of their scores."""
        scores = [track.score for track in self.tracks.values()]
        return len(scores), min(scores)


def matched(tracks: Sequence[Track]) -> list[Proposal]:
    """Proposals: tracks of several LiDARs matched by place and size, greedily by score."""
    left = sorted(tracks, key=lambda track: -track.score)
    out = []
    while left:
        first = left.pop(0)
        group = {first.lidar: first}
        for lidar in sorted({track.lidar for track in left} - {first.lidar}):
            options = [
                (c, t) for t in left if t.lidar == lidar and (c := _mismatch(first, t)) < 1.0
            ]
            if options:
                group[lidar] = min(options, key=lambda option: option[0])[1]
                left = [track for track in left if track is not group[lidar]]
        out.append(Proposal(group))
    return out


def _mismatch(a: Track, b: Track) -> float:
    """Dissimilarity of the tracks of two LiDARs; from 1 on they are different objects."""
    off = float(np.linalg.norm((a.place - b.place)[:2])) / (a.gate_m + b.gate_m)
    # Each LiDAR sees another side: sizes agree only roughly.
    size = abs(math.log(a.extent_m / b.extent_m)) / math.log(3.0)
    tall = 0.0
    if a.height_known and b.height_known:
        tall = abs(a.height_m - b.height_m) / 0.8
    return max(off, size, tall)
