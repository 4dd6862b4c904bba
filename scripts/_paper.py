"""The paper's own estimator, reimplemented: the baseline of the benchmarks.

UKF poses, joint registration with isotropic components (`_paper_registration`), the error on the
corners of the target's oriented bounding box, the percentile filter and Powell's method in two
stages (the paper's section III). Where the paper leaves a choice, the better one is taken: the
target is extracted by this project, components start at the target, and all computations are on
arrays, so that its time is that of the method and not of the interpreter.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from scipy.optimize import minimize
from scipy.spatial.distance import pdist

from caliv_graph._open3d import import_open3d
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import Config
from caliv_graph.errors import RegistrationError, TargetError, TrajectoryError
from caliv_graph.geometry.se3 import stack, unstack
from caliv_graph.products import (
    Array,
    IntArray,
    MotionData,
    Recording,
    TargetCloud,
    TargetObservation,
    Trajectory,
)
from caliv_graph.targets import extract_targets
from caliv_graph.trajectory.given import given_trajectory
from caliv_graph.trajectory.select import GivenTrajectory, takes_given_poses, wanted_stamps
from scripts._paper_registration import (
    COMPONENTS,
    ITERATIONS,
    cube_components,
    register_clouds,
)
from scripts._ukf import filter_trajectory

PERCENTILE = 10.0
"""Percentile k of the paper's filter."""


@dataclass(frozen=True)
class PaperResult:
    """Result of the paper's estimator.

    Attributes:
        T_vehicle_lidar: of every LiDAR that saw the target, from stage 2 and the S2S of stage 1.
        T_lidar_pairs: per (from, to) `T_to_from` of stage 1, `to` being the reference.
        T_target_lidar: of every cloud, as registered.
        means_target: (K, 3) metres, the reconstructed target.
        corners_target: (8, 3) metres, corners of its oriented bounding box.
        seconds: wall time of `registration`, `optimisation` and `total`; from a recording also of
            `ukf` (nearly none if poses were given) and `extraction` (reading included).
        iterations: iterations of the registration.
        evaluations: evaluations of the cost in stage 1 and stage 2.
    """

    T_vehicle_lidar: Mapping[str, gtsam.Pose3]
    T_lidar_pairs: Mapping[tuple[str, str], gtsam.Pose3]
    T_target_lidar: tuple[gtsam.Pose3, ...]
    means_target: Array
    corners_target: Array
    seconds: Mapping[str, float]
    iterations: int
    evaluations: tuple[int, int]


def paper_from_recording(
    recording: Recording,
    config: Config,
    seed: int,
    *,
    components: int = COMPONENTS,
    iterations: int = ITERATIONS,
    percentile: float = PERCENTILE,
) -> PaperResult:
    """Calibrates a drive with the paper's method.

    Args:
        recording: with IMU, orientation, GNSS and velocity, or with poses.
        config: topics, guesses, region, noise.
        seed: seed of the components' start.
        components: number of components of the mixture.
        iterations: iterations of the registration.
        percentile: k of the filter.

    Raises:
        TrajectoryError: the filter cannot run on what was recorded.
        TargetError: no LiDAR, or not the reference, sees the target.
        RegistrationError: there is nothing to register.
    """
    begun = time.perf_counter()
    trajectory = vehicle_poses(recording.motion(), config, wanted_stamps(recording))
    filtered = time.perf_counter()
    observations = extract_targets([recording], [trajectory], config, SilentProgress())
    clouds = _best_seen(observations, config).clouds
    R, t = trajectory.poses_at([cloud.stamp_ns for cloud in clouds])
    poses = {
        (cloud.lidar, cloud.stamp_ns): T for cloud, T in zip(clouds, unstack(R, t), strict=True)
    }
    extracted = time.perf_counter()
    result = paper_estimator(
        clouds,
        poses,
        {name: lidar.guess() for name, lidar in config.lidars.items()},
        config.reference,
        components=components,
        iterations=iterations,
        percentile=percentile,
        seed=seed,
    )
    return replace(
        result,
        seconds={
            **result.seconds,
            "ukf": filtered - begun,
            "extraction": extracted - filtered,
            "total": time.perf_counter() - begun,
        },
    )


