"""Patches of a target are no structure; the ground below it, and a wall behind it, stay."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from caliv_graph.config.load import parse_config
from caliv_graph.products import Array, TargetCloud, TargetObservation
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.without_targets import without_targets
from caliv_graph.trajectory.select import VehicleTrajectory

SECOND = 1_000_000_000
CHAIR_LIDAR = np.array([5.0, 1.0, -1.5])
"""Middle of the target in the frame of a LiDAR 2 m above the ground, when the vehicle starts."""


class Driving:
    """Along x at 2 m/s, level."""

    def poses_at(self, stamps_ns: Sequence[int]) -> tuple[Array, Array]:
        t = np.zeros((len(stamps_ns), 3))
        t[:, 0] = 2.0 * np.asarray(stamps_ns) / SECOND
        return np.tile(np.eye(3), (len(t), 1, 1)), t


def cloud(lidar: str, second: int, drive: int = 0) -> TargetCloud:
    middle = CHAIR_LIDAR - np.array([2.0 * second, 0.0, 0.0])
    corners = np.array([[x, y, z] for x in (-0.3, 0.3) for y in (-0.3, 0.3) for z in (-0.4, 0.5)])
    return TargetCloud(lidar, drive, second * SECOND, middle + corners, "a scan")


def patches(places_lidar: Sequence[Array], seconds: Sequence[int], lidar: int = 0) -> DrivePatches:
    """A patch of four points at each place, each in a scan of its own."""
    n = len(places_lidar)
    h = np.column_stack([np.array(places_lidar), np.ones(n)])
    return DrivePatches(
        drive=0,
        lidars=("front", "rear"),
        stamps_ns=np.array(seconds, np.int64) * SECOND,
        scan_lidar=np.full(n, lidar),
        scan=np.arange(n),
        time_s=np.zeros(n),
        moments=4.0 * h[:, :, None] * h[:, None, :],
        normal_lidar=np.tile([-1.0, 0.0, 0.0], (n, 1)),
        scatter_m=np.zeros(n),
    )


def kept(of: DrivePatches, *clouds: TargetCloud) -> list[int]:
    initial = {"xyz": [0, 0, 2], "rpy_deg": [0, 0, 0]}
    lidars = {name: {"topic": f"/{name}", "initial": initial} for name in ("front", "rear")}
    raw = {"data": {"format": "rosbag"}, "lidars": lidars}
    config = parse_config(raw, "config", Path())
    observation = TargetObservation(0, "target", np.zeros(3), clouds)
    trajectory = cast("VehicleTrajectory", Driving())
    return list(without_targets(of, [observation], trajectory, config).scan)


@pytest.mark.parametrize(
    ("beside", "stays"),
    [
        ((0.0, 0.0, 0.0), False),  # the back of a chair
        ((0.5, 0.0, 0.3), False),  # the corners are 0.42 m from its middle, and 0.2 m beside
        ((0.9, 0.0, 0.3), True),  # a wall close behind
        ((0.0, 0.0, -0.5), True),  # the ground below
        ((0.0, 0.0, 1.0), True),  # what is above
    ],
)
def test_what_is_where_the_target_is_goes(beside: tuple[float, ...], stays: bool) -> None:
    assert kept(patches([CHAIR_LIDAR + beside], [0]), cloud("front", 0)) == [0] * stays


def test_a_scan_without_a_cloud_takes_the_one_next_in_time() -> None:
    # The vehicle is at 2, 4 and 6 m; there are clouds at the start and at 8 m.
    places = [CHAIR_LIDAR - [2.0 * s, 0.0, 0.0] for s in (1, 2, 3)]
    both = (cloud("front", 0), cloud("front", 4))
    assert kept(patches(places, [1, 2, 3]), *both) == []
    assert kept(patches(places, [1, 2, 3])) == [0, 1, 2]


def test_clouds_of_other_lidars_and_drives_do_not_count() -> None:
    of = patches([CHAIR_LIDAR], [0], lidar=1)
    assert kept(of, cloud("front", 0)) == [0]
    assert kept(of, cloud("rear", 0, drive=1)) == [0]
    assert kept(of, cloud("rear", 0)) == []
