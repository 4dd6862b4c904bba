"""The ground in the graph: a plane per drive, seen by the LiDARs and stood upon by the vehicle.

A plane g is (slope along map x, slope along map y, height in m): `z = height + slopes . (xy -
centre)`, the centre in the middle of the drive, so that height and slopes hardly correlate.
`caliv_graph/calibration/README.md`, "Ground", has the three roles.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.calibration.graph import CalibrationGraph
from caliv_graph.calibration.ground_factors import (
    SWAY_SIGMA_RAD,
    ground_plane_factor,
    parallel_factor,
    standing_factor,
)
from caliv_graph.calibration.ground_floors import sharing_places
from caliv_graph.calibration.problem import Problem
from caliv_graph.calibration.rates import swept_drives
from caliv_graph.config.model import GroundConfig
from caliv_graph.config.range_errors import GROUND_FRAME, UNSTATED, RangeErrors
from caliv_graph.conventions import (
    key_ground,
    key_ground_bias,
    key_height,
    key_parallel,
    key_rates,
    key_vehicle,
)
from caliv_graph.products import Array, GroundObservation, IntArray
from caliv_graph.targets.cloud.views import view_weights
from caliv_graph.trajectory.rates import RATES

PLANE_SIGMAS = np.array([1.0, 1.0, 100.0])
"""Prior of a plane: 45 degrees, and 100 m about the drive's poses. It is weak beside the guesses of
the extrinsics; without it a plane that no LiDAR sees would be singular."""

GROUND_BIASES = 3 + GROUND_FRAME
"""Number of errors that a LiDAR has in common on all the ground it sees: `bias_sigmas`."""

TOGETHER_NS = 5_000_000
"""A scan nearer to a pose than this has the heave of that pose: a body that heaves by 5 mm at 2 Hz
has moved by 0.3 mm."""


@dataclass(frozen=True)
class GroundWeights:
    """Weights of the ground observations.

    Attributes:
        planes: (n,) of each observation, 0 to 1; zero if its LiDAR or pose is not in the problem.
        stands: (m,) of each pose: whether the vehicle stands on the plane there, 0 to 1.
        heave_m: (n,) 1 sigma of the change of heave between the scan and its pose.
    """

    planes: Array
    stands: Array
    heave_m: Array


def ground_centre(problem: Problem, drive: int) -> Array:
    """(2,) where the height of a drive's plane is defined: the mean of its poses, problem's map."""
    places = [
        T.translation()[:2]
        for (d, _), T in zip(problem.poses, problem.T_map_vehicle, strict=True)
        if d == drive
    ]
    return np.asarray(np.mean(places, axis=0), dtype=np.float64)


def ground_centres(problem: Problem, drives: Iterable[int]) -> dict[int, Array]:
    """`ground_centre` of each of some drives, which may be there several times."""
    return {drive: ground_centre(problem, drive) for drive in dict.fromkeys(drives)}


def taken_poses(problem: Problem, observations: Sequence[GroundObservation]) -> IntArray:
    """(n,) index of the pose that each observation was taken from; -1 if the problem has it not."""
    index = {pose: i for i, pose in enumerate(problem.poses)}
    return np.array(
        [
            index.get((o.drive, o.stamp_ns), -1) if o.lidar in problem.lidars else -1
            for o in observations
        ],
        dtype=np.int64,
    )


def seen_drives(observations: Sequence[GroundObservation], taken: IntArray) -> list[int]:
    """Drives with an observation of the problem, ascending."""
    return sorted({o.drive for o, i in zip(observations, taken, strict=True) if i >= 0})


def drives_with_planes(
    problem: Problem, observations: Sequence[GroundObservation], config: GroundConfig
) -> list[int]:
    """Drives whose ground is a plane of the graph, and the errors of the vehicle's stand on it."""
    return seen_drives(observations, taken_poses(problem, observations)) if config.use else []


def biased_lidars(
    problem: Problem, observations: Sequence[GroundObservation], taken: IntArray
) -> list[int]:
    """Index in the problem of each LiDAR whose ground tells what range biases change, ascending."""
    both = zip(observations, taken.tolist(), strict=True)
    names = {o.lidar for o, i in both if i >= 0 and o.by_range_bias is not None}
    return [index for index, name in enumerate(problem.lidars) if name in names]