def paper_estimator(
    clouds: Sequence[TargetCloud],
    T_map_vehicle: Mapping[tuple[str, int], gtsam.Pose3],
    guesses: Mapping[str, gtsam.Pose3],
    reference: str,
    *,
    components: int = COMPONENTS,
    iterations: int = ITERATIONS,
    percentile: float = PERCENTILE,
    seed: int,
) -> PaperResult:
    """Calibrates from the target's points.

    Args:
        clouds: clouds of one target.
        T_map_vehicle: pose per LiDAR and stamp of a cloud.
        guesses: `T_vehicle_lidar` for the pre-alignment; stage 2 keeps the translation of the
            reference.
        reference: the paper's L2.
        components: number of components of the mixture.
        iterations: iterations of the registration.
        percentile: k of the filter.
        seed: seed of the components' start.

    Raises:
        TargetError: the reference has no cloud.
        RegistrationError: there is nothing to register.
    """
    begun = time.perf_counter()
    lidars = list(dict.fromkeys(cloud.lidar for cloud in clouds))
    if reference not in lidars:
        raise TargetError(
            f"the paper's estimator: reference '{reference}' has no cloud of the target, "
            f"of {len(clouds)} clouds. Name another LiDAR as reference"
        )
    poses = [T_map_vehicle[cloud.lidar, cloud.stamp_ns] for cloud in clouds]
    pre_aligned = [
        pose.compose(guesses[cloud.lidar]) for pose, cloud in zip(poses, clouds, strict=True)
    ]
    points = [
        T.transformFrom(cloud.points_lidar.T).T
        for T, cloud in zip(pre_aligned, clouds, strict=True)
    ]
    # GMMCalib needs the target's position; here it follows from the guesses.
    centre = np.mean([p.mean(axis=0) for p in points], axis=0)
    mixture = register_clouds(
        [p - centre for p in points],
        cube_components(components, np.random.default_rng(seed)),
        iterations,
    )
    # The registration moves clouds in the map, relative to the centre.
    T_target_map = unstack(mixture.R, mixture.t - mixture.R @ centre)
    T_target_lidar = tuple(T.compose(pre) for T, pre in zip(T_target_map, pre_aligned, strict=True))
    registered = time.perf_counter()
    corners = oriented_box(mixture.means)
    minimisation = Minimisation.of(
        T_target_lidar,
        poses,
        [cloud.lidar for cloud in clouds],
        corners,
        guesses,
        reference,
        percentile,
    )
    pairs, stage_1 = minimisation.stage_1()
    T_vehicle_reference, stage_2 = minimisation.stage_2(pairs)
    end = time.perf_counter()
    return PaperResult(
        T_vehicle_lidar={
            name: T_vehicle_reference.compose(pairs[name]) if name in pairs else T_vehicle_reference
            for name in lidars
        },
        T_lidar_pairs={(name, reference): T for name, T in pairs.items()},
        T_target_lidar=T_target_lidar,
        means_target=mixture.means,
        corners_target=corners,
        seconds={
            "registration": registered - begun,
            "optimisation": end - registered,
            "total": end - begun,
        },
        iterations=iterations,
        evaluations=(stage_1, stage_2),
    )


def oriented_box(points: Array) -> Array:
    """Corners (8, 3) of open3d's oriented bounding box of points (n, 3).

    Raises:
        RegistrationError: the points are flat.
    """
    o3d = import_open3d()
    try:
        box = o3d.geometry.OrientedBoundingBox.create_from_points(
            o3d.utility.Vector3dVector(points)
        )
    except RuntimeError:
        raise RegistrationError(
            f"the paper's estimator: the reconstructed target, {len(points)} components, is flat: "
            "it has no oriented bounding box"
        ) from None
    return np.asarray(box.get_box_points(), np.float64)


