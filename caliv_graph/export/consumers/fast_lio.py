"""FAST-LIO: `mapping.extrinsic_T` and `mapping.extrinsic_R`.

The LiDAR's pose in the IMU's frame (hku-mars/FAST_LIO, README): `p_imu = R p_lidar + T`.
"""

from __future__ import annotations

from caliv_graph.export.parameters import Parameters, parameter_export
from caliv_graph.export.request import IMU_OPTIONS, Consumer, Export, Request, Transform


def export(request: Request) -> Export:
    """Parameters of FAST-LIO for ROS 2 (or, by `form`, ROS 1), or `--base` with new values.

    Raises:
        ExportError: the pose of the IMU is unknown, or `--base` lacks the parameters.
    """
    lidar, several = request.one_lidar("fast-lio")
    T_lidar_imu, assumed = request.T_lidar_imu(lidar, "fast-lio")
    T_imu_lidar = T_lidar_imu.inverse()
    values = {
        "extrinsic_T": T_imu_lidar.translation().tolist(),
        "extrinsic_R": T_imu_lidar.rotation().matrix().ravel().tolist(),
    }
    meaning = "extrinsic_T and extrinsic_R (row-major): p_imu = R p_lidar + T."
    return parameter_export(
        request,
        "fast-lio",
        Transform(lidar, "imu", lidar, T_imu_lidar, meaning),
        Parameters(("mapping",), values),
        Parameters(("/**", "ros__parameters", "mapping"), values),
        (*several, *assumed),
    )


CONSUMER = Consumer(export, IMU_OPTIONS | {"--form"})
