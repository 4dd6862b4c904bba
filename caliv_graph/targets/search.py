"""Finding the target: the compact static object on the ground that all LiDARs pass (SPEC 6).

Some scans of each LiDAR are taken apart into objects. The guesses are off by degrees, so that an
object wanders in the map as the vehicle turns; but one error per LiDAR, small by its sigma, must
explain the wandering of *all* it sees. The yaw and shift under which things stand stillest are
therefore found first; what still moves then, or is not there when it should be, does move. What is
left is judged by its size, and what the LiDARs found is put together across them.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from caliv_graph.common.progress import Advance, Progress
from caliv_graph.config.model import Config, TargetRegion
from caliv_graph.errors import TargetError
from caliv_graph.products import Array, BoolArray, IntArray, Recording
from caliv_graph.targets.objects import AZIMUTH_BIN_RAD, WIDE_M, SeenObject, SeenScan, see_objects
from caliv_graph.trajectory.deskew import deskew
from caliv_graph.trajectory.select import VehicleTrajectory

MIN_EXTENT_M = 0.27
"""SPEC 6: 0.3 m; the outermost beams fall short of the edges."""

MAX_EXTENT_M = 1.5
"""SPEC 6."""

MIN_HEIGHT_M = 0.2
"""Lower things are kerbs, drain covers, and what a ground surface gets wrong."""

MAX_HEIGHT_M = 2.1
"""SPEC 6: 2 m, and what noise adds."""

MAX_BOTTOM_M = 0.45
"""What has no points lower than this does not stand on the ground: a sign, a roof, a branch."""

SCANS = 60
"""Scans of one LiDAR that a short drive is searched in."""

PERIOD_S = 1.0
"""Longest time between two of them: a vehicle at 10 m/s passes a target in a few seconds."""

MAX_SCANS = 240
"""Scans of one LiDAR that a drive is searched in, however long it is."""

STANDS_M = 0.2
STANDS_RAD = math.radians(2.0)
"""A vehicle that has moved less than this since the last scan shows nothing new."""

STANDING_PERIODS = 4
"""While it stands, every fourth scan is still looked at: others move."""

MIN_VIEWS = 3
"""An object in fewer scans has no history."""

GATE_M = 0.5
"""Distance from its place in which an object is met again: half of what its visible side changes,
and what roll and pitch of the guess do to things that are not as high as the LiDAR."""

PRESENT = 0.5
"""A static object is there in at least this part of the scans that should show it; somebody who
walks past is in a tenth."""

SCATTER_M = 0.10
SCATTER_PER_EXTENT = 0.15
"""Three quarters of the sightings of a static object are within this of its place, and as much more
as its visible side changes with its size (measured: 0.20 m at most for a chair 0.9 m wide, mounted
10 degrees off); those of somebody who strolls about or waits are 0.3 to 0.4 m away."""

ALIGN_STEP_M = 0.2
"""The yaw of a LiDAR is searched in steps that move things at ALIGN_RANGE_M by this."""

ALIGN_RANGE_M = 20.0

GUESS_SIGMAS = 2.5
"""How many sigmas the guess may be off; a uniform error ends at 1.7."""

PLACE_SIGMA_M = 0.2
"""What the middle of the visible points of an object scatters by."""

FULL_POINTS = 300
"""More points than this make a view no better."""

FOV_GAP_RAD = math.radians(5.0)
"""A sector as wide as this without any return in any scan is outside the field of view."""

EDGE_RAD = math.radians(0.6)
"""An object this near to the edge of the field of view may be cut off by it."""

REGION_MARGIN_M = 0.3
"""The region is larger than the object by this on each side."""


@dataclass(frozen=True)
class FoundTarget:
    """The target of one drive.

    Attributes:
        drive: index of the drive.
        region: a box in the map about the object, as small as it can be. What the guesses are off
            is for the extraction to allow for: a box that held the object as each guess has it
            would hold its neighbours too.
        centre_map: (3,) metres, about its middle; as good as the guesses.
        extent_m: largest horizontal extent.
        height_m: above the ground.
        scans: per LiDAR, the scans in which it was seen well, of those that were looked at; 0 for a
            LiDAR that does not see it.
        looked_at: per LiDAR, the scans that were looked at.
        aligned: per LiDAR, T_vehicle_lidar with the yaw and the shift under which what it sees
            stands stillest: better than the guess to tell what is at one place, but no estimate.
        others: objects that would have done as well, a phrase each.
    """

    drive: int
    region: TargetRegion
    centre_map: Array
    extent_m: float
    height_m: float
    scans: Mapping[str, int]
    looked_at: Mapping[str, int]
    aligned: Mapping[str, gtsam.Pose3]
    others: tuple[str, ...]


def find_target(
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
) -> list[FoundTarget]:
    """Finds the target of each drive.

    Args:
        recordings: the drives.
        trajectories: one per drive.
        config: initial guesses and their sigmas, ranges, what a usable scan is.
        progress: told of every scan.

    Returns:
        One target per drive, in their order.

    Raises:
        TargetError: a drive shows no object that could be a target.
        RecordingError: a cloud could not be read.
    """
    stamps = [
        {name: _chosen_stamps(recording.scan_stamps_ns(name), trajectory) for name in config.lidars}
        for recording, trajectory in zip(recordings, trajectories, strict=True)
    ]
    total = sum(len(s) for drive in stamps for s in drive.values())
    out = []
    with progress.stage("finding the target", total) as advance:
        for drive, (recording, trajectory) in enumerate(zip(recordings, trajectories, strict=True)):
            histories = [
                _history(recording, trajectory, config, name, chosen, advance)
                for name, chosen in stamps[drive].items()
            ]
            out.append(_target_of_drive(drive, recording.name, histories, config))
    return out


def _chosen_stamps(stamps_ns: Sequence[int], trajectory: VehicleTrajectory) -> IntArray:
    """The scans of a LiDAR that are looked at: evenly in time, fewer while the vehicle stands."""
    begin, end = trajectory.span_ns
    lost = set(trajectory.lost_ns)
    stamps = np.array([s for s in stamps_ns if begin <= s <= end and s not in lost], np.int64)
    if len(stamps) < 2:
        return stamps
    duration_s = 1e-9 * float(stamps[-1] - stamps[0])
    period_s = max(min(PERIOD_S, duration_s / SCANS), duration_s / MAX_SCANS)
    slots = np.arange(0.0, duration_s + 0.5 * period_s, period_s)
    # A slot takes the next scan; a millisecond is for stamps that jitter about the slot.
    at = np.searchsorted(stamps, stamps[0] + ((slots - 1e-3) * 1e9).astype(np.int64))
    stamps = stamps[np.unique(at[at < len(stamps)])]
    R, t = trajectory.poses_at(stamps)
    chosen = [0]
    for i in range(1, len(stamps)):
        last = chosen[-1]
        cosine = 0.5 * (float(np.trace(R[last].T @ R[i])) - 1.0)
        moved = float(np.linalg.norm(t[i] - t[last])) > STANDS_M or cosine < math.cos(STANDS_RAD)
        if moved or i - last >= STANDING_PERIODS:
            chosen.append(i)
    taken: IntArray = stamps[chosen]
    return taken


# ------------------------------------------------------------------ one LiDAR


@dataclass(frozen=True)
class _Alignment:
    """What the guess of a LiDAR is off, as far as standing things tell: vehicle axes."""

    yaw_rad: float = 0.0
    shift_m: Array = field(default_factory=lambda: np.zeros(2))


class _History:
    """What one LiDAR saw in a drive.

    Attributes:
        name: of the LiDAR.
        scans: what each of its scans shows.
        objects: all objects of all scans.
        scan_of: (n,) the scan of each.
        stride: scans there are for each that was looked at.
        R_map_vehicle: (scans, 3, 3) attitude of the vehicle.
        t_map_vehicle: (scans, 3) metres, place of the vehicle.
        t_vehicle_lidar: (3,) metres, the guess.
        extent_m, points, range_m, bottom_m, top_m: (n,) of each object, see `SeenObject`.
        whole: (n,) whether all of the object's width is in view.
        top_cut: (n,) whether the field of view may end below its top.
    """

    def __init__(
        self,
        name: str,
        T_vehicle_lidar: gtsam.Pose3,
        scans: Sequence[SeenScan],
        poses: tuple[Array, Array],
        stride: float,
    ) -> None:
        self.name = name
        self.scans = tuple(scans)
        self.stride = stride
        self.R_map_vehicle, self.t_map_vehicle = poses
        self._guess = T_vehicle_lidar
        self._R_guess = T_vehicle_lidar.rotation().matrix()
        self.t_vehicle_lidar = T_vehicle_lidar.translation()
        self.objects: tuple[SeenObject, ...] = tuple(o for s in scans for o in s.objects)
        counts = [len(s.objects) for s in scans]
        self.scan_of: IntArray = np.repeat(np.arange(len(scans)), counts)
        self._base = np.array([o.base for o in self.objects]).reshape(-1, 3)
        self._fov = _field_of_view([s.azimuths for s in scans])
        self._highest_rad = max((s.highest_rad for s in scans), default=0.0)
        self.extent_m = np.array([o.extent_m for o in self.objects])
        self.points = np.array([o.points for o in self.objects], dtype=np.int64)
        self.range_m = np.array([o.range_m for o in self.objects])
        self.bottom_m = np.array([o.bottom_m for o in self.objects])
        self.top_m = np.array([o.top_m for o in self.objects])
        azimuth = np.array([o.azimuth for o in self.objects]).reshape(-1, 2)
        self._azimuth = azimuth
        self.whole: BoolArray = np.array(
            [not o.hidden for o in self.objects], dtype=bool
        ) & self._in_view(azimuth[:, 0] - EDGE_RAD, azimuth[:, 1] + EDGE_RAD)
        self.top_cut: BoolArray = np.array(
            [o.highest_rad > self._highest_rad - EDGE_RAD for o in self.objects], dtype=bool
        )

    def _in_view(self, begin: Array, end: Array) -> BoolArray:
        """Whether all azimuths from `begin` to `end` (n,) are inside the field of view."""
        first = np.floor(begin / AZIMUTH_BIN_RAD).astype(np.int64)
        last = np.floor(end / AZIMUTH_BIN_RAD).astype(np.int64)
        outside = np.concatenate([[0], np.cumsum(np.tile(~self._fov, 3))])
        n = len(self._fov)
        first, width = first % n, np.clip(last - first, 0, n - 1)
        return np.asarray(outside[first + width + 1] == outside[first])

    def places(self, alignment: _Alignment, points_lidar: Array, scan_of: IntArray) -> Array:
        """(n, 3) metres in the map of points (n, 3) of the scans (n,), the guess put right."""
        c, s = math.cos(alignment.yaw_rad), math.sin(alignment.yaw_rad)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        shift = np.array([*alignment.shift_m, 0.0])
        points = points_lidar @ (turn @ self._R_guess).T + self.t_vehicle_lidar + shift
        moved = np.einsum("nij,nj->ni", self.R_map_vehicle[scan_of], points)
        return np.asarray(moved + self.t_map_vehicle[scan_of])

    def aligned(self, alignment: _Alignment) -> gtsam.Pose3:
        """T_vehicle_lidar, the guess put right."""
        turn = gtsam.Rot3.Yaw(alignment.yaw_rad)
        shift = np.array([*alignment.shift_m, 0.0])
        return gtsam.Pose3(turn.compose(self._guess.rotation()), self.t_vehicle_lidar + shift)

    def bases(self, alignment: _Alignment) -> Array:
        """(n, 3) metres in the map, where each object stands."""
        return self.places(alignment, self._base, self.scan_of)

    def outlines(self, which: BoolArray, alignment: _Alignment) -> tuple[Array, IntArray]:
        """Points (m, 3) of these objects in the map, and the scan of each."""
        chosen = np.flatnonzero(which)
        if not len(chosen):
            return np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
        points = [self.objects[i].outline for i in chosen]
        scan_of = np.repeat(self.scan_of[chosen], [len(p) for p in points])
        return self.places(alignment, np.concatenate(points), scan_of), scan_of

    def levers(self, alignment: _Alignment) -> Array:
        """(n, 2) change of each object's place in the map per radian of yaw."""
        arm = self._base @ self._R_guess.T
        c, s = math.cos(alignment.yaw_rad), math.sin(alignment.yaw_rad)
        change = np.column_stack(
            [-s * arm[:, 0] - c * arm[:, 1], c * arm[:, 0] - s * arm[:, 1], np.zeros(len(arm))]
        )
        return np.asarray(np.einsum("nij,nj->ni", self.R_map_vehicle[self.scan_of], change)[:, :2])

    def should_show(
        self, place: Array, ranges_m: tuple[float, float], alignment: _Alignment, gate_m: float
    ) -> BoolArray:
        """(scans,) whether a thing at a place (3,) in the map should be seen.

        It should in the field of view, between these ranges, if nothing nearer hides it.
        """
        c, s = math.cos(alignment.yaw_rad), math.sin(alignment.yaw_rad)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        origin = self.t_vehicle_lidar + np.array([*alignment.shift_m, 0.0])
        at_vehicle = np.einsum("nji,nj->ni", self.R_map_vehicle, place - self.t_map_vehicle)
        at = (at_vehicle - origin) @ (turn @ self._R_guess)
        azimuth = np.arctan2(at[:, 1], at[:, 0])
        level_m = np.hypot(*(at_vehicle - origin)[:, :2].T)
        half = gate_m / np.maximum(level_m, 1.0)
        shows = self._in_view(azimuth - half, azimuth + half)
        shows &= (level_m >= ranges_m[0]) & (level_m <= ranges_m[1])
        for i in np.flatnonzero(shows):
            mine = np.flatnonzero(self.scan_of == i)
            low, high = self._azimuth[mine, 0], self._azimuth[mine, 1]
            off = (azimuth[i] - low + math.pi) % (2.0 * math.pi) - math.pi
            before = (off > -half[i]) & (off < high - low + half[i])
            before &= self.range_m[mine] < level_m[i] - gate_m
            shows[i] = not before.any()
        return shows


