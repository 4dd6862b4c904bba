"""Errors of channels: what they seem to do to clouds of a target."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.channel_errors import (
    MOST_GROUPS,
    ChannelSizes,
    OwnChannels,
    channel_sizes,
)
from caliv_graph.calibration.range_bias import without_bias
from caliv_graph.config.range_errors import UNSTATED, RangeErrors
from caliv_graph.products import Array, TargetCloud, TargetObservation
from caliv_graph.registration.register import JointRegistration
from caliv_graph.structure.beams import CHANNEL_KINDS
from caliv_graph.structure.channels import found_channels
from caliv_graph.targets.cloud.beams import elevations
from tests.registration.scenes import chair_scene, config_of, looking_at_target, matrices

RANGE, ELEVATION, AZIMUTH = 0, 1, 2
ALIKE: ChannelSizes = {"front": (1.0, 1.0, 1.0), "rear": (1.0, 1.0, 1.0)}
ROWS_DEG = np.array([-2.0, 0.0, 2.0])
"""Elevations of the channels of a LiDAR of 16 that see a target."""


@cache
def dense() -> tuple[JointRegistration, Array, Array]:
    """Three clouds of 152 channels, which neighbours blur: they are groups of elevations."""
    scene = chair_scene([0.0, 70.0, 200.0], [6.0, 8.0, 7.0], 0.01, 1)
    return JointRegistration(scene.observation, config_of()), *matrices(scene.T_target_lidar)


def board(T_target_lidar: gtsam.Pose3, rows_deg: Array) -> Array:
    """Points (n, 3) of a board across the view, lidar frame, on some channels."""
    middle = T_target_lidar.inverse().translation()
    heading, far = np.arctan2(middle[1], middle[0]), np.hypot(middle[0], middle[1])
    out = []
    for elevation in np.radians(rows_deg):
        side = heading + np.linspace(-0.05, 0.05, 21)
        level = far / np.cos(side - heading)
        out.append(
            np.column_stack([level * np.cos(side), level * np.sin(side), level * np.tan(elevation)])
        )
    return np.concatenate(out)


def of_sixteen(lidars: tuple[str, ...], drive: int = 0) -> JointRegistration:
    """Clouds of a board 8 m away, on `ROWS_DEG`."""
    poses = [looking_at_target(20.0 * j, 8.0, 0.4) for j in range(len(lidars))]
    clouds = tuple(
        TargetCloud(name, drive, j, board(T, ROWS_DEG), f"{j}.pcd")
        for j, (name, T) in enumerate(zip(lidars, poses, strict=True))
    )
    observation = TargetObservation(drive, "target", np.zeros(3), clouds)
    return JointRegistration(observation, config_of())


def summed(own: OwnChannels, state: JointRegistration, R: Array, t: Array, kind: int) -> Array:
    """(J, 6) by an error of 1 of all channels."""
    by = own.directions([state], [(R, t)], ALIKE) / own.part
    return np.asarray(by[:, own.kind == kind].sum(axis=1).reshape(-1, 6))


def turned_about_lidar(R: Array, t: Array, axes: Array) -> Array:
    """(J, 6) left perturbations of poses by turns of their LiDARs about axes (J, 3)."""
    turn = np.einsum("jab,jb->ja", R, axes)
    return np.asarray(np.hstack([turn, np.cross(t, turn)]))


def test_all_channels_together_turn_the_lidar_or_shift_its_clouds() -> None:
    state, R, t = dense()
    own = OwnChannels.of([state])
    assert own.moves[0].shape == (3, 6, 3 * MOST_GROUPS)
    upright = np.tile([0.0, 0.0, 1.0], (3, 1))
    by_azimuth = summed(own, state, R, t, AZIMUTH)
    np.testing.assert_allclose(by_azimuth, turned_about_lidar(R, t, upright), atol=1e-9)
    view = state.clouds.centres / np.linalg.norm(state.clouds.centres, axis=1)[:, None]
    level = np.cross(upright, view)
    level /= np.linalg.norm(level, axis=1)[:, None]
    by_elevation = summed(own, state, R, t, ELEVATION)
    np.testing.assert_allclose(by_elevation, turned_about_lidar(R, t, -level), atol=1e-9)
    by_range = summed(own, state, R, t, RANGE)
    away = np.einsum("jab,jb->ja", R, view)
    np.testing.assert_allclose(by_range, np.hstack([np.zeros((3, 3)), away]), atol=1e-9)


@pytest.mark.parametrize("kind", [RANGE, AZIMUTH])
def test_one_channel_moves_its_cloud_as_least_squares_do(kind: int) -> None:
    """The points of the uppermost of three rows err; a shift and a turn are fitted to all."""
    state = of_sixteen(("front", "rear"))
    own = OwnChannels.of([state])
    clouds = state.clouds.only(np.array([0]))
    rows = np.round(np.degrees(np.arctan2(clouds.points[:, 2], np.hypot(*clouds.points[:, :2].T))))
    uppermost = rows == rows.max()
    view = clouds.centres[0] / np.linalg.norm(clouds.centres[0])
    level = np.cross([0.0, 0.0, 1.0], view)
    level /= np.linalg.norm(level)
    height = clouds.centred @ np.cross(view, level)
    moved = np.where(uppermost, 1.0, 0.0)  # along the beam, or to the left
    shift, slope = np.linalg.lstsq(np.column_stack([np.ones(len(height)), height]), moved)[0]
    index = int(np.flatnonzero((own.kind == kind) & (own.lidar == 0))[-1])
    turn, motion = own.moves[0][0, :3, index], own.moves[0][0, 3:, index]
    if kind == RANGE:
        assert motion @ view == pytest.approx(shift, rel=1e-6)
        assert turn @ level == pytest.approx(slope, rel=0.1)  # less for `SHORT_M`
    else:
        far = np.hypot(*clouds.centres[0, :2])
        assert motion @ level == pytest.approx(shift * far, rel=1e-6)
        share = uppermost.mean()
        assert (turn - [0.0, 0.0, share]) @ view == pytest.approx(-slope * far, rel=0.1)


def test_each_channel_that_is_seen_errs_alike_in_all_clouds_and_placements() -> None:
    states = [of_sixteen(("front", "rear", "front")), of_sixteen(("rear", "front"), 1)]
    own = OwnChannels.of(states)
    assert own.lidars == ("front", "rear")
    assert [of.shape for of in own.moves] == [(3, 6, 18), (2, 6, 18)]
    assert (own.part == 1.0).all()
    rear = own.lidar == 1
    for moves, of_rear in zip(own.moves, ([1], [0]), strict=True):
        others = [j for j in range(len(moves)) if j not in of_rear]
        assert np.abs(moves[of_rear][:, :, rear]).max() > 0.1
        assert np.abs(moves[others][:, :, rear]).max() == 0.0
        assert np.abs(moves[of_rear][:, :, ~rear]).max() == 0.0


def test_no_number_of_clouds_tells_the_yaw_better_than_the_channels_that_see_the_target() -> None:
    """Three channels of 0.3 mrad: their mean is the LiDAR's yaw, to 0.17 mrad."""
    count = 12
    state = of_sixteen(("front",) * count)
    own = OwnChannels.of([state])
    R, t = matrices([looking_at_target(20.0 * j, 8.0, 0.4) for j in range(count)])
    sizes = {"front": (0.0, 0.0, 3e-4)}
    D = own.directions([state], [(R, t)], sizes)
    H = 1e10 * np.eye(6 * count)
    less, _ = without_bias(H, np.zeros(6 * count), D)
    upright = np.tile([0.0, 0.0, 1.0], (count, 1))
    yaw = turned_about_lidar(R, t, upright).ravel()
    estimate = yaw / (yaw @ yaw)  # of all clouds: H is alike in all directions
    sigma = np.sqrt(estimate @ np.linalg.inv(less) @ estimate)
    assert sigma == pytest.approx(3e-4 / 3**0.5, rel=0.05)


