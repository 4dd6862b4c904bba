"""The inputs of a calibration that could be wrong, as parameters that the graph leaves out.

A parameter acts on the clouds' poses (a clock, a mount that moved), on the vehicle's poses (drift
of given poses), or on a prior (a guess, the vehicle's height). Each becomes a block of one
quadratic, which `uncertainty.suspects` ranks; `caliv_graph/calibration/README.md`, "Suspects".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import scipy.linalg

from caliv_graph.calibration.heave import poses_with_heave
from caliv_graph.calibration.motion_suspects import motion_parts, worst_misfit
from caliv_graph.calibration.score_tests import CloudParts
from caliv_graph.calibration.sensor_noise import heave_of
from caliv_graph.calibration.stance import StanceRows, drives_and_stamps, stance_rows
from caliv_graph.calibration.vehicle_parameters import KEYS, POSE_TIME_OFFSET, parameter_priors
from caliv_graph.errors import SolveError
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.products import Array, Guess, LinearisedGraph, Solution
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.uncertainty.consistency import CLOCK_BIAS_S, REGISTRATION_BIAS
from caliv_graph.uncertainty.suspects import (
    DRIFT_M,
    DRIFT_RAD,
    GNSS_DRIFT_M,
    Candidate,
    Scores,
    assembled,
)

DRIFT_WAVES = 2
"""Half waves over the drive, of one and two: what is faster is noise to the fit of the noise."""

GUESS_SCALE = np.array([0.05] * 3 + [0.3] * 3)
"""Of a guess, rad and m: a direction that is less well determined is left out of the test. Strips
are 2 m wide: what ground alone says of x, y and yaw, to a metre, holds for no shift of metres."""

FRAME_SCALE = np.array([0.1] * 3 + [1.0] * 3)
"""The same of the frame of given poses."""

MOUNT_SCALE = np.array([1e-2] * 3 + [1e-1] * 3)
"""The same of a mount in one part of the drive, rad and m."""

CLOCK_SCALE_S = 0.05
HEIGHT_SCALE_M = 1.0


@dataclass
class _Block:
    """A candidate, and how its parameters act; None: not at all.

    `clouds` (6 J, k): derivative of the clouds' poses. `poses` (6 n, k): of the vehicle's poses as
    the motion data have them, right perturbations. `prior`: rows (m, M), residual (m,), weight
    (m, m) and share (m, k) of a prior `rows z + residual - share d`.
    """

    candidate: Candidate
    clouds: Array | None = None
    poses: Array | None = None
    prior: tuple[Array, Array, Array, Array] | None = None


@dataclass
class _Motion:
    """What is known of the vehicle's poses without any LiDAR, and of the smoothers' inputs.

    `information` (6 n, 6 n) and `gradient` (6 n,) at the estimate, the inputs as the user typed
    them; `blocks` of the inputs, which are the first candidates; `own`, `own_gradient` of them with
    all poses eliminated.
    """

    information: Array
    gradient: Array
    blocks: list[_Block]
    own: Array
    own_gradient: Array


def _motion(solution: Solution, trajectories: Sequence[VehicleTrajectory]) -> _Motion:
    """The vehicle's poses: the graph's own of the given ones, the smoothers' of the others."""
    graph, (drives, stamps) = solution.linearised, drives_and_stamps(solution)
    smoothed = {
        d: t
        for d, t in enumerate(trajectories)
        if isinstance(t, SmoothedTrajectory) and (drives == d).any()
    }
    candidates, parts = motion_parts(smoothed, {d: stamps[drives == d] for d in smoothed})
    size, whole = 6 * len(drives), sum(len(c.scale) for c in candidates)
    information, gradient = np.zeros((size, size)), np.zeros(size)
    columns = np.zeros((size, whole))
    own, own_gradient = np.zeros((whole, whole)), np.zeros(whole)
    given = np.repeat(~np.isin(drives, list(smoothed)), 6)
    information[np.ix_(given, given)] = graph.sound_pose_information[:size, :size][
        np.ix_(given, given)
    ]
    gradient[given] = graph.sound_pose_gradient[:size][given]
    poses = list(solution.T_map_vehicle.values())
    heave_m = heave_of(solution.sensor_noise)
    for drive, part in parts.items():
        at = np.repeat(drives == drive, 6)
        W = poses_with_heave(part.information, heave_m)
        mine = np.flatnonzero(drives == drive).tolist()
        off = [
            gtsam.Pose3.Logmap(T.between(poses[i]))
            for i, T in zip(mine, part.T_map_vehicle, strict=True)
        ]
        information[np.ix_(at, at)] = W
        gradient[at] = -W @ np.concatenate(off)
        columns[at] = part.poses
        own += part.own
        own_gradient += part.gradient
    ends = np.cumsum([len(c.scale) for c in candidates], dtype=np.int64).tolist()
    blocks = [
        _Block(c, poses=columns[:, end - len(c.scale) : end])
        for c, end in zip(candidates, ends, strict=True)
    ]
    return _Motion(information, gradient, blocks, own, own_gradient)