def _field_of_view(azimuths: Sequence[IntArray]) -> BoolArray:
    """(n,) which azimuths a LiDAR looks at, by bins from 0 on: where it ever saw anything."""
    n = round(2.0 * math.pi / AZIMUTH_BIN_RAD)
    seen = np.zeros(n, dtype=bool)
    for bins in azimuths:
        seen[bins % n] = True
    filled = np.flatnonzero(seen)
    for a, b in itertools.pairwise(np.append(filled, filled[:1] + n)):
        if (b - a) * AZIMUTH_BIN_RAD < FOV_GAP_RAD:
            seen[np.arange(a, b) % n] = True
    return seen


def _history(
    recording: Recording,
    trajectory: VehicleTrajectory,
    config: Config,
    name: str,
    chosen: IntArray,
    advance: Advance,
) -> _History:
    lidar = config.lidars[name]
    guess = lidar.initial.pose()
    scans, stamps = [], []
    for scan in recording.scans(name, wanted=set(chosen.tolist())):
        range_m = np.linalg.norm(scan.points_lidar, axis=1)
        points = deskew(scan, guess, trajectory).points_lidar
        points = points[(range_m >= lidar.min_range) & (range_m <= lidar.max_range)]
        R, _ = trajectory.poses_at([scan.stamp_ns])
        scans.append(see_objects(points, R[0] @ guess.rotation().matrix()))
        stamps.append(scan.stamp_ns)
        advance()
    poses = trajectory.poses_at(stamps) if stamps else (np.zeros((0, 3, 3)), np.zeros((0, 3)))
    stride = len(recording.scan_stamps_ns(name)) / max(len(scans), 1)
    return _History(name, guess, scans, poses, stride)


