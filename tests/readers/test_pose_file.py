from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.errors import RecordingError
from caliv_graph.products import GivenPoses
from caliv_graph.readers.pose_file import check_overlap, in_vehicle_axes, read_poses, stamp_of

T = 1_700_000_000_123_456_789
HALF = "0.7071067811865476"


def written(tmp_path: Path, text: str, name: str = "poses.txt") -> Path:
    path = tmp_path / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("1700000000.123456789", T),
        ("1700000000123456789", T),
        ("1700000000123456", T // 1000 * 1000),
        ("1700000000123", T // 10**6 * 10**6),
        ("1.7e9", 1_700_000_000 * 10**9),
        ("0.1036", 103_600_000),  # KITTI counts from the start
        ("-1", None),
        ("nan", None),
        ("x", None),
        ("1e40", None),
    ],
)
def test_times_of_all_units_to_the_nanosecond(text: str, stamp_ns: int | None) -> None:
    assert stamp_of(text) == stamp_ns


ROSTOPIC = ",".join(
    f"field.pose.pose.{part}"
    for part in (*(f"position.{a}" for a in "xyz"), *(f"orientation.{a}" for a in "xyzw"))
)


@pytest.mark.parametrize(
    "text",
    [
        f"# timestamp tx ty tz qx qy qz qw\n1700000000.123456789 1 2 3 0 0 {HALF} {HALF}\n",
        f"1700000000.123456789,1,2,3,0,0,{HALF},{HALF}\n",
        "# map: ENU, origin at latitude 48, longitude 11. vehicle: x forward, y left, z up\n"
        f"# timestamp tx ty tz qx qy qz qw\n1700000000.123456789 1 2 3 0 0 {HALF} {HALF}\n",
        f"num,t,x,y,z,qx,qy,qz,qw\n0,1700000000.123456789,1,2,3,0,0,{HALF},{HALF}\n",
        "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], "
        "q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1]\n"
        f"{T},1,2,3,{HALF},0,0,{HALF},9,9\n",
        "%time,field.header.seq,field.pose.pose.position.x,field.pose.pose.position.y,"
        "field.pose.pose.position.z,field.pose.pose.orientation.x,field.pose.pose.orientation.y,"
        "field.pose.pose.orientation.z,field.pose.pose.orientation.w,"
        f"field.twist.twist.linear.x\n{T},7,1,2,3,0,0,{HALF},{HALF},9\n",
        # The time of recording comes before the stamp, which counts.
        f"%time,field.header.seq,field.header.stamp,{ROSTOPIC}\n"
        f"1700000000750000000,7,{T},1,2,3,0,0,{HALF},{HALF}\n",
        f"__time,/odom/header/stamp,{ROSTOPIC.replace('field.', '/odom/').replace('.', '/')}\n"
        f"1700000000.75,1700000000.123456789,1,2,3,0,0,{HALF},{HALF}\n",
        f"timestamp,header.stamp [s],{ROSTOPIC}\n"
        f"1700000000.75,1700000000.123456789,1,2,3,0,0,{HALF},{HALF}\n",
        # Where nobody set the stamp, the time of recording stands in.
        f"%time,field.header.stamp,{ROSTOPIC}\n{T},0,1,2,3,0,0,{HALF},{HALF}\n",
        "Time,header.stamp.secs,header.stamp.nsecs,pose.pose.position.x,pose.pose.position.y,"
        "pose.pose.position.z,pose.pose.orientation.x,pose.pose.orientation.y,"
        "pose.pose.orientation.z,pose.pose.orientation.w\n"
        f"1700000000.75,1700000000,123456789,1,2,3,0,0,{HALF},{HALF}\n",
        f"timestamp_nsec,x,y,z,qx,qy,qz,qw\n{T},1,2,3,0,0,{HALF},{HALF}\n",
        f"sec;nsec;x;y;z;qx;qy;qz;qw;\n1700000000;123456789;1;2;3;0;0;{HALF};{HALF};\n",
        json.dumps(
            [
                {
                    "token": "a",
                    "timestamp": 1_700_000_000_123_456,
                    "rotation": [float(HALF), 0, 0, float(HALF)],
                    "translation": [1, 2, 3],
                }
            ]
        ),
    ],
)
def test_a_pose_of_every_format(tmp_path: Path, text: str) -> None:
    poses = read_poses(written(tmp_path, text))

    assert poses.stamps_ns.tolist() in ([T], [T // 1000 * 1000])
    (pose,) = poses.T_map_vehicle
    np.testing.assert_allclose(pose.translation(), [1, 2, 3])
    # The vehicle looks north: its x axis is the map's y.
    np.testing.assert_allclose(pose.rotation().matrix()[:, 0], [0, 1, 0], atol=1e-12)


def test_rows_are_sorted_by_time_and_each_counts_once(tmp_path: Path) -> None:
    text = "2 2 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n2 9 0 0 0 0 0 1\n"

    poses = read_poses(written(tmp_path, text))

    assert poses.stamps_ns.tolist() == [10**9, 2 * 10**9]
    assert [pose.x() for pose in poses.T_map_vehicle] == [1.0, 2.0]


def kitti(camera: bool) -> str:
    """A quarter turn to the left over 10 m forward, as seen by a camera or by the vehicle."""
    lines = []
    for a in np.linspace(0.0, np.pi / 2, 5):
        c, s = np.cos(a), np.sin(a)
        if camera:  # x right, y down, z forward: left is -x, the turn is about -y
            M = np.array([[c, 0, -s, -10 * (1 - c)], [0, 1, 0, 0.5], [s, 0, c, 10 * s]])
        else:
            M = np.array([[c, -s, 0, 10 * s], [s, c, 0, 10 * (1 - c)], [0, 0, 1, -0.5]])
        lines.append(" ".join(f"{v:.9e}" for v in M.ravel()))
    return "\n".join(lines)


@pytest.mark.parametrize("camera", [False, True])
def test_poses_of_a_camera_are_turned_into_those_of_a_vehicle(tmp_path: Path, camera: bool) -> None:
    poses = read_poses(written(tmp_path, kitti(camera)), [0, 1, 2, 3, 4])

    assert poses.stamps_ns.tolist() == [0, 1, 2, 3, 4]
    last = poses.T_map_vehicle[-1]
    np.testing.assert_allclose(last.translation(), [10, 10, -0.5], atol=1e-6)
    np.testing.assert_allclose(last.rotation().xyz(), [0, 0, np.pi / 2], atol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no poses"),
        ("1 2 3\n", "line 1: 3 values, expected timestamp x y z qx qy qz qw"),
        ("1 0 0 0 0 0 0 2\n", "a unit quaternion"),
        ("1 nan 0 0 0 0 0 1\n", "pose 1 is"),
        ("1 0 0 0 0 0 0 1\nx 0 0 0 0 0 0 1\n", "line 2: 'x' is not a time"),
        ("1 0 0 o 0 0 0 1\n", "line 1: 'o' is not a number"),
        ("t,x,y,z,roll\n1,0,0,0,0\n", "no column for qx, qy, qz, qw"),
        ("[1, 2]", "is JSON, expected a list of poses"),
        ("sec,nsec,x,y,z,qx,qy,qz,qw\n1,nan,0,0,0,0,0,0,1\n", "nan ns is not a part of a second"),
        (
            '[{"timestamp": -1, "translation": [0, 0, 0], "rotation": [1, 0, 0, 0]}]',
            "is JSON, expected",
        ),
        (kitti(True), "5 poses of 12 numbers have no times"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(RecordingError, match=message):
        read_poses(written(tmp_path, text))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("1 0 0 2 0 1 0 0 0 0 -1 0", "line 3: holds no rotation"),  # a mirror
        ("1 0 0 1e999 0 1 0 0 0 0 1 0", "line 3: holds no usable position"),
    ],
)
def test_a_damaged_matrix_is_named(tmp_path: Path, row: str, message: str) -> None:
    good = "".join(f"1 0 0 {x} 0 1 0 0 0 0 1 0\n" for x in range(2))

    with pytest.raises(RecordingError, match=message):
        read_poses(written(tmp_path, f"{good}{row}\n"), [1, 2, 3])


@pytest.mark.parametrize("axes", ["frd", "ned"])
def test_poses_with_z_down(tmp_path: Path, axes: Any) -> None:
    # 1 m north, 2 m east, 3 m down, heading 30 degrees clockwise, nose 10 degrees up.
    R_ned_frd = gtsam.Rot3.RzRyRx(0.0, np.radians(10.0), np.radians(30.0))
    T = gtsam.Pose3(R_ned_frd, np.array([1.0, 2.0, 3.0]))
    if axes == "frd":  # the same in a map of north, west, up
        T = gtsam.Pose3(gtsam.Rot3(np.diag([1.0, -1.0, -1.0])), np.zeros(3)).compose(T)
    cov = np.diag(np.arange(1.0, 7.0))[None].copy()
    cov[0, 1, 4] = cov[0, 4, 1] = 0.5  # y of rotation and of translation: both change sign
    cov[0, 0, 5] = cov[0, 5, 0] = 0.25  # only one of the two does

    turned = in_vehicle_axes(GivenPoses(np.array([0]), (T,), cov), axes)

    pose = turned.T_map_vehicle[0]
    np.testing.assert_allclose(pose.translation(), [1.0, -2.0, -3.0], atol=1e-12)
    np.testing.assert_allclose(np.degrees(pose.rotation().rpy()), [0.0, -10.0, -30.0], atol=1e-9)
    assert turned.cov is not None
    assert turned.cov[0, 1, 4] == 0.5
    assert turned.cov[0, 0, 5] == -0.25
    # A right perturbation of the old pose is that of the new one, turned.
    step = np.array([1e-3, 2e-3, -1e-3, 0.01, 0.02, -0.03])
    C = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
    moved = in_vehicle_axes(GivenPoses(np.array([0]), (T.retract(step),)), axes)
    np.testing.assert_allclose(pose.localCoordinates(moved.T_map_vehicle[0]), C * step, atol=1e-12)


def test_poses_of_another_time_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, "1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    poses = read_poses(path)

    check_overlap(poses, path, (10**9, 5 * 10**9), "bag")
    with pytest.raises(RecordingError, match=r"of 1\.000 to 2\.000 s, the clouds of bag of 7\.000"):
        check_overlap(poses, path, (7 * 10**9, 8 * 10**9), "bag")
