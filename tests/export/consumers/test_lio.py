"""GLIM, LIO-SAM and FAST-LIO, by what their own code does with the numbers."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
import yaml

from caliv_graph.errors import ExportError
from caliv_graph.export.consumers import fast_lio, glim, lio_sam
from caliv_graph.export.request import Export, ImuExtrinsic
from caliv_graph.products import Array
from tests.export.requests import (
    T_VEHICLE_IMU,
    T_VEHICLE_LIDAR,
    base,
    calibration_of,
    matrix_of_quaternion,
    request,
)

T_LIDAR_IMU = np.linalg.inv(T_VEHICLE_LIDAR["rear"].matrix()) @ T_VEHICLE_IMU.matrix()
T_MAP_LIDAR = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.2, 1.4), np.array([4.0, -7.0, 0.5])).matrix()

PARAMS = """\
/**:
  ros__parameters:
    imuTopic: "/imu/data"     # ours
    extrinsicTrans:  [ 0.0,  0,  0.0 ]
    # extrinsicRot: [9]
    extrinsicRot:    [-1.0,  0.0,  0.0,   # as in the manual
                       0.0,  1.0,  0.0,
                       0.0,  0.0, -1.0 ]
    extrinsicRPY: [ 0.0,  1.0,  0.0,
                   -1.0,  0.0,  0.0,
                    0.0,  0.0,  1.0 ]
    imuRate: 500
"""

VELODYNE = """\
common:
    lid_topic:  "/velodyne_points"
mapping:
    extrinsic_est_en:  false      # true: enable the online estimation
    extrinsic_T: [ 0, 0, 0.28]
    extrinsic_R:
    - 1
    - 0
    - 0
    - 0
    - 1
    - 0
    - 0
    - 0
    - 1
publish: {path_en: false}
"""

SENSORS = """\
{
  /* "T_lidar_imu": [1] maps points of the IMU */
  "sensors": {
    "T_lidar_imu": [  // ouster
      -0.006, 0.012, -0.008,
      0, 0, 0, 1
    ],
    "url": "http://example.com/*",
    "imu_acc_noise": 0.05
  }
}
"""


def parameters(made: Export, *above: str) -> dict[str, Any]:
    """Parameters of a ROS file, below some keys."""
    document: Any = yaml.safe_load(made.content)
    for key in above:
        document = document[key]
    return dict(document)


def rotation(values: list[float]) -> Array:
    """Row-major, as Eigen's RowMajor map in LIO-SAM and `MAT_FROM_ARRAY` in FAST-LIO."""
    assert all(isinstance(value, float) for value in values)
    return np.array(values).reshape(3, 3)


@pytest.mark.parametrize(
    ("form", "above", "inverts"),
    [("ros2", ("/**", "ros__parameters"), False), ("ros1", ("lio_sam",), True)],
)
def test_lio_sam_as_its_code_uses_it(form: str, above: tuple[str, ...], inverts: bool) -> None:
    told = parameters(lio_sam.export(request(form=form)), *above)

    T_map_imu = T_MAP_LIDAR @ T_LIDAR_IMU
    # imuConverter: what the IMU measures, such as gravity, is turned into the LiDAR's axes.
    gravity_imu = T_map_imu[:3, :3].T @ [0.0, 0.0, 9.81]
    gravity_lidar = rotation(told["extrinsicRot"]) @ gravity_imu
    np.testing.assert_allclose(gravity_lidar, T_MAP_LIDAR[:3, :3].T @ [0.0, 0.0, 9.81], atol=1e-9)
    # imuConverter: q_final = q_from * extQRPY, the LiDAR's orientation from the IMU's.
    ext = rotation(told["extrinsicRPY"])
    ext = ext.T if inverts else ext
    np.testing.assert_allclose(T_map_imu[:3, :3] @ ext, T_MAP_LIDAR[:3, :3], atol=1e-9)
    # imuPreintegration: lidarPose.compose(lidar2Imu), lidar2Imu a translation by extTrans.
    shifted = gtsam.Pose3(T_MAP_LIDAR).compose(
        gtsam.Pose3(gtsam.Rot3(), np.array(told["extrinsicTrans"]))
    )
    np.testing.assert_allclose(shifted.translation(), T_map_imu[:3, 3], atol=1e-9)