def full_weights(problem: Problem, observations: Sequence[GroundObservation]) -> GroundWeights:
    """Full weight for every observation with a pose, and for the vehicle standing there."""
    taken = taken_poses(problem, observations)
    stands = np.zeros(len(problem.poses))
    stands[taken[taken >= 0]] = 1.0
    heave = np.array([first_heave(problem, o) for o in observations])
    return GroundWeights((taken >= 0).astype(np.float64), stands, heave)


def first_heave(problem: Problem, observation: GroundObservation) -> float:
    """Heave between scan and pose, metres, before it is estimated: that of two scans.

    Given poses contain it; in IMU, GNSS and wheel data it is below the noise.
    """
    if observation.drive not in problem.motion or abs(observation.apart_ns) <= TOGETHER_NS:
        return 0.0
    return math.sqrt(2.0) * problem.heave_m


def bias_sigmas(ranges: RangeErrors) -> Array:
    """(7,) 1 sigma of what a LiDAR has in common on all the ground that it sees.

    Biases of the ranges, constant and the two of `config.range_errors.growth`, metres; and the
    frame in which it sees the ground (`RangeErrors.ground_frame`). Every scan has the same ones, so
    that they do not average out: they lift and tilt its planes.
    """
    constant_m = math.hypot(ranges.offsets.usual, ranges.ground_m)
    return np.array([constant_m, *[ranges.incidence_m] * 2, *ranges.ground_frame])


def ground_graph(
    problem: Problem,
    observations: Sequence[GroundObservation],
    config: GroundConfig,
    weights: GroundWeights | None = None,
    sway_rad: float | None = None,
    ranges: RangeErrors = UNSTATED,
) -> CalibrationGraph:
    """All factors of the ground; empty if it is not to be used or was not seen.

    Observations of LiDARs and poses that the problem has not are left out. Without `weights` (of
    `ground_weights`) all have full weight. `sway_rad` is 1 sigma of the body's tilt at each pose;
    `ranges` is what is stated of the errors of the ranges.
    """
    graph = CalibrationGraph()
    if not config.use:
        return graph
    taken = taken_poses(problem, observations)
    weights = weights or full_weights(problem, observations)
    drives = seen_drives(observations, taken)
    centres = ground_centres(problem, drives)
    for drive in drives:
        graph.append("ground_prior", _plane_prior(problem, drive))
        if config.vehicle_height is not None:
            graph.append("ground_height", _centred(key_height(drive), np.array([config.sigma])))
        if config.parallel_sigma_deg is not None:
            sigma = math.radians(config.parallel_sigma_deg)
            graph.append("ground_tilt", _centred(key_parallel(drive), np.full(2, sigma)))
    for index in biased_lidars(problem, observations, taken):
        graph.append("ground_bias", _centred(key_ground_bias(index), bias_sigmas(ranges)))
    weight_of = weights.planes * place_weights(problem, observations, taken)
    weighted = zip(
        observations, taken.tolist(), weight_of.tolist(), weights.heave_m.tolist(), strict=True
    )
    for o, i, weight, heave_m in weighted:
        if i >= 0 and weight > 0.0:
            factor = plane_factor_of(problem, o, i, centres[o.drive], weight, heave_m)
            graph.append("ground_plane", factor)
    if config.vehicle_height is None and config.parallel_sigma_deg is None:
        return graph
    waves = _waves_below(problem, weights.stands)
    for i, ((drive, _), weight) in enumerate(
        zip(problem.poses, weights.stands.tolist(), strict=True)
    ):
        if weight <= 0.0 or drive not in centres:
            continue
        X, plane = key_vehicle(i), key_ground(drive)
        tilt_rad, lift_m = waves[i].tolist()
        if config.vehicle_height is not None:
            error, height = key_height(drive), config.vehicle_height
            sigma = math.hypot(problem.heave_m, lift_m)
            factor = standing_factor(X, plane, error, centres[drive], height, weight, sigma)
            graph.append("standing", factor)
        if config.parallel_sigma_deg is not None:
            sigma = math.hypot(SWAY_SIGMA_RAD if sway_rad is None else sway_rad, tilt_rad)
            factor = parallel_factor(X, plane, key_parallel(drive), weight, sigma)
            graph.append("parallel", factor)
    return graph


def _waves_below(problem: Problem, stands: Array) -> Array:
    """(m, 2) 1 sigma of tilt and height of the ground below each pose against its drive's plane.

    Poses of one place know them once, and each counts for its part. `stands` (m,) are weights.
    """
    shares = standing_shares(problem, stands)
    return np.sqrt(shares)[:, None] * problem.floors[[0, 2]]


