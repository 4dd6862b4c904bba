"""LiDAR odometry on a drive with known truth, and where it must give up."""

from __future__ import annotations

import itertools
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.errors import TrajectoryError
from caliv_graph.odometry.surface_map import SurfaceMap, point_to_plane
from caliv_graph.odometry.track import track
from caliv_graph.products import Array
from tests.odometry.room_drive import RoomDrive, s_curve

MOUNTED = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, 0.1, 0.5), np.array([1.5, 0.3, 1.8]))


def ignored(n: int = 1, note: str = "") -> None:
    """No progress is shown."""


def test_a_lidar_is_tracked_while_it_turns_and_sweeps() -> None:
    drive = RoomDrive({"a": MOUNTED}, s_curve(6.0))
    found = track(drive.scans("a"), 0.01, ignored)
    assert found.stamps_ns.tolist() == list(drive.scan_stamps_ns("a"))
    R, t = drive.way.poses_at(found.stamps_ns)
    true = [gtsam.Pose3(gtsam.Rot3(Ri), ti).compose(MOUNTED) for Ri, ti in zip(R, t, strict=True)]
    assert np.linalg.norm(t[-1] - t[0]) > 9.0
    for is_now, was in zip(found.T_map_lidar, true, strict=True):
        away = gtsam.Pose3.Logmap(true[0].between(was).between(is_now))
        assert np.abs(away[:3]).max() < 0.03  # 7200 beams, of which walls get a tenth
        assert np.abs(away[3:]).max() < 0.1


@pytest.mark.parametrize("walls", [(), ((8.0, 1.57), (9.0, -1.57))], ids=["none", "parallel"])
def test_surfaces_that_leave_the_way_open_are_refused(walls: tuple[tuple[float, float]]) -> None:
    drive = RoomDrive({"a": MOUNTED}, s_curve(3.0), walls=walls)
    with pytest.raises(TrajectoryError, match="leave a direction of motion open"):
        track(drive.scans("a"), 0.01, ignored)


def test_a_scan_that_does_not_lie_on_the_map_loses_track() -> None:
    scans = list(RoomDrive({"a": MOUNTED}, s_curve(6.0)).scans("a"))
    rolled = scans[15].points_lidar @ gtsam.Rot3.Roll(0.8).matrix().T
    with pytest.raises(TrajectoryError, match=r"track is lost 3\.0 s after the start"):
        track([*scans[:15], replace(scans[15], points_lidar=rolled)], 0.01, ignored)


def test_an_empty_scan_is_as_if_it_had_not_been_recorded() -> None:
    scans = list(RoomDrive({"a": MOUNTED}, s_curve(3.0)).scans("a"))
    empty = [0, 7]  # at the start, where nothing is in the map yet, and on the way
    broken = [
        replace(
            scan,
            points_lidar=scan.points_lidar[:0],
            point_times_s=None if scan.point_times_s is None else scan.point_times_s[:0],
        )
        if i in empty
        else scan
        for i, scan in enumerate(scans)
    ]
    without = [scan for i, scan in enumerate(scans) if i not in empty]

    found, expected = track(broken, 0.01, ignored), track(without, 0.01, ignored)

    assert found.stamps_ns.tolist() == [scan.stamp_ns for scan in without]
    last = expected.T_map_lidar[-1].localCoordinates(found.T_map_lidar[-1])
    assert np.abs(last[:3]).max() < 0.02
    assert np.abs(last[3:]).max() < 0.05


def test_few_scans_are_refused() -> None:
    drive = RoomDrive({"a": MOUNTED}, s_curve(2.0))
    with pytest.raises(TrajectoryError, match="3 scans are too few"):
        track(itertools.islice(drive.scans("a"), 3), 0.01, ignored)


def test_derivatives_of_the_distance_from_a_surface() -> None:
    rng = np.random.default_rng(0)
    T = gtsam.Pose3.Expmap(rng.normal(size=6))
    points, normals, centres = rng.normal(size=(3, 5, 3))

    def residual(pose: gtsam.Pose3) -> Array:
        moved = pose.transformFrom(points.T).T
        return np.asarray(np.einsum("ni,ni->n", normals, moved - centres))

    J = point_to_plane(T.rotation().matrix(), points, normals)
    h = 1e-6
    for k, step in enumerate(h * np.eye(6)):
        numerical = (residual(T.retract(step)) - residual(T.retract(-step))) / (2.0 * h)
        np.testing.assert_allclose(J[:, k], numerical, atol=1e-8)


def test_two_faces_of_a_thin_wall_stay_two_surfaces() -> None:
    rng = np.random.default_rng(1)
    faces = []
    for x in (0.0, 0.1):
        p = np.column_stack([np.full(50, x), *rng.uniform(0.2, 0.7, (2, 50)), np.ones(50)])
        faces.append(p.T @ p)
    normals = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    known = SurfaceMap()
    known.add(np.array(faces), normals, np.eye(3), np.zeros(3))
    which, centres, found, around = known.nearest(
        np.array([[0.1, 0.5, 0.5], [0.0, 0.5, 0.5]]), normals
    )
    assert which.tolist() == [0, 1]
    assert around == 2
    np.testing.assert_allclose(centres[:, 0], [0.0, 0.1], atol=1e-9)
    np.testing.assert_allclose(found, normals, atol=1e-6)
