from __future__ import annotations

import pytest

from caliv_graph.errors import ExportError
from caliv_graph.export.frames import match_frame, parse_named, parse_pose
from tests.export.requests import matrix_of


@pytest.mark.parametrize(
    ("lidar", "frames", "expected"),
    [
        ("front", ["front_link", "front"], "front"),
        ("front", ["base_link", "front_link", "front_camera"], "front_link"),
        ("front", ["front_link", "lidar_front"], "lidar_front"),
        ("front", ["velodyne_front_base_link", "velodyne_front"], "velodyne_front"),
        ("Front_Left", ["front", "left", "front_left_laser_frame"], "front_left_laser_frame"),
        ("lidar_1", ["sensor2_link", "laser1"], "laser1"),
        ("top", ["vlp16_top", "top_camera"], "vlp16_top"),
        ("lidar", ["base_link", "velodyne"], "velodyne"),
        ("lidar", ["base_link", "imu_link"], None),
        ("front", ["front_left", "front_camera_link", "bumper_front"], None),
        ("sensors/front", ["front"], None),
    ],
)
def test_the_frame_that_is_called_like_a_lidar(
    lidar: str, frames: list[str], expected: str | None
) -> None:
    assert match_frame(lidar, frames, housing=False) == expected
    assert match_frame(lidar, frames[::-1], housing=False) == expected


def test_the_frame_of_its_housing() -> None:
    frames = ["front", "velodyne_front_base_link", "camera_front_base_link", "base_link"]

    assert match_frame("front", frames, housing=True) == "velodyne_front_base_link"
    assert match_frame("velodyne_front_base_link", frames, housing=True) == frames[1]
    assert match_frame("rear", frames, housing=True) is None


def test_two_that_fit_equally_well() -> None:
    with pytest.raises(ExportError, match="'front_link', 'front_frame' could all be its frame"):
        match_frame("front", ["front_link", "front_frame"], housing=False)


@pytest.mark.parametrize(
    "text", ["1,-2,0.5,0.1,0.2,-3", "1 -2 0.5,0.1 0.2 -3", " 1, -2, 5e-1, 0.1, 0.2, -3 "]
)
def test_a_pose_in_metres_and_radians(text: str) -> None:
    expected = matrix_of([1.0, -2.0, 0.5], 0.1, 0.2, -3.0)

    assert abs(parse_pose(text, "--imu").matrix() - expected).max() < 1e-12
    assert parse_pose("1,2,3", "--imu").rotation().matrix().trace() == 3.0


@pytest.mark.parametrize("text", ["", "1,2", "1,2,3,4", "1,2,3,4,5,6,7", "a,b,c", "1,2,nan"])
def test_what_is_no_pose(text: str) -> None:
    with pytest.raises(ExportError, match=r"--imu: '.*', expected x,y,z,roll,pitch,yaw"):
        parse_pose(text, "--imu")


def test_named_values() -> None:
    assert parse_named(["a=1,2", "b=c=d"], "--frame") == {"a": "1,2", "b": "c=d"}
    for wrong in ("a", "a=", "=1"):
        with pytest.raises(ExportError, match=f"--frame: '{wrong}', expected NAME=VALUE"):
            parse_named([wrong], "--frame")
    with pytest.raises(ExportError, match="'a' is given twice"):
        parse_named(["a=1", "a=2"], "--frame")