def _align(history: _History, config: Config) -> _Alignment:
    """The yaw and shift of a LiDAR under which what it sees stands stillest.

    An arc leaves yaw and shift to one another; then the smallest does.
    """
    lidar = config.lidars[history.name]
    usable = history.whole & (history.extent_m < WIDE_M)
    if lidar.fixed or usable.sum() < MIN_VIEWS:
        return _Alignment()
    sigma_yaw = lidar.sigma.rpy_rad()[2]
    limit = GUESS_SIGMAS * sigma_yaw
    steps = math.ceil(limit * ALIGN_RANGE_M / ALIGN_STEP_M)
    best, best_score = _Alignment(), -math.inf
    for yaw in limit * np.arange(-steps, steps + 1) / max(steps, 1):
        tree = cKDTree(history.bases(_Alignment(float(yaw)))[usable, :2])
        pairs = tree.count_neighbors(tree, np.array([0.5, 1.0]) * GATE_M).sum() - 2 * usable.sum()
        # Between equals the guess decides.
        score = float(pairs) * (1.0 - 0.02 * (yaw / sigma_yaw) ** 2)
        if score > best_score:
            best, best_score = _Alignment(float(yaw)), score
    for _ in range(3):
        best = _refined(history, best, config)
    return best


def _refined(history: _History, alignment: _Alignment, config: Config) -> _Alignment:
    """Least squares for yaw and shift: every object at one place, the guess as a prior."""
    sigma = config.lidars[history.name].sigma
    prior = np.array([sigma.rpy_rad()[2], *sigma.xyz_m()[:2]])
    gate = _gate_m(history, config)
    bases = history.bases(alignment)[:, :2]
    J = np.zeros((len(bases), 2, 3))
    J[:, :, 0] = history.levers(alignment)
    J[:, :, 1:] = history.R_map_vehicle[history.scan_of][:, :2, :2]
    now = np.array([alignment.yaw_rad, *alignment.shift_m])
    H, g = np.diag(prior**-2.0), -now / prior**2
    for members in _places(history, bases, gate):
        if len(members) < 2 * MIN_VIEWS:
            continue
        # The place is as unknown as the mounting: what is common to all says nothing.
        Jc = (J[members] - J[members].mean(axis=0)).reshape(-1, 3)
        r = (bases[members] - bases[members].mean(axis=0)).ravel()
        H += Jc.T @ Jc / PLACE_SIGMA_M**2
        g -= Jc.T @ r / PLACE_SIGMA_M**2
    now = np.clip(now + np.linalg.solve(H, g), -GUESS_SIGMAS * prior, GUESS_SIGMAS * prior)
    return _Alignment(float(now[0]), now[1:])