@dataclass
class _Quadratic:
    """The blocks as one quadratic beside the graph's."""

    graph: LinearisedGraph
    motion: _Motion
    blocks: list[_Block]
    shared: Mapping[str, _Shared]

    def scores(self, information: Array, gradient: Array) -> Scores:
        """All variables eliminated; `information`, `gradient` of them with all evidence."""
        graph, sizes = self.graph, [len(b.candidate.scale) for b in self.blocks]
        ends = np.cumsum(sizes).tolist()
        whole = ends[-1]
        C = np.zeros((len(graph.cloud_gradient), whole))
        P = np.zeros((len(self.motion.gradient), whole))
        B, c = np.zeros((whole, whole)), np.zeros(whole)
        cross = np.zeros((len(graph.gradient), whole))
        for block, size, end in zip(self.blocks, sizes, ends, strict=True):
            part = slice(end - size, end)
            if block.clouds is not None:
                C[:, part] = block.clouds
            if block.poses is not None:
                P[:, part] = block.poses
            if block.prior is not None:
                rows, residual, weight, share = block.prior
                cross[:, part] -= rows.T @ (weight @ share)
                B[part, part] += share.T @ weight @ share
                c[part] += share.T @ (weight @ residual)
        seen = graph.cloud_information @ C
        cross += graph.cloud_jacobian.T @ seen
        B += C.T @ seen
        c -= C.T @ graph.cloud_gradient
        moved = self.motion.information @ P
        cross[: len(P)] -= moved
        late = graph.starts.get(KEYS[POSE_TIME_OFFSET])
        if late is not None:
            cross[late] -= graph.sound_pose_information[late, : len(P)] @ P
        B += P.T @ moved
        c -= P.T @ self.motion.gradient
        own = slice(0, len(self.motion.own_gradient))
        B[own, own] += self.motion.own
        c[own] += self.motion.own_gradient
        candidates = [b.candidate for b in self.blocks]
        N, off = np.zeros_like(cross), np.zeros(len(gradient))
        keep = np.ones(len(gradient), dtype=bool)
        for candidate, size, end in zip(candidates, sizes, ends, strict=True):
            variable = self.shared.get(candidate.name)
            if variable is not None:
                own = slice(variable.start, variable.start + size)
                N[own, end - size : end], off[own], keep[own] = variable.by, variable.off, False
        # z = K z' + N d - off, z' being the variables without those that are candidates.
        B += N.T @ information @ N + N.T @ cross + cross.T @ N
        gradient = gradient + information @ off
        c += N.T @ gradient + cross.T @ off
        cross += information @ N
        try:
            return assembled(
                candidates, B, c, cross[keep], information[np.ix_(keep, keep)], gradient[keep]
            )
        except scipy.linalg.LinAlgError:
            raise SolveError("the graph at the estimate is singular") from None


@dataclass(frozen=True)
class _Shared:
    """A variable of the graph that is a candidate, too: `by d - off` from the estimate.

    Structure depends on it through the poses that were eliminated; its prior and the motion data
    are the candidate's. `start`: its first coordinate.
    """

    start: int
    by: Array
    off: Array


