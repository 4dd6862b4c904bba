"""The candidate whose clouds agree on one place is the target; why others do not is named."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.choose import (
    Agreement,
    agreement,
    choose_static,
    displaced,
    displaced_or_misguessed,
)
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.model import Config, SolveConfig, TargetRegion
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import TargetError
from caliv_graph.products import (
    Array,
    IntArray,
    Surface,
    TargetCloud,
    TargetObservation,
    Trajectory,
)
from caliv_graph.scenario.drive_models import FigureEightDrive
from caliv_graph.scenario.drives import make_drive
from caliv_graph.targets.cloud.choice import TriedCandidate
from caliv_graph.targets.search import FoundTarget
from caliv_graph.trajectory.select import GivenTrajectory

DRIVE = make_drive(FigureEightDrive(radius_m=9.16))
MOUNTS = {
    "front": PoseConfig(xyz=(2.0, 0.0, 2.0), rpy_deg=(0.0, 10.0, 0.0)),
    "rear": PoseConfig(xyz=(-0.4, 0.0, 2.0), rpy_deg=(0.0, 10.0, 180.0)),
}
CONFIG = Config(lidars={n: LidarConfig(topic=n, initial=mount) for n, mount in MOUNTS.items()})
MIDDLE, BESIDE = np.array([0.0, 0.0, 0.6]), np.array([1.0, 0.6, 0.0])
CHAIR, WALKER = np.array([12.1, 0.0, 0.0]), np.array([10.5, -2.0, 0.0])


@functools.cache
def trajectory() -> GivenTrajectory:
    stamps: IntArray = np.arange(0, round(DRIVE.duration_s * 1e9), 20_000_000).astype(np.int64)
    return GivenTrajectory(Trajectory(stamps, DRIVE.poses(stamps)))


@functools.cache
def shape() -> Array:
    """(n, 3) points of a corner of two boards, 0.8 m high."""
    u = np.tile(np.linspace(0.0, 0.5, 10), 10)
    v = np.repeat(np.linspace(0.2, 1.0, 10), 10)
    return np.vstack(
        [
            np.column_stack([u - 0.25, 0.0 * u, v]),
            np.column_stack([0.0 * u, u * 0.7, v]),
            np.column_stack([u - 0.25, 0.7 * v - 0.2, 0.0 * v + 0.5]),
        ]
    )


def leaves(rng: np.random.Generator) -> Array:
    """(n, 3) points of a bush of that size: others in each scan."""
    return rng.uniform([-0.7, -0.7, 0.1], [0.7, 0.7, 1.5], (150, 3))


def observation(
    at: Array,
    velocity: Sequence[float] = (0.0, 0.0, 0.0),
    late_s: float = 0.0,
    bush: bool = False,
) -> TargetObservation:
    """Clouds of an object that all LiDARs see all round, in both circles."""
    rng = np.random.default_rng(1)
    clouds = []
    last_s = DRIVE.duration_s
    for name, mount in MOUNTS.items():
        for time_s in np.linspace(3.0, last_s - 3.0, 16).tolist():
            (T,) = DRIVE.poses(np.array([round((time_s - late_s) * 1e9)]))
            where = at + np.array(velocity) * (time_s - 0.5 * last_s)
            seen = leaves(rng) if bush else shape()
            points = T.compose(mount.pose()).transformTo((seen + where).T).T
            points = points + rng.normal(0.0, 0.01, points.shape)
            clouds.append(TargetCloud(name, 0, round(time_s * 1e9), points, f"{time_s}"))
    return TargetObservation(0, "target", at + MIDDLE, tuple(clouds))


def candidate(
    of: TargetObservation, at: Array, score: float, doubtful: bool = False
) -> TriedCandidate:
    x, y, _ = at.tolist()
    found = FoundTarget(
        drive=0,
        region=TargetRegion(min=(x - 1, y - 1, -1), max=(x + 1, y + 1, 2)),
        centre_map=at + MIDDLE,
        extent_m=0.5,
        height_m=1.0,
        scans={"front": 10, "rear": 10},
        looked_at={"front": 60, "rear": 60},
        aligned={name: mount.pose() for name, mount in MOUNTS.items()},
        doubtful=doubtful,
        score=score,
    )
    return TriedCandidate(found, (of,))


def test_what_walks_loses_however_well_it_is_seen() -> None:
    walker = candidate(observation(WALKER, velocity=(0.02, 0.03, 0.0)), WALKER, score=90.0)
    chair = candidate(observation(CHAIR), CHAIR, score=20.0, doubtful=True)
    choice = choose_static([walker, chair], trajectory(), CONFIG)
    assert choice.index == 1
    (reason,) = choice.reasons
    assert "those of other objects agree less: (10.5, -2.0)" in reason
    assert "fit too" not in reason


def test_of_two_static_ones_the_better_seen_wins_and_the_other_is_named() -> None:
    box = candidate(observation(WALKER), WALKER, score=20.0)
    chair = candidate(observation(CHAIR), CHAIR, score=90.0)
    choice = choose_static([box, chair], trajectory(), CONFIG)
    assert choice.index == 1
    (reason,) = choice.reasons
    assert "Other static objects fit too: (10.5, -2.0) 0.5 m wide 1.0 m high" in reason


def test_the_clouds_of_a_bush_show_no_surface() -> None:
    bush, chair = observation(WALKER, bush=True), observation(CHAIR)
    assert agreement(candidate(bush, WALKER, 1.0), trajectory(), CONFIG).foliage
    assert not agreement(candidate(chair, CHAIR, 1.0), trajectory(), CONFIG).foliage


@pytest.mark.parametrize("bushes", [(True, False), (True, True), (False, False)])
def test_a_bush_loses_however_well_it_is_seen(
    bushes: tuple[bool, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = (Surface({"front": 0.05 if of else 0.01}, {"front": 0.01}) for of in bushes)
    nothing = TargetObservation(0, "target", CHAIR, ())
    seen = candidate(nothing, WALKER, score=90.0), candidate(nothing, CHAIR, score=20.0)
    found = iter([Agreement(0.01, surface=first), Agreement(0.02, surface=second)])
    monkeypatch.setattr("caliv_graph.calibration.choose.agreement", lambda *_: next(found))
    choice = choose_static(seen, trajectory(), CONFIG)
    (reason,) = choice.reasons
    if bushes == (True, False):
        assert choice.index == 1
        assert reason.startswith("chosen because others show no surface, as bushes do: (10.5, -2.0")
    else:
        assert choice.index == 0
        assert "Other static objects fit too: (12.1, 0.0)" in reason


def test_two_proposals_of_one_object_are_one() -> None:
    chair = observation(CHAIR)
    beside = candidate(chair, CHAIR + BESIDE, score=90.0)
    choice = choose_static([beside, candidate(chair, CHAIR, score=20.0)], trajectory(), CONFIG)
    assert choice.index == 1
    assert choice.reasons == ()


def test_a_drive_with_a_walker_alone_has_no_target() -> None:
    walker = candidate(observation(WALKER, (0.02, 0.03, 0.0)), WALKER, 90.0, doubtful=True)
    with pytest.raises(TargetError, match=r"none found that stands still: \(10\.5, -2\.0\)"):
        choose_static([walker], trajectory(), CONFIG)


def test_one_candidate_without_a_doubt_is_not_tried() -> None:
    nothing = TargetObservation(0, "target", CHAIR, ())
    assert choose_static([candidate(nothing, CHAIR, 1.0)], trajectory(), CONFIG).index == 0


def test_late_stamps_of_all_lidars_are_named_with_their_value() -> None:
    late = observation(CHAIR, late_s=0.1)
    (sentence,) = displaced([late], [trajectory()], CONFIG)
    assert "those of 'front' by +0.1" in sentence
    assert "those of 'rear' by +0.1" in sentence
    freed = CONFIG.model_copy(update={"solve": SolveConfig(time_offset=True)})
    assert displaced([late], [trajectory()], freed) == ()


def guessed(error: gtsam.Pose3, in_vehicle: bool) -> Config:
    """The config with guesses that are off alike, in vehicle or in LiDAR axes."""
    lidars = {}
    for name, mount in MOUNTS.items():
        T = error.compose(mount.pose()) if in_vehicle else mount.pose().compose(error)
        x, y, z = T.translation().tolist()
        roll, pitch, yaw = np.degrees(T.rotation().rpy()).tolist()
        lidars[name] = CONFIG.lidars[name].model_copy(
            update={"initial": PoseConfig(xyz=(x, y, z), rpy_deg=(roll, pitch, yaw))}
        )
    return CONFIG.model_copy(update={"lidars": lidars})


def test_guesses_that_are_off_alike_are_named_as_the_solve_names_them() -> None:
    """The clouds of both lie at one place, and at the wrong one: nothing scatters."""
    off = gtsam.Pose3(gtsam.Rot3.Rz(np.radians(15.0)), np.array([0.6, -0.5, 0.0]))
    seen, path, config = [observation(CHAIR)], [trajectory()], guessed(off, in_vehicle=True)
    assert displaced(seen, path, config) == ()

    (both,) = displaced_or_misguessed(seen, path, config, ["front", "rear"])

    assert both.startswith("lidars 'front' and 'rear': the initial guesses of all are off by the")
    assert "-15.0) degrees (roll, pitch, yaw)" in both
    # What another search replaced is said there.
    (rear,) = displaced_or_misguessed(seen, path, config, ["rear"])
    assert rear.startswith("lidar 'rear': ")
    assert "yaw differs from the initial guess" in rear
    assert "T_vehicle_lidar and not its inverse" in rear


def test_nothing_is_said_of_a_good_drive_from_rough_guesses() -> None:
    off = gtsam.Pose3.Expmap(np.array([0.04, -0.05, 0.05, 0.08, -0.1, 0.05]))
    config = guessed(off, in_vehicle=False)
    assert displaced_or_misguessed([observation(CHAIR)], [trajectory()], config, MOUNTS) == ()
    assert displaced([observation(CHAIR)], [trajectory()], config) == ()
    nothing = replace(observation(CHAIR), clouds=())
    assert displaced([nothing], [trajectory()], config) == ()
