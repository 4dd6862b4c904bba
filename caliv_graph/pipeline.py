"""From recordings to a calibration: one statement per stage, as in the paper's figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from caliv_graph.calibration.assemble import assemble
from caliv_graph.calibration.check import check
from caliv_graph.calibration.choose import choose_static, displaced, displaced_or_misguessed
from caliv_graph.calibration.estimate import estimate_with_noise
from caliv_graph.calibration.requirements import unmet_requirements
from caliv_graph.calibration.structure_evidence import (
    StructureEvidence,
    kept_stamps,
)
from caliv_graph.calibration.suspect_values import motion_suspects
from caliv_graph.common.progress import Progress
from caliv_graph.config.guesses import with_found_of
from caliv_graph.config.model import Config
from caliv_graph.errors import CalivError, TargetError, TrajectoryError
from caliv_graph.fusion.merge import starting_from, with_earlier
from caliv_graph.fusion.terms import drive_digest
from caliv_graph.mounting.place import Placement, place_lidars
from caliv_graph.odometry.run import with_odometry
from caliv_graph.physics import (
    check_clouds,
    contradicted,
    contradictions_of,
    heading_findings,
    raise_fatal,
    ranked_with,
    raw_findings,
    smoothed_findings,
    warnings_of,
    with_cause,
)
from caliv_graph.products import (
    Calibration,
    Finding,
    GroundObservation,
    MotionData,
    Recording,
    TargetObservation,
)
from caliv_graph.readers.common_stamps import with_common_stamps
from caliv_graph.readers.sampled import SampledRecording
from caliv_graph.results.run import CalibrationRun, RunRecord
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.read import read_patches
from caliv_graph.structure.term import structure_terms
from caliv_graph.targets.cloud.extract import extract_targets
from caliv_graph.targets.ground.measure import measure_grounds
from caliv_graph.targets.search import find_target
from caliv_graph.targets.search.misplaced import realigned
from caliv_graph.trajectory.odometry import OdometryPoses
from caliv_graph.trajectory.select import VehicleTrajectory, noise_scales, smooth_trajectories
from caliv_graph.wording.mounting import placement_sentence, region_sentence
from caliv_graph.wording.odometry import odometry_sentence
from caliv_graph.wording.structure import no_target_sentence, nothing_sentence
from caliv_graph.wording.suspects import motion_sentence


@dataclass(frozen=True)
class Prepared:
    """Recorded drives, ready to be solved.

    Attributes:
        trajectories: one per drive, with a node at every scan that sees a target.
        observations: the targets' clouds.
        grounds: the ground as the LiDARs saw it.
        findings: values of the config that the raw data contradict.
        warnings: for the user, a line each.
        config: the config, with the guesses that the search for the target had to replace.
        contradictions: how guesses and stamps contradict what the LiDARs see, a sentence each.
        patches: pieces of walls and other surfaces, per drive; empty: structure is not used.
        no_target: why no target was found; None: one was, or none was to be looked for.
    """

    trajectories: tuple[VehicleTrajectory, ...]
    observations: tuple[TargetObservation, ...]
    grounds: tuple[GroundObservation, ...]
    findings: tuple[Finding, ...]
    warnings: tuple[str, ...]
    config: Config
    contradictions: tuple[str, ...] = ()
    patches: tuple[DrivePatches, ...] = ()
    no_target: TargetError | None = None


def motions_of(
    recordings: Sequence[Recording], config: Config, progress: Progress
) -> tuple[dict[int, MotionData], Config, tuple[str, ...]]:
    """The motion data of drives; by the odometry of a LiDAR where nothing else was recorded.

    Returns:
        The motion data by the index of the drive; the config for them; what to tell the user.

    Raises:
        CalivError: something is wrong with the input; the message says what to do.
    """
    with progress.stage("reading the motion data", None):
        motions = {i: recording.motion() for i, recording in enumerate(recordings)}
    return completed_motions(recordings, config, motions, progress)


def completed_motions(
    recordings: Sequence[Recording],
    config: Config,
    motions: Mapping[int, MotionData],
    progress: Progress,
) -> tuple[dict[int, MotionData], Config, tuple[str, ...]]:
    """`motions_of` from motion data that have been read."""
    motions, used, placements = with_odometry(recordings, config, motions, progress)
    odometry = [m.poses for m in motions.values() if isinstance(m.poses, OdometryPoses)]
    if not odometry:
        return motions, config, ()
    notes = [odometry_sentence(o.lidar, o.statement, config) for o in odometry[:1] if o.statement]
    notes += map(placement_sentence, placements)
    # Clouds of a target have no pose that is known without them.
    return motions, used.model_copy(update={"target": False}), tuple(notes)


def prepare(
    recordings: Sequence[Recording],
    config: Config,
    motions: Mapping[int, MotionData],
    progress: Progress,
) -> Prepared:
    """Smooths the trajectories and finds target, ground and structure along them.

    Args:
        recordings: opened drives.
        config: topics, noise, target, ground.
        motions: motion data of each drive, by its index.
        progress: reports every stage.

    Raises:
        CalivError: something is wrong with the input; the message says what to do.
    """
    check_clouds(recordings, config)
    recordings = [with_common_stamps(recording) for recording in recordings]
    raw = raw_findings(motions, config)
    raise_fatal(raw)
    rough, findings, search, placements = _searched(recordings, config, motions, raw, progress)
    config, misplaced, observations, no_target = search
    patches = _patches(recordings, rough, config, progress)
    kept = kept_stamps(patches)
    if no_target is not None and not kept:
        raise no_target
    grounds: Sequence[GroundObservation] = ()
    ground_warnings: Sequence[str] = ()
    others = {patch.lidars[i] for patch in patches for i in np.unique(patch.scan_lidar)}
    # Without motion data the ground is in the structure, and in how the vehicle stands on it.
    if not any(isinstance(motion.poses, OdometryPoses) for motion in motions.values()):
        kept_ns = None if observations else kept
        grounds, ground_warnings = measure_grounds(
            recordings, rough, observations, config, progress, others, kept_ns
        )
    with progress.stage("smoothing the trajectory at the scans", None):
        stamps = _stamps_seen(len(recordings), observations, patches)
        scales = noise_scales(rough)
        del rough  # a graph of its own, which nobody asks any more
        trajectories = smooth_trajectories(recordings, config, stamps, motions, scales)
    warnings = [w for r in recordings for w in r.warnings()]
    warnings += map(placement_sentence, placements)
    warnings += [w for t in trajectories for w in t.warnings]
    warnings += [w for o in observations for w in o.warnings]
    if no_target is not None:
        warnings.append(no_target_sentence(no_target.what))
    return Prepared(
        tuple(trajectories),
        tuple(observations),
        tuple(grounds),
        findings,
        (*warnings, *ground_warnings, *warnings_of(findings)),
        config,
        (*misplaced, *displaced(observations, trajectories, config)),
        patches,
        no_target,
    )


Search = tuple[Config, tuple[str, ...], tuple[TargetObservation, ...], TargetError | None]
"""The config with the guesses that the search had to replace; how they contradict what the LiDARs
see, a sentence each; the targets' clouds; why there are none, if structure may replace them."""