def _shared(solution: Solution, trajectories: Sequence[VehicleTrajectory]) -> dict[str, _Shared]:
    """The parameters of the vehicle that the graph estimates, by the name of their candidate."""
    smoothed = [t for t in trajectories if isinstance(t, SmoothedTrajectory)]
    out = {}
    for name, prior in parameter_priors(smoothed).items():
        start = solution.linearised.starts.get(KEYS[name])
        if start is None:
            continue
        if isinstance(prior.mean, gtsam.Rot3):
            R = solution.values.atRot3(KEYS[name])
            to_right = R.matrix().T
            moved = gtsam.Rot3.Logmap(R.compose(prior.mean.inverse()))
            out[name] = _Shared(start, to_right, to_right @ moved)
        else:
            moved = solution.values.atVector(KEYS[name]) - prior.mean
            out[name] = _Shared(start, np.eye(len(moved)), moved)
    return out


def suspect_scores(
    solution: Solution,
    trajectories: Sequence[VehicleTrajectory],
    guesses: Mapping[str, Guess],
) -> Scores:
    """The inputs of a calibration as left-out parameters, all variables eliminated.

    The guesses are evidence here, in every mode: one wrong input shows as all estimates being off
    their guesses alike. So is how the vehicle stands on the ground (`stance_rows`), where the
    ground is seen. `trajectories` are one per drive; `guesses` of the LiDARs of the solution.

    Raises:
        SolveError: the graph is singular.
    """
    graph = solution.linearised
    motion, stances = _motion(solution, trajectories), stance_rows(solution)
    blocks = [
        *motion.blocks,
        *_of_clouds(CloudParts(solution, trajectories)),
        *_of_guesses(solution, guesses),
        *_of_height(stances),
        *_of_drift(solution, trajectories),
        *_of_given_frame(solution, trajectories),
    ]
    # The smoother's inputs are parameters of their own here, as the user typed them.
    information = graph.information - graph.pose_information
    gradient = graph.gradient - graph.pose_gradient
    size = len(motion.gradient)
    information[:size, :size] += motion.information
    gradient[:size] += motion.gradient
    late = graph.starts.get(KEYS[POSE_TIME_OFFSET])
    if late is not None:
        # The clock of given poses is no candidate. Like them it has the noise of sound ones.
        by_clock = graph.sound_pose_information[late]
        information[late] += by_clock
        information[:, late] += np.where(np.arange(len(by_clock)) == late, 0.0, by_clock)
        gradient[late] += graph.sound_pose_gradient[late]
    for block in blocks:
        # A guess that is fixed is among the data, and so is the vehicle's height.
        if block.candidate.name.endswith(".initial") and block.prior is not None:
            rows, residual, weight, _ = block.prior
            information += rows.T @ weight @ rows
            gradient -= rows.T @ (weight @ residual)
    for stance in stances:
        added = stance.rows.T @ (stance.weight - stance.in_graph)
        information += added @ stance.rows
        gradient -= added @ stance.residual
    if not blocks:
        return Scores((), np.zeros((0, 0)), np.zeros(0))
    shared = _shared(solution, trajectories)
    scores = _Quadratic(graph, motion, blocks, shared).scores(information, gradient)
    return replace(scores, misfit=worst_misfit(trajectories))


def _of_clouds(parts: CloudParts) -> list[_Block]:
    """Clocks of the LiDARs, one by one and all together; mounts in parts of the drive."""
    out, late = [], []
    for name in parts.solution.lidars:
        for kind, columns in parts.parameters(name, trusted=False):
            if kind == "clock":
                late.append(columns)
                candidate = _clock(f"lidars.{name}.time_offset")
            else:
                candidate = Candidate(f"lidars.{name}.mount.{kind}", REGISTRATION_BIAS, MOUNT_SCALE)
            out.append(_Block(candidate, clouds=columns))
    if len(late) > 1:
        together = np.sum(late, axis=0)
        out.insert(0, _Block(_clock("lidars.*.time_offset"), clouds=np.asarray(together)))
    return out


def _clock(name: str) -> Candidate:
    return Candidate(name, np.array([CLOCK_BIAS_S]), np.array([CLOCK_SCALE_S]))


def _of_guesses(solution: Solution, guesses: Mapping[str, Guess]) -> list[_Block]:
    """Each guess that is estimated, vehicle axes: its prior sees only the rest."""
    graph, out = solution.linearised, []
    size = 6 * len(solution.lidars)
    for i, name in enumerate(solution.lidars):
        guess = guesses.get(name)
        if guess is None or guess.fixed or guess.found:
            continue
        rows = np.zeros((6, len(graph.gradient)))
        rows[:, -size:] = graph.to_vehicle_axes[6 * i : 6 * i + 6]
        off = vehicle_axes_difference(solution.T_vehicle_lidar[name], guess.T_vehicle_lidar)
        prior = (rows, off, np.diag(guess.sigmas**-2.0), np.eye(6))
        candidate = Candidate(f"lidars.{name}.initial", np.zeros(6), GUESS_SCALE)
        out.append(_Block(candidate, prior=prior))
    return out


