"""What a recorded drive determines, before it is calibrated.

The early stages of `pipeline.calibrate`, a rough registration and one solve of the graph. Shape and
extrinsics are not refined together, which is what takes the time.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from caliv_graph.calibration.assemble import evidence_of_terms
from caliv_graph.calibration.no_target import solve_structure_and_ground
from caliv_graph.calibration.problem import pose_problem, usable
from caliv_graph.calibration.requirements import unmet_requirements
from caliv_graph.calibration.rough import rough_solve, roughly_used
from caliv_graph.calibration.solve import SolveState, reduced_registered
from caliv_graph.calibration.structure import lidars_with_structure
from caliv_graph.calibration.structure_evidence import (
    NO_STRUCTURE,
    StructureEvidence,
    kept_stamps,
    other_grounds,
    rough_extrinsics,
    solved_with_structure,
)
from caliv_graph.common.progress import Progress
from caliv_graph.config.guesses import configured_guess
from caliv_graph.config.model import Config
from caliv_graph.errors import TargetError
from caliv_graph.physics import contradictions_of
from caliv_graph.pipeline import (
    completed_motions,
    prepare,
    structure_evidence,
    without_anything,
)
from caliv_graph.products import (
    Array,
    GroundObservation,
    Recording,
    StructureTerm,
    TargetObservation,
)
from caliv_graph.structure.strips import LEVEL
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.uncertainty.predicted import PredictedCovariance, predict_covariance
from caliv_graph.wording.directions import named_prediction

ROUGH_ITERATIONS = 40
"""Of the registration at most: millimetres do not change what a drive determines."""


@dataclass(frozen=True)
class Survey:
    """What recorded drives tell.

    Attributes:
        names: of the recordings.
        covariance: predicted sigmas and directions; extrinsics are rough estimates.
        scans: (target, LiDAR) -> number of clouds that count.
        wall_sightings: LiDAR -> number of pairs of a strip of wall and a scan that sees it; empty:
            no structure was used.
        shared_walls: (LiDAR, LiDAR) -> number of strips of walls that both see.
        unmet: what `require` and `limits` of the config ask for and will not get, a sentence each.
        warnings: what a person should know, a line each.
    """

    names: tuple[str, ...]
    covariance: PredictedCovariance
    scans: Mapping[tuple[str, str], int]
    wall_sightings: Mapping[str, int]
    shared_walls: Mapping[tuple[str, str], int]
    unmet: tuple[str, ...]
    warnings: tuple[str, ...]


def survey(recordings: Sequence[Recording], config: Config, progress: Progress) -> Survey:
    """Finds out what recorded drives (`readers.open_recording`) of one vehicle determine.

    Raises:
        CalivError: something is wrong with the input; the message says what to do.
    """
    read = {i: recording.motion() for i, recording in enumerate(recordings)}
    motions, config, notes = completed_motions(recordings, config, read, progress)
    prepared = prepare(recordings, config, motions, progress)
    try:
        with threadpool_limits(limits=1):
            found = survey_observations(
                prepared.observations,
                prepared.trajectories,
                prepared.grounds,
                prepared.config,
                progress,
                structure_evidence(prepared),
            )
    except TargetError as error:
        raise without_anything(prepared, error) from error
    return replace(
        found,
        names=tuple(recording.name for recording in recordings),
        warnings=(
            *notes,
            *prepared.misplaced,
            *prepared.contradictions,
            *contradictions_of(prepared.findings),
            *prepared.warnings,
            *found.warnings,
        ),
    )


def survey_observations(
    observations: Sequence[TargetObservation],
    trajectories: Sequence[VehicleTrajectory],
    grounds: Sequence[GroundObservation],
    config: Config,
    progress: Progress,
    structure: StructureEvidence = NO_STRUCTURE,
) -> Survey:
    """The same from extracted targets and grounds; without names and the warnings before it.

    Raises:
        RegistrationError, SolveError: it could not be done.
    """
    used = usable(observations)
    if not used and structure.patches:
        alone = solve_structure_and_ground(
            trajectories, config, progress, tuple(grounds), structure
        )
        return _verdict(alone.state, alone.reduced.D, alone.offsets_s, alone.warnings, used, config)
    kept = kept_stamps(structure.patches, used)
    problem = pose_problem(used, trajectories, config, kept_ns=kept)
    limit = min(config.registration.max_iterations, ROUGH_ITERATIONS)
    rough = rough_solve(
        problem, used, tuple(grounds), config, progress, limit, look_for_symmetries=True
    )
    state = rough.state
    terms = structure.terms_beside(state, problem, trajectories, problem.heave_m)
    if terms:
        others = lidars_with_structure(terms)
        problem = pose_problem(used, trajectories, config, None, others, kept)
        problem, used = roughly_used(problem, used, config.extraction.min_scans)
        extrinsics = state.problem.extrinsics(state.values)
        state, offsets_s = solved_with_structure(
            problem,
            rough.registrations,
            other_grounds(tuple(grounds), terms),
            config,
            state.turns,
            terms,
            extrinsics,
        )
        rough = replace(rough, offsets_s=offsets_s)
    D = reduced_registered(state, rough.registrations).D
    return _verdict(state, D, rough.offsets_s, rough.warnings, used, config)


def _verdict(
    state: SolveState,
    D: Array,
    offsets_s: Mapping[str, float],
    warnings: Sequence[str],
    observations: Sequence[TargetObservation],
    config: Config,
) -> Survey:
    problem, weights = state.problem, state.weights.values
    scans: dict[tuple[str, str], int] = {}
    for j in np.flatnonzero(weights >= 0.5).tolist():
        target = observations[int(problem.cloud_placement[j])].name
        key = (target, problem.lidars[int(problem.cloud_lidar[j])])
        scans[key] = scans.get(key, 0) + 1
    covariance = predict_covariance(
        D,
        problem.lidars,
        problem.reference,
        rough_extrinsics(state),
        {name: configured_guess(config, name) for name in config.lidars},
        {name: sum(n for (_, of), n in scans.items() if of == name) for name in problem.lidars},
        offsets_s,
        lidars_with_structure(state.structure),
    )
    unmet = unmet_requirements(covariance.calibration, config).unmet
    sightings, shared = _walls(state.structure, tuple(config.lidars))
    named = named_prediction(covariance, evidence_of_terms(state.structure, bool(scans)))
    return Survey((), named, scans, sightings, shared, unmet, tuple(warnings))


def _walls(
    terms: Sequence[StructureTerm], lidars: Sequence[str]
) -> tuple[dict[str, int], dict[tuple[str, str], int]]:
    """Sightings of walls per LiDAR, and strips of walls that two LiDARs see."""
    if not terms:
        return {}, {}
    walls = [
        strip
        for term in terms
        for strip in term.strips
        if strip.weight > 0.0 and abs(strip.normal_map[2]) < LEVEL
    ]
    sightings = {name: sum(strip.scans.get(name, 0) for strip in walls) for name in lidars}
    pairs = itertools.combinations(lidars, 2)
    return sightings, {pair: sum(set(pair) <= set(s.scans) for s in walls) for pair in pairs}
