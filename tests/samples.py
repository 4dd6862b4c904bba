"""A small calibration with known numbers, for the tests of what is made from one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import scipy.sparse

from caliv_graph.config.guesses import TRUSTED_SIGMAS
from caliv_graph.conventions import AXES
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.products import (
    Array,
    Calibration,
    Direction,
    Guess,
    LidarResult,
    LinearisedGraph,
    Mixture,
    PoseNoise,
    Registration,
    Solution,
    TargetCloud,
    TargetObservation,
)

RADIUS_M = 9.16
"""Of the sample's arc, whose centre is to the right of the vehicle."""

MOUNTINGS: Mapping[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "front": ((2.0, 0.0, 2.0), (0.0, 10.0, 0.0)),
    "rear": ((-0.4, 0.0, 2.0), (0.0, 10.0, 180.0)),
    "left": ((0.5, 0.9, 1.5), (0.0, 0.0, 90.0)),
}


def pose(xyz: tuple[float, float, float], rpy_deg: tuple[float, float, float]) -> gtsam.Pose3:
    roll, pitch, yaw = (math.radians(a) for a in rpy_deg)
    return gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array(xyz))


def make_covariance(lidars: int, seed: int = 1) -> Array:
    """A joint covariance with correlations and sigmas of millimetres and milliradians."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(6 * lidars, 12 * lidars)) / math.sqrt(12 * lidars)
    scale = np.tile([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3], lidars)
    return np.asarray(scale[:, None] * (roots @ roots.T) * scale)


def turn_about_centre(lidars: Mapping[str, gtsam.Pose3]) -> Direction:
    """Rotation of all LiDARs by 1 rad about the centre of the turn, in vehicle axes."""
    centre = np.array([0.0, -RADIUS_M, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    vector = {
        name: np.concatenate([up, np.cross(up, T.translation() - centre)])
        for name, T in lidars.items()
    }
    return Direction(
        vector=vector,
        sigma_data=math.inf,
        sigma_prior=4.3e-3,
        together=True,
        text="rotation of all LiDARs about the turn centre",
    )


def make_calibration(*lidars: str, **changes: Any) -> Calibration:
    """LiDARs `front` and `rear`, or others; an arc left x and yaw undetermined."""
    names = lidars or ("front", "rear")
    poses = {name: pose(*MOUNTINGS[name]) for name in names}
    cov = make_covariance(len(names))
    determined = dict.fromkeys(AXES, True) | {"x": False, "yaw": False}
    calibration = Calibration(
        status="partial",
        reference=names[-1],
        lidars={
            name: LidarResult(
                T_vehicle_lidar=T,
                cov=cov[6 * i : 6 * i + 6, 6 * i : 6 * i + 6],
                determined=determined,
                scans_used=60 + i,
                saw_target=True,
            )
            for i, (name, T) in enumerate(poses.items())
        },
        cov_joint=cov,
        information_data=np.asarray(np.linalg.inv(cov), dtype=np.float64),
        undetermined=(turn_about_centre(poses),),
        weak=(),
        unmet=(),
        provenance={"version": "0.1.0", "drives": ["drive"]},
    )
    return replace(calibration, **changes)


def unseen(calibration: Calibration, name: str) -> Calibration:
    """The same, but one LiDAR never saw a target."""
    never = replace(
        calibration.lidars[name],
        determined=dict.fromkeys(AXES, False),
        scans_used=0,
        saw_target=False,
    )
    return replace(calibration, lidars={**calibration.lidars, name: never})


def trusted(calibration: Calibration, name: str) -> Calibration:
    """The same, but the config fixes one LiDAR (`fixed: true`), which saw nothing."""
    unseen_one = unseen(calibration, name).lidars[name]
    guess = Guess(unseen_one.T_vehicle_lidar, TRUSTED_SIGMAS, fixed=True)
    known = replace(unseen_one, determined=dict.fromkeys(AXES, True), guess=guess)
    return replace(calibration, lidars={**calibration.lidars, name: known})


def make_solution(placements: int = 1) -> Solution:
    """A solution with as many reconstructed targets, and otherwise next to nothing in it."""
    mixture = Mixture(
        means_target=np.array([[0.1, 0.2, 0.3], [-0.1, 0.0, 0.25]]),
        normals_target=np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
        var_tangent=np.full(2, 1e-3),
        weights=np.full(2, 0.45),
    )
    cloud = TargetCloud("front", 0, 0, np.zeros((3, 3)), "0.pcd")
    registrations = tuple(
        Registration(
            observation=TargetObservation(i, f"target {i + 1}", np.zeros(3), (cloud,)),
            T_target_lidar=(gtsam.Pose3(),),
            information=np.eye(6)[None],
            information_joint=np.eye(6),
            view_weights=np.ones(1),
            mixture=mixture,
            inlier_ratio=np.ones(1),
            iterations=7,
            converged=True,
            last_step=(1e-6, 1e-6),
        )
        for i in range(placements)
    )
    return Solution(
        mode="auto",
        lidars=("front", "rear"),
        reference="rear",
        T_vehicle_lidar={},
        T_map_vehicle={},
        T_target_map=(gtsam.Pose3(),) * placements,
        registrations=registrations,
        cloud_weights=(np.ones(1),) * placements,
        residuals=(np.zeros((1, 6)),) * placements,
        pose_noise=PoseNoise(1e-3, 1e-2, 1e-3, 1e-2, 5.0),
        registration_scale=1.5,
        information_data=np.zeros((12, 12)),
        information_prior=np.eye(12),
        cov=np.eye(12),
        held=(),
        iterations=4,
        converged=True,
        graph=gtsam.NonlinearFactorGraph(),
        factor_kinds=(),
        values=gtsam.Values(),
        linearised=LinearisedGraph(
            information=np.zeros((12, 12)),
            gradient=np.zeros(12),
            information_guesses=np.eye(12),
            cloud_jacobian=scipy.sparse.csr_array((6 * placements, 12)),
            cloud_information=np.zeros((6 * placements, 6 * placements)),
            cloud_gradient=np.zeros(6 * placements),
            by_vehicle=np.zeros((placements, 6, 6)),
            by_extrinsic=np.zeros((placements, 6, 6)),
            starts={},
            pose_information=np.zeros((12, 12)),
            pose_gradient=np.zeros(12),
            sound_pose_information=np.zeros((12, 12)),
            sound_pose_gradient=np.zeros(12),
            to_vehicle_axes=np.eye(12),
        ),
        stage_times_s={"solve": 0.5},
    )


def twist_of_all(twist: Sequence[float], lidars: Mapping[str, gtsam.Pose3]) -> dict[str, Array]:
    """What each LiDAR does, by differences, if all are moved by a small twist of the vehicle."""
    step = 1e-6
    motion = gtsam.Pose3.Expmap(step * np.array(twist))
    return {
        name: vehicle_axes_difference(motion.compose(T), T) / step for name, T in lidars.items()
    }


def turn_about(centre_xy: tuple[float, float]) -> list[float]:
    """Twist of a rotation about the vertical through a point of the vehicle frame."""
    x, y = centre_xy
    return [0.0, 0.0, 1.0, y, -x, 0.0]
