"""Several objects in one region: told apart per LiDAR, and matched between LiDARs.

The guesses of two LiDARs displace the same object by decimetres at 10 m: which object of one is
which of the other, their arrangement tells better than any single place. One error of each guess
must explain all displacements at once, and it is small by its sigma. Where another matching
explains the places about as well, none is used: the LiDARs then share no object.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from caliv_graph.products import Array, IntArray
from caliv_graph.targets.cloud.groups import MAX_EXTENT_M, extent_m
from caliv_graph.targets.cloud.region import MIN_EXTENT_M, Candidate, RegionExtractor
from caliv_graph.targets.cloud.track import PLACE_SIGMA_M, CandidateSet

PART_OF_SCANS = 0.5
"""An object beside another is static if it is seen in at least this part of the scans that see the
other: somebody who stops for a while is not."""

PART_OF_DRIVE = 0.25
"""What is seen whole counts before what the region cuts off if it is seen over at least this part
of the scans that the object seen most often has: somebody who stops before a wall is not."""

APART_M = 0.2
"""Minimum horizontal gap between two objects, as wide as the thinnest of them: what is nearer, or
above, is a part of the same object that the clustering split off."""

TOGETHER_M = 0.5
"""Largest horizontal gap between static objects that are one target, if that is not wider than a
target: a group of cones, two boxes. Each cone by itself is symmetric, and LiDARs whose guesses are
off by as much as the gap take one for the other. A scan that shows only a part of them shows a
part of a target that is hidden."""

COMPARED_SCANS = 5
"""Scans in which the gap between two objects is measured; the median counts."""

MOST_OBJECTS = 6
"""Objects of a LiDAR that are matched at most."""

VIEWS_OF_A_TRACK = 4.0
"""Independent observations of an object's place that a track has at most: the middle of its visible
points is off in the same way in all scans from one side."""

OF_EXTENT = 0.25
"""Sigma of an object's place as part of its extent: LiDARs on two sides of it see two surfaces."""

UNMATCHED = 6.0
"""Cost of an object that only one of two LiDARs sees, in squared sigmas: probability 5 %. A pair is
matched up to twice this, which 99 % of the pairs of one object keep."""

AMBIGUOUS = 9.0
"""A matching is ambiguous if another one costs less than this more: 3 sigmas, a likelihood ratio of
90."""

UNSEEN = 3.0
"""Cost of an object that only one of two LiDARs sees where doubts are concerned: probability 20 %.
LiDARs with different fields of view miss an object more often than by occlusion."""


DIFFERENT = 30.0
"""Squared sigmas, 5.5 sigmas of one axis, from which two LiDARs that see one object each see two
different ones: an initial guess may be wrong by more than its sigma says, and a result that
contradicts it by more than 5 sigmas is reported as inconsistent."""


@dataclass(frozen=True)
class LidarObjects:
    """The static objects that one LiDAR sees in a region and beside it.

    Attributes:
        lidar: name of the LiDAR.
        scans: scans with any candidate.
        candidates: of each of the k objects, one per scan; first the one that is seen most.
        places: (k, 3) metres, region frame, at the most probable error of the guess.
        cov: (3k, 3k) of the places, m^2: the guess, and what the LiDAR sees of an object.
    """

    lidar: str
    scans: int
    candidates: tuple[tuple[Candidate, ...], ...]
    places: Array
    cov: Array


@dataclass(frozen=True)
class SharedObject:
    """An object in a region.

    Attributes:
        place: (3,) metres, region frame, mean over the LiDARs.
        seen: LiDAR -> index of the object among those of the LiDAR.
    """

    place: Array
    seen: Mapping[str, int]


@dataclass(frozen=True)
class Constellation:
    """The objects of all LiDARs.

    Attributes:
        objects: each with the LiDARs that see it.
        ambiguous: pairs of LiDARs of which no object could be matched without doubt.
    """

    objects: tuple[SharedObject, ...]
    ambiguous: tuple[tuple[str, str], ...]


