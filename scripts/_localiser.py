"""A sliding-window localiser: IMU, GNSS and LiDAR scans registered to a map, on GTSAM.

The extrinsics of the LiDARs are constants or variables; everything else is the same. Scans with
large innovations have Huber's weight in all cases, because wrong constants would otherwise make it
lose the map. It measures the effect of a calibration, and has the parts of a real localiser.

The covariance of a registration. Point-to-plane ICP minimises sum w_i e_i^2 over the pose, where
e_i = n_i . (T p_i - q_i) and w_i is Tukey's weight. With J_i = [p_i x n_i, n_i] (lidar axes), A =
sum w_i J_i J_i^T is half its Hessian, and the noise of the points propagates to
cov = A^-1 (sum w_i^2 s_i^2 J_i J_i^T) A^-1. A beam's noise is along the beam, so s_i is the range
noise times the cosine of the angle of incidence: a beam that grazes the ground 10 m ahead measures
its height to 2 mm, not 10. The errors of a sampled map (`REGISTRATION_FLOOR`) and the heave of the
vehicle, which no other sensor measures, are added.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
import pymap3d

from caliv_graph._open3d import import_open3d
from caliv_graph.fusion.factors import lidar_pose_factor, random_walk
from caliv_graph.fusion.monitor import MountAlarm, MountMonitor, extrinsic_innovation
from caliv_graph.fusion.priors import prior_factors
from caliv_graph.products import Array, Calibration, LidarScan, MotionData
from caliv_graph.scenario.model import Scenario
from caliv_graph.scenario.world import GROUND, World
from caliv_graph.trajectory.imu import clean_inertial, preintegrate
from caliv_graph.trajectory.noise import ImuNoise

LAG_S = 4.0
"""The smoother's window."""

WALK_SIGMAS = np.repeat([1e-5, 1e-5], 3)
"""Random walk of an extrinsic per square root of a second, rad and m: 0.6 mrad and 0.6 mm in an
hour. The localiser is slightly conservative about unmoved mounts (NEES 0.95 of a drive; 1.05 with
3e-6). At 1e-6 the Cholesky factors become singular, and GTSAM throws."""

PRIOR_VELOCITY_M_S = 0.02
"""Sigma of the standing vehicle's velocity."""

FALSE_ALARMS_PER_HOUR = 0.1
"""Upper bound of the mount monitor's false alarms."""

MAP_SPACING_M = 0.2
"""Spacing of the map's points on walls."""

POLE_SPACING_M = 0.05
GROUND_SPACING_M = 0.4

STAGES = ((2.5, 1.0), (0.35, 0.05))
"""Stages of the registration: largest distance of paired points, and Tukey's limit, metres."""

GOOD_FITNESS = 0.9
"""Fraction of points on the map above which the last stage alone is sufficient. Ground points are
always on the map; a lower fraction means that walls were out of reach."""

LEAST_FITNESS = 0.85
"""Fraction of points on the map below which a registration has failed. This world is completely on
its map; with parked cars, use a lower value."""

HUBER = 4.7
"""Sigmas beyond which a scan is down-weighted: probability 1e-3 with six degrees of freedom."""

MOST_SIGMA_M = 0.05
"""Largest sigma of a registration. A scan of one wall and the ground is undetermined along it."""

REGISTRATION_FLOOR = np.repeat([1e-5, 1e-4], 3)
"""rad and m, 1 sigma: pairs across an edge, flat sides of poles, stopping of the iterations."""


# ------------------------------------------------------------------ the map


@dataclass(frozen=True)
class WallMap:
    """The surroundings as points with normals.

    Attributes:
        points_map: (n, 3) metres.
        normals_map: (n, 3) of length 1.
        cloud: the same as a cloud of Open3D.
    """

    points_map: Array
    normals_map: Array
    cloud: Any


def make_map(world: World, seed: int = 0) -> WallMap:
    """A surveyed map of a simulated world: exact, and sampled.

    Args:
        world: the world.
        seed: seed of the samples.
    """
    o3d = import_open3d()
    rng = np.random.default_rng(seed)
    standing = [mesh.vertices for name, mesh in world.meshes.items() if name != GROUND]
    low, high = np.vstack(standing).min(axis=0), np.vstack(standing).max(axis=0)
    x, y = np.meshgrid(*(np.arange(low[i], high[i], GROUND_SPACING_M) for i in range(2)))
    ground = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, world.ground_z_map)])
    points, normals = [ground], [np.tile([0.0, 0.0, 1.0], (len(ground), 1))]
    for name, mesh in world.meshes.items():
        if name == GROUND:
            continue
        spacing = POLE_SPACING_M if name.startswith("pole") else MAP_SPACING_M
        sampled = _samples(mesh.vertices[mesh.triangles], spacing, rng)
        points.append(sampled[0])
        normals.append(sampled[1])
    cloud = o3d.geometry.PointCloud()
    cloud.points = o3d.utility.Vector3dVector(np.vstack(points))
    cloud.normals = o3d.utility.Vector3dVector(np.vstack(normals))
    return WallMap(np.vstack(points), np.vstack(normals), cloud)


