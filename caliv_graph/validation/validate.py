"""Alignment before and after calibration, on structure that the solve did not use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.special import chdtrc
from threadpoolctl import threadpool_limits

from caliv_graph.calibration.noise import first_pose_noise
from caliv_graph.calibration.problem import HEAVE_SIGMA_M
from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.errors import ConfigError
from caliv_graph.products import Array, Calibration, IntArray, MotionData, PoseNoise, Recording
from caliv_graph.trajectory.select import VehicleTrajectory, smooth_trajectories
from caliv_graph.trajectory.smoothed import MERGE_NS, SmoothedTrajectory
from caliv_graph.validation.clouds import (
    Clouds,
    Extrinsics,
    Placed,
    choose_scans,
    read_clouds,
    target_regions,
)
from caliv_graph.validation.measure import (
    POLE_TRUE_M,
    WALL_TRUE_M,
    Apart,
    Errors,
    Expected,
    SurfaceMeter,
    Thickness,
    cloud_distances,
    offset_covariance,
    thing_distance,
)
from caliv_graph.validation.refine import align, sharper, vehicle_axes_covariance
from caliv_graph.validation.surfaces import Pole, Structure, Thing, Wall

BEFORE, AFTER, BEST = "before", "after", "best"
"""The initial guesses, the calibration, and what aligns this structure best."""

STAGES = (BEFORE, AFTER, BEST)

CONTRADICTION = 5.7e-7
"""Chance of more than 5 sigma: from there on data contradict each other (SPEC 5, exit code 4)."""

Pair = tuple[str, str]


@dataclass(frozen=True)
class SurfaceResult:
    """A wall or a pole.

    Attributes:
        name: what to call it.
        surface: where it is, and its points, as the best alignment has it.
        points: per LiDAR.
        thickness: by stage (`STAGES`).
        apart: by stage, per pair of LiDARs that both see it.
        expected: after calibration, from known errors alone.
    """

    name: str
    surface: Wall | Pole
    points: Mapping[str, int]
    thickness: Mapping[str, Thickness]
    apart: Mapping[str, Mapping[Pair, Apart]]
    expected: Expected


@dataclass(frozen=True)
class ThingResult:
    """An object that is neither: a second target, a box, a bush.

    Attributes:
        name: what to call it.
        thing: where it is, and its points.
        points: per LiDAR.
        distance_m: by stage, per pair of LiDARs, mean distance from the other's nearest point.
    """

    name: str
    thing: Thing
    points: Mapping[str, int]
    distance_m: Mapping[str, Mapping[Pair, float]]


@dataclass(frozen=True)
class PairResult:
    """Two LiDARs, over all walls and poles that both see.

    Attributes:
        lidars: the two.
        surfaces: how many.
        distance_m: by stage, root mean square over the surfaces.
        expected_m: after calibration, from known errors alone.
        cloud_m: by stage, median distance of a point from the other's surface, both ways; None
            where neither has one nearby.
        overlap: by stage, part of the points that have a surface of the other near.
    """

    lidars: Pair
    surfaces: int
    distance_m: Mapping[str, float]
    expected_m: float
    cloud_m: Mapping[str, float | None]
    overlap: Mapping[str, float]


@dataclass(frozen=True)
class Verdict:
    """What it comes to.

    Attributes:
        better: how many times the measure (`measure`) has become smaller; None: nothing measured.
        measure: `distance` between LiDARs, or `thickness` where no two see the same.
        of_expected: what remains of it over what is expected.
        chi2: of all offsets between LiDARs against their joint covariance.
        dof: how many these are; 0: nothing to test.
        p_value: chance of more, if extrinsics, trajectory and ranges are as good as they say.
        contradicts: whether that is beyond 5 sigma.
        sentences: as a person says it.
    """

    better: float | None
    measure: str
    of_expected: float | None
    chi2: float
    dof: int
    p_value: float | None
    contradicts: bool
    sentences: tuple[str, ...]


@dataclass(frozen=True)
class Validation:
    """What was found.

    Attributes:
        drive: its name.
        lidars: names.
        scans: per LiDAR, scans looked at.
        surfaces: walls, then poles, the largest first.
        things: objects.
        pairs: per pair of LiDARs with anything in common.
        thickness_m: by stage, of merged clouds, root mean square over the surfaces.
        alone_m: by stage, per LiDAR, likewise of its cloud alone.
        expected_thickness_m: after calibration, from known errors alone.
        expected_alone_m: likewise per LiDAR.
        verdict: what it comes to.
        clouds: the points, for pictures.
        best: extrinsics that align this structure best, in the order of `lidars`; no calibration.
        warnings: what a person should know, a line each.
    """

    drive: str
    lidars: tuple[str, ...]
    scans: Mapping[str, int]
    surfaces: tuple[SurfaceResult, ...]
    things: tuple[ThingResult, ...]
    pairs: tuple[PairResult, ...]
    thickness_m: Mapping[str, float]
    alone_m: Mapping[str, Mapping[str, float]]
    expected_thickness_m: float
    expected_alone_m: Mapping[str, float]
    verdict: Verdict
    clouds: Clouds
    best: tuple[gtsam.Pose3, ...]
    warnings: tuple[str, ...]

    @property
    def has_structure(self) -> bool:
        """Whether there was anything to validate on."""
        return bool(self.surfaces or self.things)

    def points_map(self, stage: str) -> Array:
        """(N, 3) metres, all points as a stage has them."""
        if stage == BEST:
            return self.clouds.points_map(self.clouds.placed[AFTER], self.best)
        return self.clouds.points_map(self.clouds.placed[stage])


def validate(
    recording: Recording,
    calibration: Calibration,
    config: Config,
    progress: Progress,
    motion: MotionData | None = None,
) -> Validation:
    """Measures the alignment of all LiDARs' clouds of a drive, before and after calibration.

    The clouds are brought into the map by the trajectory and the extrinsics. What a target's region
    holds is left out, and the ground, unless the solve did without it.

    Args:
        recording: the drive; the one that was calibrated, or another of the same vehicle.
        calibration: to be validated.
        config: initial guesses, topics, noise, target and ground as for `calibrate`.
        progress: told of every scan.
        motion: what the recording tells of the vehicle's motion, if it has been read already.

    Raises:
        ConfigError: calibration and config are of different LiDARs.
        RecordingError: the recording could not be read.
        TrajectoryError: the motion cannot be had from it.
    """
    # Thousands of small matrices: threads of a linear algebra library would wait for each other.
    with threadpool_limits(limits=1):
        return _validate(recording, calibration, config, progress, motion)


def _validate(
    recording: Recording,
    calibration: Calibration,
    config: Config,
    progress: Progress,
    motion: MotionData | None,
) -> Validation:
    names, notes = _common_lidars(recording, calibration, config)
    extrinsics = _extrinsics(names, calibration, config)
    motions = {0: recording.motion() if motion is None else motion}
    with progress.stage("smoothing the trajectory", None):
        (rough,) = smooth_trajectories([recording], config, [[]], motions)
    regions, no_target = target_regions(recording, rough, config, progress)
    chosen = {name: choose_scans(recording.scan_stamps_ns(name), rough) for name in names}
    nodes = _nodes(chosen, extrinsics[AFTER], rough.span_ns)
    with progress.stage("smoothing the trajectory at the scans", None):
        (trajectory,) = smooth_trajectories([recording], config, [nodes], motions)
    # First the calibration: by it one sees what is target and what is ground.
    clouds = read_clouds(
        recording, trajectory, chosen, extrinsics, regions, not config.ground.use, progress
    )
    errors = Errors(
        _mounting_covariance(names, calibration),
        _pose_covariance(clouds.placed[AFTER].taken_ns, nodes, trajectory, calibration, config),
        config.noise.lidar_range_m,
        HEAVE_SIGMA_M if isinstance(trajectory, SmoothedTrajectory) else 0.0,
    )
    sigmas = np.array([config.lidars[n].sigma.sigmas() for n in names])
    with progress.stage("measuring the alignment", None):
        start = sharper(clouds, (AFTER, BEFORE))
        structure, best = align(clouds, clouds.placed[start], sigmas, not config.ground.use)
        return _measured(
            recording.name,
            clouds,
            (start, structure, best),
            errors,
            (*notes, *recording.warnings(), *trajectory.warnings, *no_target),
        )


def _common_lidars(
    recording: Recording, calibration: Calibration, config: Config
) -> tuple[tuple[str, ...], list[str]]:
    """LiDARs to validate, in the config's order; and a line for each that is left out."""
    names = tuple(name for name in config.lidar_order() if name in calibration.lidars)
    if not names:
        raise ConfigError(
            f"the config has none of the LiDARs of the calibration "
            f"({', '.join(calibration.lidars)}), but {', '.join(config.lidars)}. Give them the "
            "same names"
        )
    notes = [
        f"LiDAR '{name}' is not in the calibration: left out"
        for name in config.lidars
        if name not in names
    ]
    notes += [
        f"LiDAR '{name}' of the calibration is not in the config: left out"
        for name in calibration.lidars
        if name not in names
    ]
    return names, notes


