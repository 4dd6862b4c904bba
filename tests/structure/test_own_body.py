"""The vehicle's own body, seen by its LiDARs, is no ground; what looks like it stays."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from scipy.spatial import cKDTree

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import Config, GroundConfig
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, BoolArray, Trajectory
from caliv_graph.structure.own_body import _above_ground, _in_map, without_own_body
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.read import read_patches
from caliv_graph.trajectory.select import GivenTrajectory
from tests.samples import pose
from tests.structure.worlds import (
    Spinner,
    World,
    driven,
    ground,
    guessed,
    recorded,
    wall,
    world_of,
    yard,
)
from tests.trajectory.motions import eight_drive

DECK_M = 1.2
DECK = world_of(
    [np.array([-3.0, -0.9, DECK_M]), np.array([5.0, 0.0, 0.0]), np.array([0.0, 1.8, 0.0])]
)
"""A deck from 3 m behind the vehicle's origin to 2 m before it."""

GUESSES = {
    "front": pose((2.1, 0.2, 1.5), (0.0, 12.0, 5.0)),
    "rear": pose((-1.0, 0.1, 1.9), (0.0, 10.0, 175.0)),
}
AROUND = np.linspace(-180.0, 180.0, 300, endpoint=False)
CONFIG = Config(lidars=guessed(GUESSES))


STATED = CONFIG.model_copy(update={"ground": GroundConfig(vehicle_height=0.0)})


def lidars(body: World | None) -> dict[str, Spinner]:
    """At the guesses, but for a degree; the front one looks beyond the deck."""
    off = gtsam.Pose3(gtsam.Rot3.Expmap(np.radians([0.6, -0.8, 1.0])), np.array([0.02, 0.0, 0.03]))
    return {
        "front": Spinner(GUESSES["front"], np.arange(-24.0, 8.0), np.arange(-60.0, 61.0, 0.6)),
        "rear": Spinner(GUESSES["rear"] * off, np.arange(-36.0, 5.0), AROUND, 0.01, 0.0, body),
    }


def rocking(trajectory: GivenTrajectory, seed: int = 4) -> GivenTrajectory:
    """The same way on springs: 4 mm of heave and 4 mrad of lean from pose to pose."""
    of, rng = trajectory.trajectory, np.random.default_rng(seed)
    poses = tuple(
        T * gtsam.Pose3(gtsam.Rot3.Expmap(w * [1.0, 1.0, 0.0]), np.array([0.0, 0.0, h]))
        for T, w, h in zip(
            of.T_map_vehicle,
            rng.normal(0.0, 4e-3, (len(of.stamps_ns), 3)),
            rng.normal(0.0, 4e-3, len(of.stamps_ns)),
            strict=True,
        )
    )
    return GivenTrajectory(Trajectory(of.stamps_ns, poses))


def straight(metres: float) -> GivenTrajectory:
    """Along the x axis of the map at 2 m/s, and exactly so."""
    stamps = np.arange(0.0, max(metres / 2.0, 20.0), 0.1)
    x = np.minimum(2.0 * stamps, metres) - 0.5 * metres
    poses = tuple(pose((a, 0.0, 0.0), (0.0, 0.0, 0.0)) for a in x)
    return GivenTrajectory(Trajectory(np.round(1e9 * stamps).astype(np.int64), poses))


FIELDS = ("corner", "first", "second")
EIGHT = driven(eight_drive())


def read(world: World, trajectory: GivenTrajectory, body: World | None) -> DrivePatches:
    begin, end = trajectory.span_ns
    stamps = np.arange(begin + 100_000_000, end, 1_500_000_000, dtype=np.int64)
    spinners = lidars(body)
    recording = recorded(world, trajectory, spinners, dict.fromkeys(spinners, stamps))
    (patches,) = read_patches([recording], [trajectory], CONFIG, SilentProgress(), keep_level=True)
    return patches


WAYS = {"eight": EIGHT, "rocking": rocking(EIGHT), "straight": straight(60.0)}


@cache
def in_yard(way: str, deck: bool) -> DrivePatches:
    """Patches of the yard along one of `WAYS`, seen over a deck or not."""
    return read(yard(), WAYS[way], DECK if deck else None)


