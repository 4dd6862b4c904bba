"""LIO-SAM: `extrinsicTrans`, `extrinsicRot`, `extrinsicRPY` of params.yaml.

Both are `T_lidar_imu`, `p_lidar = R p_imu + t`, in spite of the comment "lidar -> IMU" in the file:
`imuConverter` multiplies IMU measurements by `extrinsicRot`, which gives LiDAR axes, and
`imuPreintegration` composes the pose of the LiDAR with the translation `extrinsicTrans`. The author
confirms it (TixiaoShan/LIO-SAM, issue 47), and the published values for KITTI are its imu_to_velo.
`extrinsicRPY` rotates the orientation of a nine-axis IMU: the main branch (ROS 1) takes R_lidar_imu
and inverts it, the ROS 2 branch takes R_imu_lidar and does not invert it.
"""

from __future__ import annotations

from caliv_graph.export.parameters import Parameters, parameter_export
from caliv_graph.export.request import IMU_OPTIONS, Consumer, Export, Request, Transform


def export(request: Request) -> Export:
    """Parameters of LIO-SAM for ROS 2 (or, by `form`, ROS 1), or `--base` with new values.

    Raises:
        ExportError: the pose of the IMU is unknown, or `--base` lacks the parameters.
    """
    lidar, several = request.one_lidar("lio-sam")
    T_lidar_imu, assumed = request.T_lidar_imu(lidar, "lio-sam")
    R_lidar_imu = T_lidar_imu.rotation().matrix()
    shared = {
        "extrinsicTrans": T_lidar_imu.translation().tolist(),
        "extrinsicRot": R_lidar_imu.ravel().tolist(),
    }
    own_axes = "if the IMU reports the orientation of its own axes."
    return parameter_export(
        request,
        "lio-sam",
        Transform(
            lidar,
            lidar,
            "imu",
            T_lidar_imu,
            "extrinsicTrans and extrinsicRot (row-major): p_lidar = R p_imu + t.",
        ),
        Parameters(
            ("lio_sam",),
            {**shared, "extrinsicRPY": R_lidar_imu.ravel().tolist()},
            (
                "extrinsicRPY is R_lidar_imu, which LIO-SAM's main branch (ROS 1) inverts, "
                f"{own_axes}",
            ),
        ),
        Parameters(
            ("/**", "ros__parameters"),
            {**shared, "extrinsicRPY": R_lidar_imu.T.ravel().tolist()},
            (f"extrinsicRPY is R_imu_lidar, as LIO-SAM's ROS 2 branch expects it, {own_axes}",),
        ),
        (*several, *assumed),
        optional=("extrinsicRPY",),
    )


CONSUMER = Consumer(export, IMU_OPTIONS | {"--form"})
