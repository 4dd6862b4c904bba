from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
import yaml

from caliv_graph.errors import ExportError
from caliv_graph.export.consumers.autoware import export
from caliv_graph.export.edit import read_base
from caliv_graph.export.request import Export
from caliv_graph.products import Array
from caliv_graph.readers.frames import FrameTransform, FrameTree
from tests.export.requests import (
    T_HOUSING_LIDAR,
    T_VEHICLE_KIT,
    T_VEHICLE_LIDAR,
    base,
    calibration_of,
    matrix_of,
    request,
)

KIT = """\
# measured by hand in May
sensor_kit_base_link:
  camera0/camera_link: {x: 0.1, y: 0.5, z: -0.3, roll: 0.0, pitch: 0.3, yaw: 1.0}
  velodyne_front_base_link:   # on the roof
    x: 1.0     # metres
    y:  -2e-1
    z: 0
    roll: 0.0
    pitch: 0.0
    yaw: 1.575
  velodyne_left_base_link:
    {x: 0.0, y: 0.56, z: -0.3, roll: -0.02, pitch: 0.71, yaw: 1.575}
  traffic_light_left_camera_link: {x: 0.05, y: 0.0, z: -0.1, roll: 0.0, pitch: 0.0, yaw: 0.0}
"""

HOUSINGS = {"front": T_HOUSING_LIDAR, "rear": T_HOUSING_LIDAR.inverse()}


def sensors() -> str:
    """A sensors_calibration.yaml with the sensor kit and the rear LiDAR."""
    x, y, z = T_VEHICLE_KIT.translation()
    roll, pitch, yaw = T_VEHICLE_KIT.rotation().rpy()
    kit = {"x": x, "y": y, "z": z, "roll": roll, "pitch": pitch, "yaw": yaw}
    rear = dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), 0.0)
    frames = {
        "sensor_kit_base_link": {key: float(value) for key, value in kit.items()},
        "velodyne_rear_base_link": rear,
    }
    return yaml.safe_dump({"base_link": frames}, sort_keys=False)


def pose(document: dict[str, dict[str, dict[str, float]]], parent: str, child: str) -> Array:
    """Pose of a child in its parent, (4, 4), as Autoware's xacro makes an origin of it."""
    values = document[parent][child]
    assert all(isinstance(value, float) for value in values.values())
    xyz = np.array([values["x"], values["y"], values["z"]])
    return matrix_of(xyz, values["roll"], values["pitch"], values["yaw"])


def loaded(made: Export) -> dict[str, dict[str, dict[str, float]]]:
    document: dict[str, dict[str, dict[str, float]]] = yaml.safe_load(made.content)
    return document


def test_a_new_file_by_the_published_rule() -> None:
    document = loaded(export(request(housings=HOUSINGS)))

    for name, T in T_VEHICLE_LIDAR.items():
        # To <sensor>_base_link by the file, from there to the cloud's frame by the sensor's xacro.
        composed = pose(document, "base_link", f"{name}_base_link") @ HOUSINGS[name].matrix()
        np.testing.assert_allclose(composed, T.matrix(), atol=1e-9)


