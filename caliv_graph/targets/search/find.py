"""The search itself: which scans are read, and which object of a drive is its target."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from caliv_graph.common.progress import Advance, Progress
from caliv_graph.config.model import Config, TargetRegion
from caliv_graph.errors import TargetError
from caliv_graph.products import Array, IntArray, Recording
from caliv_graph.targets.search.align import (
    FAR_PAIRS,
    FAR_RATIO,
    GUESS_SIGMAS,
    align,
    align_anywhere,
    concentration,
    gate_m,
    tracks_at_places,
)
from caliv_graph.targets.search.history import Alignment, LidarHistory
from caliv_graph.targets.search.level import levelled
from caliv_graph.targets.search.objects import WIDE_M, segment_scan
from caliv_graph.targets.search.tracks import (
    MAX_EXTENT_M,
    MOVING,
    Proposal,
    Track,
    judged_tracks,
    matched,
)
from caliv_graph.trajectory.deskew import deskew
from caliv_graph.trajectory.select import VehicleTrajectory

SCANS = 60
"""Scans of one LiDAR that are read in a short drive."""

PERIOD_S = 1.0
"""Longest time between two of them: a vehicle at 10 m/s passes a target in a few seconds."""

MAX_SCANS = 240
"""Scans of one LiDAR that are read at most, however long the drive is."""

LEVEL_SCANS = 5
"""Scans whose ground shows a tilt of the guess: the first, under which the ground is one plane."""

STANDS_M = 0.2
STANDS_RAD = math.radians(2.0)
"""Motion of the vehicle since the last scan below which a scan shows nothing new."""

STANDING_PERIODS = 4
"""While the vehicle stands, every fourth scan is read: other objects move."""

FEWEST_PLACES = 2
"""Objects that must stand still under a guess far off for it to be taken."""

MOST_TRIED = 4
"""Candidates that are tried at most: each costs a registration of some of its clouds."""

SAME_PLACE_M = 0.7
"""Tracks whose places are nearer to each other than this are of one candidate: half of a target."""

REGION_MARGIN_M = 0.3
"""Margin of the region about the object on each side."""


@dataclass(frozen=True)
class FoundTarget:
    """The target of one drive.

    Attributes:
        drive: index of the drive.
        region: a tight box in the map about the object. The extraction allows for the errors of the
            guesses: a box that held the object as each guess places it would hold its neighbours.
        centre_map: (3,) metres, about its middle; as good as the guesses.
        extent_m: largest horizontal extent.
        height_m: above the ground.
        scans: per LiDAR, the number of read scans in which it was seen well; 0 for a LiDAR that
            does not see it.
        looked_at: per LiDAR, the number of scans that were read.
        aligned: per LiDAR, T_vehicle_lidar with corrected yaw and shift (`align`): better than the
            guess for associating objects, but no estimate.
        doubtful: in the scans that were read it scatters, or is missing, more than a static object.
        score: quality of the view.
        others: the other candidates, the best first.
        misplaced: LiDARs whose objects stand still only with a guess that is farther off than its
            sigma allows, and the correction; `aligned` has it.
    """

    drive: int
    region: TargetRegion
    centre_map: Array
    extent_m: float
    height_m: float
    scans: Mapping[str, int]
    looked_at: Mapping[str, int]
    aligned: Mapping[str, gtsam.Pose3]
    doubtful: bool = False
    score: float = 0.0
    others: tuple[FoundTarget, ...] = ()
    misplaced: Mapping[str, Alignment] = field(default_factory=dict)

    def __str__(self) -> str:
        x, y, _ = self.centre_map
        seen_by = ", ".join(name for name, scans in self.scans.items() if scans)
        return (
            f"({x:.1f}, {y:.1f}) {self.extent_m:.1f} m wide {self.height_m:.1f} m high seen by "
            f"{seen_by}"
        )


def find_target(
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
) -> list[FoundTarget]:
    """Finds the target of each drive, in their order; `progress` advances with every scan.

    Raises:
        TargetError: a drive shows no object that could be a target.
        RecordingError: a cloud could not be read.
    """
    stamps = [
        {name: scans_to_read(recording.scan_stamps_ns(name), trajectory) for name in config.lidars}
        for recording, trajectory in zip(recordings, trajectories, strict=True)
    ]
    total = sum(len(s) for drive in stamps for s in drive.values())
    out = []
    with progress.stage("finding the target", total) as advance:
        for drive, (recording, trajectory) in enumerate(zip(recordings, trajectories, strict=True)):
            histories = [
                _read_history(recording, trajectory, config, name, chosen, advance)
                for name, chosen in stamps[drive].items()
            ]
            out.append(_target_of_drive(drive, recording.name, histories, config))
    return out


def scans_to_read(stamps_ns: Sequence[int], trajectory: VehicleTrajectory) -> IntArray:
    """Stamps of the scans of a LiDAR to read: evenly in time, fewer while the vehicle stands."""
    begin, end = trajectory.span_ns
    lost = set(trajectory.lost_ns)
    stamps = np.array([s for s in stamps_ns if begin <= s <= end and s not in lost], np.int64)
    if len(stamps) < 2:
        return stamps
    duration_s = 1e-9 * float(stamps[-1] - stamps[0])
    period_s = max(min(PERIOD_S, duration_s / SCANS), duration_s / MAX_SCANS)
    slots = np.arange(0.0, duration_s + 0.5 * period_s, period_s)
    # A slot takes the next scan, with 1 ms for stamps that jitter about the slot.
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


def _read_history(
    recording: Recording,
    trajectory: VehicleTrajectory,
    config: Config,
    name: str,
    chosen: IntArray,
    advance: Advance,
) -> LidarHistory:
    """Reads and segments the chosen scans of one LiDAR."""
    lidar = config.lidars[name]
    guess = lidar.guess()
    scans, stamps = [], []
    read = recording.scans(name, wanted=set(chosen.tolist()))
    first = list(itertools.islice(read, LEVEL_SCANS))
    if first:
        R, _ = trajectory.poses_at([scan.stamp_ns for scan in first])
        guess = levelled([scan.points_lidar for scan in first], R, guess, name, config)
    for scan in itertools.chain(first, read):
        range_m = np.linalg.norm(scan.points_lidar, axis=1)
        points = deskew(scan, guess, trajectory).points_lidar
        points = points[(range_m >= lidar.min_range) & (range_m <= lidar.max_range)]
        R, _ = trajectory.poses_at([scan.stamp_ns])
        scans.append(segment_scan(points, R[0] @ guess.rotation().matrix()))
        stamps.append(scan.stamp_ns)
        advance()
    poses = trajectory.poses_at(stamps) if stamps else (np.zeros((0, 3, 3)), np.zeros((0, 3)))
    stride = len(recording.scan_stamps_ns(name)) / max(len(scans), 1)
    return LidarHistory(name, guess, scans, poses, stride)


def _target_of_drive(
    drive: int, name: str, histories: Sequence[LidarHistory], config: Config
) -> FoundTarget:
    """The best proposal of a drive, and the others."""
    alignments = {history.name: align(history, config) for history in histories}
    tracks, proposals = _proposals(histories, alignments, config)
    misplaced = {h.name: a for h in histories if (a := _elsewhere(h, alignments[h.name], config))}
    if misplaced:
        tried = {**alignments, **misplaced}
        other_tracks, others = _proposals(histories, tried, config)
        if others and (not proposals or len(others[0].tracks) >= len(proposals[0].tracks)):
            alignments, tracks, proposals = tried, other_tracks, others
        else:
            misplaced = {}
    for history in histories:
        if not history.guess.equals(config.lidars[history.name].guess(), 0.0):
            misplaced.setdefault(history.name, alignments[history.name])
    usable = [p for p in proposals if math.isfinite(p.height_m)]
    if not usable:
        raise TargetError(*_why_none(name, histories, tracks, len(proposals)))
    found = [_found(drive, p, histories, alignments) for p in usable[:MOST_TRIED]]
    return replace(found[0], others=tuple(found[1:]), misplaced=misplaced)


def _proposals(
    histories: Sequence[LidarHistory], alignments: Mapping[str, Alignment], config: Config
) -> tuple[list[Track], list[Proposal]]:
    """All tracks, and the candidates: those without a doubt first."""
    tracks = [t for h in histories for t in judged_tracks(h, alignments[h.name], config)]
    proposals = _ranked(matched([track for track in tracks if not track.verdict]))
    for doubtful in _ranked(matched([track for track in tracks if track.doubtful])):
        apart = [float(np.linalg.norm((doubtful.place - p.place)[:2])) for p in proposals]
        if min(apart, default=math.inf) > SAME_PLACE_M:
            proposals.append(doubtful)
    return tracks, proposals


def _elsewhere(history: LidarHistory, near: Alignment, config: Config) -> Alignment | None:
    """A correction beyond the guess's sigma under which much more stands still; None if none."""
    lidar = config.lidars[history.name]
    if lidar.fixed:
        return None
    far = align_anywhere(history, config)
    prior = np.array([lidar.sigma.rpy_rad()[2], *lidar.sigma.xyz_m()[:2]])
    if (np.abs([far.yaw_rad, *far.shift_m]) <= GUESS_SIGMAS * prior).all():
        return None
    least = FAR_RATIO * max(concentration(history, near), 0) + FAR_PAIRS
    if concentration(history, far) <= least:
        return None
    # Some yaw and shift make a single walker stand still.
    places = tracks_at_places(history, history.bases(far)[:, :2], gate_m(history, config))
    return far if len(places) >= FEWEST_PLACES else None


