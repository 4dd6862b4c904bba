"""Places of a target that somebody moves while the vehicle stands.

Every place is a placement of its own, independent of the others; one that two LiDARs see makes S2S
observable. A static object has one place in the *LiDAR's* frame while the vehicle stands: neither
guess nor pose is needed to find the times at which it stood.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.trajectory.select import VehicleTrajectory

VEHICLE_STANDS_M = 0.15
VEHICLE_STANDS_RAD = 0.02
"""A vehicle that moved less than this stands: its poses drift by centimetres and milliradians."""

STAYS_M = 0.15
"""An object within this of its mean place stands: the middle of a target's visible points scatters
by centimetres, and somebody who walks has left in two scans."""

STAYS_NS = 2_000_000_000
"""Minimum duration of a stay. Nobody who carries a chair stops for two seconds."""

GAP_NS = 1_000_000_000
"""Maximum gap in a stay: somebody who passes in front occludes the target for less."""

SETTLES_NS = 300_000_000
"""Time removed at either end of a stay, when somebody holds the target."""

SAME_PLACE_M = 0.05
"""An object that reappears within this of its place has not been moved."""


@dataclass(frozen=True)
class CandidateCentres:
    """Centres (n, 3) of the candidates of one LiDAR in a region, metres, lidar frame.

    `stamps_ns` (n,), ascending, are the scans of the candidates.
    """

    stamps_ns: IntArray
    centres_lidar: Array


@dataclass(frozen=True)
class Stay:
    """An object that stood for a while.

    Attributes:
        begin_ns: stamp of the first of its scans.
        end_ns: stamp of the last.
        place_lidar: (3,) metres, its place in the lidar frame.
        members: (m,) indices of the LiDAR's candidates, one per scan.
    """

    begin_ns: int
    end_ns: int
    place_lidar: Array
    members: IntArray


@dataclass(frozen=True)
class Period:
    """A time during which the target stood at one place.

    Attributes:
        begin_ns: it was put there after this.
        end_ns: it was picked up before this.
        members: per LiDAR (m,) indices of its candidates: those that may be the target in scans
            while the vehicle stood, all in scans while it drove.
        drove: whether the vehicle drove in this time.
    """

    begin_ns: int
    end_ns: int
    members: Mapping[str, IntArray]
    drove: bool


def periods(
    candidates: Mapping[str, CandidateCentres], trajectory: VehicleTrajectory, fewest: int
) -> list[Period]:
    """The times between moves of the target; empty if it was not moved.

    Moves are searched while the vehicle stands; a stay has at least `fewest` scans.
    """
    stamps = np.unique(np.concatenate([s.stamps_ns for s in candidates.values()]))
    if not len(stamps):
        return []
    cuts: list[int] = []
    stays: dict[str, list[Stay]] = {name: [] for name in candidates}
    standing: list[tuple[int, int]] = []
    for begin, end in _standstills(stamps, trajectory):
        of_spell = {name: _stays(seen, begin, end, fewest) for name, seen in candidates.items()}
        found = _cuts([stay for one in of_spell.values() for stay in one])
        if found:
            cuts += found
            standing.append((begin, end))
            for name, own in of_spell.items():
                stays[name] += own
    if not cuts:
        return []
    edges = [int(stamps[0]) - 1, *sorted(cuts), int(stamps[-1]) + 1]
    return [
        Period(
            begin,
            end,
            {n: _members(s, stays[n], standing, begin, end) for n, s in candidates.items()},
            drove=_outside(stamps[(stamps > begin) & (stamps < end)], standing).any().item(),
        )
        for begin, end in itertools.pairwise(edges)
    ]


def _members(
    seen: CandidateCentres,
    stays: Sequence[Stay],
    standing: Sequence[tuple[int, int]],
    begin_ns: int,
    end_ns: int,
) -> IntArray:
    """CandidateCentres of a period: of stays while the vehicle stood, all while it drove."""
    within = (seen.stamps_ns > begin_ns) & (seen.stamps_ns < end_ns)
    kept = within & _outside(seen.stamps_ns, standing)
    for stay in stays:
        kept[stay.members[within[stay.members]]] = True
    return np.flatnonzero(kept)


def _outside(stamps_ns: IntArray, standing: Sequence[tuple[int, int]]) -> BoolArray:
    """(n,) which stamps are not within the times at which the vehicle stood."""
    out = np.ones(len(stamps_ns), dtype=bool)
    for first, last in standing:
        out &= (stamps_ns < first) | (stamps_ns > last)
    return out


def _standstills(stamps_ns: IntArray, trajectory: VehicleTrajectory) -> Iterator[tuple[int, int]]:
    """First and last stamp of each time the vehicle stands, if two stays fit in."""
    R, t = trajectory.poses_at(stamps_ns.tolist())
    begin = 0
    for i in range(1, len(stamps_ns) + 1):
        if i < len(stamps_ns):
            cosine = 0.5 * (float(np.trace(R[begin].T @ R[i])) - 1.0)
            turned = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
            if np.linalg.norm(t[i] - t[begin]) < VEHICLE_STANDS_M and turned < VEHICLE_STANDS_RAD:
                continue
        if stamps_ns[i - 1] - stamps_ns[begin] >= 2 * STAYS_NS:
            yield int(stamps_ns[begin]), int(stamps_ns[i - 1])
        begin = i


@dataclass
class _Open:
    """A stay that may go on."""

    total: Array
    members: list[int]
    begin_ns: int
    last_ns: int

    @property
    def place(self) -> Array:
        return np.asarray(self.total / len(self.members))


def _stays(seen: CandidateCentres, begin_ns: int, end_ns: int, fewest: int) -> list[Stay]:
    """Stays within a time, in order, no two at once: those that were seen the most."""
    of_spell = np.flatnonzero((seen.stamps_ns >= begin_ns) & (seen.stamps_ns <= end_ns))
    running: list[_Open] = []
    done: list[_Open] = []
    for stamp in np.unique(seen.stamps_ns[of_spell]).tolist():
        done += [stay for stay in running if stamp - stay.last_ns > GAP_NS]
        running = [stay for stay in running if stamp - stay.last_ns <= GAP_NS]
        first, last = np.searchsorted(seen.stamps_ns, [stamp, stamp + 1])
        free = list(range(int(first), int(last)))
        # The longest stay chooses first: somebody who passes does not draw it off.
        for stay in sorted(running, key=lambda stay: -len(stay.members)):
            off = [float(np.linalg.norm(seen.centres_lidar[i] - stay.place)) for i in free]
            if off and min(off) < STAYS_M:
                nearest = free.pop(int(np.argmin(off)))
                stay.total = stay.total + seen.centres_lidar[nearest]
                stay.members.append(nearest)
                stay.last_ns = stamp
        running += [_Open(seen.centres_lidar[i].copy(), [i], stamp, stamp) for i in free]
    long = [
        Stay(stay.begin_ns, stay.last_ns, stay.place, np.array(stay.members))
        for stay in done + running
        if stay.last_ns - stay.begin_ns >= STAYS_NS and len(stay.members) >= fewest
    ]
    return [_settled(seen, stay) for stay in _seen_again(_one_at_a_time(long))]


def _one_at_a_time(stays: Sequence[Stay]) -> list[Stay]:
    """Those stays, no two at once, that were seen in the most scans (weighted intervals)."""
    ordered = sorted(stays, key=lambda stay: stay.end_ns)
    ends = [stay.end_ns for stay in ordered]
    best: list[tuple[int, list[Stay]]] = [(0, [])]
    for i, stay in enumerate(ordered):
        before = int(np.searchsorted(ends[:i], stay.begin_ns))
        count, chain = best[before]
        best.append(max((count + len(stay.members), [*chain, stay]), best[i], key=lambda b: b[0]))
    return best[-1][1]


def _seen_again(stays: Sequence[Stay]) -> list[Stay]:
    """Merges successive stays at one place: the target was occluded in between."""
    out: list[Stay] = []
    for stay in stays:
        if out and np.linalg.norm(stay.place_lidar - out[-1].place_lidar) < SAME_PLACE_M:
            members = np.concatenate([out[-1].members, stay.members])
            out[-1] = Stay(out[-1].begin_ns, stay.end_ns, out[-1].place_lidar, members)
        else:
            out.append(stay)
    return out


def _settled(seen: CandidateCentres, stay: Stay) -> Stay:
    """A stay without its ends, when somebody may hold the target."""
    begin, end = stay.begin_ns + SETTLES_NS, stay.end_ns - SETTLES_NS
    stamps = seen.stamps_ns[stay.members]
    members = stay.members[(stamps >= begin) & (stamps <= end)]
    return Stay(begin, end, stay.place_lidar, members)


def _cuts(stays: Sequence[Stay]) -> list[int]:
    """The fewest times that separate all stays that do not overlap: those are at two places."""
    between = [
        (before.end_ns, after.begin_ns)
        for before in stays
        for after in stays
        if before.end_ns < after.begin_ns
    ]
    out: list[int] = []
    left = sorted(between, key=lambda gap: gap[1])
    while left:
        at_once = [gap for gap in left if gap[0] < left[0][1]]
        out.append((max(gap[0] for gap in at_once) + left[0][1]) // 2)
        left = [gap for gap in left if not gap[0] <= out[-1] <= gap[1]]
    return out
