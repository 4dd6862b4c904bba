"""Places of a target: made-up candidates with known moves."""

from __future__ import annotations

import math
from collections.abc import Callable

import gtsam
import numpy as np
import pytest

from caliv_graph.products import Array, Trajectory
from caliv_graph.targets.cloud.moved import CandidateCentres, Period, periods
from caliv_graph.trajectory.select import GivenTrajectory

Where = Callable[[float], Array | None]

A, B, C = (np.array(p) for p in ([8.0, 2.0, -1.4], [6.5, -3.0, -1.4], [10.0, 0.5, -1.4]))
BYSTANDER = np.array([9.0, 4.0, -1.2])


def standing(seconds: float, drives_after_s: float = math.inf) -> GivenTrajectory:
    """A vehicle that stands, and from some time on goes straight ahead at 2 m/s."""
    times = np.arange(0.0, seconds + 0.05, 0.1)
    poses = tuple(
        gtsam.Pose3(gtsam.Rot3(), np.array([2.0 * max(t - drives_after_s, 0.0), 0.0, 0.0]))
        for t in times
    )
    return GivenTrajectory(Trajectory((times * 1e9).round().astype(np.int64), poses))


def candidates(
    *things: Where, seconds: float = 30.0, rate_hz: float = 5.0, phase_s: float = 0.0, seed: int = 0
) -> CandidateCentres:
    """What a LiDAR sees of things; their middles scatter by 15 mm."""
    rng = np.random.default_rng(seed)
    stamps, centres = [], []
    for time in np.arange(phase_s, seconds, 1.0 / rate_hz):
        for thing in things:
            place = thing(float(time))
            if place is not None:
                stamps.append(round(1e9 * time))
                centres.append(place + 0.015 * rng.normal(size=3))
    return CandidateCentres(np.array(stamps, np.int64), np.array(centres).reshape(-1, 3))


def carried(time: float, begin: float, end: float, here: Array, there: Array) -> Array:
    return np.asarray(here + (there - here) * np.clip((time - begin) / (end - begin), 0.0, 1.0))


def a_then_b(time: float) -> Array:
    """At A until 10 s, at B from 13 s on."""
    return carried(time, 10.0, 13.0, A, B)


def three_places(time: float) -> Array:
    """At A until 8 s, at B from 11 to 18 s, at C from 21 s on."""
    return a_then_b(time + 2.0) if time < 15.0 else carried(time, 18.0, 21.0, B, C)


def within(begin: float, end: float, where: Where) -> Where:
    return lambda time: where(time) if begin <= time <= end else None


def cuts_s(found: list[Period]) -> list[float]:
    return [period.end_ns / 1e9 for period in found[:-1]]


def places_of(found: list[Period], seen: CandidateCentres, name: str) -> list[list[float]]:
    """Mean place of what each period kept of a LiDAR, in decimetres."""
    out = []
    for period in found:
        members = seen.centres_lidar[period.members[name]]
        out.append(np.round(members.mean(axis=0), 1).tolist() if len(members) else [])
    return out


def test_what_stands_all_the_time_was_not_moved() -> None:
    assert periods({"front": candidates(lambda _: A)}, standing(30.0), 8) == []


def test_every_place_is_a_period_and_nothing_is_taken_on_the_way() -> None:
    seen = candidates(three_places)
    found = periods({"front": seen}, standing(30.0), 8)
    assert len(found) == 3
    first, second = cuts_s(found)
    assert 8.0 < first < 11.0
    assert 18.0 < second < 21.0
    assert places_of(found, seen, "front") == [A.tolist(), B.tolist(), C.tolist()]
    for period, place in zip(found, (A, B, C), strict=True):
        off = np.linalg.norm(seen.centres_lidar[period.members["front"]] - place, axis=1)
        # Scatter alone: no scan of the way, nor of the third of a second before and after it.
        assert off.max() < 0.08
        assert len(off) > 0.8 * 5.0 * 7.0


def test_lidars_with_other_clocks_and_rates_agree() -> None:
    front, left = candidates(three_places), candidates(three_places, rate_hz=9.7, phase_s=0.043)
    found = periods({"front": front, "left": left}, standing(30.0), 8)
    assert len(found) == 3
    assert places_of(found, left, "left") == [A.tolist(), B.tolist(), C.tolist()]


