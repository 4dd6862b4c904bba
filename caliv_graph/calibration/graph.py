"""The factor graph: assembling, solving, and reading its information on the extrinsics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import gtsam
import numpy as np

from caliv_graph.calibration.factors import (
    extrinsic_prior,
    gauss_markov_factor,
    given_pose_factor,
    target_pose_factor,
)
from caliv_graph.calibration.problem import Problem
from caliv_graph.calibration.vehicle_parameters import KEYS, POSE_TIME_OFFSET
from caliv_graph.conventions import (
    key_extrinsic,
    key_pose_error,
    key_rates,
    key_target,
    key_vehicle,
)
from caliv_graph.errors import SolveError
from caliv_graph.geometry.chart import PoseChart
from caliv_graph.products import Array, PoseNoise
from caliv_graph.trajectory.factors import Gaussian
from caliv_graph.trajectory.rates import RATES

OFFSET_SIGMA_S = 0.05
"""Prior sigma of a LiDAR's time offset: half a revolution at 10 Hz."""

FactorKind = Literal[
    "motion",
    "vehicle_parameter",
    "given_pose",
    "pose_error_start",
    "pose_error_step",
    "time_offset",
    "extrinsic_prior",
    "cloud",
    "ground_prior",
    "ground_height",
    "ground_tilt",
    "ground_bias",
    "ground_plane",
    "standing",
    "parallel",
    "structure",
    "rates",
]


class CalibrationGraph(gtsam.NonlinearFactorGraph):
    """A factor graph that knows what is in it.

    Attributes:
        kinds: the kind of each of its factors, in order.
        gaussians: those on many poses at once.
        gaussian_kinds: their kinds.
        others: all factors but these.
    """

    def __init__(self) -> None:
        super().__init__()
        self.kinds: list[FactorKind] = []
        self.gaussians: list[Gaussian] = []
        self.gaussian_kinds: list[FactorKind] = []
        self.others = gtsam.NonlinearFactorGraph()

    def append(self, kind: FactorKind, factor: gtsam.NonlinearFactor) -> None:
        """Adds a factor."""
        self.add(factor)
        self.others.add(factor)
        self.kinds.append(kind)

    def append_gaussian(self, kind: FactorKind, gaussian: Gaussian) -> None:
        """Adds a Gaussian on many poses at once."""
        self.add(gaussian.factor())
        self.gaussians.append(gaussian)
        self.gaussian_kinds.append(kind)
        self.kinds.append(kind)


def pose_error_sigmas(noise: PoseNoise) -> Array:
    """(6,) stationary sigmas of the Gauss-Markov pose error."""
    return np.array([noise.drift_rotation_rad] * 3 + [noise.drift_position_m] * 3)


def motion_graph(problem: Problem) -> CalibrationGraph:
    """The joint Gaussian of motion data on the vehicle's poses, a factor per drive that has them.

    Where lever arm and rotation of the IMU are uncertain they are variables of these factors, with
    one prior each for all drives. A factor has the correlations of hundreds of poses and takes time
    to build.
    """
    graph = CalibrationGraph()
    drives = problem.drives()
    for drive, information in problem.motion.items():
        of_drive = np.flatnonzero(drives == drive).tolist()
        keys = [key_vehicle(i) for i in of_drive]
        poses = [problem.T_map_vehicle[i] for i in of_drive]
        term = problem.motion_terms.get(drive)
        if term is None:
            nothing = np.zeros(len(information))
            graph.append_gaussian(
                "motion",
                Gaussian(tuple(keys), tuple(poses), information, nothing, chart=PoseChart()),
            )
            continue
        keys += [KEYS[name] for name in term.values]
        means = (*poses, *term.values.values())
        graph.append_gaussian(
            "motion",
            Gaussian(
                tuple(keys), means, term.information, term.gradient, term.constant, term.chart
            ),
        )
    for name, prior in problem.parameters.items():
        noise, mean = gtsam.noiseModel.Gaussian.Covariance(prior.cov), prior.mean
        if isinstance(mean, gtsam.Rot3):
            graph.append("vehicle_parameter", gtsam.PriorFactorRot3(KEYS[name], mean, noise))
        else:
            graph.append("vehicle_parameter", gtsam.PriorFactorVector(KEYS[name], mean, noise))
    return graph


def pose_graph(
    problem: Problem, noise: PoseNoise, motion: CalibrationGraph | None = None
) -> CalibrationGraph:
    """The vehicle's poses without any LiDAR; `motion` is `motion_graph(problem)`, if built before.

    Given poses have white and Gauss-Markov errors (`noise`), smoothed ones a joint Gaussian.
    """
    graph = merged(motion_graph(problem) if motion is None else motion)
    times, drives, given = problem.times_s(), problem.drives(), problem.given()
    stationary = pose_error_sigmas(noise)
    stated, rates = problem.stated(), problem.given_rates
    for i in np.flatnonzero(given).tolist():
        T = problem.T_map_vehicle[i]
        graph.append(
            "given_pose",
            given_pose_factor(
                key_vehicle(i),
                key_pose_error(i),
                T,
                noise.white_rotation_rad,
                noise.white_position_m,
                problem.stated_cov[i] if problem.stated_cov is not None and stated[i] else None,
                None if rates is None else (KEYS[POSE_TIME_OFFSET], rates[i]),
            ),
        )
        if i == 0 or drives[i] != drives[i - 1]:
            start = gtsam.noiseModel.Diagonal.Sigmas(stationary)
            graph.append(
                "pose_error_start",
                gtsam.PriorFactorVector(key_pose_error(i), np.zeros(6), start),
            )
        else:
            decay = float(np.exp(-(times[i] - times[i - 1]) / noise.drift_time_s))
            step = stationary * np.sqrt(1.0 - decay**2)
            graph.append(
                "pose_error_step",
                gauss_markov_factor(key_pose_error(i - 1), key_pose_error(i), decay, step),
            )
    return graph


