"""A calibration without any symmetry that could hide a wrong direction, and requests for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from caliv_graph.export.request import Base, ImuExtrinsic, Request
from caliv_graph.products import Array, Calibration
from tests.samples import make_calibration, pose

T_VEHICLE_LIDAR = {
    "front": pose((1.913, 0.317, 1.721), (7.3, -11.9, 23.1)),
    "rear": pose((-0.612, -0.234, 1.108), (-4.7, 17.2, 163.9)),
}
T_HOUSING_LIDAR = pose((0.011, -0.027, 0.0377), (1.1, -2.3, 90.7))
T_VEHICLE_IMU = pose((0.412, -0.153, 0.608), (3.3, 5.1, -31.7))
T_VEHICLE_KIT = pose((0.9, 0.05, 2.0), (-0.7, 1.9, -2.6))


def calibration_of(
    T_vehicle_lidar: Mapping[str, gtsam.Pose3] = T_VEHICLE_LIDAR, **changes: Any
) -> Calibration:
    """Extrinsics as given; x and yaw were not determined.

    Args:
        T_vehicle_lidar: per LiDAR.
        changes: by the name of a LiDAR, fields of its result; else fields of the calibration.
    """
    names = list(T_vehicle_lidar)
    sample = make_calibration(*["front", "rear", "left"][: len(names)])
    results = zip(T_vehicle_lidar.items(), sample.lidars.values(), strict=True)
    lidars = {
        name: replace(result, T_vehicle_lidar=T, **changes.pop(name, {}))
        for (name, T), result in results
    }
    return replace(sample, lidars=lidars, reference=names[-1], undetermined=(), **changes)


def request(calibration: Calibration | None = None, **changes: Any) -> Request:
    """A request for all LiDARs; the IMU is known."""
    chosen = calibration or calibration_of()
    settings: dict[str, Any] = {
        "lidars": tuple(chosen.lidars),
        "out": Path("out"),
        "imu": ImuExtrinsic(T_VEHICLE_IMU, "config.yaml"),
        **changes,
    }
    return Request(calibration=chosen, source="calibration.yaml", **settings)


def quaternion_xyzw(T: gtsam.Pose3) -> list[float]:
    """Unit quaternion of a pose."""
    q: Any = T.rotation().toQuaternion()
    return [q.x(), q.y(), q.z(), q.w()]


def base(text: str, path: str = "old") -> Base:
    """An existing file, not on the disk."""
    return Base(Path(path), text)


def matrix_of(xyz: npt.ArrayLike, roll: float, pitch: float, yaw: float) -> Array:
    """A transform by URDF's rule, R = Rz(yaw) Ry(pitch) Rx(roll), written out."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    cy, sy = np.cos(yaw), np.sin(yaw)
    out = np.eye(4)
    out[:3, :3] = (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    )
    out[:3, 3] = xyz
    return out


def matrix_of_quaternion(xyz: Array, x: float, y: float, z: float, w: float) -> Array:
    """A transform of a translation and a unit quaternion, by the textbook."""
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, 3] = xyz
    return out
