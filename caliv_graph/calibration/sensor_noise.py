"""Noise that no message states, estimated from what the LiDARs see along smoothed trajectories.

Heave of the body, waves of the ground, and errors of fixes and orientations that are correlated
over time: variance components of the residuals of clouds and ground planes at the smoothed poses,
extrinsics, targets and planes integrated out (`README.md`, "Noise levels").
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from caliv_graph.calibration.evidence import (
    NOTHING,
    ErrorsByStructure,
    Evidence,
    linearised_evidence,
    motion_evidence,
)
from caliv_graph.calibration.ground_scatter import MOST, GroundLevels
from caliv_graph.calibration.noise import CLOUD, LOG_SPREAD
from caliv_graph.calibration.open_errors import (
    RATHER_NONE,
    SIZES,
    SURELY_NONE,
    Limit,
    limits_by_motion,
    of_expected_size,
    open_errors,
)
from caliv_graph.calibration.problem import HEAVE_SIGMA_M
from caliv_graph.calibration.solve import SolveState
from caliv_graph.calibration.variance_components import (
    Component,
    Likelihood,
    SlowComponent,
    Unknown,
    maximise,
)
from caliv_graph.config.noise import NoiseConfig
from caliv_graph.products import Array, NoiseLevel, Registration
from caliv_graph.targets.ground.planes import DISTANCE_FLOOR_M, NORMAL_FLOOR_RAD, ground_floors
from caliv_graph.trajectory.correlated import GROUPS, CorrelatedError
from caliv_graph.trajectory.noise import TYPICAL_CORRELATION_S
from caliv_graph.trajectory.select import VehicleTrajectory, is_of_wheels
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.trajectory.variances import LARGEST_RIGHT

EVIDENCE = 3.0
"""Gain of the log-likelihood from which an error is taken to be correlated over time: one for each
of its parameters (Akaike). Errors as slow as the drive is long gain little more, and move S2V by
many of its sigmas; chance gains as much in one of twenty drives, at levels that cost little."""

LEVELS: Mapping[str, Unknown] = {
    "registration": Unknown(1.0, LOG_SPREAD, (0.1, 30.0)),
    "heave": Unknown(HEAVE_SIGMA_M, LOG_SPREAD, (1e-4, MOST.heave_m)),
    "ground_normal": Unknown(NORMAL_FLOOR_RAD, LOG_SPREAD, (1e-5, MOST.normal_rad)),
    "ground_distance": Unknown(DISTANCE_FLOOR_M, LOG_SPREAD, (1e-4, MOST.distance_m)),
}
"""White errors, a sigma each: of the registration as a factor, else in metres and radians. The
usual figures are weak priors, a factor of ten."""

TIME = Unknown(TYPICAL_CORRELATION_S, math.log(3.0), (2.0, 300.0))
"""Correlation time in seconds: below, the error is as good as white; above, it is constant over a
drive, which extrinsics and target take up."""


@dataclass(frozen=True)
class Slow:
    """A correlated error that is looked for.

    Attributes:
        sigma: of each group of axes.
        starts: sigmas that the search begins with, all with each of `START_TIMES_S`.
    """

    sigma: Unknown
    starts: tuple[float, ...]


SLOW: Mapping[str, Slow] = {
    "gnss": Slow(Unknown(5e-3, LOG_SPREAD, (1e-4, 30.0)), (5e-3, 0.02)),
    "orientation": Slow(Unknown(1e-3, LOG_SPREAD, (1e-5, 0.5)), (5e-4, 2e-3)),
}
"""By kind of factor; the prior is that of a receiver with corrections, and of an AHRS."""

START_TIMES_S = (8.0, 40.0)

RESIDUALS = "residuals of the LiDARs"
"""Source of an estimated figure."""

OPEN = "expected: LiDARs and motion data leave it open"
"""Source of the figure of an error whose size is integrated out."""


@dataclass(frozen=True)
class SensorNoise:
    """Noise levels that hold for all drives.

    Attributes:
        heave_m: 1 sigma of the heave.
        floors: (3,) 1 sigma of (a, b, distance) of a ground plane by the waves of the ground.
        correlated: errors of sensors that are correlated over time.
        opened: kinds of those that nothing shows (`open_errors.py`).
        levels: for the report.
    """

    heave_m: float
    floors: Array
    correlated: tuple[CorrelatedError, ...] = ()
    opened: tuple[str, ...] = ()
    levels: tuple[NoiseLevel, ...] = ()

    def with_ground_levels(self, found: GroundLevels) -> SensorNoise:
        """The same with levels of ground and heave that residuals asked for."""
        sigmas = {
            "ground_normal": found.normal_rad,
            "ground_distance": found.distance_m,
            "heave": found.heave_m,
        }
        levels = tuple(
            replace(level, sigma=sigmas[level.name], source=RESIDUALS)
            if level.name in sigmas and sigmas[level.name] != level.sigma
            else level
            for level in self.levels
        )
        floors = np.array([found.normal_rad, found.normal_rad, found.distance_m])
        return replace(self, heave_m=found.heave_m, floors=floors, levels=levels)


def estimated_noise(
    state: SolveState,
    registrations: Sequence[Registration],
    trajectories: Sequence[VehicleTrajectory],
    structure: ErrorsByStructure = NOTHING,
) -> SensorNoise:
    """Noise levels that the config leaves open, from a rough solve.

    Of drives with given poses, whose noise is fitted elsewhere, nothing is used. `structure` is
    what that of each drive says of slow errors of its sensors.
    """
    noise = state.config.noise
    evidence = linearised_evidence(state, registrations, trajectories, structure)
    if evidence is None:
        return noise_of_motion(trajectories, noise, structure)
    of_wheels = any(map(is_of_wheels, trajectories))
    found = estimated(evidence, noise, of_wheels)
    if again := _with_other_levels(found, evidence, trajectories):
        evidence = replace(evidence, motion=motion_evidence(again, structure).motion)
        found = estimated(evidence, noise, of_wheels)
    return found


def _white_levels(of_wheels: bool) -> Mapping[str, Unknown]:
    """`LEVELS`, with a heave that is at least the usual one where a drive has no IMU.

    Without one the path is as smooth as fixes a fifth of a second apart can tell, and bumps are in
    its errors: they leave little to a heave. That came out at 0.4 mm, and a vertical velocity that
    wheels are assumed not to have told S2V pitch and x, 18 mrad and 62 mm off at 4.6 and 13 (random
    drive 137 of the second simulator).
    """
    if not of_wheels:
        return LEVELS
    heave = LEVELS["heave"]
    return {**LEVELS, "heave": replace(heave, bounds=(heave.median, heave.bounds[1]))}


def noise_of_motion(
    trajectories: Sequence[VehicleTrajectory],
    noise: NoiseConfig,
    structure: ErrorsByStructure = NOTHING,
) -> SensorNoise:
    """`usual_noise`, and the correlated errors that motion data and structure leave open.

    Motion data alone rather see such errors on a sound drive than not: there they count from a
    higher probability on.
    """
    none_from = SURELY_NONE if structure else RATHER_NONE
    evidence = motion_evidence(trajectories, structure)
    found = _open_errors(evidence, noise, none_from)
    again = _with_other_levels(found, evidence, trajectories)
    if not again:
        return found
    return _open_errors(motion_evidence(again, structure), noise, none_from)


def _with_other_levels(
    noise: SensorNoise, evidence: Evidence, trajectories: Sequence[VehicleTrajectory]
) -> list[VehicleTrajectory]:
    """The drives with the white levels that they have beside correlated errors; empty: the same.

    Without these, the accelerometer's level takes up a part of an error of the fixes, and hides it.
    One that is smaller than all that are looked for (`open_errors.SIZES`) leaves them as they are.
    """
    white = evidence.sensor_sigmas
    large = [e for e in noise.correlated if (e.sigmas >= SIZES[0] * white[e.kind]).any()]
    if not large or not any(
        t.data.scales for t in trajectories if isinstance(t, SmoothedTrajectory)
    ):
        return []
    out: list[VehicleTrajectory] = []
    changed = False
    for before, after in zip(trajectories, with_noise(noise, trajectories), strict=True):
        if isinstance(before, SmoothedTrajectory) and isinstance(after, SmoothedTrajectory):
            changed |= _differ(before.data.scales, after.data.scales)
            out.append(replace(after, correlated=()))
        else:
            out.append(after)  # its place among the drives counts
    return out if changed else []


def _differ(one: Mapping[str, float], other: Mapping[str, float]) -> bool:
    """Whether a scale on stated sigmas is another one, by more than is left alone."""
    ratios = [one.get(name, 1.0) / other.get(name, 1.0) for name in {*one, *other}]
    return any(max(ratio, 1.0 / ratio) > LARGEST_RIGHT for ratio in ratios)


def _open_errors(evidence: Evidence, noise: NoiseConfig, none_from: float) -> SensorNoise:
    """The usual noise, and errors that may be there, unless none is as probable."""
    kinds = _looked_for(noise, evidence)
    errors = open_errors(evidence, (), kinds, none_from)
    opened = tuple(error.kind for error in errors)
    found = replace(_usual(noise), correlated=errors, opened=opened)
    return replace(found, levels=_levels(found, noise, ()))


def usual_noise(noise: NoiseConfig) -> SensorNoise:
    """The figures of a config, and the usual ones where it is silent."""
    usual = _usual(noise)
    return replace(usual, levels=_levels(usual, noise, ()))


def _usual(noise: NoiseConfig) -> SensorNoise:
    return SensorNoise(noise.heave_m or HEAVE_SIGMA_M, ground_floors(noise))


def estimated(evidence: Evidence, noise: NoiseConfig, of_wheels: bool = False) -> SensorNoise:
    """The noise levels that a config leaves open; `of_wheels`: the motion is that of wheels."""
    usual = _usual(noise)
    given = {
        "heave": noise.heave_m,
        "ground_normal": noise.ground_normal_deg and math.radians(noise.ground_normal_deg),
        "ground_distance": noise.ground_distance_m,
    }
    names = [name for name in evidence.white if given.get(name) is None]
    names += ["registration"] * bool(evidence.clouds)
    stated = [s**2 * evidence.white[n] for n, s in given.items() if s and n in evidence.white]
    known = np.sum([evidence.observed.known, *stated], axis=0)
    evidence = replace(evidence, observed=replace(evidence.observed, known=known))
    levels = _white_levels(of_wheels)
    best = _fitted(evidence, levels, names, (), None, _Limits({}))
    kinds = _looked_for(noise, evidence)
    limits = _Limits.of(evidence, kinds)
    while kinds:
        start = _best_start(evidence, names, best, kinds, limits)
        if start is None:
            break
        before = [(error.kind, _start_of(error)) for error in best.errors]
        better = _fitted(evidence, levels, names, [*before, start], best, limits)
        if best.cost - better.cost < EVIDENCE:
            break
        best = better
        kinds.remove(start[0])
    all_white = np.log(np.concatenate([best.white, best.factors]))
    known = _likelihood(evidence, names, ()).covariance(all_white)
    evidence = replace(evidence, observed=replace(evidence.observed, known=known))
    shown = of_expected_size(evidence, best.errors)
    opened = open_errors(evidence, shown, kinds)
    values = dict(zip(names, best.white.tolist(), strict=True))
    normal = values.get("ground_normal", usual.floors[0])
    floors = np.array([normal, normal, values.get("ground_distance", usual.floors[2])])
    errors = (*shown, *opened)
    kinds = [error.kind for error in opened]
    fitted = SensorNoise(values.get("heave", usual.heave_m), floors, errors, tuple(kinds))
    return replace(fitted, levels=_levels(fitted, noise, names))


def heave_of(levels: Sequence[NoiseLevel]) -> float:
    """1 sigma of the heave (m) among the figures of a result; the usual one if it is not there."""
    return next((level.sigma for level in levels if level.name == "heave"), HEAVE_SIGMA_M)


def with_noise(
    noise: SensorNoise, trajectories: Sequence[VehicleTrajectory]
) -> list[VehicleTrajectory]:
    """The trajectories, smoothed again where a sensor's error is correlated.

    An error that nothing shows contradicts no stated sigma: those that held still hold. Drives
    that are linearised elsewhere have no sensor with such an error (`drift.py`), and stay.
    """
    open_only = len(noise.opened) == len(noise.correlated)
    out: list[VehicleTrajectory] = []
    for t in trajectories:
        if noise.correlated and isinstance(t, SmoothedTrajectory) and not t.elsewhere:
            stamps = t.trajectory.stamps_ns
            known: dict[str, float] | None = {} if open_only and not t.data.scales else None
            motion, config = t.data.motion, t.data.config
            t = smooth_trajectory(motion, config, stamps, noise.correlated, known, t)
        out.append(t)
    return out


def _levels(
    noise: SensorNoise, config: NoiseConfig, estimated: Sequence[str]
) -> tuple[NoiseLevel, ...]:
    """The figures in use and where they are from."""
    given = {
        "heave": config.heave_m,
        "ground_normal": config.ground_normal_deg,
        "ground_distance": config.ground_distance_m,
    }

    def source(name: str) -> str:
        if given[name] is not None:
            return "config"
        return RESIDUALS if name in estimated else "the usual figure"

    figures = (
        ("heave", noise.heave_m, "m"),
        ("ground_normal", float(noise.floors[0]), "rad"),
        ("ground_distance", float(noise.floors[2]), "m"),
    )
    out = [NoiseLevel(name, value, unit, source(name)) for name, value, unit in figures]
    for error in noise.correlated:
        unit = "m" if error.kind == "gnss" else "rad"
        parts = ("horizontal", "vertical") if error.kind == "gnss" else ("tilt", "yaw")
        for part, sigma in zip(parts, error.sigmas[::2], strict=True):
            name = f"{error.kind}_correlated_{part}"
            told = OPEN if error.kind in noise.opened else RESIDUALS
            out.append(NoiseLevel(name, sigma, unit, told, error.time_s))
    return tuple(out)


# ------------------------------------------------------------------ likelihood


@dataclass(frozen=True)
class _Fit:
    """The most likely noise.

    Attributes:
        white: (k,) sigmas of the white levels.
        factors: (J,) of the registrations of the clouds, on their level.
        errors: that are correlated over time.
        cost: minus the log-posterior, with what the motion data rule out.
    """

    white: Array
    factors: Array
    errors: tuple[CorrelatedError, ...]
    cost: float


def _fitted(
    evidence: Evidence,
    white_levels: Mapping[str, Unknown],
    names: Sequence[str],
    slow: Sequence[tuple[str, Array]],
    start: _Fit | None,
    limits: _Limits,
) -> _Fit:
    """The most likely of the `white_levels` of `names`, factors of the clouds, correlated errors.

    `slow` are the kinds of these, and where their search begins: sigmas of the groups, then the
    time. That of the others begins at `start`.
    """
    levels, clouds = [white_levels[name] for name in names], [CLOUD] * len(evidence.clouds)
    unknowns = [*levels, *clouds]
    first = [u.median for u in unknowns] if start is None else [*start.white, *start.factors]
    for kind, values in slow:
        unknowns += [SLOW[kind].sigma] * len(GROUPS[kind]) + [TIME]
        first += values.tolist()

    kinds = [kind for kind, _ in slow]
    likelihood, at = _likelihood(evidence, names, kinds), len(levels) + len(clouds)

    def cost(x: Array) -> tuple[float, Array, Array]:
        value, slope, information = likelihood.cost(x)
        lost, by_slow = limits.cost(kinds, x[at:])
        slope[at:] += by_slow
        return value + lost, slope, information

    found, value = maximise(cost, unknowns, np.array(first))
    white, factors = found[: len(levels)], found[len(levels) : at]
    return _Fit(white, factors, _errors_of(kinds, found[at:]), value)


def _errors_of(kinds: Sequence[str], values: Array) -> tuple[CorrelatedError, ...]:
    """Errors of some kinds: the sigmas of the groups of each, and its time, all in a row."""
    errors, at = [], 0
    for kind in kinds:
        groups = GROUPS[kind]
        sigmas = np.zeros(3)
        for group, sigma in zip(groups, values[at:], strict=False):
            sigmas[list(group)] = sigma
        at += len(groups)
        east, north, up = sigmas.tolist()
        errors.append(CorrelatedError(kind, (east, north, up), float(values[at])))
        at += 1
    return tuple(errors)


@dataclass(frozen=True)
class _Limits:
    """What the motion data rule out of the errors of some sensors (`limits_by_motion`)."""

    of_kinds: Mapping[str, Sequence[Limit]]

    @classmethod
    def of(cls, evidence: Evidence, kinds: Sequence[str]) -> _Limits:
        """Of all kinds that are looked for."""
        return cls({kind: limits_by_motion(evidence, kind) for kind in kinds})

    def cost(self, kinds: Sequence[str], logarithms: Array) -> tuple[float, Array]:
        """Minus a log-likelihood, and its slope, at the logarithms of sigmas and times in a row."""
        value, slope, at = 0.0, np.zeros(len(logarithms)), 0
        for kind in kinds:
            time = at + len(GROUPS[kind])
            for i, limit in enumerate(self.of_kinds[kind], start=at):
                lost, by_sigma, by_time = limit(float(logarithms[i]), float(logarithms[time]))
                value += lost
                slope[[i, time]] += by_sigma, by_time
            at = time + 1
        return value, slope


def _likelihood(evidence: Evidence, names: Sequence[str], kinds: Sequence[str]) -> Likelihood:
    """Of errors of the named levels, of the clouds and of `kinds`.

    Unknowns: the levels, the clouds' factors, and of each kind its sigmas and its time.
    """
    level = {name: number for number, name in enumerate(names)}
    white = [Component(of, (level[n],)) for n, of in evidence.white.items() if n in level]
    clouds = [
        Component(cloud, (level["registration"], len(names) + j))
        for j, cloud in enumerate(evidence.clouds)
    ]
    slow, at = [], len(names) + len(clouds)
    for kind in kinds:
        time = at + len(GROUPS[kind])
        slow.append(SlowComponent(partial(_slow, evidence, kind), (*range(at, time),), time))
        at = time + 1
    return Likelihood(evidence.observed, [*white, *clouds], slow)


def _slow(evidence: Evidence, kind: str, time_s: float) -> list[Array]:
    """(N, N) by an error of unit sigma of each group of axes."""
    return [evidence.slow(kind, group, time_s) for group in GROUPS[kind]]


def _best_start(
    evidence: Evidence, names: Sequence[str], best: _Fit, kinds: Sequence[str], limits: _Limits
) -> tuple[str, Array] | None:
    """Which further error explains most before anything is fitted, and with which sigmas and time.

    None: none of them explains anything.
    """
    before = [error.kind for error in best.errors]
    so_far = [best.white, best.factors, *map(_start_of, best.errors)]
    logarithms = np.log(np.concatenate(so_far))
    at = len(best.white) + len(best.factors)
    least, out = _likelihood(evidence, names, before).value(logarithms), None
    least += limits.cost(before, logarithms[at:])[0]
    for kind in kinds:
        likelihood = _likelihood(evidence, names, [*before, kind])
        for sigma in SLOW[kind].starts:
            for time_s in START_TIMES_S:
                values = np.array([sigma] * len(GROUPS[kind]) + [time_s])
                x = np.concatenate([logarithms, np.log(values)])
                cost = likelihood.value(x)
                cost += limits.cost([*before, kind], x[at:])[0]
                if cost < least:
                    least, out = cost, (kind, values)
    return out


def _start_of(error: CorrelatedError) -> Array:
    """Sigmas of its groups, and its time."""
    return np.array([*(error.sigmas[g[0]] for g in GROUPS[error.kind]), error.time_s])


def _looked_for(noise: NoiseConfig, evidence: Evidence) -> list[str]:
    """Kinds of correlated errors that the config leaves open and a drive has."""
    configured = {
        "gnss": (noise.gnss_correlated_horizontal_m, noise.gnss_correlated_vertical_m),
        "orientation": (noise.orientation_correlated_deg, noise.orientation_correlated_yaw_deg),
    }
    has = {kind for _, of in evidence.effects for kind in of} | evidence.sensor_sigmas.keys()
    return [k for k, values in configured.items() if k in has and all(v is None for v in values)]
