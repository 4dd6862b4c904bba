"""From parameters to the config's keys: the value that each suspect would take, in its unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from caliv_graph.calibration.clock_suspects import clock_solved_again, is_lidar_clock
from caliv_graph.calibration.motion_suspects import motion_scores
from caliv_graph.calibration.suspects import DRIFT_WAVES, suspect_scores
from caliv_graph.config.guesses import configured_guess
from caliv_graph.config.model import Config
from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import retract_vehicle_axes
from caliv_graph.products import Array, BoolArray, Guess, MotionData, Solution, Suspect
from caliv_graph.trajectory.parameters import (
    HEADING_YAW,
    IMU_ROTATION,
    LEVER_ARM,
    SECOND_ARM,
    WHEELS_ROTATION,
)
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.uncertainty.consistency import CONTRADICTION_SIGMAS
from caliv_graph.uncertainty.suspects import Freed, Ranked, ranking

FREE_ARM_M = 2.0
"""Sigma of a lever arm that is freed: antennas are within some metres of the vehicle's origin."""

FREE_ROTATION_DEG = 30.0
"""The same of the IMU's rotation, degrees."""

_POSE_UNITS = ("m",) * 3 + ("deg",) * 3
"""Of a pose as the config has it: xyz, then roll, pitch, yaw."""


@dataclass(frozen=True)
class _Quantity:
    """A vector in the unit of its key: present value, change, its sigma."""

    now: Array
    change: Array
    sigma: Array
    units: tuple[str, ...]
    determined: BoolArray
    value: Array | None = None


def ranked_suspects(
    solution: Solution,
    trajectories: Sequence[VehicleTrajectory],
    motions: Mapping[int, MotionData],
    config: Config,
    displaced: bool = False,
) -> tuple[Suspect, ...]:
    """The inputs of a calibration that could be wrong, ranked, in the units of the config's keys.

    `trajectories` are one per drive, `motions` by the index of the drive; `displaced`: some target
    is at one place only with late stamps or another guess (`choose.displaced`).

    Raises:
        SolveError: the graph is singular.
        TrajectoryError: the motion data leave the poses undetermined.
    """
    guesses = {name: configured_guess(config, name) for name in solution.lidars}
    ranked = ranking(suspect_scores(solution, trajectories, guesses))
    if ranked and (displaced or (_leads(ranked) and is_lidar_clock(ranked[0].candidate.name))):
        clock = clock_solved_again(ranked, solution, trajectories, motions, config, displaced)
        if clock is not None:
            return named_suspects(clock, config, guesses)
    ranked = _first_solved(ranked, solution, trajectories, motions, config)
    return named_suspects(ranked, config, guesses)


def _leads(ranked: Sequence[Ranked]) -> bool:
    """Whether the first explains a contradiction."""
    return bool(ranked) and ranked[0].freed.sigmas > CONTRADICTION_SIGMAS


def motion_suspects(
    trajectories: Sequence[VehicleTrajectory],
    motions: Mapping[int, MotionData],
    config: Config,
) -> tuple[Suspect, ...]:
    """What the motion data alone say of the smoothers' inputs, ranked: no cloud is needed.

    Arguments as of `ranked_suspects`. Empty where all poses were given.

    Raises:
        TrajectoryError: the motion data leave the trajectory undetermined.
    """
    ranked = ranking(motion_scores(trajectories))
    ranked = _first_solved(ranked, None, trajectories, motions, config)
    return named_suspects(ranked, config, {})


def _first_solved(
    ranked: tuple[Ranked, ...],
    solution: Solution | None,
    trajectories: Sequence[VehicleTrajectory],
    motions: Mapping[int, MotionData],
    config: Config,
) -> tuple[Ranked, ...]:
    """The ranking with the value of its first suspect as `solved_again` has it, if it matters."""
    if not _leads(ranked):
        return ranked
    first, *rest = ranked
    again = solved_again(first, solution, trajectories, motions, config)
    # How far the first linearisation contradicts stays; what the input takes is known better now.
    freed = replace(again, squares=first.freed.squares, dof=first.freed.dof)
    return (replace(first, freed=freed), *rest)


