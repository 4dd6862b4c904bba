from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.errors import ExportError
from caliv_graph.export.consumers.urdf import export
from tests.export.requests import (
    T_HOUSING_LIDAR,
    T_VEHICLE_LIDAR,
    base,
    calibration_of,
    matrix_of,
    request,
)

VEHICLE = """<?xml version='1.0' encoding="utf-8"?>
<!-- our van; do not touch > "quotes" -->
<robot name="van">
  <link name="base_footprint"/>  <link name="base_link"/>
  <link name="roof">
    <visual><origin xyz="1 2 3"/><geometry><box size="1 1 0.1"/></geometry></visual>
  </link>
  <link name="lidar_front"/><link name="camera_front"/>
  <link name='velodyne_rear'/>

  <joint name="foot" type="fixed">
    <origin xyz="0 0 0.31"/><parent link="base_footprint"/><child link="base_link"/>
  </joint>
  <joint name="roof_joint" type="fixed">
    <parent link="base_link"/> <child link="roof"/>
    <origin rpy="0.02 -0.03 0.4" xyz="0.7 0 1.9"/>  <!-- as welded -->
  </joint>
  <joint name="a" type="fixed">
    <!-- <origin xyz="9 9 9"/> from the drawing, <child link="lidar_front"/> -->
    <parent link="roof"/>
    <child link="lidar_front"/>
    <origin  rpy='0 0.17 0'
             xyz = '1.3 0 0.1' />
  </joint>
  <joint type="fixed" name="é"><parent link="lidar_front"/><child link="velodyne_rear"/>
  </joint>
  <joint name="b" type="fixed">
    <parent link="roof"/><child link="camera_front"/><origin xyz="1.3 0 0.1" rpy="0 0.17 0"/>
  </joint>
  <transmission name="t"><joint name="a"/></transmission>
</robot>
"""

LINE = '<robot name="r"><link name="base_link"/><link name="{child}"/>{joint}</robot>'
JOINT = (
    '<joint name="j" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
    '<origin xyz="{xyz}" rpy="0 0 0"/></joint>'
)


def pose_in(path: Path, child: str, parent: str = "base_link") -> Any:
    """Pose of a link in another one, (4, 4), as yourdfpy has it."""
    yourdfpy = pytest.importorskip("yourdfpy")
    robot = yourdfpy.URDF.load(str(path), load_meshes=False, build_scene_graph=True)
    return robot.get_transform(frame_to=child, frame_from=parent)


def one_joint(
    child: str, parent: str = "base_link", kind: str = "fixed", xyz: str = "0 0 0"
) -> str:
    joint = JOINT.format(kind=kind, parent=parent, child=child, xyz=xyz)
    return LINE.format(child=child, joint=joint)


def front(text: str, **changes: Any) -> Any:
    """Exports only the front LiDAR onto a base."""
    return export(request(base=base(text), lidars=("front",), **changes))


def test_a_new_file_in_another_parser(tmp_path: Path) -> None:
    path = tmp_path / "new.urdf"
    path.write_bytes(export(request()).content)

    for name, T in T_VEHICLE_LIDAR.items():
        np.testing.assert_allclose(pose_in(path, name), T.matrix(), atol=1e-9)
    # Turned round it would be another pose: this example cannot hide a wrong direction.
    assert not np.allclose(
        pose_in(path, "front"), T_VEHICLE_LIDAR["front"].inverse().matrix(), atol=0.1
    )


def test_check_urdf_takes_it(tmp_path: Path) -> None:
    check_urdf = shutil.which("check_urdf")
    if check_urdf is None:
        pytest.skip("check_urdf is not installed (Debian: liburdfdom-tools)")
    for name, made in (
        ("new", export(request())),
        ("changed", export(request(base=base(VEHICLE)))),
    ):
        path = tmp_path / f"{name}.urdf"
        path.write_bytes(made.content)
        result = subprocess.run(
            [check_urdf, str(path)], capture_output=True, text=True, check=False
        )
        assert result.returncode == 0, result.stderr
        assert "Successfully Parsed XML" in result.stdout


