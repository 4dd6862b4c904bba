"""Frames, transforms, tangent order, units and key letters, on one page.

Transforms
    `T_a_b` maps points of frame b into frame a: `p_a = T_a_b * p_b`. In code `T_a_b` is a
    `gtsam.Pose3`, `R_a_b` a 3x3 array, `t_a_b` a (3,) array, `points_b` an (N, 3) array.

Frames
    `map`      ENU axes, gravity-aligned, or the frame of the given poses (R in the paper)
    `vehicle`  base_link, x forward, y left, z up (V)
    `lidar`    the frame of a LiDAR's cloud (L_a)
    `target`   the latent calibration frame, origin at the target's centre, axes of the map (C)
    `ref`      the reference LiDAR's frame

Tangent space
    GTSAM's `Pose3`: rotation (3) before translation (3), right perturbation
    `T.retract(d) = T * Exp(d)`. A covariance names its pose, its order and its side:
    `cov_*` is a covariance, `info_*` its inverse, `sigma_*` a standard deviation.
    *Vehicle axes*: the perturbation of `T_vehicle_lidar` by a small rotation about the vehicle's
    axes at the LiDAR's origin and a translation along them: `t' = t + dt`, `R' = Exp(dw) R`.
    It is the right perturbation rotated by `R_vehicle_lidar`.

Units
    Metres, radians, seconds; stamps are `int` nanoseconds (`stamp_ns`), durations float seconds
    (`_s`). Degrees and millimetres exist at the edges only (config, tables) and say so in the
    name (`rpy_deg`). Roll, pitch, yaw: `R = Rz(yaw) Ry(pitch) Rx(roll)`, as in URDF and in
    `gtsam.Rot3.RzRyRx(roll, pitch, yaw)`. Quaternions in files are x y z w.
"""

import gtsam

NANOSECONDS_PER_SECOND = 1_000_000_000

AXES = ("roll", "pitch", "yaw", "x", "y", "z")
"""Names of the six tangent coordinates, in the order of GTSAM's Pose3."""


def key_vehicle(index: int) -> int:
    """Key of X_i = T_map_vehicle at the i-th stamp used (counted over all drives)."""
    return int(gtsam.symbol("x", index))


def key_pose_error(index: int) -> int:
    """Key of the Gauss-Markov error of the given pose at the i-th stamp used."""
    return int(gtsam.symbol("d", index))


def key_imu(index: int) -> int:
    """Key of T_map_imu at a node of a trajectory."""
    return int(gtsam.symbol("i", index))


def key_velocity(index: int) -> int:
    """Key of the velocity of the IMU's origin in the map, (3,) m/s, at a node of a trajectory."""
    return int(gtsam.symbol("v", index))


def key_bias(index: int) -> int:
    """Key of the IMU's `gtsam.imuBias.ConstantBias` (imu frame) at a node of a trajectory."""
    return int(gtsam.symbol("b", index))


def key_yaw_bias() -> int:
    """Key of the yaw bias of a trajectory's orientation source, (1,) rad, about map z."""
    return int(gtsam.symbol("y", 0))


def key_parameters() -> int:
    """Key of a trajectory's uncertain parameters, all in one vector of its linear graph."""
    return int(gtsam.symbol("u", 0))


def key_lever_arm() -> int:
    """Key of the GNSS antenna in the vehicle frame, (3,) metres, one for all drives."""
    return int(gtsam.symbol("l", 0))


def key_imu_place() -> int:
    """Key of the IMU in the vehicle frame, (3,) metres, one for all drives."""
    return int(gtsam.symbol("l", 1))


def key_imu_rotation() -> int:
    """Key of R_vehicle_imu, a `gtsam.Rot3`, right perturbation, one for all drives."""
    return int(gtsam.symbol("r", 0))


def key_wheels_rotation() -> int:
    """Key of R_vehicle_wheels, a `gtsam.Rot3`, right perturbation, one for all drives."""
    return int(gtsam.symbol("w", 0))


def key_sensor_offset(index: int) -> int:
    """Key of the time offset of a sensor of the motion, (1,) seconds, one for all drives.

    0: GNSS, 1: IMU, 2: wheels, 3: given poses.
    """
    return int(gtsam.symbol("f", index))


def key_extrinsic() -> int:
    """Key of E = T_vehicle_ref, the extrinsic of the reference LiDAR."""
    return int(gtsam.symbol("e", 0))


def key_sensor(index: int) -> int:
    """Key of S_a = T_ref_a of the LiDAR at `index` in the order of the problem."""
    return int(gtsam.symbol("s", index))


def key_target(index: int) -> int:
    """Key of T_target_map of the target placement at `index`."""
    return int(gtsam.symbol("c", index))


def key_offset(index: int) -> int:
    """Key of the time offset of the LiDAR at `index` in the order of the problem, (1,) seconds."""
    return int(gtsam.symbol("o", index))


def key_ground(drive: int) -> int:
    """Key of the ground plane of a drive: slopes along map x and y, and height, (3,)."""
    return int(gtsam.symbol("g", drive))


def key_ground_bias(index: int) -> int:
    """Key of the range biases on the ground of the LiDAR at `index`, (3,): see `ground_graph`."""
    return int(gtsam.symbol("q", index))


def key_rates(drive: int) -> int:
    """Key of the errors of a drive's rates, (9,): angular velocity (rad/s), velocity (m/s), m.

    Along vehicle axes, true ones less those of the trajectory; the velocity is that in the map. The
    last three are how far the vehicle's origin is from the point that the velocity is of.
    """
    return int(gtsam.symbol("t", drive))


def key_height(drive: int) -> int:
    """Key of the error of the vehicle's height above ground of a drive, (1,) metres."""
    return int(gtsam.symbol("h", drive))


def key_parallel(drive: int) -> int:
    """Key of the ground's tilt in the vehicle frame of a drive: x and y of its normal, (2,)."""
    return int(gtsam.symbol("p", drive))