def in_vehicle(patches: DrivePatches) -> tuple[Array, Array]:
    """Centres and normals (N, 3) in the vehicle frame, at the true extrinsics."""
    R, t = stack([s.T_vehicle_lidar for s in lidars(None).values()])
    of = patches.scan_lidar[patches.scan]
    centres = np.einsum("nij,nj->ni", R[of], patches.centres_lidar) + t[of]
    return centres, np.einsum("nij,nj->ni", R[of], patches.normal_lidar)


def on_deck(patches: DrivePatches) -> BoolArray:
    centres, normals = in_vehicle(patches)
    return np.asarray((np.abs(centres[:, 2] - DECK_M) < 0.03) & (normals[:, 2] > 0.95))


@pytest.mark.parametrize("way", WAYS)
def test_patches_on_the_deck_are_left_out_and_no_others(way: str) -> None:
    trajectory, patches = WAYS[way], in_yard(way, deck=True)
    deck = on_deck(patches)
    assert deck.sum() > 300
    left, found = without_own_body(patches, trajectory, CONFIG)
    assert on_deck(left).sum() <= 0.02 * deck.sum()
    assert len(patches.scan) - len(left.scan) <= deck.sum()
    (body,) = found
    rear = patches.scan_lidar[patches.scan] == 1
    assert body.lidar == "rear"
    assert body.share == pytest.approx(deck.sum() / rear.sum(), rel=0.03)
    far_m = np.linalg.norm(patches.centres_lidar[deck], axis=1).max()
    assert far_m - 0.1 < body.reach_m <= far_m


@pytest.mark.parametrize("way", WAYS)
def test_without_a_body_all_patches_stay(way: str) -> None:
    patches = in_yard(way, deck=False)
    assert without_own_body(patches, WAYS[way], CONFIG) == (patches, ())


def test_a_vehicle_that_stands_loses_nothing() -> None:
    for way_m in (0.0, 6.0):
        patches = read(yard(), straight(way_m), DECK)
        assert on_deck(patches).sum() > 100
        assert without_own_body(patches, straight(way_m), CONFIG) == (patches, ())


def test_a_platform_along_a_straight_way_stays_and_so_do_walls() -> None:
    """It stands still in the frame of the LiDAR as well, 0.9 m above the track."""
    top = [np.array([-60.0, 2.0, 0.9]), np.array([120.0, 0.0, 0.0]), np.array([0.0, 4.0, 0.0])]
    edge = wall(0.0, 2.0, 0.0, 120.0, 0.9)
    roof = [np.array([-60.0, -5.0, 4.0]), np.array([120.0, 0.0, 0.0]), np.array([0.0, 7.0, 0.0])]
    world = world_of(ground(), top, edge, wall(0.0, 6.0, 0.0, 120.0), wall(0, -4, 0, 120.0), roof)
    patches = read(world, straight(60.0), None)
    centres, normals = in_vehicle(patches)
    level = normals[:, 2] > 0.95
    assert (level & (np.abs(centres[:, 2] - 0.9) < 0.03)).sum() > 300
    assert (level & (np.abs(centres[:, 2]) < 0.1)).sum() > 1000
    # At the edge ground is seen below, on one side; with better guesses it counts as lower.
    for config in (CONFIG, with_sigma(0.2)):
        assert without_own_body(patches, straight(60.0), config) == (patches, ())


def test_a_table_with_ground_below_it_stays() -> None:
    """It stands still in the map, not in the frame of a LiDAR."""
    top = [np.array([10.2, -11.0, 0.9]), np.array([1.8, 0.0, 0.0]), np.array([0.0, 2.5, 0.0])]
    both = [np.vstack([getattr(yard(), f), [a]]) for f, a in zip(FIELDS, top, strict=True)]
    patches = read(World(*both), EIGHT, None)
    centres_map, level = _in_map(patches, EIGHT, [s.T_vehicle_lidar for s in lidars(None).values()])
    on_table = level & (np.abs(centres_map[:, 2] - 0.9) < 0.03)
    assert on_table.sum() > 30
    assert without_own_body(patches, EIGHT, with_sigma(0.5)) == (patches, ())