def standing_shares(problem: Problem, stands: Array) -> Array:
    """(m,) how many poses share the ground below each, itself too; `stands` (m,) are weights.

    Waves stay where they are, as for scans of the ground (`ground_floors.sharing_scans`).
    """
    shares = np.ones(len(stands))
    of_drive = problem.drives()
    for drive in np.unique(of_drive).tolist():
        own = np.flatnonzero((of_drive == drive) & (stands > 0.0))
        places = [problem.T_map_vehicle[i].translation() for i in own.tolist()]
        shares[own] = sharing_places(np.array(places).reshape(-1, 3), stands[own])
    return shares


def plane_factor_of(
    problem: Problem,
    observation: GroundObservation,
    pose: int,
    centre: Array,
    weight: float = 1.0,
    heave_m: float = 0.0,
    rates: bool = True,
) -> gtsam.CustomFactor:
    """`ground_plane_factor` with the variables that a problem has.

    `pose` is the index of the observation's; without `rates` those of the drive are taken as exact.
    """
    keys = (key_vehicle(pose), *problem.extrinsic_keys_of(observation.lidar))
    plane = key_ground(observation.drive)
    bias = key_ground_bias(problem.lidars.index(observation.lidar))
    erring = rates and observation.drive in problem.rate_rows
    of_rates = key_rates(observation.drive) if erring else None
    return ground_plane_factor(keys, plane, centre, observation, weight, heave_m, bias, of_rates)


def place_weights(
    problem: Problem, observations: Sequence[GroundObservation], taken: IntArray
) -> Array:
    """(n,) weights for repeated views: a standing vehicle sees the same bumps in every scan.

    Once the waves of the ground are known, observations say themselves how often they count
    (`GroundObservation.repeated`), and have full weight.
    """
    out = np.ones(len(observations))
    alike: dict[tuple[int, str], list[int]] = {}
    for n, (o, i) in enumerate(zip(observations, taken.tolist(), strict=True)):
        if i >= 0 and o.repeated is None:
            alike.setdefault((o.drive, o.lidar), []).append(n)
    for own in alike.values():
        places = [problem.T_map_vehicle[taken[n]].translation() for n in own]
        out[own] = view_weights(np.array(places))
    return out


def _centred(key: int, sigmas: Array) -> gtsam.PriorFactorVector:
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    return gtsam.PriorFactorVector(key, np.zeros(len(sigmas)), noise)


def _plane_prior(problem: Problem, drive: int) -> gtsam.PriorFactorVector:
    height = np.mean(
        [
            T.translation()[2]
            for (d, _), T in zip(problem.poses, problem.T_map_vehicle, strict=True)
            if d == drive
        ]
    )
    noise = gtsam.noiseModel.Diagonal.Sigmas(PLANE_SIGMAS)
    return gtsam.PriorFactorVector(key_ground(drive), np.array([0.0, 0.0, height]), noise)


def ground_values(
    problem: Problem,
    observations: Sequence[GroundObservation],
    values: gtsam.Values,
    config: GroundConfig,
) -> gtsam.Values:
    """First values of the variables of `ground_graph`, and of no others.

    `values` has poses and extrinsics; guesses will do.
    """
    out = gtsam.Values()
    if not config.use:
        return out
    taken = taken_poses(problem, observations)
    for drive in seen_drives(observations, taken):
        centre = ground_centre(problem, drive)
        slopes, feet = [], []
        for o, i in zip(observations, taken.tolist(), strict=True):
            if i >= 0 and o.drive == drive:
                T = values.atPose3(key_vehicle(i)).compose(problem.extrinsic(values, o.lidar))
                n = T.rotation().matrix() @ o.normal_lidar
                slopes.append(-n[:2] / n[2])
                feet.append(T.translation() - o.distance_m * n)
        slope = np.median(slopes, axis=0)
        # At the vehicle, not at the centre: from afar a wrong tilt gives a wrong height.
        heights = [foot[2] - slope @ (foot[:2] - centre) for foot in feet]
        out.insert(key_ground(drive), np.append(slope, np.median(heights)))
        if config.vehicle_height is not None:
            out.insert(key_height(drive), np.zeros(1))
        if config.parallel_sigma_deg is not None:
            out.insert(key_parallel(drive), np.zeros(2))
    for index in biased_lidars(problem, observations, taken):
        out.insert(key_ground_bias(index), np.zeros(GROUND_BIASES))
    for drive in swept_drives(problem, observations):
        if not values.exists(key_rates(drive)):
            out.insert(key_rates(drive), np.zeros(RATES))
    return out
