"""From recordings to a calibration: one statement per stage, as in the paper's figure."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import gtsam
import numpy as np
from threadpoolctl import threadpool_limits

import caliv_graph
from caliv_graph.calibration.contrasts import (
    assumptions,
    cloud_counts,
    contrasts,
    registration_sigma,
    typical_speed,
)
from caliv_graph.calibration.estimate import estimate
from caliv_graph.calibration.problem import TRUSTED_SIGMAS
from caliv_graph.config import Config, dump_config
from caliv_graph.conventions import AXES
from caliv_graph.errors import SolveError
from caliv_graph.fusion.merge import guess_covariance, starting_from, with_earlier
from caliv_graph.fusion.terms import DRIVES, drive_digest
from caliv_graph.geometry.se3 import (
    pose_from_mounting,
    right_to_vehicle_axes,
    sigmas_from_mounting,
    vehicle_axes_difference,
)
from caliv_graph.preparation import prepare
from caliv_graph.products import (
    Array,
    Calibration,
    Guess,
    LidarResult,
    MotionData,
    Recording,
    Solution,
    TargetObservation,
    Uncertainty,
)
from caliv_graph.progress import Progress
from caliv_graph.readers.sampled import SampledRecording
from caliv_graph.report.evidence import Evidence
from caliv_graph.requirements import unmet_requirements
from caliv_graph.trajectory.heading import HeadingDisagreement, heading_disagreement
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.uncertainty import consistency
from caliv_graph.uncertainty.observability import assess


@dataclass(frozen=True)
class CalibrationRun:
    """What a run leaves: the result, and what it was made from.

    Attributes:
        calibration: the result to write.
        solution: the solved graph.
        observations: the target's clouds.
        warnings: what a person should know, a line each.
        evidence: what the report shows beside these; None: nothing was kept.
    """

    calibration: Calibration
    solution: Solution
    observations: tuple[TargetObservation, ...]
    warnings: tuple[str, ...]
    evidence: Evidence | None = None


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
        progress: told of every stage.
        prior: an earlier calibration of the vehicle. Its mountings are the guesses that the solve
            starts from, and what its drives' data say is added to what these drives' say. The
            solve itself does without: it shall find a mount that has moved since.

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
    # What goes by is looked at in the report; nothing is read for it.
    sampled = [SampledRecording(recording) for recording in recordings]
    recordings = sampled
    motions = {i: recording.motion() for i, recording in enumerate(recordings)}
    digests = [drive_digest(motion) for motion in motions.values()]
    asked = config
    if prior is not None:
        config = starting_from(config, prior, digests)
    prepared = prepare(recordings, config, motions, progress)
    trajectories, observations = prepared.trajectories, prepared.observations
    solution = estimate(observations, trajectories, config, progress, prepared.grounds)
    uncertainty = assess(
        solution.information_data,
        solution.information_prior,
        solution.T_vehicle_lidar,
        solution.held,
    )
    calibration = assemble(solution, uncertainty, asked, recordings, digests)
    headings = _headings(trajectories, motions)
    calibration, untested = _checked(calibration, solution, recordings, trajectories, headings)
    prior_warnings: tuple[str, ...] = ()
    if prior is not None:
        calibration, prior_warnings = with_earlier(calibration, prior)
        calibration = unmet_requirements(calibration, asked)
    return CalibrationRun(
        calibration,
        solution,
        observations,
        (
            *prepared.warnings,
            *_warnings(solution),
            *(heading.warning for heading in headings.values() if heading.warning),
            *untested,
            *prior_warnings,
        ),
        Evidence(
            tuple(Path(recording.name).absolute().name for recording in recordings),
            trajectories,
            prepared.grounds,
            {drive: recording.kept() for drive, recording in enumerate(sampled)},
        ),
    )


def _headings(
    trajectories: Sequence[VehicleTrajectory], motions: Mapping[int, MotionData]
) -> dict[int, HeadingDisagreement]:
    """Per drive that tells it, how the orientation source and the direction of travel differ."""
    out = {}
    for index, trajectory in enumerate(trajectories):
        if isinstance(trajectory, SmoothedTrajectory):
            disagreement = heading_disagreement(trajectory, motions[index])
            if disagreement is not None:
                out[index] = disagreement
    return out


def _checked(
    calibration: Calibration,
    solution: Solution,
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    headings: Mapping[int, HeadingDisagreement],
) -> tuple[Calibration, tuple[str, ...]]:
    """The calibration with what contradicts what, and a line on what could not be tested."""
    drives = [Path(recording.name).name for recording in recordings]
    trusted = [
        name for name, lidar in calibration.lidars.items() if lidar.guess and lidar.guess.fixed
    ]
    untested: tuple[str, ...] = ()
    try:
        between = contrasts(solution, trajectories, trusted)
    except SolveError as e:
        # The result stands; that it was tested must not be believed.
        between = ()
        untested = (f"parts of the drive were not tested against each other: {e}",)
    found = consistency.contradictions(
        consistency.Evidence(
            lidars=calibration.lidars,
            contrasts=between,
            counts=cloud_counts(solution, trajectories),
            registration_scale=solution.registration_scale,
            registration_sigma=registration_sigma(solution),
            assumed=assumptions(solution, drives),
            headings=[
                consistency.Heading(
                    drives[index],
                    heading.yaw_rad,
                    heading.sigma_rad,
                    told_apart=heading.measured or math.isfinite(heading.axle_m),
                    measured=heading.measured,
                )
                for index, heading in headings.items()
            ],
            speed_m_s=typical_speed(solution, trajectories),
        )
    )
    if found:
        calibration = replace(calibration, status="inconsistent", contradictions=found)
    return calibration, untested


def _warnings(solution: Solution) -> tuple[str, ...]:
    out = [*solution.warnings]
    for registration in solution.registrations:
        if not registration.converged:
            turn, shift = registration.last_step
            out.append(
                f"{registration.observation.name}: shape and poses still moved by "
                f"{1e3 * turn:.2f} mrad and {1e3 * shift:.2f} mm in the last of "
                f"{registration.iterations} iterations: trust the result no further than its sigmas"
            )
    return tuple(out)


def assemble(
    solution: Solution,
    uncertainty: Uncertainty,
    config: Config,
    recordings: Sequence[Recording],
    digests: Sequence[str] = (),
) -> Calibration:
    """The reported result: every LiDAR of the config, in its order, in right perturbations.

    Args:
        solution: the solved graph.
        uncertainty: of it.
        config: guesses, and what was asked.
        recordings: the drives, for the provenance.
        digests: of the drives (`drive_digest`).
    """
    names = config.lidar_order()
    index = {name: i for i, name in enumerate(solution.lidars)}
    used = _scans_used(solution)
    size = 6 * len(names)
    to_right = np.zeros((size, 6 * len(solution.lidars)))
    cov_joint, information = np.zeros((size, size)), np.zeros((size, size))
    guesses = {name: _guess(config, name) for name in names}
    information_data, gradient_data = _without_trust(solution, guesses)
    poses: dict[str, gtsam.Pose3] = {}
    for row, name in enumerate(names):
        block = slice(6 * row, 6 * row + 6)
        if name in index:
            poses[name] = solution.T_vehicle_lidar[name]
            column = slice(6 * index[name], 6 * index[name] + 6)
            to_right[block, column] = right_to_vehicle_axes(poses[name]).T
        else:
            poses[name] = guesses[name].T_vehicle_lidar
            cov_joint[block, block] = guess_covariance(guesses[name], poses[name])
    cov_joint += to_right @ solution.cov @ to_right.T
    information += to_right @ information_data @ to_right.T
    lidars = {}
    for row, name in enumerate(names):
        block = slice(6 * row, 6 * row + 6)
        lidars[name] = LidarResult(
            T_vehicle_lidar=poses[name],
            cov=cov_joint[block, block],
            determined=dict(uncertainty.determined.get(name, dict.fromkeys(AXES, False))),
            scans_used=used.get(name, 0),
            saw_target=used.get(name, 0) > 0,
            time_offset=solution.time_offsets.get(name),
            guess=guesses[name],
        )
    complete = not uncertainty.undetermined and all(
        all(lidar.determined.values()) for lidar in lidars.values()
    )
    draft = Calibration(
        status="ok" if complete else "partial",
        reference=solution.reference,
        lidars=lidars,
        cov_joint=0.5 * (cov_joint + cov_joint.T),
        information_data=0.5 * (information + information.T),
        undetermined=uncertainty.undetermined,
        weak=uncertainty.weak,
        unmet=(),
        provenance=_provenance(config, recordings, solution, digests),
        gradient_data=None if gradient_data is None else to_right @ gradient_data,
    )
    return unmet_requirements(draft, config)


def _guess(config: Config, name: str) -> Guess:
    """What the config says of a mounting."""
    lidar = config.lidars[name]
    sigmas = TRUSTED_SIGMAS if lidar.fixed else sigmas_from_mounting(lidar.sigma)
    return Guess(pose_from_mounting(lidar.initial), sigmas, lidar.fixed)


def _without_trust(solution: Solution, guesses: Mapping[str, Guess]) -> tuple[Array, Array | None]:
    """Information and gradient of the data (vehicle axes), less what `fixed: true` put in.

    The solve takes a trusted mounting for one more measurement; it is still a guess, and two
    calibrations that share it must not count it twice.
    """
    information = solution.information_data.copy()
    gradient = None if solution.gradient_data is None else solution.gradient_data.copy()
    seen = {c.lidar for r in solution.registrations for c in r.observation.clouds}
    for i, name in enumerate(solution.lidars):
        rows = slice(6 * i, 6 * i + 6)
        guess = guesses[name]
        if not guess.fixed:
            continue
        certainty = guess.sigmas**-2.0
        information[rows, rows] -= np.diag(certainty)
        if gradient is not None:
            moved = vehicle_axes_difference(solution.T_vehicle_lidar[name], guess.T_vehicle_lidar)
            gradient[rows] += certainty * moved
        if name not in seen:
            # Nothing is left but the rounding of large numbers.
            information[rows], information[:, rows] = 0.0, 0.0
            if gradient is not None:
                gradient[rows] = 0.0
    return information, gradient


def _scans_used(solution: Solution) -> dict[str, int]:
    """Per LiDAR, the scans whose clouds carry at least half their weight."""
    out: dict[str, int] = {}
    for registration, weights in zip(solution.registrations, solution.cloud_weights, strict=True):
        for cloud, weight in zip(registration.observation.clouds, weights, strict=True):
            out[cloud.lidar] = out.get(cloud.lidar, 0) + int(weight >= 0.5)
    return out


def _provenance(
    config: Config, recordings: Sequence[Recording], solution: Solution, digests: Sequence[str]
) -> dict[str, object]:
    """Versions, what was asked, and what the solve found out about its input."""
    # Where the drive lies on this machine is no part of what was asked.
    asked = config.model_copy(update={"data": config.data.model_copy(update={"path": None})})
    return {
        "caliv_graph": caliv_graph.__version__,
        "config_sha256": hashlib.sha256(dump_config(asked).encode()).hexdigest(),
        "mode": solution.mode,
        "robust_kernel": config.robust.kernel,
        "recordings": [Path(r.name).absolute().name for r in recordings],
        **({DRIVES: list(digests)} if digests else {}),
        **({} if solution.pose_noise is None else {"pose_noise": asdict(solution.pose_noise)}),
        "registration_scale": solution.registration_scale,
        "iterations": solution.iterations,
        "converged": solution.converged,
    }