def _extrinsics(
    names: Sequence[str], calibration: Calibration, config: Config
) -> dict[str, Extrinsics]:
    """The calibration first, then the guesses."""
    results = calibration.lidars
    return {
        AFTER: Extrinsics(
            {name: results[name].T_vehicle_lidar for name in names},
            {n: o[0] for n in names if (o := results[n].time_offset) is not None},
        ),
        BEFORE: Extrinsics({name: config.lidars[name].initial.pose() for name in names}, {}),
    }


def _nodes(
    chosen: Mapping[str, IntArray], extrinsics: Extrinsics, span_ns: tuple[int, int]
) -> IntArray:
    """Times at which poses are wanted, ascending; those that share a node once."""
    taken = [extrinsics.true_ns(name, stamps) for name, stamps in chosen.items()]
    stamps = np.unique(np.clip(np.concatenate([*taken, np.zeros(0, dtype=np.int64)]), *span_ns))
    out: list[int] = []
    for stamp in stamps.tolist():
        if not out or stamp - out[-1] > 2 * MERGE_NS:
            out.append(stamp)
    return np.array(out, dtype=np.int64)


def _mounting_covariance(names: Sequence[str], calibration: Calibration) -> Array:
    """(6 L, 6 L) of the calibration, vehicle axes, in the order of `names`."""
    order = list(calibration.lidars)
    rows = [6 * order.index(name) + axis for name in names for axis in range(6)]
    poses = [calibration.lidars[name].T_vehicle_lidar for name in names]
    return vehicle_axes_covariance(poses, calibration.cov_joint[np.ix_(rows, rows)])


