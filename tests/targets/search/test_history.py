"""The field of view of a LiDAR, from the azimuths of its returns."""

from __future__ import annotations

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.products import IntArray
from caliv_graph.targets.search import align
from caliv_graph.targets.search.history import Alignment, LidarHistory
from caliv_graph.targets.search.objects import WIDE_M, ScanObject, ScanObjects


def object_at(azimuth_deg: float) -> ScanObject:
    """A thing 2 degrees wide, fully seen."""
    middle = math.radians(azimuth_deg)
    return ScanObject(
        centre=np.zeros(3),
        base=np.zeros(3),
        range_m=9.0,
        extent_m=0.3,
        bottom_m=0.1,
        top_m=1.0,
        points=100,
        azimuth=(middle - math.radians(1.0), middle + math.radians(1.0)),
        elevation=(-0.2, -0.1),
        hidden=False,
        outline=np.zeros((1, 3)),
    )


def whole(azimuth_deg: float, bins: IntArray) -> bool:
    """Whether an object there is in full view of a LiDAR with returns in these half degrees."""
    scan = ScanObjects((object_at(azimuth_deg),), bins, (-0.4, 0.2), True)
    poses = np.eye(3)[None], np.zeros((1, 3))
    history = LidarHistory("front", gtsam.Pose3(), [scan], poses, 1.0)
    return bool(history.whole[0])


@pytest.mark.parametrize("azimuth_deg", [-28.0, 0.0, 0.7, 28.0])
def test_gaps_between_columns_are_in_view(azimuth_deg: float) -> None:
    # A column every 1.5 degrees from -30 to 30.
    assert whole(azimuth_deg, np.arange(-60, 61, 3))


@pytest.mark.parametrize("azimuth_deg", [-45.0, -29.5, 29.5, 45.0, 180.0])
def test_what_the_edge_may_cut_is_not_whole(azimuth_deg: float) -> None:
    assert not whole(azimuth_deg, np.arange(-60, 61, 3))


@pytest.mark.parametrize("azimuth_deg", [0.0, 90.0, 179.5, -179.5])
def test_a_lidar_that_looks_all_around_has_no_edge(azimuth_deg: float) -> None:
    assert whole(azimuth_deg, np.arange(-360, 360, 2))


def test_a_scan_without_returns_has_no_field_of_view() -> None:
    assert not whole(0.0, np.zeros(0, np.int64))


def test_objects_at_one_place_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    # One pair within 0.25 m (0 and 0.2), three within 0.5 m, each counted from both sides. The last
    # one is too wide for a target.
    along_m = (0.0, 0.2, 0.4501, 3.0, 0.1)
    objects = [replace(object_at(0.0), base=np.array([9.0, y, 0.0])) for y in along_m]
    objects[-1] = replace(objects[-1], extent_m=2.0 * WIDE_M)
    scan = ScanObjects(tuple(objects), np.arange(-60, 61, 3), (-0.4, 0.2), True)
    poses = np.eye(3)[None], np.zeros((1, 3))
    history = LidarHistory("front", gtsam.Pose3(), [scan], poses, 1.0)
    moved = Alignment(0.3, np.array([1.0, -2.0]))
    assert align.concentration(history, moved) == 2 * (1 + 3)
    # The same with a tree, where there are many.
    monkeypatch.setattr(align, "FEW", 0)
    assert align.concentration(history, moved) == 2 * (1 + 3)


@pytest.mark.parametrize("count", [0, 1, 30])
@pytest.mark.parametrize("few", [0, align.FEW])
def test_many_corrections_count_what_each_counts(
    count: int, few: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a vehicle that leans, a LiDAR on its side; some corrections at a time."""
    rng = np.random.default_rng(count)
    scans = 5
    bases = [np.array([9.0, *rng.normal(0.0, 0.4, 2)]) for _ in range(count)]
    objects = [replace(object_at(0.0), base=base) for base in bases]
    scan = ScanObjects(tuple(objects), np.arange(-60, 61, 3), (-0.4, 0.2), True)
    tilts = [gtsam.Rot3.Expmap(rng.normal(0.0, 0.05, 3)).matrix() for _ in range(scans)]
    poses = np.array(tilts), rng.normal(0.0, 0.2, (scans, 3))
    guess = gtsam.Pose3(gtsam.Rot3.RzRyRx(1.4, 0.1, 0.2), np.array([1.0, 0.3, 2.0]))
    history = LidarHistory("front", guess, [scan] * scans, poses, 1.0)
    corrections = rng.uniform(-1.0, 1.0, (17, 3))
    monkeypatch.setattr(align, "FEW", few)
    monkeypatch.setattr(align, "AT_ONCE", 3 * 5 * count * (5 * count - 1) // 2)

    found = align.concentrations(history, corrections)

    each = [align.concentration(history, Alignment(c[0], c[1:])) for c in corrections]
    assert found.tolist() == each
    assert count < 30 or len(set(each)) > 5


@pytest.mark.parametrize(
    ("roll_deg", "low_deg", "high_deg", "top_cut", "is_whole"),
    [
        (0.0, -20.0, 8.0, True, True),
        (0.0, -25.0, 0.0, False, True),
        (10.0, -20.0, 8.0, True, True),
        # Upside down, beams of high elevation look at the ground: the top is at the lowest.
        (180.0, -25.0, 0.0, True, True),
        (180.0, -20.0, 8.0, False, True),
        # On its side, the ends of the elevations are at the left and at the right.
        (90.0, -20.0, 8.0, False, False),
        (-90.0, -25.0, 0.0, False, False),
        (90.0, -10.0, 0.0, False, True),
    ],
)
def test_what_the_outermost_beams_cut_off(
    roll_deg: float, low_deg: float, high_deg: float, top_cut: bool, is_whole: bool
) -> None:
    """Of a LiDAR whose beams are at -25 to 8 degrees, as it is mounted."""
    beams = math.radians(low_deg), math.radians(high_deg)
    ends = math.radians(-25.0), math.radians(8.0)
    scan = ScanObjects(
        (replace(object_at(0.0), elevation=beams),), np.arange(-360, 360, 2), ends, True
    )
    guess = gtsam.Pose3(gtsam.Rot3.Roll(math.radians(roll_deg)), np.zeros(3))
    history = LidarHistory("front", guess, [scan], (np.eye(3)[None], np.zeros((1, 3))), 1.0)
    assert (bool(history.top_cut[0]), bool(history.whole[0])) == (top_cut, is_whole)
