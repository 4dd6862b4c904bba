"""Checks of the raw data against the config, before the target is searched for.

`calibrate` and `inspect` make the same checks and say them in the same words.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.errors import CalivError, RecordingError, TargetError, TrajectoryError
from caliv_graph.products import (
    Calibration,
    Finding,
    MotionData,
    Recording,
    StructureTerm,
    Suspect,
    VehicleParameter,
)
from caliv_graph.targets.cloud.copies import copies
from caliv_graph.targets.ground.guesses import lidar_grounds, misfits
from caliv_graph.trajectory.given_physics import impossible_speed, poses_physics
from caliv_graph.trajectory.heading import heading_disagreement
from caliv_graph.trajectory.outliers import lost_fixes
from caliv_graph.trajectory.physics import motion_physics
from caliv_graph.trajectory.select import VehicleTrajectory, is_of_wheels, takes_given_poses
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.tilt import vehicle_tilt
from caliv_graph.uncertainty.consistency import CONTRADICTION_SIGMAS
from caliv_graph.wording.offsets import late_clock_sentences
from caliv_graph.wording.physics import (
    copies_sentence,
    fast_finding,
    fixes_finding,
    guess_findings,
    heading_finding,
    motion_findings,
    poses_finding,
    tilt_finding,
)
from caliv_graph.wording.suspects import apart_finding, clock_finding, slip_finding


def check_clouds(recordings: Sequence[Recording], config: Config) -> None:
    """Raises `RecordingError` if two LiDARs of a drive have the same clouds."""
    for recording in recordings:
        for found in copies(recording):
            raise RecordingError(copies_sentence(recording.name, found, config))


def raw_findings(motions: Mapping[int, MotionData], config: Config) -> tuple[Finding, ...]:
    """What the raw sensors of each drive say against each other and against the config."""
    out: list[Finding] = []
    for motion in motions.values():
        if takes_given_poses(motion, config):
            # Far from the map's origin, poses that are inverted are fast, too.
            poses, speed_m_s = poses_physics(motion), impossible_speed(motion)
            if poses is not None:
                out.append(poses_finding(poses, config))
            elif speed_m_s is not None:
                out.append(fast_finding(motion.name, speed_m_s, config))
            continue
        try:
            found = motion_physics(motion, config)
        except TrajectoryError:
            continue  # unusable samples: smoothing says the same
        if found is not None:
            out += motion_findings(found, config)
    return tuple(out)


def raise_fatal(findings: Sequence[Finding]) -> None:
    """Raises `TrajectoryError` with the most significant fatal finding, if there is one."""
    fatal = [found for found in findings if found.severity == "fatal"]
    if fatal:
        raise TrajectoryError(_most_likely(fatal).sentence)


def smoothed_findings(
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    motions: Mapping[int, MotionData],
    config: Config,
    progress: Progress,
) -> tuple[Finding, ...]:
    """What trajectory and ground say against the config, but for the heading.

    Raises:
        RecordingError: a cloud could not be read.
    """
    out: list[Finding] = []
    for index, (recording, trajectory) in enumerate(zip(recordings, trajectories, strict=True)):
        lies = False
        if isinstance(trajectory, SmoothedTrajectory):
            lost = lost_fixes(trajectory.data, trajectory.gnss_dropped)
            if lost is not None:
                has_imu = not is_of_wheels(trajectory)
                out.append(fixes_finding(trajectory.data.name, lost, has_imu))
        if not is_of_wheels(trajectory):
            tilt = vehicle_tilt(trajectory, motions[index].name, config)
            found, lies = tilt_finding(tilt, config), tilt.lies
            if found is not None:
                out.append(found)
        if config.ground.use and not lies:
            grounds = lidar_grounds(recording, trajectory, config, progress)
            out += guess_findings(recording.name, misfits(grounds, config), config)
    return tuple(out)


def clock_findings(
    names: Sequence[str], terms: Sequence[StructureTerm], calibration: Calibration
) -> tuple[Finding, ...]:
    """Clocks of LiDARs that the surfaces of a drive contradict, if the graph has no culprit.

    The ranking of suspects takes structure for fixed evidence, at a clock that is right: then it
    outvotes the target. What else is wrong beyond 5 sigma may bend walls as a late clock does.
    `names` are of the drives.

    In a drive in which a mount slips clocks seem late because of it: nothing is said of them there.

    Surfaces tell the clocks of LiDARs against that of the IMU or the poses. Where this was
    estimated as off, the fewer wrong clocks are the likelier: that one, unless one LiDAR alone
    explains as much. Clocks that are all right by that are compared with each other: of this the
    motion data's own errors are no part, and a millisecond shows.

    The clock of given poses is a variable of the graph, whose estimate has what LiDARs share
    against it: they are judged against what most of them say. Velocities have the noise of the
    poses in them, and so has how these move what carries the vehicle: of a slow robot whose clocks
    were right all four LiDARs were 53 +- 8 ms late, where the graph had 0.0 +- 0.1.
    """
    if _has_culprit(calibration):
        return ()
    terms = [t for t in terms if t.slip is None or t.slip.sigmas <= CONTRADICTION_SIGMAS]
    inertial = [
        float(found.value[0])
        for name, found in calibration.vehicle.items()
        if name in ("imu_time_offset", "twist_time_offset", "pose_time_offset")
    ]

    def against(term: StructureTerm, late_s: float) -> list[Finding]:
        found = [
            clock_finding(names[term.drive], lidar, value_s + late_s, sigma_s)
            for lidar, (value_s, sigma_s) in term.clocks.items()
        ]
        return [finding for finding in found if finding is not None]

    shifts = [0.0, sum(inertial)]
    if "pose_time_offset" in calibration.vehicle:
        found: list[Finding] = []
        for term in terms:
            of_lidars = [-value_s for value_s, _ in term.clocks.values()]
            judged = [against(term, shift) for shift in (*shifts, *of_lidars)]
            fewest = min(judged, key=len)
            found += fewest
    else:
        judged = [[f for t in terms for f in against(t, shift)] for shift in shifts]
        found = min(judged, key=len)
    return tuple(found) or _apart(names, terms)


def _has_culprit(calibration: Calibration) -> bool:
    """Whether the first suspect of the graph explains a contradiction by itself."""
    suspects = calibration.suspects
    return bool(suspects) and suspects[0].sigmas > CONTRADICTION_SIGMAS


def slip_findings(
    names: Sequence[str], terms: Sequence[StructureTerm], calibration: Calibration
) -> tuple[Finding, ...]:
    """Mounts that slip within a drive by its surfaces, if the graph has no culprit.

    `names` are of the drives.
    """
    if _has_culprit(calibration):
        return ()
    found = [slip_finding(names[t.drive], t.slip) for t in terms if t.slip is not None]
    return tuple(finding for finding in found if finding is not None)


def without_effects(
    doubts: Sequence[str], clocks: Sequence[Finding], calibration: Calibration
) -> tuple[str, ...]:
    """The doubts without those about clocks of the motion data, if those of LiDARs are wrong.

    Where two LiDARs are 50 ms apart, the clock of the poses is estimated between theirs.
    """
    if not contradictions_of(clocks):
        return tuple(doubts)
    effects = set(late_clock_sentences(calibration.vehicle))
    return tuple(doubt for doubt in doubts if doubt not in effects)


def _apart(names: Sequence[str], terms: Sequence[StructureTerm]) -> tuple[Finding, ...]:
    """Clocks of LiDARs against each other, the most significant pairs; each LiDAR once a drive."""
    out: list[Finding] = []
    for term in terms:
        pairs = {
            pair: finding
            for pair, told in term.clocks_apart.items()
            for finding in [apart_finding(names[term.drive], pair, *told)]
            if finding is not None
        }
        named: set[str] = set()
        for pair in sorted(pairs, key=lambda pair: -pairs[pair].sigmas):
            if named.isdisjoint(pair):
                out.append(pairs[pair])
                named.update(pair)
    return tuple(out)


def heading_findings(
    trajectories: Sequence[VehicleTrajectory],
    motions: Mapping[int, MotionData],
    config: Config,
    raw: Sequence[Finding],
) -> tuple[Finding, ...]:
    """Headings that disagree with the course. `calibration.check` says them after the solve.

    None with a finding of the raw sensors about `T_vehicle_imu`: then the trajectory is no
    evidence.
    """
    if any(found.input == "imu.T_vehicle_imu" for found in raw):
        return ()
    out = []
    for index, trajectory in enumerate(trajectories):
        if isinstance(trajectory, SmoothedTrajectory):
            disagreement = heading_disagreement(trajectory, motions[index])
            found = None if disagreement is None else heading_finding(disagreement, config)
            if found is not None:
                out.append(found)
    return tuple(out)


def _most_likely(findings: Sequence[Finding]) -> Finding:
    return max(findings, key=lambda found: found.sigmas)


def with_cause(error: CalivError, findings: Sequence[Finding]) -> CalivError:
    """The same error with the most significant finding as its cause, instead of its remedy."""
    if not findings:
        return error
    found = _most_likely(findings)
    what = error.what if isinstance(error, TargetError) else str(error)
    return type(error)(f"{what}. Most likely because of {found.input}: {found.sentence}")


def contradicted(
    calibration: Calibration, before: Sequence[str], after: Sequence[str]
) -> Calibration:
    """The calibration, inconsistent if there are sentences before or after its own ones."""
    if not (before or after):
        return calibration
    sentences = (*before, *calibration.contradictions, *after)
    return replace(calibration, status="inconsistent", contradictions=sentences)


_CANDIDATES = {
    "topics.gnss": "gnss.time_offset",
    "topics.imu": "imu.gyroscope.scale",
    "topics.twist": "twist.scale",
    "topics.pose": "poses.frame",
}
"""Key of the config that a finding blames -> the suspect of the graph, where they differ."""


def ranked_with(calibration: Calibration, findings: Sequence[Finding]) -> Calibration:
    """The calibration, a suspect that a finding contradicts first, if the graph has no culprit.

    A finding and the score of the same input rest on the same data (`calibration/README.md`,
    section 11): they do not add up. The more significant one counts: the score is linear, and sees
    nothing where the effect of an error is far from it. Where a score is beyond 5 sigma, a finding
    may be what its culprit causes, and changes nothing.
    """
    suspects = calibration.suspects
    if not suspects or _has_culprit(calibration):
        return calibration
    # The most significant one of each input.
    contradicting = sorted(
        (f for f in findings if f.severity == "contradiction"), key=lambda f: f.sigmas
    )
    found = {_candidate(f.input): f for f in contradicting}
    clock = calibration.vehicle.get("gnss_time_offset")
    raised = [_raised(s, found[s.input], clock) if s.input in found else s for s in suspects]
    raised.sort(key=lambda s: -s.sigmas if s.input in found else 0.0)
    if raised[0].input in found:
        raised[0] = replace(raised[0], sigmas_left=raised[0].sigmas)
    return replace(calibration, suspects=tuple(raised))


def _raised(suspect: Suspect, finding: Finding, clock: VehicleParameter | None) -> Suspect:
    """A suspect with a finding about it; with its value, too, if it is a clock.

    What the graph says of a clock of a LiDAR that structure outvotes is no value. Of `clock`, that
    of the fixes, it says what is left of the finding, from which the smoother begins.
    """
    raised = replace(suspect, sigmas=max(suspect.sigmas, finding.sigmas))
    value, sigma = finding.value, (finding.sigma,)
    if suspect.input == "gnss.time_offset" and finding.value:
        if clock is not None:
            value, sigma = (float(clock.value[0]),), (float(clock.sigma[0]),)
    elif not (suspect.input.startswith("lidars.") and suspect.input.endswith(".time_offset")):
        return raised
    return replace(raised, value=value, change=value, sigma=sigma)


def _candidate(key: str) -> str:
    """The suspect that a key of the config belongs to."""
    if key.startswith("lidars."):
        return key.removesuffix(".xyz").removesuffix(".rpy_deg")
    return _CANDIDATES.get(key, key)


def contradictions_of(findings: Sequence[Finding]) -> tuple[str, ...]:
    """The sentences of those that are contradictions."""
    return tuple(f.sentence for f in findings if f.severity != "warning")


def warnings_of(findings: Sequence[Finding]) -> tuple[str, ...]:
    """The sentences of those that are no contradictions."""
    return tuple(f.sentence for f in findings if f.severity == "warning")
