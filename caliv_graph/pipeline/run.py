"""From recordings to a calibration: one statement per stage, as in the paper's figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from caliv_graph.calibration.assemble import assemble
from caliv_graph.calibration.check import check, cloud_counts, surfaces
from caliv_graph.calibration.choose import SAME_OBJECT_M
from caliv_graph.calibration.estimate import estimate_with_noise
from caliv_graph.calibration.requirements import unmet_requirements
from caliv_graph.calibration.structure import lidars_with_structure
from caliv_graph.calibration.structure_evidence import (
    StructureEvidence,
)
from caliv_graph.common.memory import collecting_what_is_new
from caliv_graph.common.progress import Progress
from caliv_graph.config.guesses import with_found_of
from caliv_graph.config.model import Config
from caliv_graph.errors import CalivError, TargetError
from caliv_graph.fusion.marks import drive_marks
from caliv_graph.fusion.merge import starting_from, with_earlier
from caliv_graph.fusion.terms import drive_digest
from caliv_graph.physics import (
    clock_findings,
    contradicted,
    contradictions_of,
    ranked_with,
    raw_findings,
    slip_findings,
    warnings_of,
    without_effects,
)
from caliv_graph.pipeline.mistakes import mistakes
from caliv_graph.pipeline.preparation import Prepared, as_used, motions_of, prepare
from caliv_graph.pipeline.standing import with_standing
from caliv_graph.products import (
    Calibration,
    LidarScan,
    MotionData,
    Recording,
)
from caliv_graph.readers.sampled import SampledRecording
from caliv_graph.results.run import CalibrationRun, RunRecord
from caliv_graph.structure.slow_errors import slow_errors
from caliv_graph.structure.term import structure_terms
from caliv_graph.uncertainty.consistency import (
    CONTRADICTION_SIGMAS,
    SCALE_LIMIT,
    CloudCount,
    too_many_outliers,
    without_surface,
)
from caliv_graph.wording.contradictions import no_surface_text, outliers_text, scale_text
from caliv_graph.wording.mounting import mistake_sentence
from caliv_graph.wording.structure import (
    left_out_sentence,
    nothing_sentence,
    ranges_sentence,
    wrong_target_sentence,
)

SUSPECT_SIGMAS = 3.0
"""Of an input of the config, from which it may explain clouds that do not fit each other."""


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
    with threadpool_limits(limits=1), collecting_what_is_new():
        return _calibrate(recordings, config, progress, prior)


def _calibrate(
    recordings: Sequence[Recording], config: Config, progress: Progress, prior: Calibration | None
) -> CalibrationRun:
    """Once more without what is no target, or is none for a LiDAR; see `calibrate`."""
    # The report shows the scans as they are read; nothing is read for it.
    sampled = [SampledRecording(recording) for recording in recordings]
    read = motions_of(sampled, config, progress)
    run, named = _calibrated(sampled, config, progress, prior, read)
    refused = None if named else no_target_of(run, config)
    left_out = elsewhere(run) if refused is None else ()
    if refused is None and not left_out:
        return run
    again = [SampledRecording(recording) for recording in recordings]
    names = " and ".join(f"'{count.lidar}'" for count in left_out)
    what = f"target clouds of {names}" if left_out else "that target"
    try:
        with progress.stage(f"calibrating again, without {what}", None):
            alone, _ = _calibrated(again, config, progress, prior, read, refused, left_out)
    except CalivError:
        return run
    # A wrong guess or clock contradicts walls, too: then the target shows it as well.
    return run if alone.calibration.status == "inconsistent" else alone


def elsewhere(run: CalibrationRun) -> tuple[CloudCount, ...]:
    """LiDARs all of whose target clouds contradict the others', and that see walls.

    Their clouds are of another object, or were laid on the target wrongly. What is wrong with the
    LiDAR itself (its guess, its clock, the sign of an axis) contradicts walls as well.
    """
    if run.calibration.status != "inconsistent" or run.record is None:
        return ()
    counts = cloud_counts(run.solution, run.record.trajectories)
    out = [of for of in counts if too_many_outliers(of) and of.outliers == of.clouds]
    if not out or len(out) == len(counts):
        return ()
    known = lidars_with_structure(run.solution.structure)
    return tuple(of for of in out if of.lidar in known)


def no_target_of(run: CalibrationRun, config: Config) -> TargetError | None:
    """Why the object that the search found is no target; None: nothing speaks against it.

    Most clouds of a LiDAR lie elsewhere than the others: on the next object, or along a hedge. Or
    none of the targets shows a surface, as foliage. Or clouds do not fit each other, and nothing
    else is contradicted, nor would another input of the config explain it: what stands there moves.
    """
    if run.calibration.status != "inconsistent" or config.target is not None:
        return None
    if not run.solution.structure or run.record is None:
        return None
    scattered = without_surface(surfaces(run.solution))
    if scattered and len(scattered) == len(run.solution.registrations):
        return TargetError(wrong_target_sentence("; ".join(map(no_surface_text, scattered))))
    found = run.calibration
    scale = run.solution.registration_scale
    explained = any(of.sigmas > SUSPECT_SIGMAS for of in found.suspects)
    if scale >= SCALE_LIMIT and len(found.contradictions) == 1 and not explained:
        return TargetError(wrong_target_sentence(scale_text(scale)))
    for count in cloud_counts(run.solution, run.record.trajectories):
        off = count.offset_vehicle
        if (
            too_many_outliers(count)
            and 2 * count.outliers >= count.clouds
            and off is not None
            and np.linalg.norm(off) > SAME_OBJECT_M
        ):
            return TargetError(wrong_target_sentence(outliers_text(count)))
    return None


def _calibrated(
    sampled: Sequence[SampledRecording],
    config: Config,
    progress: Progress,
    prior: Calibration | None,
    read: tuple[dict[int, MotionData], Config, tuple[str, ...]],
    refused: TargetError | None = None,
    left_out: Sequence[CloudCount] = (),
) -> tuple[CalibrationRun, bool]:
    """One statement per stage; and whether a mistake of the config was named.

    Args:
        sampled: the drives.
        config: the configuration.
        progress: reports every stage.
        prior: see `calibrate`.
        read: of `motions_of`.
        refused: why the target that the search finds is not used; None: it is.
        left_out: LiDARs whose target clouds are not used.
    """
    recordings: Sequence[Recording] = sampled
    motions, used, notes = read
    digests = [drive_digest(motion) for motion in motions.values()]
    marks = [drive_marks(motion) for motion in motions.values()]
    guessed = used if prior is None else starting_from(used, prior, digests, marks)

    prepared = prepare(recordings, guessed, motions, progress, refused)
    recordings = as_used(sampled, prepared.config, motions)
    if left_out:
        prepared = prepared.without_clouds({count.lidar for count in left_out})
        notes = (*notes, *(left_out_sentence(outliers_text(count)) for count in left_out))
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
        # What is left-handed all about, or far from where the guess has it, stands still nowhere.
        if not prepared.mistakes:
            causes, _ = _mistakes(recordings, prepared, motions, guessed, progress)
            if causes:
                raise TargetError(error.what, " ".join(causes)) from error
        raise without_anything(prepared, error) from error
    with progress.stage("checking the result", None):
        calibration = assemble(
            solution,
            with_found_of(config, prepared.config),
            recordings,
            digests,
            trajectories,
            marks,
        )
        calibration, doubts, concerned = check(
            calibration,
            solution,
            recordings,
            trajectories,
            motions,
            prepared.config,
            displaced=bool(prepared.misplaced or prepared.contradictions),
        )
        names = [recording.name for recording in recordings]
        slips = slip_findings(names, solution.structure, calibration)
        clocks = clock_findings(names, solution.structure, calibration)
        findings = (*prepared.findings, *clocks, *slips)
        doubts = without_effects(doubts, clocks, calibration)
        said, unread = prepared.mistakes, ""
        blamed = _blamed(calibration, concerned)
        if not said and prior is None and blamed is not None:
            said, unread = _mistakes(recordings, prepared, motions, guessed, progress, blamed)
        before = (*prepared.misplaced, *prepared.contradictions)
        if said:
            # What a solve from a mistaken guess or heading contradicts has that cause, and so has
            # what the search takes for guesses that are off.
            calibration = replace(calibration, contradictions=())
            before = prepared.contradictions
        calibration = contradicted(
            ranked_with(calibration, findings),
            (*said, *before),
            contradictions_of(findings),
        )
        calibration, conflicts = with_prior(calibration, prior, config)

    doubts = (*doubts, *warnings_of(clocks), *warnings_of(slips), *([unread] if unread else []))
    of_prior = calibration.warnings
    warnings = (*notes, *prepared.warnings, *solution.warnings, *doubts, *conflicts, *of_prior)
    record = RunRecord(
        drives=tuple(Path(recording.name).absolute().name for recording in recordings),
        trajectories=trajectories,
        grounds=prepared.grounds,
        scene={drive: _scene(recording, prepared) for drive, recording in enumerate(sampled)},
    )
    calibration = replace(calibration, warnings=tuple(dict.fromkeys(warnings)))
    run = CalibrationRun(calibration, solution, prepared.observations, record)
    return run, bool(said)


def _scene(recording: SampledRecording, prepared: Prepared) -> tuple[LidarScan, ...]:
    """Scans of a drive for the report, moved as the calibration moves them."""
    lidars = prepared.config.lidars
    return tuple(
        replace(scan, point_times_s=None) if lidars[scan.lidar].deskewed is True else scan
        for scan in recording.kept()
    )


def _mistakes(
    recordings: Sequence[Recording],
    prepared: Prepared,
    motions: dict[int, MotionData],
    config: Config,
    progress: Progress,
    blamed: Sequence[str] = (),
) -> tuple[tuple[str, ...], str]:
    """A sentence for each usual mistake that is found; and why none was looked for, or nothing.

    `blamed` are LiDARs whose guess a solve contradicts.
    """
    raw, smoothed = raw_findings(motions, config), prepared.trajectories
    try:
        found = mistakes(recordings, smoothed, motions, config, progress, raw, blamed=blamed)
    except CalivError as error:
        return (), f"usual mistakes of the config were not looked for: {error}"
    return tuple(mistake_sentence(doubt, config) for doubt in found), ""


def _blamed(calibration: Calibration, concerned: Sequence[str]) -> tuple[str, ...] | None:
    """LiDARs whose guess may be contradicted; None: no mistake of a guess is to be looked for.

    It is not where an input of the motion explains more. A drift is no such input: it takes up a
    part of whatever is wrong. `concerned` are LiDARs that contradictions of the solve are about.
    From guesses far off, structure may tell too little to be contradicted, and less than required.
    """
    if calibration.status != "inconsistent":
        return () if calibration.unmet else None
    leading = {s.input for s in calibration.suspects[:1] if s.sigmas > CONTRADICTION_SIGMAS}
    if any(not key.endswith(".initial") and ".drift" not in key for key in leading):
        return None
    blamed = tuple(
        name
        for name in calibration.lidars
        if f"lidars.{name}.initial" in leading or name in concerned
    )
    return blamed if blamed or leading else None


def structure_evidence(prepared: Prepared) -> StructureEvidence:
    """The structure of prepared drives, for the solve."""
    return StructureEvidence(prepared.patches, structure_terms, slow_errors)


NEAR_M, FAR_M = 5.0, 10.0
"""A larger min_range, or a smaller max_range, takes away most of what LiDARs see, metres: of the
ground, of a target that is passed at 5 m, of walls."""


def without_anything(prepared: Prepared, error: TargetError) -> TargetError:
    """The error of drives of which structure tells nothing; with why there is no target."""
    narrow = {
        name: (lidar.min_range, lidar.max_range)
        for name, lidar in prepared.config.lidars.items()
        if lidar.min_range > NEAR_M or lidar.max_range < FAR_M
    }
    error = with_standing(error, prepared.trajectories) or error
    if narrow:
        # In a hall with 8 m to the walls a short max_range is right.
        said = ranges_sentence(narrow)
        error = TargetError(error.what, f"{error.remedy}. {said}" if error.remedy else said)
    if prepared.no_target is None:
        return error
    said = str(error) if narrow else error.what
    return TargetError(nothing_sentence(str(prepared.no_target), said))


def with_prior(
    calibration: Calibration, prior: Calibration | None, config: Config
) -> tuple[Calibration, tuple[str, ...]]:
    """Adds the data of an earlier calibration's drives; and a warning for each conflict."""
    if prior is None:
        return calibration, ()
    fused, conflicts = with_earlier(calibration, prior)
    return unmet_requirements(fused, config), conflicts