def _searched(
    recordings: Sequence[Recording],
    config: Config,
    motions: Mapping[int, MotionData],
    raw: tuple[Finding, ...],
    progress: Progress,
) -> tuple[Sequence[VehicleTrajectory], tuple[Finding, ...], Search, tuple[Placement, ...]]:
    """The rough trajectories, all findings (`raw` first), the targets, and found mountings.

    Raises:
        ConfigError: a LiDAR has no guess, and the drive does not show its mounting.
        TrajectoryError: the motion data are unusable.
        TargetError: no target was found, and the config does without structure or gives a region.
    """
    rough: Sequence[VehicleTrajectory] = ()
    findings = raw
    placements: tuple[Placement, ...] = ()
    try:
        with progress.stage("smoothing the trajectory", None):
            rough = smooth_trajectories(recordings, config, [[] for _ in recordings], motions)
        config, placements = place_lidars(recordings, rough, config, progress)
        findings += smoothed_findings(recordings, rough, motions, config, progress)
        found = _targets(recordings, rough, config, progress)
    except (TrajectoryError, TargetError) as error:
        caused = _with_cause(error, rough, motions, config, (findings, raw))
        if caused is error and isinstance(error, TargetError) and config.target:
            elsewhere = region_sentence(placements)
            caused = TargetError(error.what, elsewhere) if elsewhere else error
        if not (isinstance(caused, TargetError) and config.target is None and _uses(config)):
            raise caused from error
        return rough, findings, (config, (), (), caused), placements
    return rough, findings, (*found, None), placements


