from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import TargetRegion
from caliv_graph.errors import RecordingError
from caliv_graph.products import Array, GivenPoses, IntArray, LidarScan, Trajectory
from caliv_graph.trajectory.select import GivenTrajectory
from caliv_graph.validation.clouds import (
    POINTS,
    SCANS,
    Clouds,
    Extrinsics,
    choose_scans,
    read_clouds,
)
from tests.drives_with_chair import Memory

SECOND = 1_000_000_000


def trajectory_of(x_m: Sequence[float]) -> GivenTrajectory:
    """Straight ahead, a pose per second."""
    stamps = np.arange(len(x_m), dtype=np.int64) * SECOND
    poses = tuple(gtsam.Pose3(gtsam.Rot3(), np.array([x, 0.0, 0.0])) for x in x_m)
    return GivenTrajectory(Trajectory(stamps, poses))


def read(
    scans: Sequence[LidarScan],
    regions: Sequence[TargetRegion] = (),
    trajectory: GivenTrajectory | None = None,
) -> Clouds:
    trajectory = trajectory or trajectory_of([0.0, 1.0, 2.0])
    stamps: IntArray = np.array([scan.stamp_ns for scan in scans], dtype=np.int64)
    none = GivenPoses(trajectory.trajectory.stamps_ns, trajectory.trajectory.T_map_vehicle)
    level = {"top": gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 2.0]))}
    return read_clouds(
        Memory({"top": tuple(scans)}, none),
        trajectory,
        {"top": stamps},
        {"after": Extrinsics(level, {})},
        regions,
        False,
        SilentProgress(),
    )


def scene(rng: np.random.Generator) -> Array:
    """Ground, and a plate 2 m high at x = 15, about a LiDAR 2 m above the ground."""
    ground = np.column_stack([rng.uniform(-25.0, 25.0, (3000, 2)), np.full(3000, -2.0)])
    plate = np.column_stack(
        [np.full(3000, 15.0), rng.uniform(-5.0, 5.0, 3000), rng.uniform(-2.0, 0.0, 3000)]
    )
    return np.vstack([ground, plate])


def scan_at(stamp_ns: int, points: Array) -> LidarScan:
    return LidarScan("top", stamp_ns, points, f"top at {stamp_ns}")


def test_scans_are_spread_over_the_way_not_the_time() -> None:
    # Stands for 900 s, then goes on for 100 m at 1 m/s.
    x = [*np.zeros(900), *np.arange(101.0)]
    stamps = (np.arange(1001) * SECOND).tolist()
    chosen = choose_scans(stamps, trajectory_of(x))

    standing = int((chosen < 900 * SECOND).sum())
    assert len(chosen) <= SCANS
    # At 20 mm/s standing still counts as 18 m of 118.
    assert 10 < standing < 20
    assert len(chosen) > 90


def test_scans_outside_the_span_are_left_out() -> None:
    stamps = [-SECOND, 0, SECOND, 5 * SECOND]

    assert choose_scans(stamps, trajectory_of([0.0, 1.0, 2.0])).tolist() == [0, SECOND]


def test_what_stands_is_kept_and_put_into_the_map() -> None:
    rng = np.random.default_rng(1)
    clouds = read([scan_at(SECOND, scene(rng))])
    points = clouds.points_map(clouds.placed["after"])

    assert len(points) > 500
    assert points[:, 0] == pytest.approx(np.full(len(points), 16.0))
    assert points[:, 2].min() > 0.14
    beams = clouds.beams_map(clouds.placed["after"])
    assert np.linalg.norm(beams, axis=1) == pytest.approx(np.ones(len(points)))
    assert beams[:, 0].min() > 0.9


def test_memory_is_bounded_and_the_same_points_are_taken_again() -> None:
    rng = np.random.default_rng(1)
    points = scene(rng)
    posts = np.column_stack([rng.uniform(-25.0, 25.0, (20000, 2)), rng.uniform(-1.5, 0.0, 20000)])
    scans = [scan_at(0, np.vstack([points, posts])), scan_at(SECOND, points[:3])]
    clouds, again = read(scans), read(scans)

    assert np.bincount(clouds.scan)[0] == POINTS
    assert clouds.scans == {"top": 2}
    placed = clouds.placed["after"].points_lidar
    assert np.array_equal(placed, again.placed["after"].points_lidar)


def test_regions_of_targets_are_left_out_in_either_frame() -> None:
    rng = np.random.default_rng(1)
    # The first pose is at x = 1: what is at 16 in the map is at 15 from the start.
    trajectory = trajectory_of([1.0, 1.0, 1.0])
    region = TargetRegion(min=(15.9, -4.5, 0.0), max=(16.1, 0.0, 2.0))
    start = replace_frame(region)
    of_map = read([scan_at(SECOND, scene(rng))], [region], trajectory)
    of_start = read([scan_at(SECOND, scene(np.random.default_rng(1)))], [start], trajectory)

    for clouds in (of_map, of_start):
        points = clouds.points_map(clouds.placed["after"])
        # Half a metre around a region belongs to it.
        assert points[:, 1].min() > 0.49
        assert clouds.target_points > 100
    assert of_map.target_points == of_start.target_points


def replace_frame(region: TargetRegion) -> TargetRegion:
    low, high = np.array(region.min), np.array(region.max)
    shift = np.array([1.0, 0.0, 0.0])
    return TargetRegion(
        min=tuple((low - shift).tolist()), max=tuple((high - shift).tolist()), frame="start"
    )


def test_the_vehicle_itself_is_no_structure() -> None:
    rng = np.random.default_rng(1)
    mirror = rng.uniform(-0.1, 0.1, (400, 3)) + np.array([1.9, -1.1, -0.8])
    clouds = read([scan_at(SECOND, np.vstack([scene(rng), mirror]))])

    assert clouds.points_map(clouds.placed["after"])[:, 0].min() > 15.0


def test_an_empty_cloud_and_no_cloud() -> None:
    empty = replace(scan_at(0, np.zeros((0, 3))), source="empty")
    clouds = read([empty])

    assert len(clouds.points_map(clouds.placed["after"])) == 0
    with pytest.raises(RecordingError, match="memory: has no cloud of top within"):
        read([])