def test_a_place_that_one_lidar_does_not_see_is_a_period_of_the_others() -> None:
    def not_b(time: float) -> Array | None:
        place = three_places(time)
        return place if np.linalg.norm(place - B) > 0.5 else None

    front, left = candidates(three_places), candidates(not_b, phase_s=0.05)
    found = periods({"front": front, "left": left}, standing(30.0), 8)
    assert places_of(found, front, "front") == [A.tolist(), B.tolist(), C.tolist()]
    assert places_of(found, left, "left") == [A.tolist(), [], C.tolist()]


def test_lidars_that_never_see_it_at_once_see_it_at_two_places() -> None:
    # As one placement, these clouds would be laid over one another.
    front = candidates(within(0.0, 10.0, lambda _: A))
    left = candidates(within(13.0, 30.0, lambda _: B))
    found = periods({"front": front, "left": left}, standing(30.0), 8)
    assert len(found) == 2
    assert places_of(found, front, "front") == [A.tolist(), []]
    assert places_of(found, left, "left") == [[], B.tolist()]


@pytest.mark.parametrize(
    "other",
    [
        # Walks to and fro at 1.3 m/s, 4 m long.
        lambda t: np.array([7.0, 3.0 + abs((1.3 * t) % 8.0 - 4.0), -1.2]),
        # Stops twice for 5 s to look.
        lambda t: BYSTANDER if t % 15.0 < 5.0 else BYSTANDER + np.array([0.0, t % 15.0 - 5.0, 0.0]),
    ],
    ids=["walks", "stops"],
)
def test_somebody_else_in_the_region_is_no_move(other: Where) -> None:
    seen = candidates(lambda _: A, other)
    assert periods({"front": seen}, standing(30.0), 8) == []


def test_what_was_hidden_for_a_while_was_not_moved() -> None:
    seen = candidates(lambda t: None if 12.0 < t < 16.0 else A)
    assert periods({"front": seen}, standing(30.0), 8) == []


def test_a_short_stop_on_the_way_is_no_place() -> None:
    def pauses(time: float) -> Array:
        middle = 0.5 * (A + B)
        if time < 14.0:
            return carried(time, 10.0, 12.0, A, middle)
        return carried(time, 13.5, 15.5, middle, B)

    found = periods({"front": candidates(pauses)}, standing(30.0), 8)
    assert len(found) == 2


def test_while_the_vehicle_drives_nothing_is_taken_for_a_move() -> None:
    # What stands in the map comes nearer in the LiDAR's frame, in jumps where others hide it.
    def approached(time: float) -> Array | None:
        return None if 9.0 < time < 12.0 else A - np.array([2.0 * time, 0.0, 0.0])

    seen = candidates(approached)
    assert periods({"front": seen}, standing(30.0, drives_after_s=0.0), 8) == []


def test_the_way_after_the_last_place_belongs_to_it() -> None:
    # Moved while the vehicle stands, and then driven past.
    def seen_on_the_way(time: float) -> Array:
        driven = np.array([2.0 * max(time - 20.0, 0.0), 0.0, 0.0])
        return np.asarray(a_then_b(time) - driven)

    seen = candidates(seen_on_the_way, seconds=24.0)
    found = periods({"front": seen}, standing(24.0, drives_after_s=20.0), 8)
    assert len(found) == 2
    last = seen.stamps_ns[found[1].members["front"]] / 1e9
    driving = last[last > 20.5]
    assert len(driving) == int((seen.stamps_ns > 20.5e9).sum())
    assert [period.drove for period in found] == [False, True]
    assert seen.stamps_ns[found[0].members["front"]].max() < 10e9


def test_too_few_scans_are_no_place() -> None:
    # Two scans a second: some 18 of them at A.
    seen = candidates(a_then_b, rate_hz=2.0, seconds=20.0)
    assert periods({"front": seen}, standing(20.0), 18) == []
    assert len(periods({"front": seen}, standing(20.0), 8)) == 2


def test_nothing_seen_is_no_move() -> None:
    assert periods({"front": candidates()}, standing(30.0), 8) == []
