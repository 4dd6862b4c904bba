from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import pytest
import yaml

from caliv_graph.errors import ExportError
from caliv_graph.export.consumers.apollo import export
from caliv_graph.products import Array
from tests.export.requests import T_VEHICLE_LIDAR, base, matrix_of_quaternion, request

# A GNSS/IMU unit with Apollo's axes right, forward, up, half a metre above the rear axle.
T_VEHICLE_NOVATEL = gtsam.Pose3(gtsam.Rot3.Yaw(-np.pi / 2.0), np.array([0.0, 0.0, 0.5]))

OLD = """\
# our van
header:
  seq: 0
  stamp: {secs: 0, nsecs: 0}
  frame_id: novatel
child_frame_id: velodyne_front  # 128 rings
transform:
  translation:
    x: 0.0
    y: 1.1
    z: 2.5
  rotation: {x: 0.0, y: 0.0, z: 0.0, w: 1.0}
"""


def published(content: bytes) -> tuple[str, str, Array]:
    """Frames and transform as Apollo's static transform component reads them."""
    tf: dict[str, Any] = yaml.safe_load(content)
    t, r = tf["transform"]["translation"], tf["transform"]["rotation"]
    xyz = np.array([float(t[axis]) for axis in "xyz"])
    x, y, z, w = (float(r[axis]) for axis in "xyzw")
    return tf["header"]["frame_id"], tf["child_frame_id"], matrix_of_quaternion(xyz, x, y, z, w)


def test_a_new_file_in_the_vehicle_frame() -> None:
    made = export(request(lidars=("front",)))

    parent, child, T = published(made.content)
    assert (parent, child) == ("base_link", "front")
    np.testing.assert_allclose(T, T_VEHICLE_LIDAR["front"].matrix(), atol=1e-9)
    assert b"yaw, x (vehicle axes) not determined" in made.content
    assert made.warnings == ()


def test_a_file_has_one_lidar_and_says_which() -> None:
    made = export(request())

    assert published(made.content)[1] == "rear"  # the reference
    assert "'rear' is written, not front" in made.warnings[0]


def test_apollos_axes_are_those_of_the_parent() -> None:
    made = export(request(lidars=("front",), parents={"novatel": T_VEHICLE_NOVATEL}))

    parent, _, T = published(made.content)
    assert parent == "novatel"
    # A LiDAR 1.9 m in front of the axle and 0.3 m to the left: y and -x of right, forward, up.
    x, y, z = T_VEHICLE_LIDAR["front"].translation()
    np.testing.assert_allclose(T[:3, 3], [-y, x, z - 0.5], atol=1e-9)
    forward_lidar = T_VEHICLE_LIDAR["front"].rotation().matrix()[0]
    np.testing.assert_allclose(T[1, :3], forward_lidar, atol=1e-9)


def test_only_the_numbers_of_a_base_change() -> None:
    asked = request(base=base(OLD), parents={"novatel": T_VEHICLE_NOVATEL})
    made = export(asked)

    expected = T_VEHICLE_NOVATEL.between(T_VEHICLE_LIDAR["front"])
    parent, child, T = published(made.content)
    assert (parent, child) == ("novatel", "velodyne_front")
    np.testing.assert_allclose(T, expected.matrix(), atol=1e-9)
    text = made.content.decode()
    assert text.partition("\ntransform:")[0].endswith(OLD.partition("\ntransform:")[0])
    again = export(request(base=base(text), parents={"novatel": T_VEHICLE_NOVATEL}))
    assert again.content == made.content


def test_a_frame_that_names_no_lidar_needs_to_be_given() -> None:
    old = OLD.replace("velodyne_front", "velodyne128")
    parents = {"novatel": T_VEHICLE_NOVATEL}

    with pytest.raises(ExportError, match="LiDAR of frame 'velodyne128' is unknown"):
        export(request(base=base(old), parents=parents))
    given = export(request(base=base(old), parents=parents, frames={"rear": "velodyne128"}))
    alone = export(request(base=base(old), parents=parents, lidars=("rear",)))
    assert given.content == alone.content
    assert given.transforms[0].lidar == "rear"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (OLD, "pose of 'novatel' in 'base_link' is unknown. Give --parent novatel=x,y,z"),
        (OLD.replace("novatel", "base_link").replace("rotation", "turn"), "has no 'rotation'"),
        (OLD.replace("child_frame_id", "child"), "has no 'child_frame_id'. Give an extrinsics"),
        (OLD.replace("novatel", "velodyne_front"), "pose of 'velodyne_front' in 'base_link'"),
    ],
)
def test_what_is_wrong_with_a_base(text: str, message: str) -> None:
    with pytest.raises(ExportError, match=message):
        export(request(base=base(text)))


def test_a_file_has_one_parent() -> None:
    parents = {"novatel": T_VEHICLE_NOVATEL, "localization": gtsam.Pose3()}

    with pytest.raises(ExportError, match="Give one --parent, not novatel, localization"):
        export(request(parents=parents))