def _ranked(proposals: Sequence[Proposal]) -> list[Proposal]:
    """The best first; those whose top no LiDAR sees last."""
    return sorted(proposals, key=lambda p: (math.isfinite(p.height_m), p.rank()), reverse=True)


def _found(
    drive: int,
    proposal: Proposal,
    histories: Sequence[LidarHistory],
    alignments: Mapping[str, Alignment],
) -> FoundTarget:
    tracks = proposal.tracks
    return FoundTarget(
        drive=drive,
        region=_region(proposal),
        centre_map=proposal.place + np.array([0.0, 0.0, 0.5 * proposal.height_m]),
        extent_m=proposal.extent_m,
        height_m=proposal.height_m,
        scans={h.name: tracks[h.name].good if h.name in tracks else 0 for h in histories},
        looked_at={h.name: len(h.scans) for h in histories},
        aligned={h.name: h.aligned(alignments[h.name]) for h in histories},
        doubtful=any(track.doubtful for track in tracks.values()),
        score=proposal.rank()[1],
    )


def _region(target: Proposal) -> TargetRegion:
    """A box around the target, map frame."""
    around = 0.5 * target.extent_m + REGION_MARGIN_M
    reach = np.array([around, around, REGION_MARGIN_M])
    top = target.place + np.array([0.0, 0.0, target.height_m])
    return TargetRegion(min=_triple(target.place - reach), max=_triple(top + reach))


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 3) for value in values)
    return x, y, z