def test_a_base_leads_to_the_mountings(tmp_path: Path) -> None:
    """Through a roof that is turned, and the rear LiDAR's joint hangs on the front LiDAR."""
    path = tmp_path / "new.urdf"
    path.write_bytes(export(request(base=base(VEHICLE))).content)

    for child, name in (("lidar_front", "front"), ("velodyne_rear", "rear")):
        np.testing.assert_allclose(pose_in(path, child), T_VEHICLE_LIDAR[name].matrix(), atol=1e-9)


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_all_else_in_a_base_stays_byte_for_byte(ends: str) -> None:
    old = VEHICLE.replace("\n", ends)

    new = export(request(base=base(old))).content.decode()

    new = re.sub(r"<!-- caliv-graph export.*?-->\r?\n", "", new, flags=re.DOTALL)
    # The changed origin keeps its quotes, blanks and order; the missing one gets a line of its own.
    changed = r"<origin  rpy='[-0-9. ]+'\s+xyz = '[-0-9. ]+' />"
    assert len(re.findall(changed, new)) == 1
    new = re.sub(r"(<origin  rpy=')[-0-9. ]+(')", r"\g<1>0 0.17 0\2", new)
    new = re.sub(r"(xyz = ')[-0-9. ]+(')", r"\g<1>1.3 0 0.1\2", new)
    new, added = re.subn(r'(name="é">)<origin xyz="[-0-9. ]+" rpy="[-0-9. ]+"/>', r"\1", new)
    assert added == 1
    assert new == old


def test_the_comment_says_direction_and_what_is_not_determined() -> None:
    for old in (None, base(VEHICLE)):
        text = export(request(base=old)).content.decode()
        assert "p_parent = T p_child" in text
        assert "'front': yaw, x (vehicle axes) not determined" in text


def test_a_second_export_changes_nothing() -> None:
    once = export(request(base=base(VEHICLE))).content

    assert export(request(base=base(once.decode()))).content == once


def test_a_xacro_keeps_what_is_no_number() -> None:
    old = VEHICLE.replace('xyz="1 2 3"', 'xyz="${length / 2} 0 $(arg height)"')
    old = old.replace(
        '<robot name="van">',
        '<robot name="van" xmlns:xacro="http://ros.org/wiki/xacro">\n<xacro:include filename="x"/>',
    )

    text = export(request(base=base(old))).content.decode()

    assert "${length / 2} 0 $(arg height)" in text
    assert '<xacro:include filename="x"/>' in text


def test_the_parent_of_a_xacro_can_be_told() -> None:
    old = one_joint("front", parent="${parent}")
    with pytest.raises(
        ExportError, match=r"do not lead from 'base_link' to its parent '\$\{parent"
    ):
        front(old)
    T_vehicle_parent = T_HOUSING_LIDAR

    made = front(old, parents={"${parent}": T_vehicle_parent})

    T = T_vehicle_parent.compose(made.transforms[0].T_parent_child)
    assert T.equals(T_VEHICLE_LIDAR["front"], 1e-9)


def test_the_call_of_a_sensors_macro_holds_the_housing() -> None:
    call = '<xacro:VLP-16 parent="base_link" name="velodyne_front" topic="/p">\n  {}</xacro:VLP-16>'
    old = f'<robot name="r"><link name="base_link"/>{call}</robot>'
    origin = '<origin xyz="0 0 ${height}" rpy="0 0 0"/>'
    with pytest.raises(ExportError, match="'velodyne_front_base_link' is the frame of a housing"):
        front(old.format(origin))

    made = front(old.format(origin), housings={"front": T_HOUSING_LIDAR})

    T = made.transforms[0].T_parent_child.compose(T_HOUSING_LIDAR)
    assert T.equals(T_VEHICLE_LIDAR["front"], 1e-9)
    before, written, after = re.split(r"(<origin[^>]*>)", made.content.decode())
    xyz, rpy = re.findall(r'"([^"]*)"', written)
    values = [float(value) for value in (xyz + " " + rpy).split()]
    expected = T_VEHICLE_LIDAR["front"].compose(T_HOUSING_LIDAR.inverse())
    np.testing.assert_allclose(
        matrix_of(np.array(values[:3]), *values[3:]), expected.matrix(), atol=1e-9
    )
    assert before.endswith('topic="/p">\n  ')
    assert after == "</xacro:VLP-16></robot>"
    with pytest.raises(ExportError, match="Write an <origin> there"):
        front(old.format(""), housings={"front": T_HOUSING_LIDAR})