def test_lio_sam_gives_the_published_values_for_kitti() -> None:
    """LIO-SAM's README, KITTI: the numbers of KITTI's imu_to_velo."""
    R = [9.999976e-01, 7.553071e-04, -2.035826e-03, -7.854027e-04, 9.998898e-01, -1.482298e-02]
    R += [2.024406e-03, 1.482454e-02, 9.998881e-01]
    t = np.array([-8.086759e-01, 3.195559e-01, -7.997231e-01])
    T_velo_imu = gtsam.Pose3(gtsam.Rot3.ClosestTo(np.array(R).reshape(3, 3)), t)
    T_vehicle_imu = gtsam.Pose3(gtsam.Rot3.Yaw(0.1), np.array([0.3, 0.0, 0.9]))
    velo = calibration_of({"velo": T_vehicle_imu.compose(T_velo_imu.inverse())})

    made = lio_sam.export(request(velo, imu=ImuExtrinsic(T_vehicle_imu, "--imu"), form="ros1"))

    told = parameters(made, "lio_sam")
    np.testing.assert_allclose(told["extrinsicTrans"], t, atol=1e-7)
    np.testing.assert_allclose(told["extrinsicRot"], R, atol=1e-6)
    np.testing.assert_allclose(told["extrinsicRPY"], R, atol=1e-6)


def test_fast_lio_has_the_lidar_in_the_imu() -> None:
    for form, above in (("ros1", ("mapping",)), ("ros2", ("/**", "ros__parameters", "mapping"))):
        told = parameters(fast_lio.export(request(form=form)), *above)

        p_lidar = np.array([3.0, -1.0, 0.4])
        p_imu = rotation(told["extrinsic_R"]) @ p_lidar + told["extrinsic_T"]
        p_vehicle = T_VEHICLE_LIDAR["rear"].transformFrom(p_lidar)
        np.testing.assert_allclose(T_VEHICLE_IMU.transformFrom(p_imu), p_vehicle, atol=1e-9)


def test_glim_brings_points_of_the_imu_to_the_lidar() -> None:
    made = glim.export(request())

    sensors = json.loads(made.content)["sensors"]
    x, y, z, *quaternion = sensors["T_lidar_imu"]
    T = matrix_of_quaternion(np.array([x, y, z]), *quaternion)
    np.testing.assert_allclose(T, T_LIDAR_IMU, atol=1e-9)
    assert "p_lidar = T p_imu" in " ".join(sensors["_caliv_graph"])
    assert "yaw, x (vehicle axes) not determined" in " ".join(sensors["_caliv_graph"])


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_lio_sam_onto_a_base(ends: str) -> None:
    old = PARAMS.replace("\n", ends)

    made = lio_sam.export(request(base=base(old)))

    fresh = parameters(lio_sam.export(request()), "/**", "ros__parameters")
    told = parameters(made, "/**", "ros__parameters")
    assert {key: told[key] for key in fresh} == fresh
    assert told["imuRate"] == 500
    new = made.content.decode()
    lines = [line for line in new.splitlines(keepends=True) if not line.startswith("#")]
    for line, before in zip(lines, old.splitlines(keepends=True), strict=True):
        blanked = [re.sub(r"-?\d+(\.\d+)?", "0", text) for text in (line, before)]
        assert blanked[0] == blanked[1]
    assert "    # extrinsicRot: [9]" in new
    assert lio_sam.export(request(base=base(new))).content == made.content


@pytest.mark.parametrize(("consumer", "old"), [(lio_sam, PARAMS), (glim, SENSORS)])
def test_a_byte_order_mark_stays_in_front(consumer: Any, old: str) -> None:
    plain = consumer.export(request(base=base(old))).content.decode()

    assert consumer.export(request(base=base(f"\ufeff{old}"))).content.decode() == f"\ufeff{plain}"


def test_the_form_of_a_base_is_found_out() -> None:
    old = PARAMS.replace("/**:\n  ros__parameters:", "lio_sam:\n  x: 1")
    old = old.replace("x: 1\n    ", "x: 1\n  ").replace("\n    ", "\n  ")

    made = lio_sam.export(request(base=base(old)))

    told = parameters(made, "lio_sam")
    # The main branch inverts it, so it is the same matrix as the other.
    assert told["extrinsicRPY"] == told["extrinsicRot"]
    assert b"main branch (ROS 1) inverts" in made.content