def test_both_files_of_a_vehicle(tmp_path: Path) -> None:
    """The sensor kit's file takes the place of the kit from the other one beside it."""
    (tmp_path / "sensor_kit_calibration.yaml").write_text(KIT)
    (tmp_path / "sensors_calibration.yaml").write_text(sensors())
    old = {
        name: read_base(tmp_path / f"{name}.yaml")
        for name in ("sensors_calibration", "sensor_kit_calibration")
    }

    in_kit = export(request(base=old["sensor_kit_calibration"], housings=HOUSINGS))
    in_sensors = export(request(base=old["sensors_calibration"], housings=HOUSINGS))

    kit, vehicle = loaded(in_kit), loaded(in_sensors)
    front = (
        pose(vehicle, "base_link", "sensor_kit_base_link")
        @ pose(kit, "sensor_kit_base_link", "velodyne_front_base_link")
        @ HOUSINGS["front"].matrix()
    )
    np.testing.assert_allclose(front, T_VEHICLE_LIDAR["front"].matrix(), atol=1e-9)
    rear = pose(vehicle, "base_link", "velodyne_rear_base_link") @ HOUSINGS["rear"].matrix()
    np.testing.assert_allclose(rear, T_VEHICLE_LIDAR["rear"].matrix(), atol=1e-9)
    # Each has one of the two LiDARs, and says which it has not.
    assert "has no frame of LiDAR 'rear', which is not written" in in_kit.warnings[0]
    assert "has no frame of LiDAR 'front', which is not written" in in_sensors.warnings[0]


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_all_else_in_a_base_stays_byte_for_byte(ends: str) -> None:
    old = KIT.replace("\n", ends)
    asked = request(
        base=base(old), housings=HOUSINGS, parents={"sensor_kit_base_link": T_VEHICLE_KIT}
    )

    made = export(asked)

    new = re.sub(
        r"\A# caliv-graph export.*?# end of[^\n]*\n", "", made.content.decode(), flags=re.DOTALL
    )
    for key, value in (
        ("x", "1.0"),
        ("y", "-2e-1"),
        ("z", "0"),
        ("roll", "0.0"),
        ("pitch", "0.0"),
        ("yaw", "1.575"),
    ):
        new, count = re.subn(
            rf"^(    {key}: +)-?\d+\.\d+", rf"\g<1>{value}", new, flags=re.MULTILINE
        )
        assert count == 1
    assert new == old
    again = export(replace(asked, base=base(made.content.decode())))
    assert again.content == made.content


def test_where_the_sensor_kit_is_can_be_told_or_recorded() -> None:
    with pytest.raises(
        ExportError, match="the pose of 'sensor_kit_base_link' in 'base_link' is unknown"
    ):
        export(request(base=base(KIT), lidars=("front",)))
    link = FrameTransform("base_link", "sensor_kit_base_link", T_VEHICLE_KIT)

    told = export(request(base=base(KIT), lidars=("front",), parents={link.child: T_VEHICLE_KIT}))
    recorded = export(request(base=base(KIT), lidars=("front",), tree=FrameTree([link])))

    for made in (told, recorded):
        T = T_VEHICLE_KIT.compose(made.transforms[0].T_parent_child)
        assert T.equals(T_VEHICLE_LIDAR["front"], 1e-9)


def test_a_housing_that_nobody_told_is_warned_about_and_commented() -> None:
    made = export(request(lidars=("front",)))

    assert "the pose of the cloud's frame in it is unknown: assumed the same" in made.warnings[0]
    assert b"The LiDAR's frame is assumed to be the frame of its housing." in made.content
    assert b"yaw, x (vehicle axes) not determined" in made.content
    assert b"p_parent = T p_child" in made.content
    assert "--housing" not in " ".join(export(request(housings=HOUSINGS)).warnings)


def test_left_is_the_lidar_not_the_camera() -> None:
    made = export(
        request(
            calibration_of({"left": T_VEHICLE_LIDAR["front"]}),
            base=base(KIT),
            parents={"sensor_kit_base_link": gtsam.Pose3()},
        )
    )

    assert made.transforms[0].child == "velodyne_left_base_link"
    document = loaded(made)
    values = pose(document, "sensor_kit_base_link", "velodyne_left_base_link")
    np.testing.assert_allclose(values, T_VEHICLE_LIDAR["front"].matrix(), atol=1e-9)
    assert document["sensor_kit_base_link"]["traffic_light_left_camera_link"]["x"] == 0.05


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [", "old: not valid YAML in line 1"),
        ("- 1", "old: has no keys with values"),
        ("a: {b: {x: 1}}", "old: is not a calibration file of Autoware"),
        (KIT.replace("velodyne_front", "velodyne_top"), "old: has none of the LiDARs front, but"),
        (
            KIT.replace("1.575\n", "[1]\n", 1),
            "velodyne_front_base_link in line 4: has no number 'yaw'",
        ),
    ],
)
def test_what_is_wrong_with_a_base(text: str, message: str) -> None:
    parents = {"sensor_kit_base_link": T_VEHICLE_KIT}
    with pytest.raises(ExportError, match=message) as caught:
        export(request(base=base(text), lidars=("front",), parents=parents))

    assert "\n" not in str(caught.value)


def test_a_frame_that_is_not_there() -> None:
    with pytest.raises(
        ExportError, match=r"has no frame 'top'. Give --frame one of camera0/camera_link"
    ):
        export(request(base=base(KIT), lidars=("front",), frames={"front": "top"}))