def _samples(corners: Array, spacing_m: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """(n, 3) points spread over (m, 3, 3) triangles, and their normals."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normals = np.cross(b - a, c - a)
    double_area = np.linalg.norm(normals, axis=1)
    count = rng.poisson(0.5 * double_area / spacing_m**2)
    which = np.repeat(np.arange(len(corners)), count)
    u, v = rng.random((2, len(which)))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    points = a[which] + u[:, None] * (b - a)[which] + v[:, None] * (c - a)[which]
    return points, (normals / double_area[:, None])[which]


# ------------------------------------------------------------------ registration


@dataclass(frozen=True)
class Registered:
    """A scan registered to the map.

    Attributes:
        T_map_lidar: the registered pose.
        cov: (6, 6) its covariance, right perturbation, rotation then translation, rad and m.
        fitness: fraction of the points on the map.
    """

    T_map_lidar: gtsam.Pose3
    cov: Array
    fitness: float


def register(
    scan: LidarScan, T_map_lidar: gtsam.Pose3, walls: WallMap, range_sigma_m: float
) -> Registered | None:
    """Point-to-plane ICP of a scan by Open3D, with a covariance (see the module).

    Args:
        scan: the cloud.
        T_map_lidar: the predicted pose.
        walls: the map.
        range_sigma_m: noise of the points along their beams.

    Returns:
        None if the scan is not on the map.
    """
    o3d = import_open3d()
    registration = o3d.pipelines.registration
    cloud = o3d.geometry.PointCloud()
    cloud.points = o3d.utility.Vector3dVector(scan.points_lidar)
    criteria = registration.ICPConvergenceCriteria(1e-8, 1e-8, 40)

    def icp(T: Array, stage: tuple[float, float]) -> Any:
        kernel = registration.TukeyLoss(k=stage[1])
        method = registration.TransformationEstimationPointToPlane(kernel)
        return registration.registration_icp(cloud, walls.cloud, stage[0], T, method, criteria)

    fine = icp(T_map_lidar.matrix(), STAGES[-1])
    if _on_map(fine, scan, walls) < GOOD_FITNESS:
        coarse = icp(T_map_lidar.matrix(), STAGES[0])
        fine = icp(coarse.transformation, STAGES[-1])
    fitness = _on_map(fine, scan, walls)
    if fitness < LEAST_FITNESS:
        return None
    cov = _covariance(fine, scan, walls, range_sigma_m)
    if cov is None:
        return None
    return Registered(gtsam.Pose3(np.asarray(fine.transformation)), cov, fitness)


def _pairs(result: Any, scan: LidarScan, walls: WallMap) -> tuple[Array, Array, Array]:
    """(m, 3) paired points and (m, 3) the normals there, lidar axes, and (m,) distances."""
    pairs = np.asarray(result.correspondence_set)
    T = np.asarray(result.transformation)
    points, normals_map = scan.points_lidar[pairs[:, 0]], walls.normals_map[pairs[:, 1]]
    apart = points @ T[:3, :3].T + T[:3, 3] - walls.points_map[pairs[:, 1]]
    return points, normals_map @ T[:3, :3], np.einsum("ni,ni->n", apart, normals_map)


def _on_map(result: Any, scan: LidarScan, walls: WallMap) -> float:
    """Fraction of the points on a surface of the map, by Tukey's weight."""
    if not len(result.correspondence_set):
        return 0.0
    distance_m = _pairs(result, scan, walls)[2]
    return float((np.abs(distance_m) < STAGES[-1][1]).sum() / len(scan.points_lidar))


def _covariance(result: Any, scan: LidarScan, walls: WallMap, range_sigma_m: float) -> Array | None:
    """See the module; None if the map does not determine the scan's pose."""
    points, normals, distance_m = _pairs(result, scan, walls)
    weight = np.maximum(1.0 - (distance_m / STAGES[-1][1]) ** 2, 0.0) ** 2
    J = np.hstack([np.cross(points, normals), normals])
    along = np.einsum("ni,ni->n", points, normals) / np.linalg.norm(points, axis=1)
    sigma = range_sigma_m * along
    hessian = (J * weight[:, None]).T @ J
    # For the inverse only; the limit is checked below.
    if np.linalg.eigvalsh(hessian)[0] < (0.5 * range_sigma_m / MOST_SIGMA_M) ** 2:
        return None
    inverse = np.linalg.inv(hessian)
    spread = J * (weight * sigma)[:, None]
    cov: Array = inverse @ (spread.T @ spread) @ inverse + np.diag(REGISTRATION_FLOOR**2)
    if np.linalg.eigvalsh(cov[3:, 3:])[-1] > MOST_SIGMA_M**2:
        return None
    return 0.5 * (cov + cov.T)


# ------------------------------------------------------------------ the localiser


Extrinsics = Mapping[str, gtsam.Pose3] | Calibration
"""Constants, or variables with a prior."""


@dataclass
class Track:
    """Estimates of a localiser, one row per keyframe, each of the newest pose.

    Attributes:
        stamps_ns: nanoseconds.
        T_map_vehicle: estimates.
        cov: (6, 6) each, right perturbation, rotation then translation.
        registered: LiDAR, stamp and registration of each scan.
        innovations: chi-square of each of these scans against the prediction.
        alarms: alarms of the monitor.
        left_out: number of scans that the localiser left out.
    """

    stamps_ns: list[int] = field(default_factory=list)
    T_map_vehicle: list[gtsam.Pose3] = field(default_factory=list)
    cov: list[Array] = field(default_factory=list)
    registered: list[tuple[str, int, Registered]] = field(default_factory=list)
    innovations: list[float] = field(default_factory=list)
    alarms: list[MountAlarm] = field(default_factory=list)
    left_out: int = 0


class Localiser:
    """IMU preintegration, GNSS and registered scans in a `gtsam.IncrementalFixedLagSmoother`."""

    def __init__(
        self,
        motion: MotionData,
        scenario: Scenario,
        datum: tuple[float, float, float],
        walls: WallMap,
        extrinsics: Extrinsics,
        first_ns: int,
        keyframes_per_s: float,
    ) -> None:
        """Starts at standstill.

        Args:
            motion: IMU with orientation, and GNSS.
            scenario: noise of the sensors, as in their data sheets.
            datum: latitude, longitude (degrees) and altitude (m) of the map's origin.
            walls: the map.
            extrinsics: poses: constants; a calibration: variables with its joint prior, watched.
            first_ns: stamp of the first keyframe; the vehicle stands until then.
            keyframes_per_s: scans per second.
        """
        assert motion.imu is not None
        assert motion.gnss is not None
        self._scenario, self._walls, self._extrinsics = scenario, walls, extrinsics
        self.track = Track()
        self._inertial = clean_inertial(motion.imu, motion.name)[0]
        self._noise = _imu_noise(scenario)
        fixes = motion.gnss
        east, north, up = pymap3d.geodetic2enu(
            fixes.latitude_deg, fixes.longitude_deg, fixes.altitude_m, *datum
        )
        self._antenna_map = dict(
            zip(fixes.stamps_ns.tolist(), np.column_stack([east, north, up]), strict=True)
        )
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(1e-3)
        parameters.relinearizeSkip = 1
        self._smoother = gtsam.IncrementalFixedLagSmoother(LAG_S, parameters)
        self._k, self._stamp_ns, self._first_ns = 0, first_ns, first_ns
        self._mounted: dict[str, tuple[int, int]] = {}
        self._monitor: MountMonitor | None = None
        self._start(motion)
        if isinstance(extrinsics, Calibration):
            poses = {n: result.T_vehicle_lidar for n, result in extrinsics.lidars.items()}
            self._monitor = MountMonitor(poses, keyframes_per_s, FALSE_ALARMS_PER_HOUR)

    # -------------------------------------------------------------- start

    def _start(self, motion: MotionData) -> None:
        """Priors from the measurements at standstill."""
        imu, gnss, first_ns = motion.imu, self._scenario.gnss, self._first_ns
        assert imu is not None
        assert imu.orientation_xyzw is not None
        standing = imu.stamps_ns <= first_ns
        xyzw = imu.orientation_xyzw[standing]
        rotation = gtsam.Rot3.ClosestTo(
            sum(gtsam.Rot3.Quaternion(w, x, y, z).matrix() for x, y, z, w in xyzw)
        )
        places = [p for stamp, p in self._antenna_map.items() if stamp <= first_ns]
        lever = np.array(gnss.lever_arm)
        pose = gtsam.Pose3(rotation, np.mean(places, axis=0) - rotation.matrix() @ lever)
        turn = self._scenario.imu.orientation.sigma_rad / math.sqrt(len(xyzw))
        shift = self._gnss_sigmas() / math.sqrt(len(places))
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        # The antenna measures the position, at a lever arm.
        known = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([turn, 1e3], 3))
        graph.add(gtsam.PriorFactorPose3(_x(0), pose, known))
        graph.add(
            gtsam.GPSFactorArm(
                _x(0), np.mean(places, axis=0), lever, gtsam.noiseModel.Diagonal.Sigmas(shift)
            )
        )
        still = gtsam.noiseModel.Isotropic.Sigma(3, PRIOR_VELOCITY_M_S)
        graph.add(gtsam.PriorFactorVector(_v(0), np.zeros(3), still))
        biases = np.concatenate([self._noise.force_bias, self._noise.gyro_bias])
        bias = gtsam.imuBias.ConstantBias()
        graph.add(
            gtsam.PriorFactorConstantBias(_b(0), bias, gtsam.noiseModel.Diagonal.Sigmas(biases))
        )
        values.insert(_x(0), pose)
        values.insert(_v(0), np.zeros(3))
        values.insert(_b(0), bias)
        keys = [_x(0), _v(0), _b(0)]
        if isinstance(self._extrinsics, Calibration):
            names = list(self._extrinsics.lidars)
            self._mounted = {name: (_m(i, 0), self._first_ns) for i, name in enumerate(names)}
            graph.push_back(prior_factors(self._extrinsics, lambda name: self._mounted[name][0]))
            for name, (key, _) in self._mounted.items():
                values.insert(key, self._extrinsics.lidars[name].T_vehicle_lidar)
                keys.append(key)
        self._update(graph, values, keys)
        self._pose, self._velocity, self._bias = pose, np.zeros(3), bias

    def _gnss_sigmas(self) -> Array:
        gnss = self._scenario.gnss
        return np.array([gnss.horizontal_sigma_m] * 2 + [gnss.vertical_sigma_m])

    # -------------------------------------------------------------- each keyframe

    def step(self, scan: LidarScan) -> None:
        """One keyframe: predict, register the scan, update.

        Args:
            scan: later than all earlier scans.
        """
        predicted = self._predict(scan)
        T_vehicle_lidar = self._mounting(scan.lidar)
        model = self._scenario.lidars[scan.lidar]
        found = register(scan, predicted.compose(T_vehicle_lidar), self._walls, model.range_sigma_m)
        if found is not None:
            self.track.registered.append((scan.lidar, scan.stamp_ns, found))
            self._take_in(scan, predicted, T_vehicle_lidar, found)
        self._pose = self._smoother.calculateEstimatePose3(_x(self._k))
        self._velocity = self._smoother.calculateEstimateVector(_v(self._k))
        self._bias = self._smoother.calculateEstimateConstantBias(_b(self._k))
        self.track.stamps_ns.append(scan.stamp_ns)
        self.track.T_map_vehicle.append(self._pose)
        self.track.cov.append(np.asarray(self._smoother.marginalCovariance(_x(self._k))))

    def _predict(self, scan: LidarScan) -> gtsam.Pose3:
        """Propagates the smoother to a scan's stamp with IMU and GNSS."""
        before, k, nodes = self._k, self._k + 1, np.array([self._stamp_ns, scan.stamp_ns])
        gravity = self._scenario.gravity_m_s2
        (measured,) = preintegrate(
            self._inertial, nodes, [self._bias, self._bias], self._noise, gravity
        )
        state = measured.predict(gtsam.NavState(self._pose, self._velocity), self._bias)
        graph, values, keys = gtsam.NonlinearFactorGraph(), gtsam.Values(), [_x(k), _v(k), _b(k)]
        graph.add(
            gtsam.CombinedImuFactor(
                _x(before), _v(before), _x(k), _v(k), _b(before), _b(k), measured
            )
        )
        values.insert(_x(k), state.pose())
        values.insert(_v(k), state.velocity())
        values.insert(_b(k), self._bias)
        antenna_map = self._antenna_map.get(scan.stamp_ns)
        if antenna_map is not None:
            lever = np.array(self._scenario.gnss.lever_arm)
            noise = gtsam.noiseModel.Diagonal.Sigmas(self._gnss_sigmas())
            graph.add(gtsam.GPSFactorArm(_x(k), antenna_map, lever, noise))
        if self._mounted:
            key, stamp_ns = self._mounted[scan.lidar]
            later = _m(list(self._mounted).index(scan.lidar), k)
            elapsed_s = (scan.stamp_ns - stamp_ns) * 1e-9
            graph.add(random_walk(key, later, elapsed_s, WALK_SIGMAS))
            values.insert(later, self._smoother.calculateEstimatePose3(key))
            keys.append(later)
            self._mounted[scan.lidar] = (later, scan.stamp_ns)
        self._k, self._stamp_ns = k, scan.stamp_ns
        self._update(graph, values, keys)
        return self._smoother.calculateEstimatePose3(_x(k))

    def _mounting(self, lidar: str) -> gtsam.Pose3:
        if self._mounted:
            return self._smoother.calculateEstimatePose3(self._mounted[lidar][0])
        assert not isinstance(self._extrinsics, Calibration)
        return self._extrinsics[lidar]

    def _take_in(
        self,
        scan: LidarScan,
        T_map_vehicle: gtsam.Pose3,
        T_vehicle_lidar: gtsam.Pose3,
        found: Registered,
    ) -> None:
        """Adds a registered scan unless the monitor finds it suspicious."""
        up_lidar = found.T_map_lidar.rotation().matrix()[2]
        heave = self._scenario.suspension.heave_sigma_m * np.concatenate([np.zeros(3), up_lidar])
        cov = found.cov + np.outer(heave, heave)
        innovation = extrinsic_innovation(
            T_map_vehicle, T_vehicle_lidar, self._cov_predicted(scan.lidar), found.T_map_lidar, cov
        )
        self.track.innovations.append(innovation.chi2)
        if self._monitor is not None:
            alarm = self._monitor.add(scan.lidar, scan.stamp_ns, innovation)
            if alarm is not None:
                self.track.alarms.append(alarm)
            if self._monitor.suspicious(innovation):
                self.track.left_out += 1
                return
        # Huber's weight of the innovation. A robust noise model would use the error before the
        # update, which is as large as the prediction's uncertainty.
        cov = cov * max(1.0, math.sqrt(innovation.chi2) / HUBER)
        graph = gtsam.NonlinearFactorGraph()
        if self._mounted:
            key = self._mounted[scan.lidar][0]
            noise = gtsam.noiseModel.Gaussian.Covariance(cov)
            graph.add(lidar_pose_factor(_x(self._k), key, found.T_map_lidar, noise))
        else:
            # Z Exp(d) M^-1 = Z M^-1 Exp(Ad(M) d).
            turned = np.asarray(T_vehicle_lidar.AdjointMap())
            noise = gtsam.noiseModel.Gaussian.Covariance(turned @ cov @ turned.T)
            place = found.T_map_lidar.compose(T_vehicle_lidar.inverse())
            graph.add(gtsam.PriorFactorPose3(_x(self._k), place, noise))
        self._update(graph, gtsam.Values(), [])

    def _cov_predicted(self, lidar: str) -> Array:
        """(12, 12) covariance of pose and extrinsic before the scan; that of a constant is zero."""
        isam, cov = self._smoother.getISAM2(), np.zeros((12, 12))
        if not self._mounted:
            cov[:6, :6] = isam.marginalCovariance(_x(self._k))
            return cov
        keys = [_x(self._k), self._mounted[lidar][0]]
        joint = isam.jointMarginalCovariance(keys)
        return np.block([[joint.at(a, b) for b in keys] for a in keys])

    def _update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keys: list[int]
    ) -> None:
        at_s = (self._stamp_ns - self._first_ns) * 1e-9
        self._smoother.update(graph, values, dict.fromkeys(keys, at_s))


def _imu_noise(scenario: Scenario) -> ImuNoise:
    imu = scenario.imu
    return ImuNoise(
        gyro_density=np.eye(3) * imu.gyroscope_sigma_rad_s**2 / imu.rate_hz,
        force_density=np.eye(3) * imu.accelerometer_sigma_m_s2**2 / imu.rate_hz,
        gyro_walk=np.full(3, imu.gyroscope_bias_walk_rad_s2_sqrthz),
        force_walk=np.full(3, imu.accelerometer_bias_walk_m_s3_sqrthz),
        gyro_bias=np.full(3, np.max(imu.gyroscope_bias_sigma_rad_s)),
        force_bias=np.full(3, np.max(imu.accelerometer_bias_sigma_m_s2)),
        sources={},
    )


def _x(k: int) -> int:
    return int(gtsam.symbol("x", k))


def _v(k: int) -> int:
    return int(gtsam.symbol("v", k))


def _b(k: int) -> int:
    return int(gtsam.symbol("b", k))


def _m(lidar: int, k: int) -> int:
    """Key of a LiDAR's extrinsic at a keyframe, up to a million keyframes each."""
    return int(gtsam.symbol("m", 1_000_000 * lidar + k))
