"""Single scans, cast at boxes on a plane, taken apart."""

from __future__ import annotations

import math
from collections.abc import Sequence

import gtsam
import numpy as np
import pytest

from caliv_graph.products import Array
from caliv_graph.targets.search.objects import ScanObject, ScanObjects, connected, segment_scan

HEIGHT_M = 2.0
"""Of the LiDAR above the ground."""

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Lower and upper corner; the LiDAR is at (0, 0, 2)."""


def directions(
    azimuths_deg: tuple[float, float] = (-60.0, 60.0),
    elevations_deg: Sequence[float] = tuple(np.arange(-25.0, 3.0, 0.4)),
    step_deg: float = 0.3,
) -> Array:
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(*azimuths_deg, step_deg)), np.radians(elevations_deg)
    )
    return np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=-1,
    ).reshape(-1, 3)


def cast(beams: Array, boxes: Sequence[Box], sigma_m: float = 0.01) -> Array:
    """(n, 3) returns from the ground at z = 0 and from boxes, about the LiDAR, axes level."""
    origin = np.array([0.0, 0.0, HEIGHT_M])
    with np.errstate(divide="ignore", invalid="ignore"):
        range_m = np.where(beams[:, 2] < 0.0, -HEIGHT_M / beams[:, 2], np.inf)
        for low, high in boxes:
            ends = np.sort(np.stack([(np.array(c) - origin) / beams for c in (low, high)]), axis=0)
            enters, leaves = ends[0].max(axis=1), ends[1].min(axis=1)
            range_m = np.where(
                (enters < leaves) & (enters > 0.0), np.minimum(range_m, enters), range_m
            )
    back = range_m < 100.0
    noise = np.random.default_rng(0).normal(0.0, sigma_m, len(beams))
    return np.asarray(beams[back] * (range_m + noise)[back, None])


def box_at(x: float, y: float, size_m: float, height_m: float) -> Box:
    half = 0.5 * size_m
    return (x - half, y - half, 0.0), (x + half, y + half, height_m)


def seen(boxes: Sequence[Box], beams: Array | None = None) -> ScanObjects:
    return segment_scan(cast(directions() if beams is None else beams, boxes), np.eye(3))


def only(scan: ScanObjects) -> ScanObject:
    [found] = scan.objects
    return found


WALL: Box = (12.0, -15.0, 0.0), (12.3, 15.0, 2.8)


class TestOneObject:
    def test_is_described(self) -> None:
        found = only(seen([box_at(9.0, 1.0, 0.6, 1.1)]))
        # Front at x = 8.7 and top, both 0.6 m wide: seen in full, 0.6 m to 0.85 m across.
        assert 0.58 < found.extent_m < 0.87
        assert found.centre[:2] == pytest.approx([8.9, 1.0], abs=0.12)
        assert found.base == pytest.approx([8.9, 1.0, -HEIGHT_M], abs=0.12)
        assert found.range_m == pytest.approx(math.hypot(8.7, 1.0), abs=0.1)
        assert found.top_m == pytest.approx(1.1, abs=0.06)
        assert 0.1 < found.bottom_m < 0.25
        low, high = found.azimuth
        assert low == pytest.approx(math.atan2(0.7, 8.7), abs=math.radians(0.4))
        assert high == pytest.approx(math.atan2(1.3, 8.7), abs=math.radians(0.4))
        assert found.elevation[1] == pytest.approx(math.atan2(1.1 - 2.0, 8.7), abs=math.radians(1))
        assert not found.hidden

    def test_seen_with_a_mounting_that_is_off(self) -> None:
        R = gtsam.Rot3.RzRyRx(0.1, -0.12, 0.3).matrix()
        points = cast(directions(), [box_at(9.0, 1.0, 0.6, 1.1)])
        straight = only(segment_scan(points, np.eye(3)))
        tilted = only(segment_scan(points, R))
        # Described in the LiDAR's frame, from which the map is as far as the guess is off.
        assert tilted.base == pytest.approx(straight.base, abs=0.2)
        assert tilted.top_m == pytest.approx(straight.top_m, abs=0.1)
        assert tilted.extent_m == pytest.approx(straight.extent_m, abs=0.15)

    def test_behind_the_lidar_across_the_jump_of_the_azimuth(self) -> None:
        beams = directions((120.0, 240.0))
        found = only(seen([box_at(-9.0, 0.0, 0.6, 1.1)], beams))
        # A column at 9 m is 5 cm wide.
        assert 0.53 < found.extent_m < 0.87
        assert found.azimuth[1] - found.azimuth[0] < math.radians(6.0)

    def test_of_few_rings_is_not_cut_into_slices(self) -> None:
        beams = directions(elevations_deg=np.arange(-16.0, 2.0, 2.0).tolist(), step_deg=0.2)
        found = only(seen([box_at(9.0, 1.0, 0.6, 1.8)], beams))
        assert found.top_m > 1.3

    def test_a_thin_pole(self) -> None:
        found = only(seen([box_at(8.0, -3.0, 0.12, 3.5)]))
        assert found.extent_m < 0.25
        assert found.top_m > 2.0

    def test_nothing_but_ground(self) -> None:
        scan = seen([])
        assert scan.has_ground
        assert scan.objects == ()

    def test_nothing_at_all(self) -> None:
        scan = segment_scan(np.zeros((0, 3)), np.eye(3))
        assert not scan.has_ground
        assert scan.objects == ()
        assert len(scan.azimuths) == 0


class TestMoreThanOne:
    def test_two_a_metre_apart_are_two(self) -> None:
        # As high as the LiDAR: of lower ones, single rings on the top would be objects too.
        scan = seen([box_at(8.0, -1.0, 0.5, 2.0), box_at(8.0, 0.6, 0.5, 2.0)])
        assert len(scan.objects) == 2

    def test_a_wall_is_wide(self) -> None:
        widest = max(seen([WALL]).objects, key=lambda o: o.points)
        assert widest.extent_m > 20.0

    def test_what_is_seen_of_a_wall_between_two_things_is_hidden(self) -> None:
        # Two panels leave a gap through which 1.2 m of the wall are seen.
        panels: list[Box] = [
            ((6.0, -6.0, 0.0), (6.1, -0.3, 2.8)),
            ((6.0, 0.3, 0.0), (6.1, 6.0, 2.8)),
        ]
        scan = seen([WALL, *panels], directions((-30.0, 30.0)))
        piece = [o for o in scan.objects if o.extent_m < 1.75]
        assert len(piece) == 1
        assert piece[0].hidden

    def test_what_stands_in_front_is_not(self) -> None:
        scan = seen([WALL, box_at(7.0, 0.0, 0.6, 1.0)])
        front = max((o for o in scan.objects if o.range_m < 8.0), key=lambda o: o.points)
        assert not front.hidden
        assert front.extent_m < 0.87

    def test_what_goes_on_beyond_the_range_is_hidden(self) -> None:
        # Its near edge is 29.3 m away, the ends of its two visible faces 30.3 m.
        found = only(seen([box_at(21.4, 21.4, 1.4, 2.0)], directions(step_deg=0.1)))
        assert found.hidden
        assert not only(seen([box_at(18.4, 18.4, 1.4, 2.0)], directions(step_deg=0.1))).hidden


@pytest.mark.parametrize("reach", [0.05, 0.2, 0.6])
def test_what_is_connected_does_not_depend_on_how_many_links_say_so(reach: float) -> None:
    rng = np.random.default_rng(3)
    points = rng.random((400, 2)) + 3.0 * rng.integers(0, 2, (400, 1))
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    pairs = np.argwhere(np.triu(apart < reach, 1))
    labels = connected(pairs, len(points))
    reached = apart < reach
    for _ in range(9):  # each doubles the number of steps
        reached = (reached.astype(np.float32) @ reached.astype(np.float32)) > 0.0
    assert np.array_equal(labels[:, None] == labels[None], reached)
    first = np.unique(labels, return_index=True)[1]
    assert (np.diff(first) > 0).all()  # numbered by their first points


def test_points_without_links_are_alone() -> None:
    assert connected(np.zeros((0, 2), np.int64), 3).tolist() == [0, 1, 2]
    assert connected(np.zeros((0, 2), np.int64), 0).tolist() == []
