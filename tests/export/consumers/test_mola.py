from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import yaml

from caliv_graph.errors import ExportError
from caliv_graph.export.consumers.mola import export
from caliv_graph.products import Array
from tests.export.requests import T_VEHICLE_LIDAR, base, matrix_of, request

TOPICS = {"front": "/front/points", "rear": "/rear/points"}

SYSTEM = """\
modules:
  - type: mola::Rosbag2Dataset
    params:
      rosbag_filename: ${ROSBAG2_FILE}
      sensors:
        - topic: ${POINTCLOUD_TOPIC|'/rear/points'}
          type: CObservationPointCloud
          fixed_sensor_pose: "0 0 0 0 0 0"  # 'x y z yaw_deg pitch_deg roll_deg'
        - topic: /front/points
          fixed_sensor_pose: 1 2 3 4 5 6
        - topic: /imu
          fixed_sensor_pose: "7 0 0 0 0 0"
"""


def sensor_pose(text: str) -> Array:
    """MRPT's CPose3D of x y z and yaw pitch roll in degrees."""
    x, y, z, *angles = (float(value) for value in text.split())
    yaw, pitch, roll = np.radians(angles)
    return matrix_of(np.array([x, y, z]), roll, pitch, yaw)


def poses(sensors: list[dict[str, Any]]) -> list[Array]:
    return [sensor_pose(sensor["fixed_sensor_pose"]) for sensor in sensors]


def test_new_sensors() -> None:
    made = export(request(topics=TOPICS))

    sensors = yaml.safe_load(made.content)["sensors"]
    assert [sensor["topic"] for sensor in sensors] == list(TOPICS.values())
    for found, T in zip(poses(sensors), T_VEHICLE_LIDAR.values(), strict=True):
        np.testing.assert_allclose(found, T.matrix(), atol=1e-9)
    assert b"p_parent = T p_child" in made.content
    assert b"yaw, x (vehicle axes) not determined" in made.content


def test_onto_a_base() -> None:
    made = export(request(base=base(SYSTEM), topics=TOPICS))

    sensors = yaml.safe_load(made.content)["modules"][0]["params"]["sensors"]
    rear, front, imu = poses(sensors)
    np.testing.assert_allclose(front, T_VEHICLE_LIDAR["front"].matrix(), atol=1e-9)
    np.testing.assert_allclose(rear, T_VEHICLE_LIDAR["rear"].matrix(), atol=1e-9)
    assert imu[0, 3] == 7.0
    text = re.sub(r"\A(?:# .*\n)*", "", made.content.decode())
    text = re.sub(r'pose: "[^"]*"  #', 'pose: "0 0 0 0 0 0"  #', text)
    text = re.sub(r'(/front/points\n +fixed_sensor_pose: )"[^"]*"', r"\g<1>1 2 3 4 5 6", text)
    assert text == SYSTEM


def test_a_topic_that_is_not_known() -> None:
    with pytest.raises(ExportError, match="needs the topic of LiDAR 'front'"):
        export(request())
    with pytest.raises(ExportError, match="0 sensors with fixed_sensor_pose have topic /other of"):
        export(request(base=base(SYSTEM), topics={**TOPICS, "front": "/other"}))