def solved_again(
    first: Ranked,
    solution: Solution | None,
    trajectories: Sequence[VehicleTrajectory],
    motions: Mapping[int, MotionData],
    config: Config,
) -> Freed:
    """The value of the first suspect, the smoother solved with it free, where it is one of its.

    A lever arm that is a metre off is far from linear: robust weights and the noise of the fixes
    were those of the wrong one. The clouds are as they were registered; without a `solution` the
    motion data say it alone.
    """
    name = first.candidate.name
    begun = np.where(first.freed.determined, first.freed.change, 0.0)
    free = freed_in_smoother(config, name, begun)
    if free is None:
        return first.freed
    try:
        again = [
            smooth_trajectory(motions[d], free, t.trajectory.stamps_ns)
            if isinstance(t, SmoothedTrajectory)
            else t
            for d, t in enumerate(trajectories)
        ]
        # A lever arm moves the fixes only. A rotation also turns the vehicle frame, of which the
        # ground and the guesses say more.
        if solution is None or name == LEVER_ARM.name:
            scores = motion_scores(again)
        else:
            guesses = {n: configured_guess(config, n) for n in solution.lidars}
            scores = suspect_scores(solution, again, guesses)
    except TrajectoryError:
        return first.freed
    index = scores.index(name)
    # The sigma that freed it is no property of the input.
    candidates = list(scores.candidates)
    candidates[index] = first.candidate
    found = replace(scores, candidates=tuple(candidates)).freed([index])
    return replace(found, change=_after(name, begun, found.change))


def freed_in_smoother(config: Config, name: str, change: Array) -> Config | None:
    """The config with an input moved, with a wide sigma; None: the smoother does not estimate it.

    `change` (3,) is of the lever arm, metres, or of the IMU's rotation about the vehicle's axes.
    """
    if name == LEVER_ARM.name:
        arm = np.zeros(3) if config.gnss.lever_arm is None else np.array(config.gnss.lever_arm)
        moved = {"lever_arm": tuple((arm + change).tolist()), "lever_arm_sigma": FREE_ARM_M}
        return config.model_copy(update={"gnss": config.gnss.model_copy(update=moved)})
    if name == IMU_ROTATION.name and config.imu.T_vehicle_imu.rpy_deg is not None:
        R = gtsam.Rot3.Expmap(change).compose(config.imu.T_vehicle_imu.pose().rotation())
        rpy_deg = tuple(np.degrees(R.rpy()).tolist())
        T_vehicle_imu = config.imu.T_vehicle_imu.model_copy(update={"rpy_deg": rpy_deg})
        turned = {"T_vehicle_imu": T_vehicle_imu, "rotation_sigma_deg": FREE_ROTATION_DEG}
        return config.model_copy(update={"imu": config.imu.model_copy(update=turned)})
    return None


def _after(name: str, first: Array, second: Array) -> Array:
    """Two changes after each other, as one."""
    if name not in (IMU_ROTATION.name, WHEELS_ROTATION.name):
        return first + second
    both = gtsam.Rot3.Expmap(second).compose(gtsam.Rot3.Expmap(first))
    return np.asarray(gtsam.Rot3.Logmap(both))


def named_suspects(
    ranked: Sequence[Ranked], config: Config, guesses: Mapping[str, Guess]
) -> tuple[Suspect, ...]:
    """The ranking for the result, values in the units of the config's keys."""
    out = []
    for each in ranked:
        q = _quantity(each.candidate.name, each.freed, config, guesses)
        value = q.now + q.change if q.value is None else q.value
        out.append(
            Suspect(
                input=each.candidate.name,
                value=tuple(value.tolist()),
                sigma=tuple(q.sigma.tolist()),
                change=tuple(q.change.tolist()),
                units=q.units,
                explains=each.explains,
                sigmas=each.freed.sigmas,
                sigmas_left=each.sigmas_left,
                determined=() if q.determined.all() else tuple(q.determined.tolist()),
            )
        )
    return tuple(out)