def _uses(config: Config) -> bool:
    """Whether structure is used; the paper's procedure does without."""
    return config.structure.use and config.solve.mode != "staged"


def _patches(
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
) -> tuple[DrivePatches, ...]:
    """The patches of every drive, if structure is used."""
    if not _uses(config):
        return ()
    return read_patches(recordings, trajectories, config, progress, keep_level=True)


def _with_cause(
    error: TrajectoryError | TargetError,
    trajectories: Sequence[VehicleTrajectory],
    motions: Mapping[int, MotionData],
    config: Config,
    findings: tuple[Sequence[Finding], Sequence[Finding]],
) -> CalivError:
    """An error with what most likely caused it; `findings` are all so far, and the raw ones."""
    found, raw = findings
    causes = (*found, *heading_findings(trajectories, motions, config, raw))
    if isinstance(error, TargetError) and not causes:
        said = _doubts_about_motion(trajectories, motions, config)
        if said:
            return TargetError(error.what, said)
    return with_cause(error, causes)


def _targets(
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
) -> tuple[Config, tuple[str, ...], tuple[TargetObservation, ...]]:
    """The config with the guesses that the search had to replace; sentences; the targets' clouds.

    The sentences say how these guesses contradict what the LiDARs see.
    """
    if config.target is False:
        return config, (), ()
    searched = (
        find_target(recordings, trajectories, config, progress) if config.target is None else []
    )
    config, misplaced = realigned(config, searched)
    observations = extract_targets(
        recordings, trajectories, config, progress, choose_static, searched
    )
    return config, misplaced, observations


@dataclass(frozen=True)
class Look:
    """What a recorded drive shows with a config, as far as it can be seen.

    Attributes:
        observations: the targets' clouds; None if the search stopped.
        findings: values of the config that the raw data contradict, the heading included.
        problems: what stopped the search, a sentence each.
        notes: where LiDARs without an initial guess were found, a sentence each.
        trajectory: of the vehicle; None if it could not be smoothed.
        config: with the mountings that were found; None if none was looked for.
    """

    observations: tuple[TargetObservation, ...] | None
    findings: tuple[Finding, ...]
    problems: tuple[str, ...]
    notes: tuple[str, ...] = ()
    trajectory: VehicleTrajectory | None = None
    config: Config | None = None


def look(recording: Recording, config: Config, progress: Progress) -> Look:
    """The checks of `prepare`, and the search for the target, of one drive; raises no CalivError.

    Clouds that are read for the first time here may be damaged: that is a problem like the others.
    """
    findings: tuple[Finding, ...] = ()
    problems: list[str] = []
    notes: tuple[str, ...] = ()
    trajectory: VehicleTrajectory | None = None
    observations: tuple[TargetObservation, ...] | None = None
    try:
        check_clouds([recording], config)
    except CalivError as error:
        problems.append(str(error))
    try:
        motions, config, notes = completed_motions(
            [recording], config, {0: recording.motion()}, progress
        )
        findings = raw = raw_findings(motions, config)
        if any(found.severity == "fatal" for found in findings):
            return Look(None, findings, tuple(problems), notes)
        trajectories = smooth_trajectories([recording], config, [[]], motions)
        (trajectory,) = trajectories
        config, placements = place_lidars([recording], trajectories, config, progress)
        notes += tuple(map(placement_sentence, placements))
        findings += smoothed_findings([recording], trajectories, motions, config, progress)
        findings += heading_findings(trajectories, motions, config, raw)
        near, misplaced, observations = _targets([recording], trajectories, config, progress)
        kept = [name for name in near.lidars if near.lidars[name] is config.lidars[name]]
        said = displaced_or_misguessed(observations, trajectories, near, kept)
        problems += (*misplaced, *said)
    except CalivError as error:
        problems.append(error.what if findings and isinstance(error, TargetError) else str(error))
        observations = None
    return Look(observations, findings, tuple(problems), notes, trajectory, config)


