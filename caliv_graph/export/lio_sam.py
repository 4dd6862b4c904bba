"""LIO-SAM: `extrinsicTrans`, `extrinsicRot`, `extrinsicRPY` of params.yaml.

Not what its comment "lidar -> IMU" seems to say. `imuConverter` multiplies what the IMU measured by
`extrinsicRot` and so brings it into the LiDAR's axes, and `imuPreintegration` composes the LiDAR's
pose with the translation `extrinsicTrans` to the IMU's: both are `T_lidar_imu`,
`p_lidar = R p_imu + t`, as the author says (TixiaoShan/LIO-SAM, issue 47) and as the published
values for KITTI are, which are KITTI's imu_to_velo. `extrinsicRPY` turns the orientation that an
IMU of nine axes reports: the main branch (ROS 1) takes R_lidar_imu and inverts it, the branch for
ROS 2 takes R_imu_lidar as it is.
"""

from __future__ import annotations

from caliv_graph.export.parameters import Parameters, parameter_export
from caliv_graph.export.request import Export, Request


def export(request: Request) -> Export:
    """Parameters of LIO-SAM for ROS 2 (or, by `form`, ROS 1), or `--base` with them changed.

    Raises:
        ExportError: the IMU's mounting is not known, or `--base` lacks the parameters.
    """
    lidar, chosen = request.one_lidar("lio-sam")
    T_lidar_imu, unsaid = request.T_lidar_imu(lidar, "lio-sam")
    R_lidar_imu = T_lidar_imu.rotation().matrix()
    shared = {
        "extrinsicTrans": T_lidar_imu.translation().tolist(),
        "extrinsicRot": R_lidar_imu.ravel().tolist(),
    }
    return parameter_export(
        request,
        Parameters(
            consumer="lio-sam",
            lidar=lidar,
            parent=lidar,
            child="imu",
            T_parent_child=T_lidar_imu,
            meaning="extrinsicTrans and extrinsicRot (row-major): p_lidar = R p_imu + t.",
            ros1={**shared, "extrinsicRPY": R_lidar_imu.ravel().tolist()},
            ros2={**shared, "extrinsicRPY": R_lidar_imu.T.ravel().tolist()},
            optional=("extrinsicRPY",),
            above_ros1=("lio_sam",),
            above_ros2=("/**", "ros__parameters"),
            extra_ros1=(
                "extrinsicRPY is R_lidar_imu, which LIO-SAM's main branch (ROS 1) inverts. It "
                "assumes that the IMU's orientation is that of its own axes.",
            ),
            extra_ros2=(
                "extrinsicRPY is R_imu_lidar, which LIO-SAM's branch for ROS 2 takes as it is. It "
                "assumes that the IMU's orientation is that of its own axes.",
            ),
        ),
        (*chosen, *unsaid),
    )