def static_objects(
    extractor: RegionExtractor, found: Sequence[Sequence[Candidate]], lidar: str, fewest: int
) -> LidarObjects | None:
    """The static objects among the candidates of a LiDAR's scans; None without any.

    Every object has at least `fewest` scans. What the widened region cuts off is none, unless there
    is nothing else.
    """
    scans = [candidates for candidates in found if candidates]
    if not scans:
        return None
    flat, candidate_set = extractor.candidate_set(scans, lidar)
    tracks = candidate_set.tracks(fewest)
    groups = _standing_together(tracks, flat, candidate_set, fewest)
    if len(groups) < len(tracks):
        numbers = [number for number in range(len(scans)) if any(number in g for g in groups)]
        objects = [[k for k, g in enumerate(groups) if number in g] for number in numbers]
        joined = [[groups[k][n] for k in of] for n, of in zip(numbers, objects, strict=True)]
        flat, candidate_set = extractor.candidate_set(joined, lidar)
        of_group = np.concatenate([np.array(of, np.int64) for of in objects])
        tracks = [np.flatnonzero(of_group == k) for k in range(len(groups))]
    tracks = _whole(tracks, flat, candidate_set)
    kept = tracks[:1]
    for track in tracks[1:]:
        if all(_is_another(track, other, flat, candidate_set, fewest) for other in kept):
            kept.append(track)
    whole = [track for track in kept if not _is_cut_off(track, flat)]
    kept = (whole or kept)[:MOST_OBJECTS]
    if not kept:
        return None
    places, cov = _places(candidate_set, kept, flat)
    candidates = tuple(tuple(flat[n] for n in track.tolist()) for track in kept)
    return LidarObjects(lidar, len(scans), candidates, places, cov)


def _standing_together(
    tracks: Sequence[IntArray], flat: Sequence[Candidate], seen: CandidateSet, fewest: int
) -> list[dict[int, Candidate]]:
    """The objects, as a candidate per scan, with those that stand together joined."""
    groups: list[dict[int, Candidate]] = []
    for track in tracks:
        part = {int(seen.scan[n]): flat[n] for n in track.tolist()}
        for group in groups:
            if _are_together(group, part, fewest):
                for scan, candidate in part.items():
                    group[scan] = group[scan].joined(candidate) if scan in group else candidate
                break
        else:
            groups.append(part)
    return groups


def _are_together(
    one: Mapping[int, Candidate], other: Mapping[int, Candidate], fewest: int
) -> bool:
    """Whether two static objects, a candidate per scan, are parts of one target.

    Where a LiDAR is farther away it sees them as one, so that it sees them apart in some scans
    only; but not in a row, as it sees somebody who stops there.
    """
    at_once = sorted(one.keys() & other.keys())
    if len(at_once) < max(fewest, 1) or np.ptp(at_once) < PART_OF_SCANS * len(one) - 1:
        return False
    some = np.unique(np.linspace(0, len(at_once) - 1, COMPARED_SCANS).round().astype(int))
    pairs = [(one[at_once[n]], other[at_once[n]]) for n in some.tolist()]
    gap_m = np.median([_gap_m(a, b) for a, b in pairs])
    extent = np.median([extent_m(np.vstack([a.points_region, b.points_region])) for a, b in pairs])
    return bool(gap_m < TOGETHER_M and extent < MAX_EXTENT_M)


def _whole(tracks: list[IntArray], flat: Sequence[Candidate], seen: CandidateSet) -> list[IntArray]:
    """The tracks that the region does not cut off; all of them if none counts.

    First of all: the wall behind a target is seen in scans in which the target is not. One counts
    that has the height of a target and stands there for a good part of the drive.
    """
    whole = [track for track in tracks if not _is_cut_off(track, flat)]
    longest = max((len(track) for track in tracks), default=0)
    for track in whole:
        lasts = np.ptp(seen.scan[track]) >= PART_OF_DRIVE * longest - 1
        if lasts and _is_high(track, flat):
            return whole
    return tracks


def _is_high(track: IntArray, flat: Sequence[Candidate]) -> bool:
    """Whether a track is of something of a target's height."""
    return float(np.median([flat[n].top_m for n in track.tolist()])) >= MIN_EXTENT_M


def _is_cut_off(track: IntArray, flat: Sequence[Candidate]) -> bool:
    """Whether the widened region cuts an object off in most scans."""
    some = track[np.linspace(0, len(track) - 1, COMPARED_SCANS).round().astype(int)]
    return bool(np.median([flat[n].is_cut_off for n in some.tolist()]) > 0.5)