def _doubts_about_motion(
    trajectories: Sequence[VehicleTrajectory], motions: Mapping[int, MotionData], config: Config
) -> str:
    """What is most likely wrong by the motion data alone, for the end of a message; or nothing.

    A wrong lever arm lets a target wander, and none is found.
    """
    try:
        return motion_sentence(motion_suspects(trajectories, motions, config))
    except TrajectoryError:
        return ""


def _stamps_seen(
    drives: int,
    observations: Sequence[TargetObservation],
    patches: Sequence[DrivePatches],
) -> list[list[int]]:
    """Per drive the stamps of the scans that see a target, and of those with patches."""
    seen = {(cloud.drive, cloud.stamp_ns) for o in observations for cloud in o.clouds}
    seen |= {(of.drive, stamp) for of in patches for stamp in of.stamps_ns.tolist()}
    return [sorted(stamp for d, stamp in seen if d == drive) for drive in range(drives)]


def calibrate(
    recordings: Sequence[Recording],
    config: Config,
    progress: Progress,
    prior: Calibration | None = None,
) -> CalibrationRun:
    """Calibrates all LiDARs of one vehicle from one or several drives.

    Args:
        recordings: opened drives (`readers.open_recording`).
        config: the configuration.
        progress: reports every stage.
        prior: an earlier calibration of the vehicle. Its extrinsics are the initial guesses of the
            solve, and the data of its drives are added to the result. The solve itself does not
            use these data: it shall find a mount that has moved since.

    Raises:
        CalivError: something is wrong with the input; the message says what to do.
    """
    # Matrices are small, and threads that share a sum add it up in another order: the same result
    # on any number of cores.
    with threadpool_limits(limits=1):
        return _calibrate(recordings, config, progress, prior)


def _calibrate(
    recordings: Sequence[Recording], config: Config, progress: Progress, prior: Calibration | None
) -> CalibrationRun:
    """One statement per stage; see `calibrate`."""
    # The report shows the scans as they are read; nothing is read for it.
    recordings = sampled = [SampledRecording(recording) for recording in recordings]
    motions, used, notes = motions_of(recordings, config, progress)
    digests = [drive_digest(motion) for motion in motions.values()]
    guessed = used if prior is None else starting_from(used, prior, digests)

    prepared = prepare(recordings, guessed, motions, progress)
    try:
        solution, trajectories = estimate_with_noise(
            prepared.observations,
            prepared.trajectories,
            prepared.config,
            progress,
            prepared.grounds,
            structure_evidence(prepared),
        )
    except TargetError as error:
        raise without_anything(prepared, error) from error
    with progress.stage("checking the result", None):
        calibration = assemble(
            solution, with_found_of(config, prepared.config), recordings, digests, trajectories
        )
        calibration, doubts = check(
            calibration,
            solution,
            recordings,
            prepared.trajectories,
            motions,
            prepared.config,
            displaced=bool(prepared.contradictions),
        )
        calibration = contradicted(
            ranked_with(calibration, prepared.findings),
            prepared.contradictions,
            contradictions_of(prepared.findings),
        )
        calibration, conflicts = with_prior(calibration, prior, config)

    warnings = (*notes, *prepared.warnings, *solution.warnings, *doubts, *conflicts)
    record = RunRecord(
        drives=tuple(Path(recording.name).absolute().name for recording in recordings),
        trajectories=trajectories,
        grounds=prepared.grounds,
        scene={drive: recording.kept() for drive, recording in enumerate(sampled)},
    )
    return CalibrationRun(calibration, solution, prepared.observations, warnings, record)


def structure_evidence(prepared: Prepared) -> StructureEvidence:
    """The structure of prepared drives, for the solve."""
    return StructureEvidence(prepared.patches, structure_terms)


def without_anything(prepared: Prepared, error: TargetError) -> TargetError:
    """The error of drives of which structure tells nothing; with why there is no target."""
    if prepared.no_target is None:
        return error
    return TargetError(nothing_sentence(str(prepared.no_target), error.what))


def with_prior(
    calibration: Calibration, prior: Calibration | None, config: Config
) -> tuple[Calibration, tuple[str, ...]]:
    """Adds the data of an earlier calibration's drives; and a warning for each conflict."""
    if prior is None:
        return calibration, ()
    fused, conflicts = with_earlier(calibration, prior)
    return unmet_requirements(fused, config), conflicts