def _pose_covariance(
    taken_ns: IntArray,
    nodes_ns: IntArray,
    trajectory: VehicleTrajectory,
    calibration: Calibration,
    config: Config,
) -> Array:
    """(6 S, 6 S) joint covariance of the vehicle's poses at the scans, right perturbations."""
    at = np.clip(np.searchsorted(nodes_ns, taken_ns, "right") - 1, 0, None)
    if isinstance(trajectory, SmoothedTrajectory):
        information, _ = trajectory.joint_information(nodes_ns)
        cov = np.asarray(np.linalg.inv(information), dtype=np.float64)
    else:
        cov = given_pose_covariance(nodes_ns, _pose_noise(calibration, config))
    rows = (6 * at[:, None] + np.arange(6)).ravel()
    return np.asarray(0.5 * (cov + cov.T)[np.ix_(rows, rows)], dtype=np.float64)


def _pose_noise(calibration: Calibration, config: Config) -> PoseNoise:
    """Error model of given poses: what `calibrate` found, else what the config says."""
    found = calibration.provenance.get("pose_noise")
    if isinstance(found, Mapping):
        try:
            return PoseNoise(**{str(key): float(value) for key, value in found.items()})
        except (TypeError, ValueError):
            pass  # another program's idea of it
    return first_pose_noise(config.noise)


def given_pose_covariance(stamps_ns: IntArray, noise: PoseNoise) -> Array:
    """Joint covariance of given poses at some stamps (n,): white and Gauss-Markov errors.

    Returns:
        (6 n, 6 n), rotation then translation; the same in map and vehicle axes, all being alike.
    """
    apart_s = 1e-9 * np.abs(stamps_ns[:, None] - stamps_ns[None, :])
    slow = np.exp(-apart_s / noise.drift_time_s)
    white = np.array([noise.white_rotation_rad] * 3 + [noise.white_position_m] * 3) ** 2
    drift = np.array([noise.drift_rotation_rad] * 3 + [noise.drift_position_m] * 3) ** 2
    eye = np.eye(len(stamps_ns))
    out = np.kron(eye, np.diag(white)) + np.kron(slow, np.diag(drift))
    return np.asarray(out, dtype=np.float64)


