"""Usual mistakes that a drive shows: topics exchanged, a guess or the heading a quarter turn off.

What stands still is seen at its place again and again only with the right mountings on the right
path. Each mistake is undone on trial; where the maps become much sharper, it was made. No target
is needed for this, and no guess that is nearly right.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import gtsam
import numpy as np

from caliv_graph.common.progress import Progress
from caliv_graph.config.lidars import FoundLidarConfig
from caliv_graph.config.model import Config
from caliv_graph.errors import ConfigError
from caliv_graph.mounting.place import View, in_level_axes, view_of
from caliv_graph.mounting.sharpness import difference_m, sharpest_near
from caliv_graph.products import Array, Recording
from caliv_graph.targets.search.find import scans_to_read
from caliv_graph.trajectory.select import GivenTrajectory, VehicleTrajectory

Kind = Literal["exchanged", "turned", "upside_down", "heading", "mirrored", "left_handed"]

SHARPER = 1.6
"""Times as many points at one place from which a mistake is said. Measured on an arc and an S-curve
past a chair and a few other objects: 2.3 to 15 for what was wrong, 1.3 at most for what was not."""

LEAST_OF_PAIR, PAIR_SHARPER = 1.2, 2.0
"""Of two LiDARs whose guesses are exchanged: the gain of each, and of both multiplied. What was not
wrong has 1.3 each, 1.7 together, at most. Guesses with y to the right in a street, whose tilts are
wrong as well, had 1.3 and 2.0; one of them alone seemed turned by 90 degrees, with 1.7."""

ALIKE = 0.9
"""Explanations that sharpen the maps nearly as much: then the one whose guesses are nearer holds.
On an arc a mounting may turn about the centre of the arc."""

HANGS_M = 0.4
"""Largest difference between the height of a LiDAR by its guess and by the ground, if it hangs."""

UPSIDE_DOWN = math.cos(math.radians(135.0))
"""Cosine of the angle between up by the guess and up by the ground, from which a LiDAR hangs."""

QUARTERS = (180, 90, -90)
"""Turns that are tried, degrees: axes that were taken for others."""


@dataclass(frozen=True)
class Doubt:
    """A mistake that explains what the LiDARs see.

    Attributes:
        drive: index of the drive that shows it.
        name: of its recording.
        kind: `exchanged`: two LiDARs have each other's guess. `turned`: the guess of one is.
            `upside_down`: the same about an axis of the LiDAR that lies in its horizon.
            `heading`: that of the vehicle is, against its path. `mirrored`: the path turns right
            where the vehicle turned left, or all clouds are left-handed, which looks the same.
            `left_handed`: the clouds have x forward, y to the right and z up.
        lidars: whose maps become sharper.
        turn_deg: of `turned` and `heading`: of the guess or the heading against the right one,
            counted to the left. Of `upside_down`: 0 about x (roll), 90 about y (pitch).
        sharing: points that share a cell (`sharpness.sharpest_near`), now and without the mistake,
            of each of `lidars`.
        given: whether poses were given.
    """

    drive: int
    name: str
    kind: Kind
    lidars: tuple[str, ...]
    turn_deg: int
    sharing: Mapping[str, tuple[float, float]]
    given: bool


@dataclass(frozen=True)
class _Trial:
    """A mistake undone: mountings of some LiDARs, and the way or the clouds in a mirror."""

    kind: Kind
    turn_deg: int
    T_vehicle_lidar: Mapping[str, gtsam.Pose3]

    def undone(self, view: View) -> View:
        """What a LiDAR sees without the mistake."""
        if self.kind == "mirrored":
            return replace(view, sightings=view.sightings.mirrored)
        return view.right_handed if self.kind == "left_handed" else view


def doubts(
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
    blamed: Collection[str] = (),
) -> tuple[Doubt, ...]:
    """The mistake that each drive shows, if it shows one; the same one of a guess only once.

    Clouds are read again: it is asked where something is wrong already. `blamed` are LiDARs whose
    guess a solve contradicts: only of these is it asked whether they are upside down, as a ceiling
    looks like the ground of a LiDAR that hangs.

    Raises:
        RecordingError: a cloud could not be read.
        TrajectoryError: times of points are invalid.
    """
    found: dict[tuple[object, ...], Doubt] = {}
    names = [
        name
        for name, lidar in config.lidars.items()
        if lidar.initial is not None and not isinstance(lidar, FoundLidarConfig)
    ]
    for drive, (recording, trajectory) in enumerate(zip(recordings, trajectories, strict=True)):
        given = isinstance(trajectory, GivenTrajectory)
        if isinstance(trajectory, GivenTrajectory) and trajectory.odometry is not None:
            continue  # its path is that of a guess
        views = _views(recording, trajectory, config, names, progress)
        doubt = _of_drive(drive, recording.name, views, config, given, blamed)
        if doubt is not None:
            of = () if doubt.kind in ("exchanged", "turned", "upside_down") else (drive,)
            found.setdefault((doubt.kind, doubt.lidars, *of), doubt)
    return tuple(found.values())


def _views(
    recording: Recording,
    trajectory: VehicleTrajectory,
    config: Config,
    names: Sequence[str],
    progress: Progress,
) -> dict[str, View]:
    """What each LiDAR sees, of those that see the ground and what stands on it."""
    stamps = {n: scans_to_read(recording.scan_stamps_ns(n), trajectory) for n in names}
    views = {}
    with progress.stage("looking for mistakes", sum(map(len, stamps.values()))) as advance:
        for name in names:
            try:
                views[name] = view_of(recording, trajectory, config, name, stamps[name], advance)
            except ConfigError:
                continue
    return views


def _of_drive(
    drive: int,
    name: str,
    views: Mapping[str, View],
    config: Config,
    given: bool,
    blamed: Collection[str],
) -> Doubt | None:
    """The mistake whose undoing sharpens the maps most; None if none does by much."""
    guesses = {n: config.lidars[n].guess() for n in views}
    for n, T in guesses.items():
        if n in blamed and _hangs(T, views[n], config):
            return _upside_down(drive, name, n, views[n], T, given)
    now = {n: _sharpness(views[n], T)[0] for n, T in guesses.items()}
    best: tuple[float, float, _Trial, dict[str, float]] | None = None
    for trial in _trials(guesses, given):
        then, moved_m = {}, 0.0
        for n, T in trial.T_vehicle_lidar.items():
            then[n], off_m = _sharpness(trial.undone(views[n]), T)
            moved_m += off_m
        gains = np.array([then[n] / now[n] for n in then])
        if not _explains(gains, trial.kind):
            continue
        gain = float(np.log(gains).sum())
        alike = -math.log(ALIKE) * max(len(gains), 1)
        if best is None or gain > best[0] + alike or (gain > best[0] - alike and moved_m < best[1]):
            best = gain, moved_m, trial, then
    if best is None:
        return None
    _, _, trial, then = best
    sharing = {n: (now[n], then[n]) for n in then}
    return Doubt(drive, name, trial.kind, tuple(then), trial.turn_deg, sharing, given)


def _hangs(guess: gtsam.Pose3, view: View, config: Config) -> bool:
    """Whether the ground lies above a LiDAR by its guess, as far away as the guess has it below."""
    if np.asarray(guess.rotation().matrix())[2] @ view.ground.up_lidar > UPSIDE_DOWN:
        return False
    height_m = config.ground.vehicle_height
    return height_m is None or abs(guess.z() + height_m - view.ground.height_m) < HANGS_M


def _upside_down(
    drive: int, name: str, lidar: str, view: View, guess: gtsam.Pose3, given: bool
) -> Doubt:
    """Which way it is turned over: maps are drawn in level axes, and only yaw makes them sharp."""
    now, _ = _sharpness(view, guess)
    sharp = {turn: _sharpness(view, turned_over(guess, turn))[0] for turn in (0, 90)}
    turn = max(sharp, key=sharp.__getitem__)
    return Doubt(drive, name, "upside_down", (lidar,), turn, {lidar: (now, sharp[turn])}, given)


def turned_over(T_vehicle_lidar: gtsam.Pose3, turn_deg: int) -> gtsam.Pose3:
    """A mounting the other way up: about x of the LiDAR (0) or about its y (90)."""
    about = gtsam.Rot3.Rx(math.pi) if turn_deg == 0 else gtsam.Rot3.Ry(math.pi)
    rotation = T_vehicle_lidar.rotation().compose(about)
    return gtsam.Pose3(rotation, T_vehicle_lidar.translation())


def _explains(gains: Array, kind: Kind) -> bool:
    """Whether the maps are so much sharper; of what concerns all, those of most."""
    if kind == "exchanged":
        return bool(gains.min() >= LEAST_OF_PAIR and gains.prod() >= PAIR_SHARPER)
    if kind in ("heading", "mirrored"):
        return bool(np.sort(gains)[(len(gains) - 1) // 2] >= SHARPER and gains.min() >= ALIKE)
    return bool(gains.min() >= SHARPER)


def _sharpness(view: View, T_vehicle_lidar: gtsam.Pose3) -> tuple[float, float]:
    """The sharpness near a mounting, and how far from it, metres at 15 m."""
    start = in_level_axes(view, T_vehicle_lidar)
    found, sharing = sharpest_near(view.sightings, start)
    return sharing, difference_m(found, start)


def _trials(guesses: Mapping[str, gtsam.Pose3], given: bool) -> Iterator[_Trial]:
    """All that is tried, for LiDARs with these guesses."""
    names = list(guesses)
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            yield _Trial("exchanged", 0, {a: guesses[b], b: guesses[a]})
    for turn in QUARTERS:
        back = gtsam.Rot3.Yaw(-math.radians(turn))
        for name, T in guesses.items():
            alone = gtsam.Pose3(back.compose(T.rotation()), T.translation())
            yield _Trial("turned", turn, {name: alone})
    if not guesses:
        return
    for turn in QUARTERS:
        # A heading that is turned turns all that is seen about the vehicle.
        turned = gtsam.Pose3(gtsam.Rot3.Yaw(-math.radians(turn)), np.zeros(3))
        yield _Trial("heading", turn, {name: turned.compose(T) for name, T in guesses.items()})
    if given:
        yield _Trial("mirrored", 0, guesses)
    elif len(guesses) > 1:
        yield _Trial("left_handed", 0, guesses)
    if not given or len(guesses) > 1:
        for name, T in guesses.items():
            yield _Trial("left_handed", 0, {name: T})