def test_a_housing_comes_between(tmp_path: Path) -> None:
    roll, pitch, yaw = T_HOUSING_LIDAR.rotation().rpy()
    xyz = " ".join(f"{value:.12f}" for value in T_HOUSING_LIDAR.translation())
    old = (
        '<robot name="r"><link name="base_link"/><link name="front_base_link"/><link name="front"/>'
        '<joint name="m" type="fixed"><parent link="base_link"/><child link="front_base_link"/>'
        "</joint>"
        '<joint name="s" type="fixed"><parent link="front_base_link"/><child link="front"/>'
        f'<origin xyz="{xyz}" rpy="{roll:.12f} {pitch:.12f} {yaw:.12f}"/></joint></robot>'
    )
    path = tmp_path / "new.urdf"

    made = front(old, housings={"front": T_HOUSING_LIDAR})

    path.write_bytes(made.content)
    assert made.transforms[0].child == "front_base_link"
    np.testing.assert_allclose(pose_in(path, "front"), T_VEHICLE_LIDAR["front"].matrix(), atol=1e-9)
    # Without the housing, it is the LiDAR's own joint that is changed.
    path.write_bytes(front(old).content)
    np.testing.assert_allclose(pose_in(path, "front"), T_VEHICLE_LIDAR["front"].matrix(), atol=1e-9)


@pytest.mark.parametrize("pitch", [90.0, -90.0, 90.0 - 1e-7])
def test_looking_straight_up_or_down(tmp_path: Path, pitch: float) -> None:
    """Where roll and yaw turn about the same axis."""
    R = gtsam.Rot3.RzRyRx(0.3, np.radians(pitch), -0.8)
    T = gtsam.Pose3(R, np.array([1.0, 2.0, 3.0]))
    path = tmp_path / "new.urdf"

    path.write_bytes(export(request(calibration_of({"front": T}))).content)

    np.testing.assert_allclose(pose_in(path, "front"), T.matrix(), atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot", "old: is not valid XML"),
        ("<sdf/>", r"old: its root is <sdf>, expected <robot>"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><robot name="r"/>', "old: has a DOCTYPE"),
        (
            one_joint("camera_front"),
            r"old: LiDAR 'front': no joint leads to a link with a similar name. Joints lead to "
            r"'camera_front'. Give --frame front=LINK",
        ),
        (
            one_joint("velodyne_front_base_link"),
            r"'velodyne_front_base_link' is the frame of a housing. Give --housing front=",
        ),
        (one_joint("front", kind="revolute"), "joint 'j' in line 1: is of type 'revolute'"),
        (
            one_joint("front", parent="mast"),
            "joint 'j' in line 1: fixed joints with numbers do not lead from 'base_link' to its",
        ),
        (
            LINE.format(
                child="lidar_front",
                joint=JOINT.format(
                    kind="fixed", parent="base_link", child="lidar_front", xyz="0 0 0"
                )
                + JOINT.format(kind="fixed", parent="base_link", child="laser_front", xyz="0 0 0"),
            ),
            "LiDAR 'front': 'lidar_front', 'laser_front' could all be its frame. Give --frame",
        ),
        (
            one_joint("front").replace("<origin", '<xacro:insert_block name="origin"/><origin'),
            "joint 'j' in line 1: its origin comes from a block of the xacro",
        ),
    ],
)
def test_what_is_wrong_with_a_base(text: str, message: str) -> None:
    with pytest.raises(ExportError, match=message) as caught:
        front(text)

    assert "\n" not in str(caught.value)


def test_a_joint_that_moves_is_no_way_to_the_vehicle() -> None:
    joints = JOINT.format(kind="prismatic", parent="base_link", child="mast", xyz="0 0 1")
    joints += JOINT.format(kind="fixed", parent="mast", child="front", xyz="0 0 0")

    with pytest.raises(ExportError, match="do not lead from 'base_link' to its parent 'mast'"):
        front(LINE.format(child="front", joint=joints))
    fixed = joints.replace("prismatic", "fixed")
    assert front(LINE.format(child="front", joint=fixed)).transforms[0].parent == "mast"
    # Nor is one that leads nobody knows where.
    with pytest.raises(ExportError, match="do not lead from 'base_link' to its parent 'mast'"):
        front(LINE.format(child="front", joint=fixed.replace("0 0 1", "0 0 nan")))


def test_the_root_stands_in_for_a_vehicle_frame_and_it_is_said() -> None:
    made = front(one_joint("front", parent="chassis").replace('"base_link"', '"chassis"'))

    assert made.transforms[0].parent == "chassis"
    assert made.transforms[0].T_parent_child.equals(T_VEHICLE_LIDAR["front"], 1e-12)
    assert "its root 'chassis' is used as the vehicle frame" in made.warnings[0]
    with pytest.raises(ExportError, match="has no link 'body'"):
        front(one_joint("front"), vehicle_frame="body")


def test_two_lidars_are_not_one_link() -> None:
    with pytest.raises(ExportError, match="link 'x' belongs to LiDARs front, rear"):
        export(request(base=base(one_joint("x")), frames={"front": "x", "rear": "x"}))
    with pytest.raises(ExportError, match="'x' would be the name of two frames"):
        export(request(frames={"front": "x", "rear": "x"}))
