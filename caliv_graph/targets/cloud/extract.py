"""The target's clouds of all drives: the stages of the extraction, and what is reported of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from caliv_graph.common.progress import Advance, Progress
from caliv_graph.config.model import Config, TargetRegion
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import TargetError
from caliv_graph.products import IntArray, Recording, TargetCloud, TargetObservation
from caliv_graph.targets.cloud.choice import Choose, TriedCandidate, first_candidate
from caliv_graph.targets.cloud.constellation import match_objects, one_object, static_objects
from caliv_graph.targets.cloud.moved import CandidateCentres, periods
from caliv_graph.targets.cloud.region import OUTSIDE_M, Candidate, RegionExtractor
from caliv_graph.targets.cloud.scans import ScanOrder, scans_to_decode
from caliv_graph.targets.cloud.tally import OTHER_REGION, Tally
from caliv_graph.targets.cloud.views import clouds_per_lidar
from caliv_graph.targets.search import FoundTarget, find_target
from caliv_graph.trajectory.select import VehicleTrajectory

REMEDY = f"{OTHER_REGION}; or check the initial guesses: run 'caliv-graph inspect' with the config"

SCANS_OF_A_PLACE = 10
"""Scans of each place of a target that is moved while the vehicle stands. All show the same spots
of it: more would average the noise but not the sampling by the beams."""


def extract_targets(
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
    choose: Choose = first_candidate,
    searched: Sequence[FoundTarget] = (),
) -> tuple[TargetObservation, ...]:
    """Reads every scan once and keeps the points of the targets (paper III-D.2).

    Scans outside the span of their drive's trajectory are left out, LiDARs that saw the target in
    fewer than `extraction.min_scans` scans too, with a warning. `progress` advances with every
    scan. Where no region is given, the search proposes objects (`searched`, of each drive, if it
    has been done), and `choose` decides by their clouds.

    Returns:
        One observation per drive and region, clouds in order of LiDAR and stamp; one per object
        where several stand in a region, and one per place for a target that was moved while the
        vehicle stood.

    Raises:
        TargetError: no LiDAR sees a target, none was found, or none is to be looked for.
        RecordingError: a cloud could not be read.
    """
    if config.target is None and not searched:
        searched = find_target(recordings, trajectories, config, progress)
    if config.target is False:
        raise TargetError("target: false: no target is looked for", "Remove target: false")
    regions: list[tuple[TargetRegion, ...]] = (
        [tuple(f.region for f in (found, *found.others)) for found in searched]
        if config.target is None
        else [config.target] * len(recordings)
    )
    observations: list[TargetObservation] = []
    wanted = [
        {name: scans_to_decode(r, t, name, config, of_drive) for name in config.lidars}
        for r, t, of_drive in zip(recordings, trajectories, regions, strict=True)
    ]
    total = sum(len(stamps) for drive in wanted for stamps in drive.values())
    with progress.stage("reading clouds", total) as advance:
        for drive, (recording, trajectory) in enumerate(zip(recordings, trajectories, strict=True)):
            extractors = [RegionExtractor(r, config, trajectory) for r in regions[drive]]
            seen = _candidates(recording, drive, wanted[drive], extractors, advance)
            order = ScanOrder.of(recording, config.lidars)
            of_drive = f" of {recording.name}" if len(recordings) > 1 else ""
            if searched:
                placements = _chosen(
                    searched[drive], extractors, seen, config, order, of_drive, choose
                )
            else:
                placements = []
                for index, (extractor, of_lidar) in enumerate(zip(extractors, seen, strict=True)):
                    label = "target" if len(extractors) == 1 else f"target {index + 1}"
                    placements += _placements(label + of_drive, extractor, of_lidar, config, order)
            observations += [
                replace(found, placement=len(observations) + n)
                for n, found in enumerate(placements)
            ]
    if not any(o.clouds for o in observations):
        why = observations[0].warnings[-1]
        what, _, remedy = why.rpartition(". ")  # the remedy is the last sentence
        raise TargetError(what, remedy)
    return tuple(observations)


def _candidates(
    recording: Recording,
    drive: int,
    wanted: Mapping[str, frozenset[int]],
    extractors: Sequence[RegionExtractor],
    advance: Advance,
) -> list[dict[str, list[list[Candidate]]]]:
    """Per extractor and LiDAR, the candidates of each of the wanted scans of a drive."""
    seen: list[dict[str, list[list[Candidate]]]] = [
        {name: [] for name in wanted} for _ in extractors
    ]
    for name, stamps in wanted.items():
        if stamps:
            for extractor in extractors:
                extractor.look_up(name, stamps)
        for scan in recording.scans(name, stamps):
            for extractor, of_lidar in zip(extractors, seen, strict=True):
                of_lidar[name].append(extractor.candidates(scan, drive))
            advance()
    return seen


def _chosen(
    searched: FoundTarget,
    extractors: Sequence[RegionExtractor],
    seen: Sequence[Mapping[str, Sequence[Sequence[Candidate]]]],
    config: Config,
    order: ScanOrder,
    of_drive: str,
    choose: Choose,
) -> list[TargetObservation]:
    """The placements of the candidate of a drive that is its target."""
    tried = []
    proposals = (searched, *searched.others)
    for found, extractor, of_lidar in zip(proposals, extractors, seen, strict=True):
        label = _label(found) + of_drive
        placements = tuple(_placements(label, extractor, of_lidar, config, order))
        tried.append(TriedCandidate(found, placements))
    choice = choose(tried, extractors[0].trajectory, config)
    first, *rest = tried[choice.index].observations
    label = _label(tried[choice.index].found) + of_drive
    lines = tuple(f"{label}: {reason}" for reason in choice.reasons)
    return [replace(first, warnings=(*lines, *first.warnings)), *rest]


def _label(found: FoundTarget) -> str:
    x, y, _ = found.centre_map
    return f"target found at ({x:.1f}, {y:.1f}) m of the map"


def _placements(
    label: str,
    extractor: RegionExtractor,
    seen: Mapping[str, Sequence[Sequence[Candidate]]],
    config: Config,
    order: ScanOrder,
) -> list[TargetObservation]:
    """One observation of a target, or one of each of its places if somebody moved it."""
    flat = {name: [c for scan in scans for c in scan] for name, scans in seen.items()}
    centres = {name: _centres(found) for name, found in flat.items()}
    moved = periods(centres, extractor.trajectory, config.extraction.min_scans)
    if not moved:
        return _objects(label, extractor, seen, config, order)
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
        observation = _observation(name, own, clouds, fewer, order)
        if observation.clouds:
            out.append(observation)
    if not out:
        return [_observation(label, extractor, [], config, order)]
    warnings = [*_warnings_of_moves(label, extractor, out, len(moved), config)]
    out = [replace(o, warnings=()) for o in out]
    return [replace(out[0], warnings=tuple(warnings)), *out[1:]]


def _objects(
    label: str,
    extractor: RegionExtractor,
    seen: Mapping[str, Sequence[Sequence[Candidate]]],
    config: Config,
    order: ScanOrder,
) -> list[TargetObservation]:
    """One observation of each object in the region that stands still."""
    fewest = config.extraction.min_scans
    found = [static_objects(extractor, scans, name, fewest) for name, scans in seen.items()]
    lidars = {objects.lidar: objects for objects in found if objects is not None}
    if one_object(tuple(lidars.values())):
        clouds = []
        for name, scans in seen.items():
            if name in lidars:
                clouds += extractor.clouds(lidars[name].candidates[0], lidars[name].scans, name)
            else:
                clouds += extractor.choose(scans, name)
        return [_observation(label, extractor, clouds, config, order)]
    matched = match_objects(tuple(lidars.values()))
    outside_m = extractor.outside_m(np.array([shared.place for shared in matched.objects]))
    # What stands beside the region is not meant; the guesses place all objects wrong together.
    limit_m = max(OUTSIDE_M, float(outside_m.min()))
    meant = [o for o, m in zip(matched.objects, outside_m.tolist(), strict=True) if m <= limit_m]
    out = []
    for number, shared in enumerate(meant, start=1):
        own = extractor if len(meant) == 1 else extractor.fresh()
        clouds = []
        for name in seen:
            if name in shared.seen:
                objects = lidars[name]
                clouds += own.clouds(objects.candidates[shared.seen[name]], objects.scans, name)
        if len(meant) == 1:
            return [_observation(label, own, clouds, config, order)]
        name = f"{label}, object {number} of {len(meant)}"
        observation = _observation(name, own, clouds, config, order)
        if observation.clouds:
            out.append(replace(observation, centre_map=extractor.in_map(shared.place)))
    if not out:
        return [_observation(label, extractor, [], config, order)]
    warnings = [*_warnings_of_objects(label, extractor, out, matched.ambiguous, config)]
    out = [replace(o, warnings=()) for o in out]
    return [replace(out[0], warnings=tuple(warnings)), *out[1:]]


def _warnings_of_objects(
    label: str,
    extractor: RegionExtractor,
    observations: Sequence[TargetObservation],
    ambiguous: Sequence[tuple[str, str]],
    config: Config,
) -> Iterator[str]:
    """Warnings about a region with several objects."""
    phrases, groups = _who_sees(observations, config)
    yield (
        f"{label}: {len(observations)} objects stand in the region, each solved for by itself: "
        f"{', '.join(phrases)}"
    )
    for one, other in ambiguous:
        yield (
            f"{label}: which object of lidar '{one}' is which of lidar '{other}' is ambiguous: "
            "their initial guesses are too uncertain for how far apart the objects stand. The two "
            "share none of them, so that these do not determine S2S while the vehicle stands. "
            f"Give better guesses (initial and sigma of '{one}' and '{other}'), or leave one "
            "object in the region"
        )
    yield from _warnings_of_blind(label, extractor, groups, "sees none of them", config)


def _who_sees(
    observations: Sequence[TargetObservation], config: Config
) -> tuple[list[str], dict[tuple[str, ...], int]]:
    """How many placements each group of LiDARs sees, in words and as counts."""
    groups: dict[tuple[str, ...], int] = {}
    for o in observations:
        lidars = tuple(n for n in config.lidars if any(c.lidar == n for c in o.clouds))
        groups[lidars] = groups.get(lidars, 0) + 1
    phrases = [
        f"{count} seen by {' and '.join(repr(n) for n in lidars)}"
        + (" alone" if len(lidars) == 1 else "")
        for lidars, count in groups.items()
    ]
    return phrases, groups


def _warnings_of_blind(
    label: str,
    extractor: RegionExtractor,
    groups: Mapping[tuple[str, ...], int],
    what: str,
    config: Config,
) -> Iterator[str]:
    """A warning for each LiDAR that is in none of the groups."""
    seeing = {name for lidars in groups for name in lidars}
    for name in config.lidars:
        if name not in seeing and extractor.tallies[name].scans:
            yield (
                f"{label}: lidar '{name}' {what} in "
                f"{config.extraction.min_scans} scans (extraction.min_scans) of its "
                f"{extractor.tallies[name].scans}"
            )


def _centres(found: Sequence[Candidate]) -> CandidateCentres:
    return CandidateCentres(
        np.array([c.cloud.stamp_ns for c in found], dtype=np.int64),
        np.array([c.centre_lidar for c in found], dtype=np.float64).reshape(-1, 3),
    )


def _of_period(found: Sequence[Candidate], members: IntArray) -> list[list[Candidate]]:
    """The candidates at these indices, scan by scan."""
    out: dict[int, list[Candidate]] = {}
    for index in members.tolist():
        out.setdefault(found[index].cloud.stamp_ns, []).append(found[index])
    return list(out.values())


def _warnings_of_moves(
    label: str,
    extractor: RegionExtractor,
    observations: Sequence[TargetObservation],
    places: int,
    config: Config,
) -> Iterator[str]:
    """Warnings about a target that was moved."""
    phrases, groups = _who_sees(observations, config)
    line = (
        f"{label}: it was moved while the vehicle stood: {places} places, each solved for by "
        f"itself: {', '.join(phrases)}"
    )
    seeing = {name for lidars in groups for name in lidars}
    if len(seeing) > 1 and all(len(lidars) == 1 for lidars in groups):
        line += ". No placement is shared, so S2S is unobservable: put it where two LiDARs see it"
    yield line
    yield from _warnings_of_blind(label, extractor, groups, "sees it at no place", config)


def _observation(
    label: str,
    extractor: RegionExtractor,
    found: list[TargetCloud],
    config: Config,
    order: ScanOrder,
) -> TargetObservation:
    """One observation; LiDARs that saw the target in too few scans are left out with a warning."""
    warnings: list[str] = []
    kept: list[TargetCloud] = []
    seen_ns: dict[str, tuple[int, ...]] = {}
    seeing = sum(t.kept >= config.extraction.min_scans for t in extractor.tallies.values())
    most = clouds_per_lidar(config.extraction.max_scans, seeing)
    for name, tally in extractor.tallies.items():
        if tally.kept >= config.extraction.min_scans:
            of_lidar = [c for c in found if c.lidar == name]
            seen_ns[name] = tuple(sorted(c.stamp_ns for c in of_lidar))
            kept += order.thinned(of_lidar, most)
        elif not tally.scans:
            warnings.append(f"{label}: {_out_of_view(name, config, order)}")
        else:
            warnings.append(
                f"{label}: lidar '{name}' sees it in {tally.kept} scans, needs "
                f"{config.extraction.min_scans} (extraction.min_scans). Of {tally.scans} scans: "
                f"{tally.reasons()}. {tally.remedy(config.extraction, config.target is not None)}"
            )
    if not kept:
        warnings = [_why_none(label, config, extractor.tallies, order)]
    centre = extractor.centre_map
    return TargetObservation(0, label, centre, tuple(kept), tuple(warnings), seen_ns)


def _out_of_view(name: str, config: Config, order: ScanOrder) -> str:
    """Why no scan of a LiDAR was looked at."""
    scans = len(order.of_stamps[name])
    if not scans:
        return f"lidar '{name}' has no scans in this drive"
    return (
        f"lidar '{name}' has it in view in none of its {scans} scans: it is outside the field of "
        f"view, or too far for {config.extraction.min_points} points (extraction.min_points)"
    )


def _why_none(region: str, config: Config, tallies: dict[str, Tally], order: ScanOrder) -> str:
    """Why no LiDAR saw the target, in one line."""
    parts = []
    is_given = config.target is not None
    best = max(tallies.values(), key=lambda tally: (tally.kept, len(tally.sparse)))
    for name, tally in tallies.items():
        if not tally.scans:
            parts.append(_out_of_view(name, config, order))
            continue
        near = (
            f"nearest return {tally.nearest_m:.2f} m from the region"
            if 0.0 < tally.nearest_m < math.inf
            else f"at most {tally.most_points} target points in a scan"
        )
        parts.append(
            f"lidar '{name}' in {tally.kept} of {tally.scans} scans, needs "
            f"{config.extraction.min_scans} ({near}; {tally.reasons() or 'nothing rejected'})"
        )
    is_remedied = bool(best.sparse) or not is_given
    remedy = best.remedy(config.extraction, is_given) if is_remedied else REMEDY
    return f"{region}: no LiDAR sees the target: {'; '.join(parts)}. {remedy}"
