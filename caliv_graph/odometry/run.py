"""Drives without motion data: poses of the vehicle by the odometry of one LiDAR."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from caliv_graph.common.progress import Progress
from caliv_graph.config.guesses import configured_guess, with_found_guess
from caliv_graph.config.model import Config
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import ConfigError, TrajectoryError
from caliv_graph.geometry.se3 import stack, unstack
from caliv_graph.mounting.place import Placement
from caliv_graph.odometry.statement import ground_of, statement_of
from caliv_graph.odometry.track import Track, track
from caliv_graph.products import Array, IntArray, MotionData, Recording
from caliv_graph.trajectory.odometry import OdometryPoses, VehicleStatement

KNOT_NS = 20_000_000
"""Between two poses: over 20 ms a car's velocity is constant to 0.1 mm."""

TOLD_BY_COURSE = 0.5
"""Part of the guess's sigma of yaw below which the direction of travel gives the yaw."""


def needs_odometry(motion: MotionData, config: Config) -> bool:
    """Whether nothing but LiDARs tells the motion: the config names no source, and there is none.

    A source that the config names and that is damaged or absent is an error, not a reason to do
    without it.
    """
    sources = (motion.poses, motion.imu, motion.gnss, motion.twist)
    return all(source is None for source in sources) and not config.names_motion()


def with_odometry(
    recordings: Sequence[Recording],
    config: Config,
    motions: Mapping[int, MotionData],
    progress: Progress,
) -> tuple[dict[int, MotionData], Config, tuple[Placement, ...]]:
    """Motion data with poses by the odometry of a LiDAR, where a drive has none.

    Args:
        recordings: opened drives.
        config: LiDARs, ground, modes.
        motions: motion data of each drive, by its index.
        progress: reports the stage.

    Returns:
        The motion data; the config, with a guess for the tracked LiDAR if it had none; and where
        that was placed.

    Raises:
        ConfigError: the config asks for what cannot be had without motion data.
        TrajectoryError: no LiDAR can be tracked.
        RecordingError: a cloud could not be read.
    """
    drives = [i for i, motion in motions.items() if needs_odometry(motion, config)]
    if not drives:
        return dict(motions), config, ()
    _check(config)
    if len(drives) < len(motions):
        bare, other = (
            motions[drives[0]].name,
            next(m for i, m in motions.items() if i not in drives),
        )
        raise ConfigError(
            f"{bare}: has no motion data, and {other.name} has: calibrate them apart, and merge"
        )
    lidar, tracks = _tracked([recordings[i] for i in drives], config, progress)
    guess = None if config.lidars[lidar].initial is None else config.lidars[lidar].guess()
    statements = [_statement(found, config, guess, lidar, len(drives)) for found in tracks]
    T = _placed(statements, config, lidar, guess)
    placements: tuple[Placement, ...] = ()
    if guess is None:
        config = with_found_guess(config, lidar, T)
        placements = (Placement(lidar, T, ()),)
    out = dict(motions)
    for i, found, statement in zip(drives, tracks, statements, strict=True):
        out[i] = replace(motions[i], poses=_poses(found, lidar, T, statement))
    return out, config, placements


def _check(config: Config) -> None:
    """Raises ConfigError where the config asks for what cannot be had without motion data."""
    without = "without motion data (no topics.imu, topics.pose or data.poses)"
    remedy = "or give one of these"
    if not config.structure.use or config.solve.mode == "staged":
        key = "structure.use: true" if not config.structure.use else "solve.mode: auto"
        raise ConfigError(
            f"{without} the structure around tells the motion, a target does not: set {key}, "
            f"{remedy}"
        )
    if not config.ground.use:
        raise ConfigError(
            f"{without} the ground tells which way is up: set ground.use: true, {remedy}"
        )
    if config.solve.time_offset:
        raise ConfigError(
            f"{without} time offsets cannot be estimated: set solve.time_offset: false, {remedy}"
        )


def _tracked(
    recordings: Sequence[Recording], config: Config, progress: Progress
) -> tuple[str, list[Track]]:
    """The LiDAR that is tracked in all drives, the reference if it can be, and its tracks."""
    names = [config.reference, *(name for name in config.lidars if name != config.reference)]
    why: list[str] = []
    for name in names:
        total = sum(len(recording.scan_stamps_ns(name)) for recording in recordings)
        tracks = []
        try:
            with progress.stage(f"tracking LiDAR '{name}'", total) as advance:
                for recording in recordings:
                    stamps = recording.scan_stamps_ns(name)
                    scans = recording.scans(name, frozenset(stamps))
                    tracks.append(track(scans, config.noise.lidar_range_m, advance))
                    ground_of(tracks[-1])
        except TrajectoryError as error:
            why.append(f"lidar '{name}': {error}")
            continue
        return name, tracks
    raise TrajectoryError(
        f"{recordings[0].name}: no motion data, and no LiDAR tells the motion. {'; '.join(why)}. "
        "Drive where walls, fronts or containers of two directions are within 40 m, or record an "
        "IMU with GNSS or velocities (topics), or poses"
    )


