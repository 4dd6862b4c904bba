"""What a recorded drive determines, before it is calibrated.

The early stages of `pipeline.calibrate`: trajectory, target, ground, a rough registration and one
solve of the graph, which puts the mountings near enough to read the information off. Shape and
mountings are not refined together, which is what takes the time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.linalg import block_diag
from threadpoolctl import threadpool_limits

from caliv_graph.calibration.estimate import OFFSET_TOLD_S
from caliv_graph.calibration.graph import (
    CloudLinearisation,
    DenseSystem,
    add_shape,
    cloud_graph,
    dense_system,
    initial_values,
    linearise_clouds,
    merged,
    offset_graph,
    optimise,
    pose_graph,
    prior_graph,
    with_given_poses,
)
from caliv_graph.calibration.ground import ground_graph, ground_values, ground_weights
from caliv_graph.calibration.noise import (
    TYPICAL_SCALE,
    first_pose_noise,
    fit_pose_noise,
    sound_clouds,
)
from caliv_graph.calibration.problem import Problem, pose_problem
from caliv_graph.calibration.robust import explained_part
from caliv_graph.config import Config
from caliv_graph.conventions import key_offset
from caliv_graph.geometry.se3 import pose_from_mounting
from caliv_graph.products import (
    Array,
    GroundObservation,
    PoseNoise,
    Recording,
    Registration,
    TargetObservation,
)
from caliv_graph.progress import Progress
from caliv_graph.registration.register import JointRegistration, register_jointly
from caliv_graph.requirements import unmet_requirements
from caliv_graph.targets import extract_targets
from caliv_graph.targets.ground_planes import measure_grounds
from caliv_graph.trajectory.select import VehicleTrajectory, smooth_trajectories
from caliv_graph.uncertainty.outlook import Outlook, look_ahead, untold_offsets

ROUGH_ITERATIONS = 40
"""Of the registration at most: millimetres do not change what a drive determines."""

SOLVES = 2
"""Graph solves, the ground weighed anew in between."""

STEPS = 10
"""Of Levenberg-Marquardt per solve."""

SOUND_PART = 0.5
"""Of a cloud's points that has to be target, against the typical cloud, for it to count."""


@dataclass(frozen=True)
class Survey:
    """What recorded drives tell.

    Attributes:
        names: of the recordings.
        outlook: sigmas, covariance, directions; mountings are rough estimates.
        scans: (target, LiDAR) -> number of clouds that count.
        unmet: what `require` and `limits` of the config ask for and will not get, a sentence each.
        warnings: what a person should know, a line each.
    """

    names: tuple[str, ...]
    outlook: Outlook
    scans: Mapping[tuple[str, str], int]
    unmet: tuple[str, ...]
    warnings: tuple[str, ...]


def survey(recordings: Sequence[Recording], config: Config, progress: Progress) -> Survey:
    """Finds out what recorded drives of one vehicle determine.

    Args:
        recordings: opened drives (`readers.open_recording`).
        config: as for `calibrate`.
        progress: told of every stage.

    Raises:
        CalivError: something is wrong with the input; the message says what to do.
    """
    motions = {i: recording.motion() for i, recording in enumerate(recordings)}
    with progress.stage("smoothing the trajectory", None):
        rough = smooth_trajectories(recordings, config, [[] for _ in recordings], motions)
    observations = extract_targets(recordings, rough, config, progress)
    grounds, ground_warnings = measure_grounds(recordings, rough, observations, config, progress)
    with progress.stage("smoothing the trajectory at the target's scans", None):
        seen = {(cloud.drive, cloud.stamp_ns) for o in observations for cloud in o.clouds}
        stamps = [sorted(t for d, t in seen if d == drive) for drive in range(len(recordings))]
        trajectories = smooth_trajectories(recordings, config, stamps, motions)
    warnings = [w for r in recordings for w in r.warnings()]
    warnings += [w for t in trajectories for w in t.warnings]
    warnings += [w for o in observations for w in o.warnings]
    used = [o for o in observations if len(o.clouds) >= 2]
    used = [replace(o, placement=m) for m, o in enumerate(used)]
    with threadpool_limits(limits=1):
        found = survey_observations(used, trajectories, grounds, config, progress)
    return replace(
        found,
        names=tuple(recording.name for recording in recordings),
        warnings=(*warnings, *ground_warnings, *found.warnings),
    )