def pairwise_errors(corners_map: Array) -> Array:
    """The paper's e for every pair of clouds.

    Args:
        corners_map: (n, 8, 3) metres, the box's corners in the map according to each cloud.

    Returns:
        (n (n - 1) / 2,) m^2, sums over the corners of their squared distances.
    """
    return np.asarray(pdist(corners_map.reshape(len(corners_map), -1), "sqeuclidean"))


def within_percentiles(errors: Array, percentile: float) -> Array:
    """The errors from the k-th to the (100 - k)-th percentile."""
    low, high = np.percentile(errors, [percentile, 100.0 - percentile])
    return np.asarray(errors[(errors >= low) & (errors <= high)])


@dataclass(frozen=True)
class Minimisation:
    """The paper's equation 5: the extrinsics with which all clouds agree on the target's place.

    Unknowns are in metres and degrees, as in the authors' program: Powell's method searches along
    one unknown at a time and starts with unit steps.

    Attributes:
        corners_lidar: (n, 8, 3) metres, the box's corners, in the frame of each cloud's LiDAR by
            its registration.
        R_map_vehicle: (n, 3, 3) when each cloud was taken.
        t_map_vehicle: (n, 3) metres.
        lidar_of: (n,) index into `lidars`.
        lidars: names, the reference last.
        guesses: of those.
        percentile: k.
    """

    corners_lidar: Array
    R_map_vehicle: Array
    t_map_vehicle: Array
    lidar_of: IntArray
    lidars: tuple[str, ...]
    guesses: Mapping[str, gtsam.Pose3]
    percentile: float

    @classmethod
    def of(
        cls,
        T_target_lidar: Sequence[gtsam.Pose3],
        T_map_vehicle: Sequence[gtsam.Pose3],
        names: Sequence[str],
        corners_target: Array,
        guesses: Mapping[str, gtsam.Pose3],
        reference: str,
        percentile: float,
    ) -> Minimisation:
        """Of registered clouds, the name of each one's LiDAR, and the box."""
        others = dict.fromkeys(name for name in names if name != reference)
        lidars = (*others, reference)
        return cls(
            np.array([T.transformTo(corners_target.T).T for T in T_target_lidar]),
            *stack(list(T_map_vehicle)),
            np.array([lidars.index(name) for name in names]),
            lidars,
            {name: guesses[name] for name in lidars},
            percentile,
        )

    @property
    def reference(self) -> str:
        return self.lidars[-1]

    def errors(self, T_vehicle_lidar: Mapping[str, gtsam.Pose3]) -> Array:
        """`pairwise_errors` with these extrinsics."""
        R, t = stack([T_vehicle_lidar[name] for name in self.lidars])
        # C_R T inverted and applied to the corners: R_V T, V_L T, then the inverse of C_L T.
        R_map_lidar = self.R_map_vehicle @ R[self.lidar_of]
        t_map_lidar = np.einsum("nij,nj->ni", self.R_map_vehicle, t[self.lidar_of])
        t_map_lidar += self.t_map_vehicle
        corners = self.corners_lidar @ np.swapaxes(R_map_lidar, 1, 2)
        return pairwise_errors(corners + t_map_lidar[:, None])

    def cost(self, T_vehicle_lidar: Mapping[str, gtsam.Pose3]) -> float:
        """The sum of the errors after the filter, m^2."""
        return float(within_percentiles(self.errors(T_vehicle_lidar), self.percentile).sum())

    def stage_1(self) -> tuple[dict[str, gtsam.Pose3], int]:
        """S2S of every other LiDAR, with the reference's extrinsic free as well.

        Returns:
            Per LiDAR its pose in the frame of the reference, and the number of evaluations.
        """
        others = self.lidars[:-1]
        if not others:
            return {}, 0

        def pairs_of(x: Array) -> dict[str, gtsam.Pose3]:
            return {
                name: self.guesses[self.reference].between(
                    perturbed(self.guesses[name], x[6 * k : 6 * k + 6])
                )
                for k, name in enumerate(others)
            }

        def cost(x: Array) -> float:
            return self.cost(
                self._extrinsics(perturbed(self._reference_guess, x[-6:]), pairs_of(x))
            )

        found = _powell(cost, 6 * len(self.lidars))
        return pairs_of(np.asarray(found.x)), int(found.nfev)

    def stage_2(self, pairs: Mapping[str, gtsam.Pose3]) -> tuple[gtsam.Pose3, int]:
        """Rotation of the reference, with S2S fixed.

        The authors' program rotates the LiDAR about the vehicle's origin, which moves it. Here the
        translation stays at the guess, as the paper says: "errors of the translation are fixed to
        zero".

        Returns:
            Its extrinsic, and the number of evaluations of the cost.
        """
        held = np.zeros(3)

        def reference_of(x: Array) -> gtsam.Pose3:
            return perturbed(self._reference_guess, np.concatenate([held, x]))

        found = _powell(lambda x: self.cost(self._extrinsics(reference_of(x), pairs)), 3)
        return reference_of(np.asarray(found.x)), int(found.nfev)

    @property
    def _reference_guess(self) -> gtsam.Pose3:
        return self.guesses[self.reference]

    def _extrinsics(
        self, T_vehicle_reference: gtsam.Pose3, pairs: Mapping[str, gtsam.Pose3]
    ) -> dict[str, gtsam.Pose3]:
        out = {name: T_vehicle_reference.compose(T) for name, T in pairs.items()}
        return {**out, self.reference: T_vehicle_reference}