def _gate_m(history: _History, config: Config) -> float:
    """Distance within which an object of an aligned LiDAR is met again."""
    lidar = config.lidars[history.name]
    return GATE_M + (0.0 if lidar.fixed else max(lidar.sigma.xyz_m()))


def _places(history: _History, bases: Array, gate_m: float) -> list[IntArray]:
    """Sightings that belong together, one per scan: the most crowded place first."""
    left = history.whole & (history.extent_m < WIDE_M)
    out = []
    while left.sum() >= MIN_VIEWS:
        index = np.flatnonzero(left)
        tree = cKDTree(bases[index])
        near = tree.query_ball_point(bases[index], gate_m)
        views = [len(np.unique(history.scan_of[index[n]])) for n in near]
        centre = bases[index[int(np.argmax(views))]]
        for _ in range(3):
            members = index[tree.query_ball_point(centre, gate_m)]
            if not len(members):
                break
            centre = np.average(bases[members], axis=0, weights=1.0 / history.range_m[members])
        if not len(members):
            members = index[near[int(np.argmax(views))]]
        # Of two in one scan, the one with more points.
        order = np.lexsort((-history.points[members], history.scan_of[members]))
        _, first = np.unique(history.scan_of[members[order]], return_index=True)
        if len(first) < MIN_VIEWS and max(views) < MIN_VIEWS:
            break
        if len(first) >= MIN_VIEWS:
            out.append(np.asarray(members[order[first]]))
        left[members] = False
    return out