def prior_graph(problem: Problem, lidars: Sequence[str]) -> CalibrationGraph:
    """The initial guesses of the named LiDARs."""
    graph = CalibrationGraph()
    for name in lidars:
        graph.append(
            "extrinsic_prior",
            extrinsic_prior(
                problem.extrinsic_keys_of(name), problem.guesses[name], problem.prior_sigmas[name]
            ),
        )
    return graph


def offset_graph(problem: Problem) -> CalibrationGraph:
    """The prior on each free time offset."""
    graph = CalibrationGraph()
    for key in problem.offset_keys():
        sigma = gtsam.noiseModel.Isotropic.Sigma(1, OFFSET_SIGMA_S)
        graph.append("time_offset", gtsam.PriorFactorVector(key, np.zeros(1), sigma))
    return graph


def cloud_graph(
    problem: Problem, measured: Sequence[gtsam.Pose3], information: Array
) -> CalibrationGraph:
    """One pose factor per registered cloud; `information` (J, 6, 6) has the weights in it."""
    graph = CalibrationGraph()
    for j, Z in enumerate(measured):
        graph.append(
            "cloud",
            target_pose_factor(problem.cloud_keys(j), Z, information[j], problem.cloud_motion(j)),
        )
    return graph


def initial_values(
    problem: Problem,
    measured: Sequence[gtsam.Pose3],
    start: Mapping[str, gtsam.Pose3] | None = None,
) -> gtsam.Values:
    """The guesses, the given poses, and the target frames that fit the median cloud.

    `start` are extrinsics that are nearer than the guesses.
    """
    extrinsics = {**problem.guesses, **(start or {})}
    values = gtsam.Values()
    for i, T in enumerate(problem.T_map_vehicle):
        values.insert(key_vehicle(i), T)
    for key in problem.pose_error_keys():
        values.insert(key, np.zeros(6))
    for key in problem.offset_keys():
        values.insert(key, np.zeros(1))
    for drive in sorted(problem.swept_drives()):
        values.insert(key_rates(drive), np.zeros(RATES))
    for key, value in problem.parameter_values().items():
        values.insert(key, value)
    E = extrinsics[problem.reference]
    values.insert(key_extrinsic(), E)
    for name in problem.lidars:
        for key in problem.extrinsic_keys_of(name)[1:]:
            values.insert(key, E.between(extrinsics[name]))
    for m in range(problem.placements):
        candidates = []
        for j in np.flatnonzero(problem.cloud_placement == m).tolist():
            X = problem.T_map_vehicle[problem.cloud_pose[j]]
            extrinsic = extrinsics[problem.lidars[problem.cloud_lidar[j]]]
            candidates.append(measured[j].compose(X.compose(extrinsic).inverse()))
        values.insert(key_target(m), _median_pose(candidates))
    return values


def with_given_poses(problem: Problem, values: gtsam.Values) -> gtsam.Values:
    """The same extrinsics and targets, with the poses as they were given."""
    out = gtsam.Values(values)
    for i, T in enumerate(problem.T_map_vehicle):
        out.update(key_vehicle(i), T)
    for key in problem.pose_error_keys():
        out.update(key, np.zeros(6))
    for drive in problem.rate_rows:
        if out.exists(key_rates(drive)):
            out.update(key_rates(drive), np.zeros(RATES))
    for key, value in problem.parameter_values().items():
        out.update(key, value)
    return out


def _median_pose(poses: Sequence[gtsam.Pose3]) -> gtsam.Pose3:
    """The pose with the smallest sum of distances to the others, measured at the target."""
    if not poses:
        return gtsam.Pose3()
    centres = np.array([p.inverse().translation() for p in poses])
    total = np.linalg.norm(centres[:, None] - centres[None], axis=2).sum(axis=1)
    return poses[int(total.argmin())]


def merged(*graphs: CalibrationGraph) -> CalibrationGraph:
    """All factors of several graphs in one."""
    out = CalibrationGraph()
    for graph in graphs:
        out.push_back(graph)
        out.others.push_back(graph.others)
        out.kinds += graph.kinds
        out.gaussians += graph.gaussians
        out.gaussian_kinds += graph.gaussian_kinds
    return out


def optimise(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, iterations: int
) -> gtsam.Values:
    """Levenberg-Marquardt from `values`.

    Raises:
        SolveError: the graph is singular or its error is not finite.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(iterations)
    parameters.setRelativeErrorTol(1e-6)
    parameters.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
    try:
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
        result = optimiser.optimizeSafely()
    except RuntimeError as e:
        raise SolveError(f"the graph could not be solved: {str(e).splitlines()[0]}") from None
    if not np.isfinite(optimiser.error()):
        raise SolveError("the graph could not be solved: its error is not a number")
    return result