def _is_another(
    track: IntArray, other: IntArray, flat: Sequence[Candidate], seen: CandidateSet, fewest: int
) -> bool:
    """Whether a track is of a static object of a target's height, apart from that of another."""
    if not _is_high(track, flat):
        return False
    at_once, of_track, of_other = np.intersect1d(
        seen.scan[track], seen.scan[other], return_indices=True
    )
    if len(at_once) < max(fewest, PART_OF_SCANS * len(other)):
        return False
    some = np.unique(np.linspace(0, len(at_once) - 1, COMPARED_SCANS).round().astype(int))
    pairs = zip(track[of_track[some]].tolist(), other[of_other[some]].tolist(), strict=True)
    return float(np.median([_gap_m(flat[a], flat[b]) for a, b in pairs])) > APART_M


def _gap_m(a: Candidate, b: Candidate) -> float:
    """Smallest horizontal distance between the points of two candidates of a scan, metres."""
    distances, _ = cKDTree(a.points_region[:, :2]).query(b.points_region[:, :2])
    return float(np.min(distances))


def _places(
    seen: CandidateSet, tracks: Sequence[IntArray], flat: Sequence[Candidate]
) -> tuple[Array, Array]:
    """Places (k, 3) and their covariance (3k, 3k): one error of the guess moves all objects."""
    count = 3 * len(tracks)
    information = np.zeros((count + 6, count + 6))
    information[count:, count:] = np.diag(seen.prior**-2)
    right = np.zeros(count + 6)
    width_m = np.zeros(len(tracks))
    for k, track in enumerate(tracks):
        weight = min(len(track), VIEWS_OF_A_TRACK) / len(track) / PLACE_SIGMA_M**2
        rows = np.zeros((3 * len(track), count + 6))
        rows[:, 3 * k : 3 * k + 3] = np.tile(np.eye(3), (len(track), 1))
        rows[:, count:] = -seen.moves[track].reshape(-1, 6)
        information += weight * rows.T @ rows
        right += weight * rows.T @ seen.places[track].ravel()
        width_m[k] = np.median([_extent_m(flat[n]) for n in track.tolist()])
    cov = np.linalg.inv(information)
    places = (cov @ right)[:count].reshape(-1, 3)
    side = np.repeat((OF_EXTENT * width_m) ** 2, 3)
    return places, np.asarray(cov[:count, :count] + np.diag(side))


def _extent_m(candidate: Candidate) -> float:
    """Largest extent of a candidate along the axes of its LiDAR, metres."""
    return float(np.ptp(candidate.cloud.points_lidar, axis=0).max())


def one_object(lidars: Sequence[LidarObjects]) -> bool:
    """Whether all LiDARs see one and the same object, as far as their guesses can say."""
    if any(len(seen.places) != 1 for seen in lidars):
        return False
    return all(
        _misfit(((0, 0),), a.places, a.cov, b.places, b.cov) < DIFFERENT
        for a, b in itertools.combinations(lidars, 2)
    )


def match_objects(lidars: Sequence[LidarObjects]) -> Constellation:
    """Matches the objects of all LiDARs, LiDAR by LiDAR; first the one that sees the most."""
    if not lidars:
        return Constellation((), ())
    first, *others = sorted(lidars, key=lambda seen: -len(seen.places))
    objects = [SharedObject(p, {first.lidar: i}) for i, p in enumerate(first.places)]
    alone: list[SharedObject] = []
    ambiguous = []
    places, cov = first.places, first.cov
    for seen in others:
        pairs, doubt = _best_matching(places, cov, seen.places, seen.cov)
        if doubt:
            ambiguous.append((first.lidar, seen.lidar))
            alone += [SharedObject(p, {seen.lidar: i}) for i, p in enumerate(seen.places)]
            continue
        partner = dict(pairs)
        objects = [
            replace(o, seen={**o.seen, seen.lidar: partner[m]}) if m in partner else o
            for m, o in enumerate(objects)
        ]
        new = [i for i in range(len(seen.places)) if i not in partner.values()]
        objects += [SharedObject(seen.places[i], {seen.lidar: i}) for i in new]
        places, cov = _with(places, cov, seen, new)
    by_name = {seen.lidar: seen for seen in lidars}
    return Constellation(
        tuple(replace(o, place=_mean_place(o, by_name)) for o in [*objects, *alone]),
        tuple(ambiguous),
    )