@dataclass(frozen=True)
class _Thing:
    """Something that one LiDAR saw at one place again and again.

    Attributes:
        lidar: its name.
        place: (3,) metres, map, where it stands, the guess put right.
        gate_m: how far the guess may still move the place.
        extent_m: largest horizontal extent.
        height_m: above ground.
        height_known: whether its top was ever inside the field of view.
        views: scans in which it was met.
        good: those of them that extraction could use.
        score: how well it is seen.
        verdict: why it is no target, or nothing.
    """

    lidar: str
    place: Array
    gate_m: float
    extent_m: float
    height_m: float
    height_known: bool
    views: int
    good: int
    score: float
    verdict: str


def _things(history: _History, alignment: _Alignment, config: Config) -> list[_Thing]:
    """Everything a LiDAR saw at least in MIN_VIEWS scans at one place, judged."""
    if not history.objects:
        return []
    gate = _gate_m(history, config)
    bases = history.bases(alignment)
    wide, wide_scan = history.outlines(history.extent_m >= WIDE_M, alignment)
    wide_tree = cKDTree(wide[:, :2]) if len(wide) else None
    tree = cKDTree(bases[:, :2])
    travelled = float(np.ptp(history.t_map_vehicle[:, :2], axis=0).max(initial=0.0))
    out = []
    for members in _places(history, bases[:, :2], gate):
        place = np.average(bases[members], axis=0, weights=1.0 / history.range_m[members])
        scans = history.scan_of[members]
        in_wide = (
            set(wide_scan[wide_tree.query_ball_point(place[:2], gate)].tolist())
            if wide_tree is not None
            else set()
        ) - set(scans.tolist())
        met = set(history.scan_of[tree.query_ball_point(place[:2], 1.3 * gate)].tolist()) | in_wide
        centre_m = np.linalg.norm((bases[members] - history.t_map_vehicle[scans])[:, :2], axis=1)
        slack = 0.5 * gate + float(np.linalg.norm(history.t_vehicle_lidar[:2]))
        ranges = (float(centre_m.min()) - slack, float(centre_m.max()) + slack)
        shows = history.should_show(place, ranges, alignment, gate)
        missed = set(np.flatnonzero(shows).tolist()) - met
        baseline = float(np.ptp(history.t_map_vehicle[scans][:, :2], axis=0).max())
        presence = len(scans) / (len(scans) + len(missed))
        good = members[history.points[members] >= config.extraction.min_points]
        judged = good if len(good) >= MIN_VIEWS else members
        # Range noise widens what it is measured on.
        noise_m = 2.0 * config.noise.lidar_range_m
        extent = max(float(np.quantile(history.extent_m[judged], 0.8)) - noise_m, 0.01)
        height, known = _height(history, judged)
        bottoms = history.bottom_m[judged]
        bottom = float(np.nanquantile(bottoms, 0.2)) if np.isfinite(bottoms).any() else math.nan
        scatter = float(np.quantile(np.linalg.norm((bases[judged] - place)[:, :2], axis=1), 0.75))
        stays = scatter <= SCATTER_M + SCATTER_PER_EXTENT * extent and presence >= PRESENT
        # What rides on the vehicle stays at a place for as long as the vehicle does.
        rides = baseline < 3.0 * gate < 0.5 * travelled
        verdict = ""
        if rides or not stays:
            verdict = "moving or seldom there"
        elif len(in_wide) > 0.5 * len(scans):
            verdict = "part of something wide"
        elif extent < MIN_EXTENT_M:
            verdict = f"under {MIN_EXTENT_M:.1f} m wide"
        elif extent > MAX_EXTENT_M:
            verdict = f"over {MAX_EXTENT_M:.1f} m wide"
        elif height > MAX_HEIGHT_M:
            verdict = "over 2 m high"
        elif height < MIN_HEIGHT_M:
            verdict = f"under {MIN_HEIGHT_M:.1f} m high"
        elif not bottom <= MAX_BOTTOM_M:
            verdict = "not standing on the ground"
        elif len(good) < 2 or len(good) * history.stride < config.extraction.min_scans:
            verdict = "with too few points"
        out.append(
            _Thing(
                lidar=history.name,
                place=place,
                gate_m=_wander_m(history.name, float(np.quantile(centre_m, 0.3)), config),
                extent_m=extent,
                height_m=height,
                height_known=known,
                views=len(members),
                good=len(good),
                score=_score(history, good, place),
                verdict=verdict,
            )
        )
    return out