def _of_height(stances: Sequence[StanceRows]) -> list[_Block]:
    """The vehicle's height above ground, one for all drives, where the config states it."""
    heights = [stance for stance in stances if stance.by_height.any()]
    if not heights:
        return []
    prior = (
        np.vstack([stance.rows for stance in heights]),
        np.concatenate([stance.residual for stance in heights]),
        scipy.linalg.block_diag(*(stance.weight for stance in heights)),
        np.concatenate([stance.by_height for stance in heights])[:, None],
    )
    candidate = Candidate("ground.vehicle_height", np.zeros(1), np.array([HEIGHT_SCALE_M]))
    return [_Block(candidate, prior=prior)]


def _of_drift(solution: Solution, trajectories: Sequence[VehicleTrajectory]) -> list[_Block]:
    """Slow errors of the vehicle's positions, map axes, and of the yaw of given poses.

    Cosines of one and two half waves over each drive. A pose that is too far east by b pulls the
    graph's pose to where it is less b.
    """
    drives, stamps = drives_and_stamps(solution)
    out = []
    for drive, trajectory in enumerate(trajectories):
        mine = np.flatnonzero(drives == drive)
        if len(mine) < 2 * DRIFT_WAVES:
            continue
        given = not isinstance(trajectory, SmoothedTrajectory)
        if isinstance(trajectory, SmoothedTrajectory) and trajectory.origin_deg_m is None:
            continue
        begin, end = trajectory.span_ns
        part = (stamps[mine] - begin) / (end - begin)
        waves = [np.cos(math.pi * k * part) for k in range(1, DRIFT_WAVES + 1)]
        axes = 4 if given else 3
        columns = np.zeros((6 * len(stamps), axes * DRIFT_WAVES))
        poses = list(solution.T_map_vehicle.values())
        for j, i in enumerate(mine.tolist()):
            R_vehicle_map = poses[i].rotation().matrix().T
            for k, wave in enumerate(waves):
                at = slice(axes * k, axes * k + 3)
                columns[6 * i + 3 : 6 * i + 6, at] = wave[j] * R_vehicle_map
                if given:
                    columns[6 * i : 6 * i + 3, axes * k + 3] = wave[j] * R_vehicle_map[:, 2]
        sigmas = np.array([DRIFT_M if given else GNSS_DRIFT_M] * 3 + [DRIFT_RAD] * (axes - 3))
        scale = np.array([1.0] * 3 + [0.1] * (axes - 3))
        name = f"{'poses' if given else 'gnss'}.drift{_of_several(drive, trajectories)}"
        candidate = Candidate(name, np.tile(sigmas, DRIFT_WAVES), np.tile(scale, DRIFT_WAVES))
        out.append(_Block(candidate, poses=columns))
    return out


def _of_several(drive: int, trajectories: Sequence[VehicleTrajectory]) -> str:
    """What tells a drive from the others in the name of a candidate."""
    return f".{drive}" if len(trajectories) > 1 else ""


def _of_given_frame(solution: Solution, trajectories: Sequence[VehicleTrajectory]) -> list[_Block]:
    """Given poses that are those of another frame than the vehicle's: one transform for all.

    None where structure of such a drive is in the graph: most of its poses are eliminated there as
    they were given. Moved without them, the others contradict it: sound drives by 4 to 6 sigma.
    """
    drives, _ = drives_and_stamps(solution)
    given = [d for d, t in enumerate(trajectories) if not isinstance(t, SmoothedTrajectory)]
    if any(term.drive in given for term in solution.structure):
        return []
    of = np.isin(drives, given)
    if not of.any():
        return []
    columns = np.asarray(np.kron(of[:, None], np.eye(6)), np.float64)
    candidate = Candidate("poses.frame", np.zeros(6), FRAME_SCALE)
    return [_Block(candidate, poses=columns)]