def _statement(
    found: Track, config: Config, guess: gtsam.Pose3 | None, lidar: str, drives: int
) -> VehicleStatement:
    R = None if guess is None else guess.rotation().matrix()
    statement = statement_of(found, ground_of(found), config, R, drives)
    if guess is None and not math.isfinite(statement.course_rad):
        raise ConfigError(
            f"lidars.{lidar}.initial is not given, and without motion data and without driving "
            f"nothing tells its yaw. Enter lidars.{lidar}.initial, or drive some metres"
        )
    return statement


def _placed(
    statements: Sequence[VehicleStatement], config: Config, lidar: str, guess: gtsam.Pose3 | None
) -> gtsam.Pose3:
    """T_vehicle_lidar that the vehicle's poses are defined by.

    Up is the ground's; ahead is the direction of travel, or that of the guess where it is better
    known; x and y are those of the guess, z by the height above the ground where that is known.
    """
    weights = [statement.tilt_rad**-2.0 for statement in statements]
    up = np.average([s.up_lidar for s in statements], axis=0, weights=weights)
    up /= np.linalg.norm(up)
    courses = np.array([statement.course_rad for statement in statements])
    distance = float(np.mean([statement.distance_m for statement in statements]))
    sigma = math.inf if guess is None else float(configured_guess(config, lidar).sigmas[2])
    if courses.min() < TOLD_BY_COURSE * sigma:
        ahead = np.average([s.ahead_lidar for s in statements], axis=0, weights=courses**-2.0)
    else:
        assert guess is not None
        ahead = guess.rotation().matrix()[0]
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    R = np.stack([ahead, np.cross(up, ahead), up])
    x, y, z = (0.0, 0.0, distance) if guess is None else guess.translation().tolist()
    height = config.ground.vehicle_height
    if height is not None:
        z = distance - height
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(R), np.array([x, y, z]))


def _poses(
    found: Track, lidar: str, T_vehicle_lidar: gtsam.Pose3, statement: VehicleStatement
) -> OdometryPoses:
    """The vehicle's poses, in a map that is the vehicle frame at the first scan."""
    stamps, R, t = _smooth(found.stamps_ns, *stack(found.T_map_lidar))
    own = unstack(R, t)
    back = T_vehicle_lidar.inverse()
    return OdometryPoses(
        stamps_ns=stamps,
        T_map_vehicle=tuple(T_vehicle_lidar.compose(T).compose(back) for T in own),
        lidar=lidar,
        T_vehicle_lidar=T_vehicle_lidar,
        statement=statement,
        T_map_lidar=own,
    )


def _smooth(stamps_ns: IntArray, R: Array, t: Array) -> tuple[IntArray, Array, Array]:
    """Stamps, rotations and translations of a smooth motion, at most `KNOT_NS` apart.

    A pose is off by millimetres from scan to scan, and a sweep would be put together with what that
    does to velocities. Cubic smoothing splines by generalised cross-validation, per axis and per
    component of the quaternion, tell such noise from motion.
    """
    # Here: most drives do without odometry, and it takes 0.1 s to import.
    from scipy.interpolate import make_smoothing_spline

    begin = int(stamps_ns[0])
    seconds = (stamps_ns - begin) / NANOSECONDS_PER_SECOND
    count = math.ceil((int(stamps_ns[-1]) - begin) / KNOT_NS)
    at = np.unique(np.append(begin + KNOT_NS * np.arange(count, dtype=np.int64), stamps_ns))
    s = (at - begin) / NANOSECONDS_PER_SECOND
    q = Rotation.from_matrix(R).as_quat()
    q *= np.cumprod(np.where(np.sum(q * np.roll(q, 1, axis=0), axis=1) < 0.0, -1.0, 1.0))[:, None]
    axes = [make_smoothing_spline(seconds, axis)(s) for axis in (*q.T, *t.T)]
    turned = Rotation.from_quat(np.stack(axes[:4], axis=1))
    return at, np.asarray(turned.as_matrix()), np.stack(axes[4:], axis=1)