def _height(history: _History, members: IntArray) -> tuple[float, bool]:
    """Height of an object above ground, and whether the LiDAR ever saw its top.

    A top that the field of view cuts off is a lower bound.
    """
    tops, cut = history.top_m[members], history.top_cut[members]
    known = np.isfinite(tops)
    if not known.any():
        return math.nan, False
    bound = float(np.quantile(tops[known], 0.8))
    whole = tops[known & ~cut]
    return max(bound, float(np.quantile(whole, 0.8)) if len(whole) else 0.0), len(whole) >= 2


def _score(history: _History, good: IntArray, place: Array) -> float:
    """How well a LiDAR sees an object: scans, their points, and from how many sides."""
    if not len(good):
        return 0.0
    views = np.minimum(history.points[good] / FULL_POINTS, 1.0).sum() * history.stride
    offset = history.t_map_vehicle[history.scan_of[good]][:, :2] - place[:2]
    bearing = np.sort(np.arctan2(offset[:, 1], offset[:, 0]))
    gaps = np.diff(np.append(bearing, bearing[0] + 2.0 * math.pi))
    span = 2.0 * math.pi - float(gaps.max())
    return float(views) * (0.2 + min(span / math.pi, 1.0))


def _wander_m(lidar: str, range_m: float, config: Config) -> float:
    """How far the guess of a LiDAR may displace what it sees at `range_m`."""
    if config.lidars[lidar].fixed:
        return 0.1
    sigma = config.lidars[lidar].sigma
    return 0.1 + 2.0 * (max(sigma.xyz_m()) + max(sigma.rpy_rad()) * range_m)


