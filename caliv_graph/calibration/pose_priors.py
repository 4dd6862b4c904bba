"""What the motion data say of many poses of each drive: the prior that structure is solved under.

The same Gaussians as the graph's own factors of the poses (`graph.pose_graph`), at more stamps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np
import scipy.linalg

from caliv_graph.calibration.heave import with_heave
from caliv_graph.calibration.vehicle_parameters import (
    POSE_TIME_OFFSET,
    ParameterPrior,
    ParameterValue,
    chart_of,
    motion_gaussian,
    parameter_priors,
    pose_clock_prior,
)
from caliv_graph.config.model import Config
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.geometry.se3 import unstack
from caliv_graph.products import Array, IntArray, PoseNoise
from caliv_graph.structure.prior import PosePrior
from caliv_graph.trajectory.chain import inverse_of
from caliv_graph.trajectory.noise import given_pose_covariances
from caliv_graph.trajectory.select import GivenTrajectory, VehicleTrajectory, twists_at
from caliv_graph.trajectory.smoothed import JointInformation, SmoothedTrajectory

WALK_RAD, WALK_M = 1e-3, 0.02
"""Random walk of the odometry of a LiDAR over 0.1 s, 1 sigma per axis: several times what a scan
is laid on the map with where walls face it, and what constant velocity may be off in the middle
between two scans. Structure, which sees the same scans, shall decide alone: the prior only ties
LiDARs to each other whose stamps lie between those of others, and bridges scans that see little."""

GAUGE_RAD, GAUGE_M = 1e-5, 1e-4
"""Of the first pose of an odometry, which is the origin of its map."""


def pose_priors(
    trajectories: Sequence[VehicleTrajectory],
    stamps_ns: Mapping[int, IntArray],
    heave_m: float,
    noise: PoseNoise,
    config: Config,
) -> dict[int, PosePrior]:
    """The prior of the poses of some drives.

    Args:
        trajectories: one per drive.
        stamps_ns: drive -> (m,) stamps, strictly increasing; a smoothed trajectory has nodes there.
        heave_m: 1 sigma of the heave; given poses contain it.
        noise: of given poses.
        config: for the covariances that messages state.

    Raises:
        KeyError: a stamp has no node.
    """
    smoothed = [t for t in trajectories if isinstance(t, SmoothedTrajectory)]
    priors = parameter_priors(smoothed)
    out = {}
    for drive, stamps in stamps_ns.items():
        trajectory = trajectories[drive]
        if isinstance(trajectory, SmoothedTrajectory):
            out[drive] = _smoothed(trajectory, stamps, heave_m, priors)
        elif isinstance(trajectory, GivenTrajectory) and trajectory.odometry is not None:
            out[drive] = odometry_prior(trajectory, stamps)
        elif isinstance(trajectory, GivenTrajectory):
            out[drive] = _given(trajectory, stamps, noise, config)
    return out


def _smoothed(
    trajectory: SmoothedTrajectory,
    stamps_ns: IntArray,
    heave_m: float,
    priors: Mapping[str, ParameterPrior],
) -> PosePrior:
    joint, values = motion_gaussian(trajectory, stamps_ns, heave_m)
    covs = [priors[name].cov for name in values]
    offsets = [_offset(priors[name], value) for name, value in values.items()]
    nothing = np.zeros((0, 0))
    return PosePrior(
        stamps_ns=np.asarray(stamps_ns, np.int64),
        T_map_vehicle=joint.T_map_vehicle,
        parameters=values,
        information=joint.information,
        gradient=joint.gradient,
        parameter_information=(
            np.asarray(scipy.linalg.block_diag(*map(np.linalg.inv, covs))) if covs else nothing
        ),
        parameter_offset=np.concatenate([np.zeros(0), *offsets]),
        chart=chart_of(trajectory),
    )


def plain_prior(joint: JointInformation, stamps_ns: IntArray, heave_m: float) -> PosePrior:
    """The prior of poses alone, from their Gaussian; the other arguments as in `pose_priors`."""
    H, b = with_heave(joint.information, joint.gradient, len(stamps_ns), heave_m)
    return _on_poses(np.asarray(stamps_ns, np.int64), joint.T_map_vehicle, H, b)


def _on_poses(
    stamps: IntArray, poses: Sequence[gtsam.Pose3], information: Array, gradient: Array
) -> PosePrior:
    return PosePrior(
        stamps_ns=stamps,
        T_map_vehicle=tuple(poses),
        parameters={},
        information=information,
        gradient=gradient,
        parameter_information=np.zeros((0, 0)),
        parameter_offset=np.zeros(0),
    )


def _offset(prior: ParameterPrior, value: ParameterValue) -> Array:
    """(p,) the value less the mean of its prior."""
    mean = prior.mean
    if isinstance(value, gtsam.Rot3) or isinstance(mean, gtsam.Rot3):
        assert isinstance(value, gtsam.Rot3)
        assert isinstance(mean, gtsam.Rot3)
        return np.asarray(gtsam.Rot3.Logmap(mean.between(value)))
    return value - mean


def _given(
    trajectory: GivenTrajectory, stamps_ns: IntArray, noise: PoseNoise, config: Config
) -> PosePrior:
    """`given_prior`, and the clock of the poses, which is a parameter."""
    prior, clock = given_prior(trajectory, stamps_ns, noise, config), pose_clock_prior(config)
    if clock is None:
        return prior
    return _with_clock(prior, twists_at(trajectory, prior.stamps_ns.tolist()), clock)


def given_prior(
    trajectory: GivenTrajectory, stamps_ns: IntArray, noise: PoseNoise, config: Config
) -> PosePrior:
    """White and Gauss-Markov errors of given poses: rotation in vehicle, position in map axes."""
    stamps = np.asarray(stamps_ns, np.int64)
    R, t = trajectory.poses_at(stamps)
    m = len(stamps)
    times = (stamps - stamps[0]) / NANOSECONDS_PER_SECOND
    slow = np.exp(-np.abs(times[:, None] - times) / noise.drift_time_s)
    cov = np.zeros((m, 6, m, 6))
    drift, white = (
        np.array([rotation] * 3 + [position] * 3) ** 2
        for rotation, position in (
            (noise.drift_rotation_rad, noise.drift_position_m),
            (noise.white_rotation_rad, noise.white_position_m),
        )
    )
    axes, each = np.arange(6), np.arange(m)
    cov[:, axes, :, axes] = drift[:, None, None] * slow
    own = np.tile(np.diag(white), (m, 1, 1))
    stated = given_pose_covariances(trajectory.error_covariances(stamps), config)
    if stated is not None:
        known = np.isfinite(stated).all(axis=(1, 2))
        own[known] = stated[known]
    cov[each, :, each, :] += own
    information = inverse_of(cov.reshape(6 * m, 6 * m)).reshape(m, 6, m, 6)
    # A right perturbation moves the position by R dt.
    information[:, 3:] = np.einsum("iba,ibjk->iajk", R, information[:, 3:])
    information[..., 3:] = np.einsum("jba,ikjb->ikja", R, information[..., 3:])
    flat = information.reshape(6 * m, 6 * m)
    return _on_poses(stamps, unstack(R, t), flat, np.zeros(6 * m))


def _with_clock(prior: PosePrior, twists: Array, clock: ParameterPrior) -> PosePrior:
    """The prior of given poses that are all late alike: they are moved along `twists` (m, 6)."""
    late = twists.reshape(-1, 1)
    coupling = -prior.information @ late
    return replace(
        prior,
        parameters={POSE_TIME_OFFSET: np.zeros(1)},
        information=np.block([[prior.information, coupling], [coupling.T, -late.T @ coupling]]),
        gradient=np.append(prior.gradient, 0.0),
        parameter_information=np.asarray(np.linalg.inv(clock.cov), np.float64),
        parameter_offset=np.zeros(1),
    )


def odometry_prior(trajectory: GivenTrajectory, stamps_ns: IntArray) -> PosePrior:
    """A random walk from pose to pose, as loose as that nothing but what stands still counts.

    The motion from one pose to the next is that of the odometry to `WALK_RAD` and `WALK_M`. It is
    held for the vehicle frame that the odometry was given, so its information is used with the
    mounting of the tracked LiDAR held alone (`structure.relative`).
    """
    stamps = np.asarray(stamps_ns, np.int64)
    R, t = trajectory.poses_at(stamps)
    poses = unstack(R, t)
    m = len(stamps)
    information = np.zeros((6 * m, 6 * m))
    unit = np.repeat([WALK_RAD, WALK_M], 3)
    information[:6, :6] = np.diag(np.repeat([GAUGE_RAD, GAUGE_M], 3) ** -2.0)
    for i in range(m - 1):
        steps = (stamps[i + 1] - stamps[i]) / NANOSECONDS_PER_SECOND / 0.1
        weight = np.diag(unit**-2.0 / steps)
        # Log(Z^-1 X_i^-1 X_j) = d_j - Ad(X_j^-1 X_i) d_i
        J = np.hstack([-poses[i + 1].between(poses[i]).AdjointMap(), np.eye(6)])
        both = slice(6 * i, 6 * i + 12)
        information[both, both] += J.T @ weight @ J
    return _on_poses(stamps, poses, information, np.zeros(6 * m))