@dataclass
class _Rough:
    """A problem, solved roughly."""

    problem: Problem
    values: gtsam.Values
    noise: PoseNoise
    scale: float
    weights: Array
    steady: gtsam.NonlinearFactorGraph


def survey_observations(
    observations: Sequence[TargetObservation],
    trajectories: Sequence[VehicleTrajectory],
    grounds: Sequence[GroundObservation],
    config: Config,
    progress: Progress,
) -> Survey:
    """The same from extracted targets and grounds; without names and the warnings before it.

    Args:
        observations: clouds of each target placement, numbered from 0.
        trajectories: one per drive.
        grounds: the ground as the LiDARs saw it.
        config: modes, kernels, priors.
        progress: told of every stage.

    Raises:
        RegistrationError, SolveError: it could not be done.
    """
    problem = pose_problem(observations, trajectories, config)
    limit = min(config.registration.max_iterations, ROUGH_ITERATIONS)
    registrations = []
    with progress.stage("registering the clouds roughly", len(observations)) as advance:
        for m, observation in enumerate(observations):
            state = JointRegistration(observation, config, rough=True)
            registrations.append(register_jointly(state, _prealigned(problem, m), limit))
            advance()
    with progress.stage("reading the information off the graph", None):
        solved = _solve(problem, registrations, grounds, config)
        system, _ = _system(solved, registrations)
        offsets_s = _offset_sigmas(solved, system)
        told = {name for name, sigma in offsets_s.items() if sigma < OFFSET_TOLD_S}
        if told != problem.offsets:
            # As `calibrate` does: what is not told stays out, for it would take x and yaw along.
            problem = replace(
                problem, offsets=frozenset(told), twists=problem.twists if told else None
            )
            solved = _solve(problem, registrations, grounds, config)
            system, _ = _system(solved, registrations)
        D = _in_vehicle_axes(solved, system)
    return _verdict(solved, D, offsets_s, observations, config)


def _prealigned(problem: Problem, placement: int) -> list[gtsam.Pose3]:
    """T_map_vehicle T_vehicle_lidar of the clouds of a placement, at the guesses."""
    return [
        problem.T_map_vehicle[problem.cloud_pose[j]].compose(
            problem.guesses[problem.lidars[problem.cloud_lidar[j]]]
        )
        for j in np.flatnonzero(problem.cloud_placement == placement).tolist()
    ]


def _solve(
    problem: Problem,
    registrations: Sequence[Registration],
    grounds: Sequence[GroundObservation],
    config: Config,
) -> _Rough:
    """Pose factors of the registered clouds, gross ones left out, noise levels from the data."""
    measured = [T for r in registrations for T in r.T_target_lidar]
    information = np.concatenate([r.information for r in registrations])
    explained = np.concatenate([explained_part(r.inlier_ratio) for r in registrations])
    values = initial_values(problem, measured)
    values.insert(ground_values(problem, grounds, values, config.ground))
    noise, scale = first_pose_noise(config.noise), TYPICAL_SCALE
    weights = np.where(explained > SOUND_PART, 1.0, 0.0)
    stands = None
    for _ in range(SOLVES):
        ground = ground_graph(problem, grounds, config.ground, stands)
        fixed = prior_graph(problem, sorted(problem.fixed))
        steady = merged(pose_graph(problem, noise), offset_graph(problem), ground, fixed)
        guesses = prior_graph(problem, [n for n in problem.lidars if n not in problem.fixed])
        weighted = information / scale**2 * weights[:, None, None]
        clouds = cloud_graph(problem, measured, weighted)
        values = optimise(merged(steady, guesses, clouds), values, STEPS)
        if grounds and config.ground.use:
            stands = ground_weights(problem, grounds, values)
        given = with_given_poses(problem, values)
        sound = sound_clouds(problem, measured, information, given, noise)
        sound &= explained > SOUND_PART
        weights = sound.astype(np.float64)
        noise, scale = fit_pose_noise(problem, measured, information, sound, given, config.noise)
    ground = ground_graph(problem, grounds, config.ground, stands)
    steady = merged(pose_graph(problem, noise), offset_graph(problem), ground, fixed)
    return _Rough(problem, values, noise, scale, weights, steady)