# ------------------------------------------------------------------ all LiDARs of a drive


@dataclass(frozen=True)
class _Candidate:
    """One object, as the LiDARs that see it describe it; `things` by LiDAR."""

    things: Mapping[str, _Thing]

    @property
    def place(self) -> Array:
        """(3,) metres, map: the mean, LiDARs counting by how well they know it."""
        weights = [thing.gate_m**-2.0 for thing in self.things.values()]
        return np.average([t.place for t in self.things.values()], axis=0, weights=weights)

    @property
    def extent_m(self) -> float:
        return max(thing.extent_m for thing in self.things.values())

    @property
    def height_m(self) -> float:
        """As seen by those that see the top."""
        known = [thing.height_m for thing in self.things.values() if thing.height_known]
        return max(known) if known else math.nan

    def rank(self) -> tuple[int, float]:
        """LiDARs that see it, and how well the worst of them does."""
        scores = [thing.score for thing in self.things.values()]
        return len(scores), min(scores)

    def __str__(self) -> str:
        x, y, _ = self.place
        return (
            f"({x:.1f}, {y:.1f}) {self.extent_m:.1f} m wide {self.height_m:.1f} m high seen by "
            f"{', '.join(self.things)}"
        )


def _put_together(things: Sequence[_Thing]) -> list[_Candidate]:
    """Objects of several LiDARs, matched by place and size; the best seen first choose."""
    left = sorted(things, key=lambda thing: -thing.score)
    out = []
    while left:
        first = left.pop(0)
        group = {first.lidar: first}
        for lidar in {thing.lidar for thing in left} - {first.lidar}:
            options = [
                (c, t) for t in left if t.lidar == lidar and (c := _mismatch(first, t)) < 1.0
            ]
            if options:
                group[lidar] = min(options, key=lambda option: option[0])[1]
                left = [thing for thing in left if thing is not group[lidar]]
        out.append(_Candidate(group))
    return out