def perturbed(T_vehicle_lidar: gtsam.Pose3, x: Array) -> gtsam.Pose3:
    """An extrinsic moved by x, y, z (m) and rotated by roll, pitch, yaw (degrees), vehicle axes."""
    roll, pitch, yaw = np.radians(x[3:])
    turn = gtsam.Rot3.RzRyRx(roll, pitch, yaw)
    return gtsam.Pose3(
        turn.compose(T_vehicle_lidar.rotation()), T_vehicle_lidar.translation() + x[:3]
    )


def _powell(cost: Any, unknowns: int) -> Any:
    """Powell's method from zero with scipy's default tolerances: the paper names none."""
    return minimize(cost, np.zeros(unknowns), method="Powell")


def vehicle_poses(motion: MotionData, config: Config, stamps_ns: IntArray) -> GivenTrajectory:
    """Filtered poses at the clouds and at the IMU's samples, or the given poses."""
    if takes_given_poses(motion, config):
        return GivenTrajectory(given_trajectory(motion))
    if motion.imu is None or motion.imu.orientation_xyzw is None:
        raise TrajectoryError(f"{motion.name}: the paper's filter needs an IMU with orientation")
    if motion.gnss is None or motion.twist is None:
        raise TrajectoryError(f"{motion.name}: the paper's filter needs GNSS and velocity")
    # The clouds of a sweep are deskewed with poses at the IMU's samples.
    wanted = np.union1d(stamps_ns, motion.imu.stamps_ns)
    R, t, _ = filter_trajectory(motion, config, wanted)
    # The filter has no pose before its start and after the end of the IMU data.
    wanted = wanted[wanted <= motion.imu.stamps_ns[-1]]
    if len(R) < 2:
        raise TrajectoryError(f"{motion.name}: the paper's filter has {len(R)} pose(s), needs 2")
    return GivenTrajectory(Trajectory(wanted[-len(R) :], unstack(R, t)))


def _best_seen(observations: Sequence[TargetObservation], config: Config) -> TargetObservation:
    """One target, as in the paper: that with the largest minimum number of clouds per LiDAR."""
    names = config.lidar_order()

    def rank(observation: TargetObservation) -> tuple[int, int]:
        seen = [sum(c.lidar == name for c in observation.clouds) for name in names]
        return min(seen), sum(seen)

    return max(observations, key=rank)
