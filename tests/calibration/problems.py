"""Small calibrations with known truth, without any cloud: poses, extrinsics, registered poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from caliv_graph.calibration.problem import Problem
from caliv_graph.conventions import key_extrinsic, key_pose_error, key_target, key_vehicle
from caliv_graph.products import Array, BoolArray, IntArray
from tests.samples import MOUNTINGS, pose

PERIOD_NS = 200_000_000

SIGMAS = np.array([0.03] * 3 + [0.058] * 3)
"""Of the initial guesses, as in the config's defaults."""

REGISTRATION_SIGMAS = np.array([2e-3] * 3 + [1e-3] * 3)


@dataclass(frozen=True)
class Case:
    """A problem, its truth, and what a registration without errors would give.

    Attributes:
        problem: with the true poses and extrinsics as given poses and guesses.
        truth: values of all variables.
        measured: T_target_lidar of each cloud.
        information: (J, 6, 6) of them, correlated, never the same twice.
    """

    problem: Problem
    truth: gtsam.Values
    measured: tuple[gtsam.Pose3, ...]
    information: Array


def eight(count: int, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> list[gtsam.Pose3]:
    """Poses on a figure-eight up and down a hill: everything can be observed from it."""
    poses, x, y, z, yaw = [], origin[0], origin[1], origin[2], 0.3
    for i in range(count):
        part = i / count
        pitch, roll = 0.12 * math.sin(6.0 * math.pi * part), 0.05 * math.cos(5.0 * part)
        poses.append(gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array([x, y, z])))
        step = 60.0 / count
        x, y = x + step * math.cos(yaw), y + step * math.sin(yaw)
        z -= step * math.sin(pitch)
        yaw += step / 9.16 * (1.0 if part < 0.5 else -1.0)
    return poses


def correlated_information(rng: np.random.Generator) -> Array:
    root = rng.normal(size=(6, 12)) / math.sqrt(12.0)
    cov = REGISTRATION_SIGMAS[:, None] * (root @ root.T + 0.1 * np.eye(6)) * REGISTRATION_SIGMAS
    return np.asarray(np.linalg.inv(cov), dtype=np.float64)


def with_clouds(problem: Problem, which: BoolArray | IntArray | list[int]) -> Problem:
    """The problem with some of its clouds, a mask or indices in any order, and the same poses."""
    return replace(
        problem,
        cloud_lidar=problem.cloud_lidar[which],
        cloud_pose=problem.cloud_pose[which],
        cloud_placement=problem.cloud_placement[which],
    )


def make_case(
    *lidars: str,
    count: int = 12,
    drives: int = 1,
    reference: str | None = None,
    seed: int = 0,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Case:
    """`count` poses per drive, every LiDAR sees the drive's target from each."""
    names = lidars or ("front", "rear")
    reference = reference or names[-1]
    rng = np.random.default_rng(seed)
    extrinsics = {name: pose(*MOUNTINGS[name]) for name in names}
    poses = [
        T
        for drive in range(drives)
        for T in eight(count, (origin[0] + 5.0 * drive, origin[1], origin[2]))
    ]
    clouds = [(a, i, i // count) for a in range(len(names)) for i in range(len(poses))]
    problem = Problem(
        lidars=names,
        reference=reference,
        guesses=extrinsics,
        prior_sigmas=dict.fromkeys(names, SIGMAS),
        fixed=frozenset(),
        poses=tuple((i // count, (i % count) * PERIOD_NS) for i in range(len(poses))),
        T_map_vehicle=tuple(poses),
        origins_map={drive: np.zeros(3) for drive in range(drives)},
        cloud_lidar=np.array([a for a, _, _ in clouds]),
        cloud_pose=np.array([i for _, i, _ in clouds]),
        cloud_placement=np.array([m for _, _, m in clouds]),
        placements=drives,
    )
    truth = gtsam.Values()
    for i, T in enumerate(poses):
        truth.insert(key_vehicle(i), T)
        truth.insert(key_pose_error(i), np.zeros(6))
    E = extrinsics[reference]
    truth.insert(key_extrinsic(), E)
    for name in names:
        for key in problem.extrinsic_keys_of(name)[1:]:
            truth.insert(key, E.between(extrinsics[name]))
    for m in range(drives):
        # The target stands in the drive's map, turned by an angle of its own.
        place = np.add(origin, (9.0, 4.0, 0.6))
        T_map_target = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, -0.03, 0.4 * m), place)
        truth.insert(key_target(m), T_map_target.inverse())
    return Case(
        problem,
        truth,
        tuple(predictions(problem, truth)),
        np.array([correlated_information(rng) for _ in clouds]),
    )


def predictions(problem: Problem, values: gtsam.Values) -> list[gtsam.Pose3]:
    """T_target_lidar of every cloud, one product at a time."""
    out = []
    for a, i, m in zip(
        problem.cloud_lidar, problem.cloud_pose, problem.cloud_placement, strict=True
    ):
        T_target_vehicle = values.atPose3(key_target(int(m))).compose(
            values.atPose3(key_vehicle(int(i)))
        )
        mounting = values.atPose3(key_extrinsic())
        for key in problem.extrinsic_keys_of(problem.lidars[a])[1:]:
            mounting = mounting.compose(values.atPose3(key))
        out.append(T_target_vehicle.compose(mounting))
    return out


def moved(values: gtsam.Values, seed: int, rotation_rad: float, position_m: float) -> gtsam.Values:
    """Every pose perturbed, uniformly, on the right."""
    rng = np.random.default_rng(seed)
    scale = np.array([rotation_rad] * 3 + [position_m] * 3)
    out = gtsam.Values(values)
    for key in values.keys():  # noqa: SIM118 - gtsam.Values is no dict
        if chr(gtsam.Symbol(key).chr()) != "d":
            out.update(key, values.atPose3(key).retract(scale * rng.uniform(-1.0, 1.0, 6)))
    return out


def noisy(case: Case, seed: int, scale: float = 1.0) -> tuple[gtsam.Pose3, ...]:
    """Registered poses with errors that their information describes, times `scale`."""
    rng = np.random.default_rng(seed)
    return tuple(
        gtsam.Pose3.Expmap(
            scale * np.linalg.solve(np.linalg.cholesky(info).T, rng.normal(size=6))
        ).compose(Z)
        for Z, info in zip(case.measured, case.information, strict=True)
    )


def with_poses(case: Case, poses: Sequence[gtsam.Pose3]) -> Problem:
    """The problem with other given poses."""
    return replace(case.problem, T_map_vehicle=tuple(poses))


def numerical_jacobian(
    error: Callable[[gtsam.Values], Array],
    values: gtsam.Values,
    key: int,
    step: float = 1e-5,
    size: int = 6,
) -> Array:
    """Central differences of an error by the tangent of one variable."""

    def at(d: Array) -> Array:
        delta = gtsam.VectorValues()
        delta.insert(key, d)
        return np.asarray(error(values.retract(delta)))

    return np.array([(at(d) - at(-d)) / (2.0 * step) for d in step * np.eye(size)]).T