def _mismatch(a: _Thing, b: _Thing) -> float:
    """How much speaks against two LiDARs seeing the same object; from 1 on it is another one."""
    off = float(np.linalg.norm((a.place - b.place)[:2])) / (a.gate_m + b.gate_m)
    # Each sees another side of it: sizes agree only roughly.
    size = abs(math.log(a.extent_m / b.extent_m)) / math.log(3.0)
    tall = 0.0
    if a.height_known and b.height_known:
        tall = abs(a.height_m - b.height_m) / 0.8
    return max(off, size, tall)


def _target_of_drive(
    drive: int, name: str, histories: Sequence[_History], config: Config
) -> FoundTarget:
    alignments = {history.name: _align(history, config) for history in histories}
    things = [t for h in histories for t in _things(h, alignments[h.name], config)]
    usable = _put_together([thing for thing in things if not thing.verdict])
    candidates = [c for c in usable if math.isfinite(c.height_m)]
    if not candidates:
        raise TargetError(_complaint(name, histories, things, len(usable)))
    candidates.sort(key=_Candidate.rank, reverse=True)
    best = candidates[0]
    return FoundTarget(
        drive=drive,
        region=_region(best),
        centre_map=best.place + np.array([0.0, 0.0, 0.5 * best.height_m]),
        extent_m=best.extent_m,
        height_m=best.height_m,
        scans={h.name: best.things[h.name].good if h.name in best.things else 0 for h in histories},
        looked_at={h.name: len(h.scans) for h in histories},
        aligned={h.name: h.aligned(alignments[h.name]) for h in histories},
        others=tuple(str(candidate) for candidate in candidates[1:]),
    )


def _region(target: _Candidate) -> TargetRegion:
    """A box around the target."""
    around = 0.5 * target.extent_m + REGION_MARGIN_M
    reach = np.array([around, around, REGION_MARGIN_M])
    top = target.place + np.array([0.0, 0.0, target.height_m])
    return TargetRegion(min=_triple(target.place - reach), max=_triple(top + reach))


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 3) for value in values)
    return x, y, z


def _complaint(
    name: str, histories: Sequence[_History], things: Sequence[_Thing], without_top: int
) -> str:
    """Why a drive shows no target, in one line."""
    scans = ", ".join(f"{len(h.scans)} of '{h.name}'" for h in histories)
    blind = [f"'{h.name}'" for h in histories if not any(s.has_ground for s in h.scans)]
    found = []
    reasons = Counter(thing.verdict for thing in things if thing.verdict)
    for verdict, count in reasons.most_common():
        widths = [thing.extent_m for thing in things if thing.verdict == verdict]
        found.append(f"{count} {verdict} ({min(widths):.1f} to {max(widths):.1f} m wide)")
    if without_top:
        found.append(f"{without_top} whose top is never in view")
    wide = sum(int((h.extent_m >= WIDE_M).sum()) for h in histories)
    if wide:
        found.append(f"wider ones {wide} times")
    sight = f"; no ground in any scan of {', '.join(blind)}" if blind else ""
    return (
        f"{name}: target: none found in {scans} scans: needs a static object on the ground, "
        f"0.3 to {MAX_EXTENT_M} m wide, at most 2 m high, seen well in several scans. Seen: "
        f"{', '.join(found) or 'nothing above the ground'}{sight}. "
        "Add target: {min: [x, y, z], max: [x, y, z]} in metres, frame map, to the config"
    )
