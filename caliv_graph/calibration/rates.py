"""Errors of the rates of a drive in the graph: variables that follow from its poses.

Points are moved to the time of their pose with the rates of the trajectory (README, section 2a).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from caliv_graph.calibration.graph import CalibrationGraph
from caliv_graph.calibration.ground_factors import moved
from caliv_graph.calibration.linear import CloudLinearisation
from caliv_graph.calibration.problem import Problem
from caliv_graph.conventions import NANOSECONDS_PER_SECOND, key_rates, key_vehicle
from caliv_graph.geometry.se3 import turned_twist
from caliv_graph.products import Array, GroundObservation
from caliv_graph.trajectory.rates import RATE_SIGMAS, RATES
from caliv_graph.trajectory.select import VehicleTrajectory, mean_twists


def swept_drives(problem: Problem, grounds: Sequence[GroundObservation]) -> list[int]:
    """Drives with a variable for the errors of their rates, ascending: by clouds or ground."""
    by_ground = {o.drive for o in grounds if o.by_rates is not None}
    return sorted(problem.swept_drives() | (by_ground & set(problem.rate_rows)))


def with_rates_of(
    observations: Sequence[GroundObservation],
    before: Sequence[VehicleTrajectory],
    after: Sequence[VehicleTrajectory],
) -> tuple[GroundObservation, ...]:
    """Observations as the rates of other trajectories of their drives would have made them.

    The poses of a drive are asked for at once: a call for one takes as long as for hundreds.
    """
    out = list(observations)
    for drive, (one, other) in enumerate(zip(before, after, strict=True)):
        own = [k for k, o in enumerate(out) if o.drive == drive and o.by_rates is not None]
        if one is other or not own:
            continue
        some = [out[k] for k in own]
        R, _ = other.poses_at([o.stamp_ns for o in some])
        twists = [_twists_in_sweeps(some, trajectory) for trajectory in (one, other)]
        for k, R_map_vehicle, then, now in zip(own, R, *twists, strict=True):
            by_rates = out[k].by_rates
            assert by_rates is not None
            changed = moved(out[k], by_rates @ (now - then))
            turned = turned_twist(R_map_vehicle, now)
            out[k] = replace(changed, twist_map=turned, R_map_vehicle=R_map_vehicle)
    return tuple(out)


def _twists_in_sweeps(
    observations: Sequence[GroundObservation], trajectory: VehicleTrajectory
) -> Array:
    """(m, 6) velocity of the vehicle while the points of each observation were taken."""
    first, last = np.array([o.taken_s for o in observations]).T * NANOSECONDS_PER_SECOND
    offsets = np.round([np.minimum(first, 0.0), np.maximum(last, 0.0)]).astype(np.int64)
    stamps = np.array([o.stamp_ns for o in observations], dtype=np.int64)
    begin, end = np.clip(stamps + offsets, *trajectory.span_ns)
    return mean_twists(trajectory, begin, end)


def rates_graph(problem: Problem, grounds: Sequence[GroundObservation]) -> CalibrationGraph:
    """What ties the rates of each drive to its poses; empty where no points were moved."""
    graph = CalibrationGraph()
    drives = problem.drives()
    for drive in swept_drives(problem, grounds):
        poses = {
            key_vehicle(i): problem.T_map_vehicle[i]
            for i in np.flatnonzero(drives == drive).tolist()
        }
        graph.append("rates", rates_factor(key_rates(drive), poses, problem.rate_rows[drive]))
    return graph


def rates_factor(
    key: int, T_map_vehicle: Mapping[int, gtsam.Pose3], rows: Array
) -> gtsam.CustomFactor:
    """`r = e - rows d`: the mean rates of some poses are off by e, as these poses are by d.

    Args:
        key: of e, (RATES,) rad/s, m/s and m, true rates less those that points were moved with.
        T_map_vehicle: the poses that gave these rates, by key: where d, right perturbations, is 0.
        rows: (RATES, 6 m) of `trajectory.rates.rate_rows`.
    """
    parts = np.split(rows, len(T_map_vehicle), axis=1)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        r = values.atVector(key).copy()
        for i, ((pose, T), by_pose) in enumerate(zip(T_map_vehicle.items(), parts, strict=True)):
            away = T.between(values.atPose3(pose))
            r -= by_pose @ gtsam.Pose3.Logmap(away)
            if jacobians is not None:
                jacobians[i] = -by_pose @ gtsam.Pose3.LogmapDerivative(away)
        if jacobians is not None:
            jacobians[len(parts)] = np.eye(RATES)
        return np.asarray(r)

    noise = gtsam.noiseModel.Diagonal.Sigmas(RATE_SIGMAS)
    return gtsam.CustomFactor(noise, [*T_map_vehicle, key], error)


def turned_clouds(problem: Problem, lines: CloudLinearisation) -> Array:
    """(6 J, 3 K) how the K clouds that were moved in time turn by 1 sigma of the gyroscope's noise.

    Left perturbations of the predicted poses, as a turn of the vehicle between the stamp and the
    points makes them. Each cloud has errors of its own.
    """
    sigmas = problem.cloud_turn_rad
    own = [] if sigmas is None else np.flatnonzero(sigmas.any(axis=1)).tolist()
    out = np.zeros((problem.clouds, 6, len(own), 3))
    for k, j in enumerate(own):
        assert sigmas is not None
        at = lines.keys[j].index(key_vehicle(int(problem.cloud_pose[j])))
        out[j, :, k] = lines.jacobians[j][at][:, :3] * sigmas[j]
    return out.reshape(6 * problem.clouds, -1)
