"""Do the data contradict each other or the initial guesses? All tests of a solved graph."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from caliv_graph.calibration.graph import CalibrationGraph
from caliv_graph.calibration.refine import LAST_STEPS
from caliv_graph.calibration.robust import FAR_OFF
from caliv_graph.calibration.score_tests import MIN_YAW_RATE_RAD_S, score_tests
from caliv_graph.calibration.suspect_values import ranked_suspects
from caliv_graph.calibration.vehicle_parameters import sigmas_from_stated
from caliv_graph.config.model import Config
from caliv_graph.errors import SolveError, TrajectoryError
from caliv_graph.products import (
    Array,
    Calibration,
    IntArray,
    MotionData,
    Recording,
    Solution,
    Surface,
    Suspect,
)
from caliv_graph.readers.pose_frame import poses_source
from caliv_graph.trajectory.heading import HeadingDisagreement, heading_disagreement
from caliv_graph.trajectory.select import (
    VehicleTrajectory,
    is_of_wheels,
    takes_given_poses,
    twists_at,
)
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.uncertainty import consistency
from caliv_graph.uncertainty.consistency import (
    Assumed,
    AssumedKind,
    CloudCount,
    CoarseRegistrations,
    Contradiction,
    Creeping,
    GuessContradiction,
    GuessesTogether,
    RangesDisagree,
    ScoreTest,
    Strain,
    perhaps_together,
)
from caliv_graph.wording.contradictions import (
    PosesGiven,
    contradiction_sentence,
    together_doubt,
)
from caliv_graph.wording.offsets import late_clock_sentences
from caliv_graph.wording.suspects import doubt_sentence, moved_sentence, ranking_sentence

_MOTION_INPUTS = ("gnss.", "poses.", "imu.", "twist.", "wheels.", "heading.")
"""How the names of suspects begin that turn the trajectory, or its heading, themselves."""


def _headings(
    trajectories: Sequence[VehicleTrajectory], motions: Mapping[int, MotionData]
) -> dict[int, HeadingDisagreement]:
    """Heading of the orientation source against the direction of travel, per drive index."""
    out = {}
    for index, trajectory in enumerate(trajectories):
        if isinstance(trajectory, SmoothedTrajectory):
            disagreement = heading_disagreement(trajectory, motions[index])
            if disagreement is not None:
                out[index] = disagreement
    return out


def _creeping(solution: Solution) -> Creeping | None:
    """The joint loop of a solution, if it ended far from where it leads."""
    if not solution.creeps:
        return None
    last = max(solution.course[-LAST_STEPS:], key=lambda step: step.sigmas)
    seeing = {c.lidar for r in solution.registrations for c in r.observation.clouds}
    lidars = tuple(name for name in solution.lidars if name in seeing)
    step = last.turn_rad, last.shift_m, last.sigmas
    return Creeping(len(solution.course), *step, lidars, solution.course[-1].way_sigmas)


def surfaces(solution: Solution) -> dict[str, Surface]:
    """Placement -> whether the clouds of its target show a surface, where that was estimated."""
    found = {r.observation.name: r.surface for r in solution.registrations}
    return {name: of for name, of in found.items() if of is not None}


def check(
    calibration: Calibration,
    solution: Solution,
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    motions: Mapping[int, MotionData],
    config: Config,
    displaced: bool = False,
) -> tuple[Calibration, tuple[str, ...], tuple[str, ...]]:
    """Tests a calibration against its data and its initial guesses.

    `recordings` and `trajectories` are one per drive, `motions` by the index of the drive;
    `displaced`: some target is at one place only with late stamps or another guess. Returns
    the calibration, inconsistent if something contradicts something, with its suspects;
    warnings: an input that may be wrong, headings that disagree, and what could not be tested;
    and the LiDARs that its contradictions are about.
    """
    headings = _headings(trajectories, motions)
    drives = [Path(recording.name).name for recording in recordings]
    trusted = [
        name for name, lidar in calibration.lidars.items() if lidar.guess and lidar.guess.fixed
    ]
    between, untested = _between_parts(solution, trajectories, trusted)
    suspects: tuple[Suspect, ...] = ()
    try:
        suspects = ranked_suspects(solution, trajectories, motions, config, displaced)
    except (SolveError, TrajectoryError) as e:
        untested = (*untested, f"the inputs were not tested against each other: {e.what}")
    found = consistency.contradictions(
        consistency.CheckInputs(
            lidars=calibration.lidars,
            score_tests=between,
            counts=cloud_counts(solution, trajectories),
            registration_scale=solution.registration_scale,
            registration_sigma=registration_sigma(solution),
            range_bias_m=solution.range_bias_m,
            assumed=assumptions(solution, drives),
            headings=[
                consistency.Heading(
                    drives[index],
                    heading.yaw_rad,
                    heading.sigma_rad,
                    told_apart=heading.measured or math.isfinite(heading.axle_m),
                    measured=heading.measured,
                    source=heading.source,
                )
                for index, heading in headings.items()
            ],
            speed_m_s=typical_speed(solution, trajectories),
            strains=strains(solution, drives),
            creeping=_creeping(solution),
            surfaces=surfaces(solution),
        )
    )
    calibration = replace(calibration, suspects=suspects)
    leads = bool(suspects) and suspects[0].sigmas > consistency.CONTRADICTION_SIGMAS
    if leads:
        found = unexplained(found, suspects)
    # Of guesses that are off together none is more likely wrong than the others.
    of_all = any(isinstance(each, GuessesTogether) for each in found)
    one = leads and not (of_all and suspects[0].input.endswith(".initial"))
    of_wheels = any(map(is_of_wheels, trajectories))
    sentences = [ranking_sentence(suspects, of_wheels)] if one else []
    given = _given(motions, config)
    sentences += [contradiction_sentence(each, one, given) for each in found]
    if sentences:
        calibration = replace(calibration, status="inconsistent", contradictions=tuple(sentences))
    said = {each.drive for each in found if isinstance(each, consistency.Heading)}
    turned = leads and suspects[0].input.startswith(_MOTION_INPUTS)
    disagreements = (
        heading.warning
        for index, heading in headings.items()
        if heading.warning and not turned and drives[index] not in said
    )
    far = "" if leads else moved_sentence(sigmas_from_stated(calibration.vehicle, trajectories))
    doubts = list(filter(None, [doubt_sentence(suspects), far]))
    of_guesses = any(isinstance(each, GuessContradiction | GuessesTogether) for each in found)
    frame = None if leads or of_guesses else perhaps_together(calibration.lidars)
    if (of_all or frame is not None) and suspects and suspects[0].input.endswith(".initial"):
        doubts = []
    if frame is not None:
        doubts.append(together_doubt(frame, given))
    # Beside what is most likely wrong, an offset is what that does to a clock.
    late = () if leads else tuple(late_clock_sentences(calibration.vehicle))
    concerned = tuple(name for name in calibration.lidars if any(name in _about(f) for f in found))
    return calibration, (*doubts, *late, *disagreements, *untested), concerned


def _given(motions: Mapping[int, MotionData], config: Config) -> PosesGiven | None:
    """The poses that were given; None: some drive has raw sensors."""
    given = [takes_given_poses(motion, config) for motion in motions.values()]
    if not given or not all(given):
        return None
    frames = [motion.poses.frame for motion in motions.values() if motion.poses is not None]
    alike = frames and all(each == frames[0] for each in frames[1:])
    return PosesGiven(poses_source(config), frames[0] if alike else None)


def _about(found: Contradiction) -> tuple[str, ...]:
    """LiDARs that a finding is about; none if it is about motion, ground or the target itself."""
    match found:
        case GuessContradiction(swapped_with=str() as other):
            return (found.lidar, other)
        case GuessContradiction() | CloudCount() | ScoreTest():
            return (found.lidar,)
        case CoarseRegistrations() | Creeping() | RangesDisagree() | GuessesTogether():
            return found.lidars
        case _:
            return ()


def _between_parts(
    solution: Solution, trajectories: Sequence[VehicleTrajectory], trusted: Sequence[str]
) -> tuple[tuple[ScoreTest, ...], tuple[str, ...]]:
    """The score tests; or a warning: the result stands, and the user must know what is untested."""
    try:
        return score_tests(solution, trajectories, trusted), ()
    except SolveError as e:
        return (), (f"parts of the drive were not tested against each other: {e.what}",)


def unexplained(
    found: Sequence[Contradiction], suspects: Sequence[Suspect]
) -> tuple[Contradiction, ...]:
    """The findings that remain once the first suspect is freed, without what its sentence says.

    A guess that is far off has many causes, which its own sentence names. Heading and course are of
    one trajectory, which a wrong input of the motion turns. Findings about many
    parameters at once (outliers, coarse registrations) have no suspect of their own, and remain.
    """
    left = {s.input: s.sigmas_left for s in suspects}
    if not suspects[0].input.endswith(".initial"):
        left[suspects[0].input] = 0.0

    def remains(each: Contradiction) -> bool:
        match each:
            case GuessContradiction():
                name = f"lidars.{each.lidar}.initial"
            case GuessesTogether():
                inputs = [f"lidars.{lidar}.initial" for lidar in each.lidars]
                return suspects[0].input in inputs or any(
                    left.get(name, math.inf) > consistency.CONTRADICTION_SIGMAS for name in inputs
                )
            case ScoreTest(kind="clock"):
                name = f"lidars.{each.lidar}.time_offset"
            case ScoreTest(kind="halves" | "turns"):
                name = f"lidars.{each.lidar}.mount.{each.kind}"
            case Assumed(kind="height"):
                name = "ground.vehicle_height"
            case consistency.Heading() | Strain():
                return not suspects[0].input.startswith(_MOTION_INPUTS)
            case _:
                return True
        return left.get(name, math.inf) > consistency.CONTRADICTION_SIGMAS

    return tuple(filter(remains, found))


def cloud_counts(
    solution: Solution, trajectories: Sequence[VehicleTrajectory]
) -> tuple[CloudCount, ...]:
    """Per LiDAR, how many of its clouds do not fit, where in the drive, and where they lie."""
    observed = [c for r in solution.registrations for c in r.observation.clouds]
    if not observed:
        return ()
    weights = np.concatenate(solution.cloud_weights)
    down = weights < 0.5
    if solution.mode != "staged":  # `staged` holds the translation at the guess, so no cloud fits
        down |= (np.concatenate(solution.residuals) ** 2).sum(axis=1) > FAR_OFF
    middles, turns, rates = _middles(solution), [], []
    for cloud in observed:
        rates.append(twists_at(trajectories[cloud.drive], [cloud.stamp_ns])[0, 2])
        turns.append(solution.T_map_vehicle[cloud.drive, cloud.stamp_ns].rotation().matrix())
    rate = np.array(rates)
    out = []
    for name in solution.lidars:
        mine = np.array([j for j, c in enumerate(observed) if c.lidar == name], np.int64)
        if not len(mine):
            continue
        mine = mine[np.argsort([observed[j].stamp_ns for j in mine], kind="stable")]

        def part(which: IntArray) -> tuple[int, int]:
            return len(which), int(down[which].sum())

        lost = mine[down[mine]]
        offset = None
        if len(lost) and not down.all():
            usual = np.median(middles[~down], axis=0)
            offset = np.median([turns[j].T @ (middles[j] - usual) for j in lost], axis=0)
        out.append(
            CloudCount(
                name,
                *part(mine),
                left=part(mine[rate[mine] > MIN_YAW_RATE_RAD_S]),
                right=part(mine[rate[mine] < -MIN_YAW_RATE_RAD_S]),
                early=part(mine[: len(mine) // 2]),
                late=part(mine[len(mine) // 2 :]),
                offset_vehicle=offset,
            )
        )
    return tuple(out)


def _middles(solution: Solution) -> Array:
    """(J, 3) middle of the extent of each cloud, map axes, from its target's origin."""
    out = []
    for T_target_map, registration in zip(
        solution.T_target_map, solution.registrations, strict=True
    ):
        centre = T_target_map.inverse().translation()
        for cloud in registration.observation.clouds:
            T = solution.T_map_vehicle[cloud.drive, cloud.stamp_ns]
            T = T.compose(solution.T_vehicle_lidar[cloud.lidar])
            points = T.transformFrom(cloud.points_lidar.T).T
            low, high = np.percentile(points, [5, 95], axis=0)
            out.append(0.5 * (low + high) - centre)
    return np.array(out)