def _measured(
    drive: str,
    clouds: Clouds,
    aligned: tuple[str, Structure, tuple[gtsam.Pose3, ...]],
    errors: Errors,
    warnings: tuple[str, ...],
) -> Validation:
    """Measures under all extrinsics what was found under the best ones."""
    start, structure, best = aligned
    stages: dict[str, tuple[Placed, Sequence[gtsam.Pose3] | None]] = {
        BEFORE: (clouds.placed[BEFORE], None),
        AFTER: (clouds.placed[AFTER], None),
        BEST: (clouds.placed[start], best),
    }
    surfaces = []
    numbers: dict[str, int] = {}
    for surface in structure.surfaces:
        kind = "pole"
        if isinstance(surface, Wall):
            kind = "ground" if surface.is_level else "wall"
        numbers[kind] = numbers.get(kind, 0) + 1
        surfaces.append(_surface(clouds, f"{kind} {numbers[kind]}", surface, stages, errors))
    things = tuple(
        _thing(clouds, f"object {number}", thing, stages)
        for number, thing in enumerate(structure.things, start=1)
    )
    pairs = _pairs(clouds, surfaces, stages)
    thickness = {s: _rms([x.thickness[s].merged for x in surfaces]) for s in STAGES}
    alone = {
        stage: {
            name: _rms(values)
            for name in clouds.lidars
            if (
                values := [
                    x.thickness[stage].alone[name]
                    for x in surfaces
                    if name in x.thickness[stage].alone
                ]
            )
        }
        for stage in STAGES
    }
    expected_alone = {
        name: _rms([x.expected.alone[name] for x in surfaces if name in x.expected.alone])
        for name in alone[AFTER]
    }
    expected = _rms([x.expected.merged for x in surfaces])
    return Validation(
        drive=drive,
        lidars=clouds.lidars,
        scans=clouds.scans,
        surfaces=tuple(surfaces),
        things=things,
        pairs=pairs,
        thickness_m=thickness,
        alone_m=alone,
        expected_thickness_m=expected,
        expected_alone_m=expected_alone,
        verdict=_verdict(surfaces, things, pairs, (alone, expected_alone), errors),
        clouds=clouds,
        best=best,
        warnings=warnings,
    )


Stages = Mapping[str, tuple[Placed, Sequence[gtsam.Pose3] | None]]


def _surface(
    clouds: Clouds, name: str, surface: Wall | Pole, stages: Stages, errors: Errors
) -> SurfaceResult:
    meter = SurfaceMeter(clouds, surface)
    found = {stage: meter.measure(placed, poses) for stage, (placed, poses) in stages.items()}
    return SurfaceResult(
        name,
        surface,
        meter.points,
        {stage: thickness for stage, (thickness, _) in found.items()},
        {stage: apart for stage, (_, apart) in found.items()},
        meter.expect(stages[AFTER][0], errors),
    )


def _thing(clouds: Clouds, name: str, thing: Thing, stages: Stages) -> ThingResult:
    lidar = clouds.lidar[thing.members]
    distances: dict[str, dict[Pair, float]] = {}
    for stage, (placed, poses) in stages.items():
        points = clouds.points_map(placed, poses)[thing.members]
        distances[stage] = {}
        for i, a in enumerate(clouds.lidars):
            for j in range(i + 1, len(clouds.lidars)):
                distance = thing_distance(points, lidar, i, j)
                if distance is not None:
                    distances[stage][a, clouds.lidars[j]] = distance
    counts = {name: int((lidar == i).sum()) for i, name in enumerate(clouds.lidars)}
    return ThingResult(name, thing, counts, distances)


def _pairs(
    clouds: Clouds, surfaces: Sequence[SurfaceResult], stages: Stages
) -> tuple[PairResult, ...]:
    near = {
        stage: cloud_distances(clouds.points_map(placed, poses), clouds.lidar, clouds.lidars)
        for stage, (placed, poses) in stages.items()
    }
    out = []
    for i, a in enumerate(clouds.lidars):
        for b in clouds.lidars[i + 1 :]:
            shared = [s for s in surfaces if _is_shared(s, (a, b))]
            both = {
                stage: [found[p] for p in ((a, b), (b, a)) if p in found]
                for stage, found in near.items()
            }
            if not shared and not any(both.values()):
                continue
            out.append(
                PairResult(
                    (a, b),
                    len(shared),
                    {
                        stage: _rms([s.apart[stage][a, b].distance_m for s in shared])
                        for stage in STAGES
                        if shared
                    },
                    _rms([s.expected.distance_m[a, b] for s in shared]),
                    {s: float(np.mean([m for m, _ in f])) if f else None for s, f in both.items()},
                    {s: float(np.mean([o for _, o in f])) if f else 0.0 for s, f in both.items()},
                )
            )
    return tuple(out)


def _is_shared(surface: SurfaceResult, pair: Pair) -> bool:
    """Whether a surface tells how two LiDARs are apart, under all extrinsics."""
    told = [surface.expected.distance_m, *surface.apart.values()]
    return all(pair in of_stage for of_stage in told)