def _why_none(
    name: str, histories: Sequence[LidarHistory], tracks: Sequence[Track], without_top: int
) -> tuple[str, str]:
    """Why a drive shows no target, in one line; and what to do about it."""
    scans = ", ".join(f"{len(h.scans)} of '{h.name}'" for h in histories)
    blind = [f"'{h.name}'" for h in histories if not any(s.has_ground for s in h.scans)]
    found = []
    reasons = Counter(track.verdict for track in tracks if track.verdict)
    for verdict, count in reasons.most_common():
        widths = [track.extent_m for track in tracks if track.verdict == verdict]
        found.append(f"{count} {verdict} ({min(widths):.1f} to {max(widths):.1f} m wide)")
    if without_top:
        found.append(f"{without_top} whose top is never in view")
    wide = sum(int((h.extent_m >= WIDE_M).sum()) for h in histories)
    if wide:
        found.append(f"wider ones {wide} times")
    sight = f"; no ground in any scan of {', '.join(blind)}" if blind else ""
    moving = any(track.verdict == MOVING for track in tracks)
    what = (
        f"{name}: target: none found in {scans} scans: needs a static object on the ground, "
        f"0.3 to {MAX_EXTENT_M} m wide, at most 2 m high, seen well in several scans. Seen: "
        f"{', '.join(found) or 'nothing above the ground'}{sight}"
    )
    return what, _remedy(blind, bool(found), moving)


def _remedy(blind: Sequence[str], seen: bool, moving: bool) -> str:
    """What to do about it: a region helps only if something is there to be named."""
    if blind:
        return (
            f"Check initial of {', '.join(blind)} (roll, pitch and height: a LiDAR whose tilt is "
            "wrong sees no level ground), its topic, min_range and max_range"
        )
    if not seen:
        return "Drive past a chair, and check the topics, min_range and max_range of the LiDARs"
    if moving:
        return (
            "If one of them is the target: what makes a static object smear is an initial guess "
            "that is farther off than its sigma, stamps that are late, or poses that drift: check "
            "these with 'caliv-graph inspect'. If none stood still, drive past a chair, or give "
            "the box of what shall serve as target.min and target.max"
        )
    return (
        "Add target: {min: [x, y, z], max: [x, y, z]} in metres, frame map, to the config, about "
        "the object that shall serve; or drive past a chair"
    )