def test_clouds_that_see_few_channels_of_a_group_have_more_of_their_errors() -> None:
    """Twenty channels, two or three to a group: a cloud on two of them has not the mean of all."""
    rows = np.linspace(-4.0, 4.0, 20)
    T = looking_at_target(0.0, 8.0, 0.4)
    clouds = tuple(
        TargetCloud("front", 0, j, board(T, of), f"{j}.pcd")
        for j, of in enumerate([rows, rows[9:11], rows[9:11], rows[9:11]])
    )
    state = JointRegistration(TargetObservation(0, "target", np.zeros(3), clouds), config_of())
    own = OwnChannels.of([state])
    assert len(own.part) == 3 * MOST_GROUPS
    D = own.directions([state], [matrices([T] * 4)], {"front": (0.0, 0.0, 1.0)})
    sideways = np.sqrt((D.reshape(4, 6, -1) ** 2).sum(axis=2))[:, 4] / 8.0
    assert sideways[1] == pytest.approx(2**-0.5, rel=0.1)
    assert 20**-0.5 < sideways[0] < 0.6 * sideways[1]  # of two groups more than its own


def test_what_is_stated_of_the_ranges_is_the_most_of_channels() -> None:
    for stated_m in (5e-4, 2e-3, 2e-2):
        usual = RangeErrors(offset_m=stated_m, beam_m=min(1e-3, stated_m))
        ((range_m, *_),) = channel_sizes(("front",), (), usual).values()
        assert range_m <= stated_m
    assert range_m == pytest.approx(2.3e-3, rel=0.01)


