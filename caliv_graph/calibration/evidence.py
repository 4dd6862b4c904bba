"""What the LiDARs see along smoothed trajectories, as residuals with errors of known shape.

Residuals of registered clouds and of ground planes at the smoothed poses. Extrinsics, targets and
planes are the parameters; the errors are those of the registration, of heave and ground, and what
errors of the motion sensors do to the poses (`README.md`, "Noise levels").
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import gtsam
import numpy as np
import scipy.linalg

from caliv_graph.calibration.graph import with_given_poses
from caliv_graph.calibration.ground import (
    GROUND_BIASES,
    PLANE_SIGMAS,
    bias_sigmas,
    biased_lidars,
    ground_centres,
    place_weights,
    plane_factor_of,
    seen_drives,
    taken_poses,
)
from caliv_graph.calibration.linear import linearise_clouds
from caliv_graph.calibration.motion_suspects import motion_parts
from caliv_graph.calibration.noise import evenly_over_drives
from caliv_graph.calibration.problem import Problem
from caliv_graph.calibration.solve import SolveState, measured_poses, of_single_clouds
from caliv_graph.calibration.variance_components import Block, Observed
from caliv_graph.config.range_errors import RangeErrors, range_errors
from caliv_graph.conventions import key_ground, key_ground_bias, key_vehicle
from caliv_graph.products import Array, IntArray, Registration
from caliv_graph.targets.ground.planes import ground_floors
from caliv_graph.trajectory.effects import ErrorEffects, error_effects, smoothed_in_time
from caliv_graph.trajectory.error_likelihood import (
    ErrorLikelihood,
    error_likelihood,
    white_sigmas,
)
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory

ErrorsByStructure = Mapping[int, tuple[Array, Array]]
"""Drive -> information and gradient of what its structure says of the errors of its sensors, as
those of `ErrorLikelihood`."""

NOTHING: ErrorsByStructure = {}

FEWEST_CLOUDS = 16
"""Fewer clouds do not tell noise levels: the usual ones hold."""

MOST_CLOUDS = 36
"""Clouds that are used, spread evenly over the drives: the cost grows with their cube."""

SEEN = 0.5
"""Least weight of a cloud or a ground observation that is used."""

WEAK = 1e-2
"""Information on targets and time offsets, per rad^2, m^2 and s^2."""


@dataclass
class Evidence:
    """What the LiDARs see, linearised at the smoothed poses.

    Attributes:
        observed: residuals of clouds and ground planes; `known`: of poses, points and heave
            between scans.
        by_pose: (N, 6 p) derivatives by right perturbations of p poses.
        white: name of `LEVELS` -> (N, N) covariance at sigma 1.
        effects: per drive, the columns of its poses in `by_pose`, and what errors do to them.
        motion: per drive, what its motion data and its structure say of these errors.
        sensor_sigmas: kind of sensor -> (3,) white 1 sigma of one measurement, map axes.
        stated_over_white: of these, how many times as much its driver states, at most; none is 1.
        clouds: the registration of each cloud, at sigma 1.
    """

    observed: Observed
    by_pose: Array
    white: dict[str, Array]
    effects: list[tuple[IntArray, dict[str, ErrorEffects]]] = field(default_factory=list)
    motion: list[ErrorLikelihood] = field(default_factory=list)
    sensor_sigmas: dict[str, Array] = field(default_factory=dict)
    stated_over_white: dict[str, float] = field(default_factory=dict)
    clouds: list[Block] = field(default_factory=list)
    _moved: dict[tuple[str, tuple[int, ...]], list[tuple[Array, IntArray]]] = field(
        default_factory=dict
    )

    def slow(self, kind: str, axes: tuple[int, ...], time_s: float) -> Array:
        """(N, N) covariance by an error of unit sigma along some map axes."""
        if (kind, axes) not in self._moved:
            self._moved[kind, axes] = [
                (np.einsum("rc,can->ran", self.by_pose[:, columns], of[kind].gain[:, axes]), n)
                for columns, of in self.effects
                if kind in of
                for n in [of[kind].stamps_ns]
            ]
        out = np.zeros((len(self.by_pose),) * 2)
        for moved, stamps_ns in self._moved[kind, axes]:
            for a in range(len(axes)):
                out += smoothed_in_time(moved[:, a], stamps_ns, time_s) @ moved[:, a].T
        return out


def motion_evidence(
    trajectories: Sequence[VehicleTrajectory], structure: ErrorsByStructure = NOTHING
) -> Evidence:
    """What motion data and structure say of the sensors of smoothed drives, without a target."""
    drives = {n: t for n, t in enumerate(trajectories) if isinstance(t, SmoothedTrajectory)}
    motion = [_of_errors(t, structure.get(n)) for n, t in drives.items() if t.open_kinds]
    nothing = Observed(np.zeros(1), np.ones((1, 1)), np.ones(1), np.eye(1))
    return Evidence(
        nothing,
        np.zeros((1, 6)),
        {},
        motion=motion,
        sensor_sigmas=_sensor_sigmas(list(drives.values())),
        stated_over_white=_stated_over_white(list(drives.values())),
    )


def _of_errors(
    trajectory: SmoothedTrajectory, structure: tuple[Array, Array] | None
) -> ErrorLikelihood:
    """What the motion data of a drive say of errors of its sensors, and its structure."""
    found = error_likelihood(trajectory, trajectory.open_kinds)
    return found if structure is None else found.told(*structure)


@dataclass
class _Rows:
    """One observation.

    Attributes:
        residual: (d,).
        jacobians: (d, size) by key.
        known: (d, d) its covariance of known size.
        white: (d, d) by name of a white level, what that brings at sigma 1.
        registration: (d, d) the same of the registration of a cloud.
    """

    residual: Array
    jacobians: Mapping[int, Array]
    known: Array
    white: Mapping[str, Array] = field(default_factory=dict)
    registration: Array | None = None


def linearised_evidence(
    state: SolveState,
    registrations: Sequence[Registration],
    trajectories: Sequence[VehicleTrajectory],
    structure: ErrorsByStructure = NOTHING,
) -> Evidence | None:
    """The residuals of smoothed drives at the smoothed poses; None: too few clouds."""
    # Rates err by what does not matter for noise levels.
    problem = replace(state.problem, cloud_apart_s=None)
    smoothed = ~problem.given()[problem.cloud_pose]
    usable = state.sound & smoothed & (state.weights.values > SEEN)
    if usable.sum() < FEWEST_CLOUDS:
        return None
    clouds = evenly_over_drives(problem, usable, MOST_CLOUDS)
    poses = np.unique(problem.cloud_pose[clouds])
    values = with_given_poses(problem, state.values)
    rows = [
        *_cloud_rows(problem, registrations, values, clouds),
        *_ground_rows(state, values, poses),
    ]
    starts = np.cumsum([0, *(len(row.residual) for row in rows)])
    parts = [slice(a, b) for a, b in itertools.pairwise(starts.tolist())]
    sizes = {key: J.shape[1] for row in rows for key, J in row.jacobians.items()}
    of_pose = {key_vehicle(i): 6 * n for n, i in enumerate(poses.tolist())}
    others = [key for key in sizes if key not in of_pose]
    columns = np.cumsum([0, *(sizes[key] for key in others)]).tolist()
    at = dict(zip(others, columns, strict=False))
    design, by_pose = np.zeros((starts[-1], columns[-1])), np.zeros((starts[-1], 6 * len(poses)))
    for row, part in zip(rows, parts, strict=True):
        for key, J in row.jacobians.items():
            if key in of_pose:
                by_pose[part, of_pose[key] : of_pose[key] + 6] = J
            else:
                design[part, at[key] : at[key] + J.shape[1]] = J
    lift = by_pose[:, 5::6]
    white = {"heave": lift @ lift.T}
    for name in dict.fromkeys(name for row in rows for name in row.white):
        white[name] = scipy.linalg.block_diag(
            *(row.white.get(name, np.zeros_like(row.known)) for row in rows)
        )
    blocks = [
        Block(part, row.registration)
        for row, part in zip(rows, parts, strict=True)
        if row.registration is not None
    ]
    known = scipy.linalg.block_diag(*(row.known for row in rows))
    effects, inputs, scales = [], np.zeros((starts[-1], 0)), np.zeros(0)
    drives = _of_drives(problem, poses, trajectories)
    if drives:
        # What the user typed may be wrong: an arm that is off moves the poses as slowly as the
        # vehicle turns, and is no noise of the fixes.
        smoothed_drives = {drive: of.trajectory for drive, of in drives.items()}
        stamps = {drive: np.array(of.stamps_ns) for drive, of in drives.items()}
        candidates, parts_of = motion_parts(smoothed_drives, stamps)
        scales = np.concatenate([c.scale for c in candidates])
        inputs = np.zeros((starts[-1], len(scales)))
    for drive, of in drives.items():
        J = by_pose[:, of.columns]
        information = of.trajectory.joint_information(of.stamps_ns)[0]
        known = known + J @ np.linalg.solve(information, J.T)
        inputs += J @ parts_of[drive].poses
        found = error_effects(of.trajectory, of.stamps_ns, of.trajectory.open_kinds)
        effects.append((of.columns, {effect.kind: effect for effect in found}))
    weak = partial(_weak, problem, range_errors(state.config.noise))
    ridge = np.concatenate([*(weak(key, sizes[key]) for key in others), scales**-2.0])
    residuals = np.concatenate([row.residual for row in rows])
    observed = Observed(residuals, np.hstack([design, inputs]), ridge, known)
    # Of all drives, those in which nobody sees a target too.
    by_motion = motion_evidence(trajectories, structure)
    return replace(
        by_motion, observed=observed, by_pose=by_pose, white=white, clouds=blocks, effects=effects
    )


@dataclass(frozen=True)
class _Drive:
    """A smoothed drive: its stamps, ascending, and where its poses are among all."""

    trajectory: SmoothedTrajectory
    stamps_ns: Sequence[int]
    columns: IntArray


def _of_drives(
    problem: Problem, poses: IntArray, trajectories: Sequence[VehicleTrajectory]
) -> dict[int, _Drive]:
    """The drives of some poses, all of them smoothed."""
    out = {}
    for drive in sorted({problem.poses[i][0] for i in poses.tolist()}):
        trajectory = trajectories[drive]
        assert isinstance(trajectory, SmoothedTrajectory)
        mine = [n for n, i in enumerate(poses.tolist()) if problem.poses[i][0] == drive]
        stamps = [problem.poses[poses[n]][1] for n in mine]
        columns = (6 * np.array(mine)[:, None] + np.arange(6)).ravel()
        out[drive] = _Drive(trajectory, stamps, columns)
    return out


def _sensor_sigmas(trajectories: Sequence[SmoothedTrajectory]) -> dict[str, Array]:
    """Sensor -> (3,) white 1 sigma of one measurement: the median of the drives."""
    found: dict[str, list[Array]] = {}
    for trajectory in trajectories:
        for kind in trajectory.open_kinds:
            found.setdefault(kind, []).append(white_sigmas(trajectory.data, kind))
    return {kind: np.median(sigmas, axis=0) for kind, sigmas in found.items()}


def _stated_over_white(trajectories: Sequence[SmoothedTrajectory]) -> dict[str, float]:
    """Sensor -> the largest ratio of what is stated to what is white, of its axes and drives."""
    found: dict[str, float] = {}
    for trajectory in trajectories:
        for name, scale in trajectory.data.scales.items():
            kind = name.partition("_")[0]
            if kind in trajectory.open_kinds:
                found[kind] = max(found.get(kind, 1.0), 1.0 / scale)
    return found


def _weak(problem: Problem, ranges: RangeErrors, key: int, size: int) -> Array:
    """(size,) weak information on a parameter, so that undetermined directions stay finite."""
    if key in problem.extrinsic_keys():
        sigmas = np.max([problem.prior_sigmas[name] for name in problem.lidars], axis=0)
        return np.asarray(sigmas**-2.0)
    if key in {key_ground_bias(index) for index in range(len(problem.lidars))}:
        return bias_sigmas(ranges) ** -2.0
    drives = {key_ground(drive) for drive in problem.drives().tolist()}
    return PLANE_SIGMAS**-2.0 if key in drives else np.full(size, WEAK)


def _cloud_rows(
    problem: Problem,
    registrations: Sequence[Registration],
    values: gtsam.Values,
    clouds: IntArray,
) -> list[_Rows]:
    """Registered clouds: the covariance of each is that of its registration."""
    measured, information = measured_poses(registrations)
    covariances = np.linalg.inv(of_single_clouds(information, registrations)[clouds])
    lines = linearise_clouds(problem, values)
    return [
        _Rows(
            gtsam.Pose3.Logmap(lines.predicted[j].compose(measured[j].inverse())),
            dict(zip(lines.keys[j], lines.jacobians[j], strict=True)),
            np.zeros((6, 6)),
            registration=cov,
        )
        for j, cov in zip(clouds.tolist(), covariances, strict=True)
    ]


def _ground_rows(state: SolveState, values: gtsam.Values, poses: IntArray) -> list[_Rows]:
    """Ground planes seen from some poses, those in use; not twice the same place."""
    problem, weights = state.problem, state.ground_weights
    if weights is None:
        return []
    floors = np.diag(ground_floors(state.config.noise) ** 2)
    taken = taken_poses(problem, state.grounds)
    weight = weights.planes * place_weights(problem, state.grounds, taken)
    # At no biases, about which their prior is.
    values = gtsam.Values(values)
    for index in biased_lidars(problem, state.grounds, taken):
        values.update(key_ground_bias(index), np.zeros(GROUND_BIASES))
    normal, distance = np.diag([1.0, 1.0, 0.0]), np.diag([0.0, 0.0, 1.0])
    centres = ground_centres(problem, seen_drives(state.grounds, taken))
    out = []
    for n, o in enumerate(state.grounds):
        if taken[n] not in poses or weight[n] < SEEN:
            continue
        # With a unit covariance, GTSAM's whitening leaves the residual as it is.
        plain = replace(o, cov=np.eye(3))
        factor = plane_factor_of(problem, plain, int(taken[n]), centres[o.drive], rates=False)
        linear: Any = factor.linearize(values)
        chain = 1 + len(problem.extrinsic_keys_of(o.lidar))
        ends = np.cumsum([6] * chain + [3])  # and the biases, if there are any
        # A copy: GTSAM's array ends with the factor.
        blocks = np.split(np.array(linear.getA()), ends[: len(linear.keys()) - 1], axis=1)
        known = o.cov - floors + weights.heave_m[n] ** 2 * distance
        out.append(
            _Rows(
                -np.asarray(linear.getb()),
                dict(zip(linear.keys(), blocks, strict=True)),
                known,
                {"ground_normal": normal, "ground_distance": distance},
            )
        )
    return out
