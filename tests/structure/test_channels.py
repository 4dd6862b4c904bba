"""Channels of a LiDAR by the elevations of its points, and what the points of each add."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.products import Array
from caliv_graph.structure.channels import (
    MOST_CHANNELS,
    ChannelSums,
    PointChannels,
    found_channels,
    found_rows,
)
from caliv_graph.structure.patches import RangeNoise
from caliv_graph.structure.planar import ScanPatches, SweepMotion, planar_patches
from caliv_graph.targets.cloud.beams import elevations
from tests.structure.test_planar import beams, on_plane

NOISE = RangeNoise.constant(0.01)

UNEVEN_DEG = np.concatenate([np.arange(-25.0, -8.0, 1.7), np.arange(-7.0, 4.0, 0.33), [5.0, 9.0]])


def drawn(channels_deg: Array, jitter_deg: float = 0.0, count: int = 40_000) -> Array:
    rng = np.random.default_rng(3)
    drawn_deg = rng.choice(channels_deg, count) + rng.normal(0.0, jitter_deg, count)
    return np.asarray(np.radians(drawn_deg))


@pytest.mark.parametrize("jitter_deg", [0.0, 0.03])
@pytest.mark.parametrize(
    "channels_deg",
    [UNEVEN_DEG, np.linspace(-15.0, 15.0, 16), np.linspace(-22.5, 22.5, 64)],
    ids=["uneven", "16", "64"],
)
def test_channels_are_found_whatever_their_distances(
    channels_deg: Array, jitter_deg: float
) -> None:
    found = found_channels(drawn(channels_deg, jitter_deg))
    assert found is not None
    np.testing.assert_allclose(np.degrees(found), channels_deg, atol=0.01)


@pytest.mark.parametrize("wide_rad", [0.0, 3e-4, 5e-4])
def test_a_single_channel_is_found(wide_rad: float) -> None:
    """A target far away, or a planar LiDAR: all points within two bins."""
    found = found_channels(0.01 + np.linspace(0.0, wide_rad, 40))
    assert found is not None
    np.testing.assert_allclose(found, [0.01 + 0.5 * wide_rad], atol=1e-9)


def test_a_channel_with_a_tenth_of_the_points_of_its_neighbours_is_found() -> None:
    few = drawn(np.array([1.0]), count=400)
    found = found_channels(np.concatenate([drawn(np.array([0.0, 2.0]), count=8000), few]))
    assert found is not None
    np.testing.assert_allclose(np.degrees(found), [0.0, 1.0, 2.0], atol=1e-6)


def test_beams_that_begin_beside_the_origin_are_still_of_their_channels() -> None:
    """An Ouster's begin 28 mm from its axis: near points are seen at other elevations."""
    rng = np.random.default_rng(5)
    channel = rng.integers(0, 64, 50_000)
    elevation = np.radians(np.linspace(-22.0, 22.0, 64))[channel]
    distance = rng.uniform(4.0, 40.0, len(channel))
    flat = distance * np.cos(elevation) + 0.028
    points = np.column_stack([flat, np.zeros_like(flat), distance * np.sin(elevation)])
    found = PointChannels.found(points)
    assert found is not None
    assert (found.of_point == channel).mean() > 0.999


def test_a_rosette_and_a_lidar_of_many_channels_have_none() -> None:
    rng = np.random.default_rng(4)
    a, b = rng.uniform(0.0, 2.0 * np.pi, (2, 40_000))
    rosette = np.radians(19.0) * (np.sin(a) + np.sin(b))
    assert found_channels(rosette) is None
    for count in (30, 300, 3000):
        assert found_channels(rosette[:count]) is None
    many = drawn(np.linspace(-12.5, 12.5, 2 * MOST_CHANNELS))
    assert found_channels(many) is None
    assert found_rows(rosette) is None
    rows = found_rows(many)
    assert rows is not None
    assert len(rows) == 2 * MOST_CHANNELS
    # Rows that bend with the azimuth, as those of a mirror that turns about one axis.
    bent = drawn(np.linspace(-12.5, 12.5, 40)) + np.radians(1.5) * np.cos(a)
    assert found_channels(bent) is None
    assert found_channels(np.zeros(0)) is None


