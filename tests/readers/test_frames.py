from __future__ import annotations

import math
from pathlib import Path

import gtsam
import numpy as np
import pytest

from caliv_graph.errors import ConfigError
from caliv_graph.readers.frames import (
    FrameTransform,
    FrameTree,
    clean_frame,
    message_transforms,
    read_urdf,
)
from tests.readers.bags import START, as_object, tf


def pose(x: float, y: float, z: float, yaw_deg: float = 0.0) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Rz(math.radians(yaw_deg)), np.array([x, y, z]))


def translation(T: gtsam.Pose3 | None) -> list[float]:
    assert T is not None
    return [round(float(v), 9) for v in T.translation()]


TREE = FrameTree(
    [
        FrameTransform("base_link", "mast", pose(1, 0, 2, yaw_deg=90)),
        FrameTransform("mast", "lidar", pose(0.5, 0, 0)),
        FrameTransform("base_footprint", "base_link", pose(0, 0, 0.3)),
        FrameTransform("base_footprint", "imu", pose(0, 1, 0)),
    ]
)


def test_chains_up_and_down() -> None:
    # The mast is turned to the left, so that its x is the vehicle's y.
    assert translation(TREE.transform("base_link", "lidar")) == [1.0, 0.5, 2.0]
    assert translation(TREE.transform("lidar", "base_link")) == [-0.5 - 0.0, 1.0, -2.0]
    assert translation(TREE.transform("base_link", "imu")) == [0.0, 1.0, -0.3]
    assert translation(TREE.transform("base_link", "base_link")) == [0.0, 0.0, 0.0]
    assert TREE.transform("base_link", "nowhere") is None
    assert TREE.root("lidar") == "base_footprint"
    assert TREE.vehicle_frame() == "base_link"


def test_the_last_word_on_a_frame_counts_and_circles_end() -> None:
    links = [FrameTransform("a", "b", pose(1, 0, 0)), FrameTransform("a", "b", pose(2, 0, 0))]
    assert translation(FrameTree(links).transform("a", "b")) == [2.0, 0.0, 0.0]
    circle = FrameTree([*links, FrameTransform("b", "a", pose(1, 0, 0))])
    assert circle.transform("a", "b") is not None
    assert FrameTree([]).vehicle_frame() is None
    assert clean_frame("/base_link") == "base_link"


def test_messages() -> None:
    message = as_object(
        tf(
            ("/map", "base_link", (1, 2, 3), (0, 0, 0, 1)),
            ("map", "broken", (1, 2, 3), (0, 0, 0, 0)),
            ("map", "nan", (math.nan, 2, 3), (0, 0, 0, 1)),
        )
    )

    ((stamp_ns, link),) = message_transforms(message)

    assert (stamp_ns, link.parent, link.child) == (START, "map", "base_link")
    assert translation(link.T_parent_child) == [1.0, 2.0, 3.0]


URDF = """<?xml version="1.0" encoding="utf-8"?>
<robot name="car">
  <link name="base_link"/>
  <joint name="mast_joint" type="fixed">
    <parent link="base_link"/><child link="mast"/>
    <origin xyz="1.0 0 2.0" rpy="0 0 1.5707963267948966"/>
  </joint>
  <joint name="lidar_joint" type="fixed">
    <parent link="mast"/><child link="lidar"/>
    <origin xyz="0.5 0 0" rpy="0 0.1 0"/>
  </joint>
  <joint name="plain" type="fixed"><parent link="mast"/><child link="same"/></joint>
  <joint name="wheel" type="continuous"><parent link="base_link"/><child link="wheel"/></joint>
  <transmission name="t"><joint name="wheel"/></transmission>
</robot>
"""


def test_fixed_joints_of_a_urdf(tmp_path: Path) -> None:
    path = tmp_path / "car.urdf"
    path.write_text(URDF)

    tree = FrameTree(read_urdf(path))

    T = tree.transform("base_link", "lidar")
    assert translation(T) == [1.0, 0.5, 2.0]
    assert T is not None
    np.testing.assert_allclose(T.rotation().rpy(), [0.0, 0.1, math.pi / 2], atol=1e-12)
    assert translation(tree.transform("mast", "same")) == [0.0, 0.0, 0.0]
    assert "wheel" not in tree.frames


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot>", "is not valid XML"),
        ("<sdf/>", "its root is <sdf>"),
        ('<!DOCTYPE r [<!ENTITY a "b">]><robot>&a;</robot>', "has a DOCTYPE"),
        ('<robot xmlns:xacro="x"><xacro:include filename="a"/></robot>', "is a xacro"),
        ('<robot><joint name="j" type="fixed"/></robot>', "joint 'j': needs one <parent"),
        (URDF.replace("0.5 0 0", "0.5 0"), r"lidar_joint': xyz='0\.5 0', expected three"),
        (URDF.replace("0 0.1 0", "0 nan 0"), "rpy='0 nan 0', expected three finite"),
    ],
)
def test_what_is_no_urdf(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "car.urdf"
    path.write_text(text)

    with pytest.raises(ConfigError, match=message):
        read_urdf(path)


def test_a_urdf_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        read_urdf(tmp_path / "none.urdf")
    (tmp_path / "wide.urdf").write_bytes(URDF.replace("utf-8", "utf-16").encode("utf-16"))
    with pytest.raises(ConfigError, match="is not text in UTF-8"):
        read_urdf(tmp_path / "wide.urdf")
