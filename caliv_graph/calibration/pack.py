"""Packing the result: estimates, residuals, covariance, the graph and its linearisation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from caliv_graph.calibration.graph import cloud_graph, merged, pose_graph
from caliv_graph.calibration.problem import moved_map
from caliv_graph.calibration.reduced import Reduced
from caliv_graph.calibration.solve import SolveState, cloud_residuals, guessed_graph, measured_poses
from caliv_graph.calibration.vehicle_parameters import KEYS, NAMES, estimated_parameters
from caliv_graph.config.noise import NoiseConfig
from caliv_graph.conventions import key_target, key_vehicle
from caliv_graph.errors import SolveError
from caliv_graph.products import Array, PoseNoise, Registration, Solution
from caliv_graph.uncertainty.suspects import DRIFT_M, DRIFT_RAD


def packed_solution(
    state: SolveState,
    registrations: Sequence[Registration],
    reduced: Reduced,
    information: Array,
    information_data: Array,
    cov: Array,
    held: tuple[str, ...],
    iterations: int,
    converged: bool,
    time_offsets: Mapping[str, tuple[float, float]],
) -> Solution:
    """Packs the result, the whole graph and its linearisation: long for the fields of a record.

    Args:
        state: after its last step.
        registrations: the registered clouds.
        reduced: linearisation at the result.
        information: (J, 6, 6) of the graph's pose factors, without robust weights.
        information_data: (6 n, 6 n) of the extrinsics by the data alone, vehicle axes.
        cov: (6 n, 6 n) of the result, vehicle axes.
        held: axes of the reference LiDAR that were held at the guess.
        iterations: of the loop.
        converged: whether its last step was below its tolerance.
        time_offsets: LiDAR -> offset and sigma, seconds.

    Raises:
        SolveError: the covariance is not finite.
    """
    if not (np.isfinite(cov).all() and np.isfinite(information_data).all()):
        raise SolveError("the covariance of the extrinsics is not finite")
    problem, measured = state.problem, measured_poses(registrations)[0]
    weights = state.weights.values
    clouds = cloud_graph(problem, measured, information * weights[:, None, None])
    graph = merged(guessed_graph(state), clouds)
    roots = np.linalg.cholesky(information)
    whitened = np.einsum("jba,jb->ja", roots, cloud_residuals(reduced.lines, measured))
    placements = problem.clouds_of_placements()
    vehicle = estimated_parameters(problem.parameters, state.values, reduced, cov)
    return Solution(
        mode=state.config.solve.mode,
        lidars=problem.lidars,
        reference=problem.reference,
        T_vehicle_lidar=problem.extrinsics(state.values),
        T_map_vehicle={
            pose: moved_map(state.values.atPose3(key_vehicle(i)), problem.origins_map[pose[0]])
            for i, pose in enumerate(problem.poses)
        },
        T_target_map=tuple(_target_in_its_map(state, m) for m in range(problem.placements)),
        registrations=tuple(registrations),
        cloud_weights=tuple(weights[own] for own in placements),
        residuals=tuple(whitened[own] for own in placements),
        pose_noise=state.noise if problem.given().any() else None,
        registration_scale=state.scale,
        range_bias_m=state.bias_sizes.least_m,
        information_data=information_data,
        information_prior=problem.guess_information(),
        cov=cov,
        held=held,
        iterations=iterations,
        converged=converged,
        graph=graph,
        factor_kinds=tuple(graph.kinds),
        values=state.values,
        linearised=reduced.linearised(
            problem,
            pose_graph(problem, state.noise, state.motion),
            pose_graph(problem, sound_noise(state.noise, state.config.noise), state.motion)
            if problem.given().any()
            else None,
        ),
        time_offsets=time_offsets,
        gradient_data=reduced.c,
        vehicle={NAMES[name]: found for name, found in vehicle.items()},
        information_knowing={
            NAMES[name]: reduced.information_knowing(KEYS[name]) for name in vehicle
        },
        structure=state.structure,
    )


def sound_noise(noise: PoseNoise, config: NoiseConfig) -> PoseNoise:
    """The noise of given poses, their drift at most that of sound ones unless the user states it.

    The fit of the noise takes a drift by decimetres for noise, and nothing would contradict it.
    """
    position_m, rotation_rad = noise.drift_position_m, noise.drift_rotation_rad
    if config.pose_drift_position_m is None:
        position_m = min(position_m, DRIFT_M)
    if config.pose_drift_rotation_deg is None:
        rotation_rad = min(rotation_rad, DRIFT_RAD)
    return replace(noise, drift_position_m=position_m, drift_rotation_rad=rotation_rad)


def _target_in_its_map(state: SolveState, placement: int) -> gtsam.Pose3:
    """T_target_map of a placement in the map of its drive."""
    problem = state.problem
    cloud = int(np.flatnonzero(problem.cloud_placement == placement)[0])
    drive = problem.poses[problem.cloud_pose[cloud]][0]
    T_target_map = state.values.atPose3(key_target(placement))
    return T_target_map.compose(gtsam.Pose3(gtsam.Rot3(), -problem.origins_map[drive]))
