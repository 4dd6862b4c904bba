"""Mountings found from a drive: what is read, LiDARs with and without a guess, what is refused."""

from __future__ import annotations

import math
from collections.abc import Iterator

import gtsam
import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.guesses import configured_guess
from caliv_graph.errors import ConfigError
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.mounting.place import place_lidars
from tests.mounting.posts import AHEAD, SPIN, Drive, config_of, views_kept

DRIVE = Drive({"spin": SPIN, "ahead": AHEAD})


@pytest.fixture(scope="module", autouse=True)
def keep_views() -> Iterator[None]:
    with views_kept():
        yield


def error(found: gtsam.Pose3, true: gtsam.Pose3) -> tuple[float, float]:
    off = vehicle_axes_difference(found, true)
    return math.degrees(float(np.abs(off[:3]).max())), float(np.abs(off[3:]).max())


def test_two_lidars_are_found_from_nothing() -> None:
    config, placements = place_lidars(
        [DRIVE], [DRIVE.way], config_of("spin", "ahead"), SilentProgress()
    )
    assert [p.lidar for p in placements] == ["spin", "ahead"]
    for name, true in DRIVE.mountings.items():
        degrees, metres = error(config.lidars[name].guess(), true)
        assert degrees < 2.0
        assert metres < 0.25
        assert configured_guess(config, name).found
    assert not any(p.others for p in placements)


def test_a_guess_that_is_given_stays() -> None:
    given = config_of("spin", ahead=AHEAD)
    config, (placement,) = place_lidars([DRIVE], [DRIVE.way], given, SilentProgress())
    assert placement.lidar == "spin"
    assert config.lidars["ahead"] is given.lidars["ahead"]
    assert error(config.lidars["spin"].guess(), SPIN)[1] < 0.25
    untouched, none = place_lidars(
        [DRIVE], [DRIVE.way], config_of(spin=SPIN, ahead=AHEAD), SilentProgress()
    )
    assert none == ()
    assert untouched == config_of(spin=SPIN, ahead=AHEAD)


def test_a_lidar_with_a_guess_need_not_see_the_ground() -> None:
    drive = Drive({"spin": SPIN, "ahead": AHEAD}, blind="ahead")
    config, (placement,) = place_lidars(
        [drive], [drive.way], config_of("spin", ahead=AHEAD), SilentProgress()
    )
    assert placement.lidar == "spin"
    assert error(config.lidars["spin"].guess(), SPIN)[1] < 0.25


@pytest.mark.parametrize(
    ("drive", "said"),
    [
        (Drive({"spin": SPIN}, ground=False), "sees no ground"),
        (Drive({"spin": SPIN}, posts=False), "nothing stands on the ground"),
    ],
)
def test_what_cannot_be_found_is_said(drive: Drive, said: str) -> None:
    with pytest.raises(ConfigError, match=rf"lidars.spin.initial is not given.*{said}.*Enter"):
        place_lidars([drive], [drive.way], config_of("spin"), SilentProgress())