def _system(
    solved: _Rough, registrations: Sequence[Registration]
) -> tuple[DenseSystem, CloudLinearisation]:
    """The data's quadratic: motion, ground, and all clouds with the shape eliminated."""
    lines = linearise_clouds(solved.problem, solved.values)
    root = np.repeat(np.sqrt(solved.weights), 6) / solved.scale
    H = block_diag(*[r.information_joint for r in registrations]) * np.outer(root, root)
    system = dense_system(solved.problem, solved.steady, solved.values)
    return add_shape(system, lines, H, np.zeros(len(H))), lines


def _in_vehicle_axes(solved: _Rough, system: DenseSystem) -> Array:
    """(6n, 6n) information on the mountings, everything else eliminated."""
    back = np.linalg.inv(solved.problem.to_vehicle_axes(solved.values))
    D = back.T @ system.schur()[0] @ back
    return np.asarray(0.5 * (D + D.T))


def _offset_sigmas(solved: _Rough, system: DenseSystem) -> dict[str, float]:
    """LiDAR -> 1 sigma of its time offset in seconds, of those that are free."""
    problem = solved.problem
    if not problem.offsets:
        return {}
    Q = problem.to_vehicle_axes(solved.values)
    cov = np.asarray(np.linalg.inv(system.schur()[0] + Q.T @ _prior(problem) @ Q), np.float64)
    return {
        name: float(np.sqrt(system.covariance_of(key_offset(i), cov)[0, 0]))
        for i, name in enumerate(problem.lidars)
        if name in problem.offsets
    }


def _prior(problem: Problem) -> Array:
    return np.diag(np.concatenate([problem.prior_sigmas[n] for n in problem.lidars]) ** -2.0)


def _verdict(
    solved: _Rough,
    D: Array,
    offsets_s: Mapping[str, float],
    observations: Sequence[TargetObservation],
    config: Config,
) -> Survey:
    problem = solved.problem
    scans: dict[tuple[str, str], int] = {}
    for j in np.flatnonzero(solved.weights > 0.0).tolist():
        target = observations[int(problem.cloud_placement[j])].name
        key = (target, problem.lidars[int(problem.cloud_lidar[j])])
        scans[key] = scans.get(key, 0) + 1
    outlook = look_ahead(
        D,
        problem.lidars,
        problem.reference,
        {
            name: problem.mounting(solved.values, name)
            if name in problem.lidars
            else pose_from_mounting(lidar.initial)
            for name, lidar in config.lidars.items()
        },
        {
            name: problem.prior_sigmas[name]
            if name in problem.lidars
            else np.array([*lidar.sigma.rpy_rad(), *lidar.sigma.xyz_m()])
            for name, lidar in config.lidars.items()
        },
        {name: sum(n for (_, of), n in scans.items() if of == name) for name in problem.lidars},
        offsets_s,
    )
    unmet = unmet_requirements(outlook.calibration, config).unmet
    return Survey((), outlook, scans, unmet, tuple(untold_offsets(offsets_s, OFFSET_TOLD_S)))