def registration_sigma(solution: Solution) -> tuple[float, float]:
    """Sigma per axis of the median cloud's registration, scaled: rotation (rad), position (m).

    Zeros without a target.
    """
    if not solution.registrations:
        return 0.0, 0.0
    information = np.concatenate([r.information for r in solution.registrations])
    variance = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)
    sigma = np.sqrt(np.median(variance.reshape(-1, 2, 3).mean(axis=2), axis=0))
    turn, shift = (solution.registration_scale * sigma).tolist()
    return turn, shift


def assumptions(solution: Solution, drives: Sequence[str]) -> tuple[Assumed, ...]:
    """Height and tilt of the vehicle above the ground: assumed and estimated."""
    out = []
    for index, kind in enumerate(solution.factor_kinds):
        if kind not in ("ground_height", "ground_tilt"):
            continue
        factor: Any = solution.graph.at(index)
        drive = drives[gtsam.symbolIndex(factor.keys()[0])]
        raw = factor.unwhitenedError(solution.values)
        sigmas = raw / np.where(raw == 0.0, 1.0, factor.whitenedError(solution.values))
        axes: list[AssumedKind] = ["height"] if kind == "ground_height" else ["tilt_x", "tilt_y"]
        for axis, value, sigma in zip(axes, raw.tolist(), sigmas.tolist(), strict=True):
            if value:
                out.append(Assumed(drive, axis, value, abs(sigma)))
    return tuple(out)


def strains(solution: Solution, drives: Sequence[str]) -> tuple[Strain, ...]:
    """How far the poses of each smoothed drive are from where its motion data have them."""
    of_poses = [drive for drive, _ in solution.T_map_vehicle]
    graph, out = solution.graph, []
    if not isinstance(graph, CalibrationGraph):
        return ()
    for kind, gaussian in zip(graph.gaussian_kinds, graph.gaussians, strict=True):
        if kind == "motion":
            drive = drives[of_poses[gtsam.symbolIndex(gaussian.keys[0])]]
            chi_square = gaussian.chi_square(solution.values)
            out.append(Strain(drive, chi_square, len(gaussian.information)))
    return tuple(out)


def typical_speed(solution: Solution, trajectories: Sequence[VehicleTrajectory]) -> float:
    """Median speed of the vehicle over the poses of the graph, m/s."""
    speeds = [
        np.linalg.norm(twists_at(trajectories[drive], [stamp])[0, 3:])
        for drive, stamp in solution.T_map_vehicle
    ]
    return float(np.median(speeds))