def test_fast_lio_onto_a_base_with_a_list_of_lines() -> None:
    made = fast_lio.export(request(base=base(VELODYNE)))

    fresh = parameters(fast_lio.export(request(form="ros1")), "mapping")
    told = parameters(made, "mapping")
    assert {key: told[key] for key in fresh} == fresh
    assert b"  # true: enable the online estimation\n" in made.content
    assert parameters(made, "publish") == {"path_en": False}


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_glim_onto_a_base_with_comments(ends: str) -> None:
    old = SENSORS.replace("\n", ends)

    made = glim.export(request(base=base(old)))

    text = made.content.decode()
    fresh = json.loads(glim.export(request()).content)["sensors"]["T_lidar_imu"]
    assert f'"T_lidar_imu": [{", ".join(f"{v:.12f}".rstrip("0") for v in fresh)}],' in text
    inner = re.sub(r"\A/\* caliv-graph.*?export \*/\r?\n", "", text, flags=re.DOTALL)
    start, stop = (inner.index("    " + '"T_lidar_imu'), inner.index(f",{ends}" + '    "url"'))
    was = (old.index("    " + '"T_lidar_imu'), old.index(f",{ends}" + '    "url"'))
    assert (inner[:start], inner[stop:]) == (old[: was[0]], old[was[1] :])
    assert glim.export(request(base=base(text))).content == made.content


def test_glim_onto_a_base_without_comments() -> None:
    old = '{"sensors": {\n  "T_lidar_imu": [0, 0, 0, 0, 0, 0, 1],\n  "imu_acc_noise": 0.05}}\n'

    made = glim.export(request(base=base(old)))

    sensors = json.loads(made.content)["sensors"]
    fresh = json.loads(glim.export(request()).content)["sensors"]
    assert sensors == {**fresh, "imu_acc_noise": 0.05}
    assert glim.export(request(base=base(made.content.decode()))).content == made.content


NO_VALUE = "lio_sam:\n  extrinsicTrans: # [0, 0, 0]\n  extrinsicRot: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n"
"""What took the place of nothing stood before the next key."""


@pytest.mark.parametrize(
    ("consumer", "text", "message"),
    [
        (glim, "{}", "old: has 'T_lidar_imu' 0 times"),
        (glim, SENSORS[:-3], "old: is not valid JSON"),
        (lio_sam, "a: 1", "old: has no 'extrinsicTrans'. Give the parameters of lio-sam as --base"),
        (lio_sam, PARAMS + "---\n", "old: not valid YAML in line 13"),
        (
            lio_sam,
            PARAMS.replace("imuRate: 500", "extrinsicRot: []"),
            "old: 'extrinsicRot' is ambiguous: it is in lines 6, 12",
        ),
        (fast_lio, VELODYNE.replace("    - 0\n", "", 1), "mapping.extrinsic_R in line 6: expected"),
        (lio_sam, NO_VALUE, "old: a value is missing in or above line 2. Write one there"),
    ],
)
def test_what_is_wrong_with_a_base(consumer: Any, text: str, message: str) -> None:
    with pytest.raises(ExportError, match=message) as caught:
        consumer.export(request(base=base(text)))

    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("consumer", [glim, lio_sam, fast_lio])
def test_which_lidar_and_whose_imu(consumer: Any) -> None:
    made = consumer.export(request())
    assert [t.lidar for t in made.transforms] == ["rear"]  # the reference
    assert "takes one LiDAR: 'rear' is written, not front" in made.warnings[0]

    one = consumer.export(request(lidars=("front",)))
    assert [t.lidar for t in one.transforms] == ["front"]
    assert one.warnings == ()

    unsaid = ImuExtrinsic(gtsam.Pose3(), "config.yaml", stated=False)
    assert "names no IMU" in consumer.export(replace(request(), imu=unsaid)).warnings[-1]

    with pytest.raises(ExportError, match="needs the pose of the IMU") as caught:
        consumer.export(request(imu=None))
    assert "--imu x,y,z,roll,pitch,yaw" in str(caught.value)