def test_channels_are_found_by_the_beams_of_a_lidar_that_drives() -> None:
    """16 channels of 2 degrees on a board, from 12 to 4 m away, at 10 m/s in sweeps of 0.1 s.

    By where the LiDAR is at the stamp elevations are up to 40 mrad off: no channels are seen.
    """
    elevation = np.radians(np.arange(-15.0, 16.0, 2.0))
    clouds = []
    for j, x_m in enumerate(np.linspace(12.0, 4.0, 17).tolist()):
        azimuth = np.linspace(-0.06, 0.06, 24)
        time_s = np.linspace(0.0, 0.1, 24)
        a, e = (g.ravel() for g in np.meshgrid(azimuth, elevation))
        beams = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        origins = np.column_stack([10.0 * np.tile(time_s, 16), np.zeros((len(a), 2))])
        points = origins + beams * ((x_m - origins[:, :1]) / beams[:, :1])
        seen = np.abs(points[:, 2]) < 0.8
        cloud = TargetCloud("front", 0, j, points[seen], f"{j}.pcd")
        clouds.append(replace(cloud, origins_lidar=origins[seen]))
    state = JointRegistration(TargetObservation(0, "t", np.zeros(3), tuple(clouds)), config_of())
    assert found_channels(elevations(state.clouds.points)) is None
    own = OwnChannels.of([state])
    # Eight groups of one or two of the channels that the clouds see, and not of bins of 0.01 rad.
    seen_channels = found_channels(elevations(state.clouds.beams))
    assert seen_channels is not None
    assert seen_channels == pytest.approx(elevation[np.abs(np.tan(elevation)) < 0.2], abs=1e-3)
    assert len(own.part) == CHANNEL_KINDS * min(len(seen_channels), MOST_GROUPS)


def test_sizes_are_those_of_structure_where_it_tells_some() -> None:
    usual = channel_sizes(("front", "rear"), (), UNSTATED)
    # Root mean squares of the priors, 2.3 times their medians of 1 mm and 0.05 mrad.
    assert usual["front"] == usual["rear"] == pytest.approx((2.3e-3, 1.15e-4, 1.15e-4), rel=2e-3)
    found: list[ChannelSizes] = [{"rear": (3e-3, 1e-4, 2e-4)}, {"rear": (4e-3, 1e-4, 0.0)}]
    sizes = channel_sizes(("front", "rear"), found, UNSTATED)
    assert sizes["front"] == usual["front"]
    np.testing.assert_allclose(sizes["rear"], [12.5e-6**0.5, 1e-4, 2e-4 / 2**0.5])