def _quantity(name: str, freed: Freed, config: Config, guesses: Mapping[str, Guess]) -> _Quantity:
    """The parameters of a candidate as the quantity that a user knows."""
    change, sigma, known = freed.change, np.sqrt(np.diag(freed.cov)), freed.determined
    if name == LEVER_ARM.name:
        now = np.zeros(3) if config.gnss.lever_arm is None else np.array(config.gnss.lever_arm)
        return _Quantity(now, np.where(known, change, 0.0), sigma, ("m",) * 3, known)
    if name == "ground.vehicle_height":
        now = np.array([config.ground.vehicle_height or 0.0])
        return _Quantity(now, change, sigma, ("m",), known)
    if name == IMU_ROTATION.name:
        return _rotation(freed, config.imu.T_vehicle_imu.rpy_deg)
    if name == HEADING_YAW.name:
        now, off = np.array([config.heading.yaw_deg]), np.degrees(change)
        return _Quantity(now, off, np.degrees(sigma), ("deg",), known)
    if name == SECOND_ARM.name:
        now = np.array(config.heading.lever_arm or (0.0, 0.0, 0.0))
        return _Quantity(now, np.where(known, change, 0.0), sigma, ("m",) * 3, known)
    if name == WHEELS_ROTATION.name:
        return _rotation(freed, config.wheels.T_vehicle_wheels.rpy_deg)
    if name.endswith(".drift") or ".drift." in name:
        return _drift(change, sigma, known)
    if name.endswith("time_offset"):
        return _Quantity(np.zeros(1), change, sigma, ("s",), known)
    if name == "imu.yaw_bias":
        return _Quantity(np.zeros(1), np.degrees(change), np.degrees(sigma), ("deg",), known)
    if name.endswith(".scale"):
        return _Quantity(np.ones(1), change, sigma, ("1",), known)
    moved, spread, known = _as_pose(change), _as_pose(sigma), np.roll(known, 3)
    if name.endswith(".initial"):
        guess = guesses[name.removeprefix("lidars.").removesuffix(".initial")].T_vehicle_lidar
        value = _pose(retract_vehicle_axes(guess, change))
        return _Quantity(_pose(guess), moved, spread, _POSE_UNITS, known, value)
    return _Quantity(np.zeros(6), moved, spread, _POSE_UNITS, known)


def _as_pose(d: Array) -> Array:
    """(6,) rotation before translation, rad and m, as xyz and rpy in m and degrees."""
    return np.concatenate([d[3:], np.degrees(d[:3])])


def _pose(T: gtsam.Pose3) -> Array:
    """(6,) xyz and rpy_deg of a config."""
    return np.concatenate([T.translation(), np.degrees(T.rotation().rpy())])


def _rotation(freed: Freed, rpy_deg: tuple[float, float, float] | None) -> _Quantity:
    """rpy_deg of a mount; the sigmas are those about the vehicle's axes."""
    now = np.radians(np.zeros(3) if rpy_deg is None else np.array(rpy_deg))
    R = gtsam.Rot3.Expmap(freed.change).compose(gtsam.Rot3.RzRyRx(*now))
    sigma = np.degrees(np.sqrt(np.diag(freed.cov)))
    change, value = np.degrees(freed.change), np.degrees(R.rpy())
    return _Quantity(np.degrees(now), change, sigma, ("deg",) * 3, freed.determined, value)


def _drift(change: Array, sigma: Array, known: BoolArray) -> _Quantity:
    """Range of the drift over the drive per map axis (and of the yaw, degrees)."""
    axes = len(change) // DRIFT_WAVES
    waves = change.reshape(DRIFT_WAVES, axes)
    part = np.linspace(0.0, 1.0, 101)
    course = sum(np.cos(np.pi * (k + 1) * part)[:, None] * wave for k, wave in enumerate(waves))
    size = np.ptp(course, axis=0)
    # A wave of one half goes from +1 to -1: its range is twice the amplitude.
    spread = 2.0 * np.linalg.norm(sigma.reshape(DRIFT_WAVES, axes), axis=0)
    unit = np.array([1.0] * 3 + [180.0 / np.pi] * (axes - 3))
    units = ("m",) * 3 + ("deg",) * (axes - 3)
    told = np.asarray(known.reshape(DRIFT_WAVES, axes).all(axis=0), bool)
    return _Quantity(np.zeros(axes), size * unit, spread * unit, units, told)
