"""Clouds that were deskewed before they were recorded: found where a sweep meets itself."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import Config
from caliv_graph.products import Array, BoolArray
from caliv_graph.structure.deskewed import MotionLeft, motion_left
from caliv_graph.structure.patches import DrivePatches, Swept
from caliv_graph.structure.read import read_patches
from caliv_graph.trajectory.select import GivenTrajectory
from tests.samples import pose
from tests.structure.worlds import (
    Spinner,
    World,
    deskewed_before,
    driven,
    ground,
    guessed,
    near_yard,
    recorded,
    world_of,
    yard,
)
from tests.trajectory.motions import eight_drive

TRUTH = pose((1.0, 0.3, 1.8), (2.0, 3.0, 20.0))
OFF = gtsam.Pose3(gtsam.Rot3.Expmap(np.radians([1.5, -1.0, 3.0])), np.array([0.1, -0.1, 0.05]))
GUESS = TRUTH * OFF
EIGHT = driven(eight_drive())
CONFIG = Config(lidars=guessed({"roof": GUESS}))


def spinner(degrees: float = 360.0, sweep_s: float = 0.1) -> Spinner:
    return Spinner(
        TRUTH,
        np.arange(-20.0, 12.0, 2.0),
        np.linspace(-0.5 * degrees, 0.5 * degrees, round(2 * degrees), endpoint=False),
        sweep_s=sweep_s,
    )


def read(world: World, trajectory: GivenTrajectory, lidar: Spinner, moved: bool) -> DrivePatches:
    begin, end = trajectory.span_ns
    stamps = np.arange(begin + 100_000_000, end - 100_000_000, 750_000_000, dtype=np.int64)
    recording = recorded(world, trajectory, {"roof": lidar}, {"roof": stamps})
    if moved:
        recording = deskewed_before(recording, trajectory, {"roof": TRUTH})
    (patches,) = read_patches([recording], [trajectory], CONFIG, SilentProgress(), keep_level=True)
    return patches


def told(patches: DrivePatches, trajectory: GivenTrajectory = EIGHT) -> MotionLeft | None:
    return motion_left([patches], [trajectory], {"roof": GUESS}).get("roof")


@cache
def in_yard(moved: bool) -> DrivePatches:
    return read(near_yard(), EIGHT, spinner(), moved)


def found(moved: bool) -> MotionLeft:
    left = told(in_yard(moved))
    assert left is not None
    return left


def test_measured_points_have_all_of_the_motion() -> None:
    left = found(moved=False)

    assert left.share == pytest.approx(1.0, abs=0.1)
    assert left.measured
    assert not left.deskewed


def test_deskewed_points_have_none() -> None:
    left = found(moved=True)

    assert left.share == pytest.approx(0.0, abs=0.1)
    assert left.deskewed
    assert not left.measured


@pytest.mark.parametrize(
    ("world", "lidar"),
    [
        (world_of(ground()), spinner()),
        (yard(), spinner(sweep_s=0.0)),
        (yard(), spinner(degrees=120.0)),
    ],
    ids=["ground alone", "at an instant", "no end that meets the beginning"],
)
def test_what_is_not_seen_at_two_times_tells_nothing(world: World, lidar: Spinner) -> None:
    assert told(read(world, EIGHT, lidar, moved=False)) is None


def test_the_vehicle_itself_and_a_car_that_follows_do_not_look_deskewed() -> None:
    # Upright across the motion, where the sweep ends and begins: a cab of 3 m, a car at 8 m.
    for behind_m in (2.0, 8.0):
        plate = world_of(
            [np.array([-behind_m, -2.5, 0.5]), np.array([0.0, 3.0, 0.0]), np.array([0.0, 0.0, 3.0])]
        )
        seen = read(near_yard(), EIGHT, replace(spinner(), body=plate), moved=False)
        on_plate = np.abs(np.linalg.norm(seen.centres_lidar, axis=1) - behind_m - 1.5) < 1.5
        assert np.count_nonzero(on_plate) > 100
        left = told(seen)
        assert left is None or left.measured


def stacked(*parts: tuple[DrivePatches, BoolArray]) -> DrivePatches:
    """Patches of the same scans from several, in the order of the scans."""
    order = np.argsort(np.concatenate([of.scan[keep] for of, keep in parts]), kind="stable")

    def together(values: list[Array]) -> Array:
        return np.asarray(np.concatenate(values)[order])

    swept = [of.swept.part(keep) for of, keep in parts if of.swept is not None]
    return replace(
        parts[0][0],
        scan=np.concatenate([of.scan[keep] for of, keep in parts])[order],
        time_s=together([of.time_s[keep] for of, keep in parts]),
        moments=together([of.moments[keep] for of, keep in parts]),
        normal_lidar=together([of.normal_lidar[keep] for of, keep in parts]),
        scatter_m=together([of.scatter_m[keep] for of, keep in parts]),
        swept=Swept(
            together([of.moments for of in swept]), together([of.twist_lidar for of in swept])
        ),
        channels=None,
    )


def test_a_few_scans_of_something_else_change_nothing() -> None:
    measured, moved = in_yard(moved=False), in_yard(moved=True)
    some = [of.scan % 8 == 0 for of in (measured, moved)]
    left = told(stacked((measured, ~some[0]), (moved, some[1])))
    assert left is not None
    assert left.measured
    assert left.share == pytest.approx(found(moved=False).share, abs=0.05)


@pytest.mark.parametrize(
    ("left", "answer"),
    [
        (MotionLeft(0.0, 0.1, 50, 0.8, 0.0), "deskewed"),
        (MotionLeft(1.0, 0.1, 50, 0.0, 0.8), "measured"),
        (MotionLeft(0.0, 0.1, 50, 0.6, 0.2), ""),
        (MotionLeft(0.0, 0.25, 50, 0.9, 0.0), ""),
        (MotionLeft(1.0, 0.25, 50, 0.0, 0.9), ""),
        (MotionLeft(0.5, 0.1, 50, 0.4, 0.4), ""),
        # Of an open place, random drive 248: what moved there, on grass.
        (MotionLeft(-0.52, 0.21, 50, 0.3, 0.0), ""),
        (MotionLeft(-0.4, 0.1, 50, 0.8, 0.0), ""),
    ],
)
def test_an_answer_is_near_and_most_scans_agree(left: MotionLeft, answer: str) -> None:
    assert (left.deskewed, left.measured) == (answer == "deskewed", answer == "measured")