def _with(places: Array, cov: Array, seen: LidarObjects, new: Sequence[int]) -> tuple[Array, Array]:
    """Places and covariance of known objects and of those that a further LiDAR sees alone."""
    if not new:
        return places, cov
    at = _coordinates(new)
    known = len(cov)
    out = np.zeros((known + len(at), known + len(at)))
    out[:known, :known] = cov
    out[known:, known:] = seen.cov[np.ix_(at, at)]
    return np.vstack([places, seen.places[list(new)]]), out


def _mean_place(shared: SharedObject, lidars: Mapping[str, LidarObjects]) -> Array:
    return np.asarray(np.mean([lidars[n].places[i] for n, i in shared.seen.items()], axis=0))


def _best_matching(
    places_a: Array, cov_a: Array, places_b: Array, cov_b: Array
) -> tuple[tuple[tuple[int, int], ...], bool]:
    """The cheapest matching of objects a and b, and whether another one is about as cheap."""
    count = len(places_a) + len(places_b)
    misfits = _plausible_matchings(places_a, cov_a, places_b, cov_b)
    best = min(misfits, key=lambda pairs: misfits[pairs] + UNMATCHED * (count - 2 * len(pairs)))
    limit = misfits[best] + UNSEEN * (count - 2 * len(best)) + AMBIGUOUS
    return best, any(
        misfit + UNSEEN * (count - 2 * len(pairs)) < limit and _contradict(pairs, best)
        for pairs, misfit in misfits.items()
    )


def _misfit(
    pairs: Sequence[tuple[int, int]], places_a: Array, cov_a: Array, places_b: Array, cov_b: Array
) -> float:
    """Squared sigmas of the displacements of a matching."""
    if not pairs:
        return 0.0
    of_a, of_b = [a for a, _ in pairs], [b for _, b in pairs]
    at_a, at_b = _coordinates(of_a), _coordinates(of_b)
    apart = (places_a[of_a] - places_b[of_b]).ravel()
    cov = cov_a[np.ix_(at_a, at_a)] + cov_b[np.ix_(at_b, at_b)]
    return float(apart @ np.linalg.solve(cov, apart))


def _coordinates(objects: Sequence[int]) -> IntArray:
    """Indices of the coordinates of these objects among those of all."""
    return (3 * np.array(objects, dtype=np.int64)[:, None] + np.arange(3)).ravel()


def _plausible_matchings(
    places_a: Array, cov_a: Array, places_b: Array, cov_b: Array
) -> dict[tuple[tuple[int, int], ...], float]:
    """Matchings, each object in one pair at most, with their misfit; none that cannot count.

    The best one costs no more than none, and a rival at most `AMBIGUOUS` more. A pair more never
    lowers the misfit: where it is too large, so it is in all matchings with these pairs. There are
    millions of matchings where each of several LiDARs sees objects of its own.
    """
    most = 2.0 * UNMATCHED * min(len(places_a), len(places_b)) + AMBIGUOUS
    found: dict[tuple[tuple[int, int], ...], float] = {}
    alone = np.array(
        [
            [_misfit(((a, b),), places_a, cov_a, places_b, cov_b) for b in range(len(places_b))]
            for a in range(len(places_a))
        ]
    )

    def extend(pairs: tuple[tuple[int, int], ...], misfit: float) -> None:
        found[pairs] = misfit
        first = pairs[-1][0] + 1 if pairs else 0
        taken = {b for _, b in pairs}
        for a, b in itertools.product(range(first, len(places_a)), range(len(places_b))):
            if b in taken or alone[a, b] > most:
                continue
            more = (*pairs, (a, b))
            misfit = _misfit(more, places_a, cov_a, places_b, cov_b)
            if misfit <= most:
                extend(more, misfit)

    extend((), 0.0)
    return found


def _contradict(pairs: Sequence[tuple[int, int]], best: Sequence[tuple[int, int]]) -> bool:
    """Whether an object has another partner in one matching than in the other."""
    by_a, by_b = dict(best), {b: a for a, b in best}
    return any(by_a.get(a, b) != b or by_b.get(b, a) != a for a, b in pairs)