def _verdict(
    surfaces: Sequence[SurfaceResult],
    things: Sequence[ThingResult],
    pairs: Sequence[PairResult],
    alone: tuple[Mapping[str, Mapping[str, float]], Mapping[str, float]],
    errors: Errors,
) -> Verdict:
    tested = _tested(surfaces)
    chi2, p_value = 0.0, None
    dof = sum(len(s.apart[AFTER][pair].offset_m) for s, pair in tested)
    if tested:
        offsets = np.concatenate([s.apart[AFTER][pair].offset_m for s, pair in tested])
        cov = offset_covariance([(s.expected, pair) for s, pair in tested], errors)
        chi2 = max(float(offsets @ np.linalg.solve(cov, offsets)), 0.0)
        p_value = float(chdtrc(dof, chi2))
    shared = [pair for pair in pairs if pair.surfaces]
    measure = "distance" if shared else "thickness"
    if shared:
        values = {s: _rms([p.distance_m[s] for p in shared]) for s in STAGES}
        expected = _rms([p.expected_m for p in shared])
    else:
        values = {s: _rms(list(alone[0][s].values())) for s in STAGES}
        expected = _rms(list(alone[1].values()))
    told = bool(surfaces)
    better = values[BEFORE] / values[AFTER] if told and values[AFTER] > 0.0 else None
    of_expected = values[AFTER] / expected if told and expected > 0.0 else None
    contradicts = p_value is not None and p_value < CONTRADICTION
    sentences = _sentences(
        values, expected, better, (chi2, dof, p_value, contradicts), (shared, surfaces, things)
    )
    if shared and better is not None:
        thick = ", ".join(
            f"'{name}' {1e3 * value:.1f} mm (expected {1e3 * alone[1][name]:.1f})"
            for name, value in alone[0][AFTER].items()
        )
        sentences += (f"As each LiDAR alone sees {_kinds(surfaces)}, they are so thick: {thick}.",)
    return Verdict(better, measure, of_expected, chi2, dof, p_value, contradicts, sentences)


def _tested(surfaces: Sequence[SurfaceResult]) -> list[tuple[SurfaceResult, Pair]]:
    """Offsets that say something each: of three LiDARs on a wall, two."""
    out = []
    for surface in surfaces:
        pairs = [pair for pair in surface.apart[AFTER] if _is_shared(surface, pair)]
        hub = max(surface.points, key=lambda name: surface.points[name])
        out += [(surface, pair) for pair in pairs if hub in pair]
    return out


def _sentences(
    values: Mapping[str, float],
    expected: float,
    better: float | None,
    test: tuple[float, int, float | None, bool],
    found: tuple[Sequence[PairResult], Sequence[SurfaceResult], Sequence[ThingResult]],
) -> tuple[str, ...]:
    shared, surfaces, things = found
    if not surfaces and not things:
        return (
            "Nothing can be said: no wall, no pole and no object stands near the drive but the "
            "target and the ground. Drive past a house, or put up a second target.",
        )
    if not surfaces or better is None:
        return (
            "No wall and no pole stands near the drive: how the objects are apart is in the table, "
            "but what is to be expected of them is not known.",
        )
    before, after, best = (f"{1e3 * values[stage]:.1f} mm" for stage in STAGES)
    kinds = _kinds(surfaces)
    how = f"{better:.1f} times better" if better >= 1.0 else f"{1.0 / better:.1f} times WORSE"
    what = (
        f"LiDARs have {kinds} apart by"
        if shared
        else f"No two LiDARs see the same surface. Each alone has {kinds} thick by"
    )
    out = [f"{what} {after} after calibration, {before} before: {how} than the initial guess."]
    chi2, dof, p_value, contradicts = test
    ratio = values[AFTER] / expected
    remains = (
        "Noise, trajectory, the calibration's own sigmas and the shape of real walls and poles "
        f"({1e3 * WALL_TRUE_M:.0f} and {1e3 * POLE_TRUE_M:.0f} mm) lead one to expect "
        f"{1e3 * expected:.1f} mm; what remains is {ratio:.1f} times that"
    )
    if p_value is None:
        out.append(f"{remains}.")
    else:
        tested = f"chi2 {chi2:.1f} of {dof} dof, p {p_value:.2g}"
        word = "They do not explain it" if contradicts else "They explain it"
        if not contradicts and p_value < 0.01:
            word = "They explain it poorly"
        out.append(f"{remains}. {word} ({tested}).")
    out.append(f"Extrinsics fitted to this structure alone would leave {best}.")
    return tuple(out)


def _kinds(surfaces: Sequence[SurfaceResult]) -> str:
    """What was found, in words."""
    words = {"wall": "walls", "pole": "poles", "ground": "planes of the ground"}
    found = dict.fromkeys(surface.name.split()[0] for surface in surfaces)
    return " and ".join(words[kind] for kind in found)


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0