RAYS = beams(np.arange(-12.0, 12.0, 0.6), np.arange(-45.0, 45.0, 0.2))
WALL = RAYS * on_plane(RAYS, np.array([0.9, 0.3, 0.1]), 12.0)[:, None]


def test_what_the_channels_add_is_what_the_patch_has() -> None:
    times = np.linspace(0.0, 0.1, len(WALL))
    motion = SweepMotion(0.0, np.tile([0.0, 0.1, 0.4], (11, 1)), np.tile([3.0, 0.2, 0.0], (11, 1)))
    at_once = planar_patches(WALL, NOISE, by_channel=True)
    for found in (at_once, planar_patches(WALL, NOISE, times, motion, by_channel=True)):
        channels = found.channels
        assert channels is not None
        total = np.zeros((len(found.time_s), 4))
        np.add.at(total, channels.patch, channels.sums)
        np.testing.assert_allclose(total, found.moments[:, :, 3], rtol=1e-9)
        assert np.bincount(channels.patch).min() >= 3
        # Within 5 ms points moved by 15 mm at most.
        seen = elevations(channels.sums[:, :3])
        assert np.abs(seen - channels.elevation_rad).max() < np.radians(0.15)
    assert planar_patches(WALL, NOISE).channels is None


def by_patch(channels: ChannelSums, patch: int) -> Array:
    own = channels.patch == patch
    return np.column_stack([channels.elevation_rad[own], channels.sums[own]])


def test_some_of_the_patches_keep_their_own() -> None:
    found = planar_patches(WALL, NOISE, by_channel=True)
    assert found.channels is not None
    for keep in (np.array([3, 7, 20]), np.isin(np.arange(len(found.time_s)), [3, 7, 20])):
        some = found.part(keep).channels
        assert some is not None
        assert set(some.patch.tolist()) == {0, 1, 2}
        for new, old in enumerate([3, 7, 20]):
            np.testing.assert_array_equal(by_patch(some, new), by_patch(found.channels, old))


def test_scans_without_channels_are_joined_with_others() -> None:
    found = planar_patches(WALL, NOISE, by_channel=True)
    none: ScanPatches = replace(found, channels=None)
    count = len(found.time_s)
    joined = ChannelSums.joined([none.channels, found.channels], [count, count])
    assert joined is not None
    assert found.channels is not None
    assert joined.patch.min() == count
    np.testing.assert_array_equal(by_patch(joined, count + 5), by_patch(found.channels, 5))
    assert ChannelSums.joined([None, None], [count, count]) is None


def test_two_rings_on_either_side_of_a_kerb_are_no_patch() -> None:
    """Taken as one, they are a plane that rises by as much as the kerb."""
    rays = beams(np.array([-25.0, -22.9]), np.arange(-180.0, 180.0, 0.2))
    height = np.where(rays[:, 2] < np.sin(np.radians(-24.0)), 1.80, 1.77)
    points = rays * (height / -rays[:, 2])[:, None]
    taken = planar_patches(points, NOISE)
    assert len(taken.time_s) > 10
    assert taken.normal_lidar[:, 2].max() < np.cos(np.radians(5.0))
    assert not len(planar_patches(points, NOISE, by_channel=True).time_s)


def test_two_rings_are_a_patch_where_no_third_is_near() -> None:
    """Ground 8 m before a LiDAR of 16 channels, whose rings are more than a metre apart."""
    rays = beams(np.array([-14.4, -12.2]), np.arange(-180.0, 180.0, 0.2))
    points = rays * (1.8 / -rays[:, 2])[:, None]
    taken = planar_patches(points, NOISE)
    assert len(taken.time_s) > 5
    by_channel = planar_patches(points, NOISE, by_channel=True)
    np.testing.assert_array_equal(by_channel.moments, taken.moments)