def test_ground_is_below_a_place_where_it_is_seen_all_about_it() -> None:
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-4.5, 5.0), np.arange(-4.5, 5.0)))
    at, limit_m = np.array([[0.3, 0.4, 7.2]]), np.array([0.5])

    def above(seen: BoolArray, height_m: float = 0.0, path: float = 7.9) -> bool:
        ground_at = np.column_stack([x, y, np.full(len(x), path)])[seen]
        return bool(_above_ground(at, limit_m, ground_at, np.full(seen.sum(), height_m))[0])

    everywhere = np.ones(len(x), dtype=bool)
    assert above(everywhere)
    assert above((x + y) % 2.0 == 0.0)
    assert not above(everywhere, height_m=0.6)
    assert above(everywhere, path=6.1)
    assert not above(everywhere, path=5.9)
    # At an edge, however it runs: half of the columns, all to one side.
    assert not above(y < 0.0)
    assert not above(x + y < 0.5)
    # Too few of them.
    assert not above(np.hypot(x, y) < 1.0)


@pytest.mark.parametrize("way", WAYS)
def test_a_deck_below_which_no_ground_is_seen_turns_with_the_vehicle(way: str) -> None:
    """The road that the vehicle drives on is out of view, as of LiDARs that look to the sides."""
    trajectory, patches = WAYS[way], in_yard(way, deck=True)
    deck = on_deck(patches)
    _, at = trajectory.poses_at(np.unique(patches.stamps_ns))
    spinners = lidars(None).values()
    centres_map, level = _in_map(patches, trajectory, [s.T_vehicle_lidar for s in spinners])
    road = level & ~deck & (cKDTree(at[:, :2]).query(centres_map[:, :2])[0] < 4.0)
    aside = patches.part(~road)

    left, found = without_own_body(aside, trajectory, STATED)

    turns = way != "straight"
    assert (on_deck(left).sum() <= 0.02 * deck.sum()) == turns
    assert [body.lidar for body in found] == ["rear"] * turns
    # Without a stated height it may be a road on a bank.
    assert without_own_body(aside, trajectory, CONFIG)[1] == ()


def test_a_road_above_the_fields_beside_it_stays() -> None:
    """It turns with the vehicle as well, 1.5 m above what is 3 m and more from the path."""
    patches = in_yard("eight", deck=False)
    _, at = EIGHT.poses_at(np.unique(patches.stamps_ns))
    spinners = lidars(None).values()
    centres_map, level = _in_map(patches, EIGHT, [s.T_vehicle_lidar for s in spinners])
    field = level & (cKDTree(at[:, :2]).query(centres_map[:, :2])[0] > 3.0)
    assert 0.2 < field.sum() / level.sum() < 0.8
    lowered = np.tile(np.eye(4), (len(field), 1, 1))
    lowered[field, :3, 3] = -1.5 * patches.normal_lidar[field]
    moments = lowered @ patches.moments @ lowered.transpose(0, 2, 1)
    bank = replace(patches, moments=moments)
    assert np.ptp(_in_map(bank, EIGHT, [s.T_vehicle_lidar for s in spinners])[0][level, 2]) > 1.4

    for config in (CONFIG, STATED):
        assert without_own_body(bank, EIGHT, config) == (bank, ())


def test_guesses_too_rough_to_tell_body_from_ground_leave_it() -> None:
    """With sigmas of 10 degrees the ground may be as high as the deck."""
    patches = in_yard("eight", deck=True)
    assert without_own_body(patches, EIGHT, with_sigma(10.0)) == (patches, ())


def with_sigma(degrees: float) -> Config:
    """The config with another sigma of the rotations."""
    lidars = {
        name: lidar.model_copy(
            update={"sigma": lidar.sigma.model_copy(update={"rpy_deg": (degrees,) * 3})}
        )
        for name, lidar in CONFIG.lidars.items()
    }
    return CONFIG.model_copy(update={"lidars": lidars})


def test_a_second_lidar_that_sees_no_body_keeps_all() -> None:
    patches = in_yard("eight", deck=True)
    left, _ = without_own_body(patches, EIGHT, CONFIG)
    count = [int((p.scan_lidar[p.scan] == 0).sum()) for p in (patches, left)]
    assert count[0] == count[1] > 1000
