"""Alignment before and after calibration, on what stands around a drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np
from threadpoolctl import threadpool_limits

from caliv_graph.calibration.problem import HEAVE_SIGMA_M
from caliv_graph.common.progress import Progress
from caliv_graph.config.guesses import with_found_guess
from caliv_graph.config.lidars import FoundLidarConfig
from caliv_graph.config.model import Config
from caliv_graph.errors import ConfigError
from caliv_graph.odometry.run import needs_odometry
from caliv_graph.products import Calibration, IntArray, MotionData, Recording
from caliv_graph.readers.common_stamps import COMMON_NS, MERGE_NS, without_neighbours
from caliv_graph.trajectory.about_poses import about_poses
from caliv_graph.trajectory.measurements import nearest_node
from caliv_graph.trajectory.select import (
    GivenTrajectory,
    VehicleTrajectory,
    sharing_poses,
    smooth_trajectories,
)
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.validation.clouds import (
    Clouds,
    Extrinsics,
    Placed,
    choose_scans,
    read_clouds,
    target_regions,
)
from caliv_graph.validation.covariances import extrinsic_covariance, pose_covariance
from caliv_graph.validation.findings import (
    AFTER,
    BEFORE,
    BEST,
    STAGES,
    Pair,
    PairResult,
    SurfaceResult,
    ThingResult,
    Validation,
)
from caliv_graph.validation.held_out import measure_held_out
from caliv_graph.validation.lidars_alone import Way, about_tracked, way_of
from caliv_graph.validation.measure import (
    Errors,
    SurfaceMeter,
    cloud_distances,
    rms,
    thing_distance,
)
from caliv_graph.validation.refine import align, sharper
from caliv_graph.validation.surfaces import Structure, Thing, Wall
from caliv_graph.validation.verdict import is_shared, judge, with_held_out
from caliv_graph.wording.guesses import before_words
from caliv_graph.wording.odometry import unseen_words

Stages = Mapping[str, tuple[Placed, Sequence[gtsam.Pose3] | None]]


def validate(
    recording: Recording,
    calibration: Calibration,
    config: Config,
    progress: Progress,
    motion: MotionData | None = None,
) -> Validation:
    """Measures the alignment of all LiDARs' clouds of a drive, before and after calibration.

    The trajectory and the extrinsics transform the clouds into the map. Points in a target's region
    are left out, and the ground too, unless the solve did not use it. The drive is the calibrated
    one or another one of the same vehicle, and the config is as for `calibrate`. Motion data that
    have been read already are not read again.

    A drive without motion data is measured on the poses by the odometry of a LiDAR, S2S alone.

    Raises:
        ConfigError: calibration and config have no LiDAR in common, or the config asks for what
            cannot be had without motion data.
        RecordingError: the recording could not be read.
        TrajectoryError: the recording does not determine the vehicle's motion.
    """
    # Thousands of small matrices: threads of the linear algebra library would make this slower.
    with threadpool_limits(limits=1):
        names, notes = _common_lidars(recording, calibration, config)
        config = _with_guesses(names, calibration, config)
        before = before_words(names, [n for n in names if _is_found(config, n)])
        motions = {0: recording.motion() if motion is None else motion}
        tracked: str | None = None
        if needs_odometry(motions[0], config):
            alone = about_tracked(recording, names, calibration, config, motions, progress)
            tracked, motions = alone.lidar, {0: alone.motion}
            config, calibration = alone.config, alone.calibration
        recording = sharing_poses(recording, motions[0], config)
        extrinsics = _extrinsics(names, calibration, config)
        with progress.stage("smoothing the trajectory", None):
            (rough,) = smooth_trajectories([recording], config, [[]], motions, by_walls=True)
        regions, no_target = target_regions(recording, rough, config, progress)
        held = measure_held_out(
            recording, rough, motions, calibration, extrinsics[AFTER], config, progress
        )
        if tracked is None:
            about = rough, held.about_walls
            way = _way(recording, about, motions, calibration, extrinsics[AFTER], config, progress)
        else:
            way = way_of(recording.name, names, rough, held)
        trajectory = way.trajectory
        # The calibration comes first: it decides which points are target and ground.
        clouds = read_clouds(
            recording, trajectory, way.chosen, extrinsics, regions, not config.ground.use, progress
        )
        errors = Errors(
            extrinsic_covariance(names, calibration),
            way.covariance(clouds.placed[AFTER].taken_ns),
            config.noise.lidar_range_m,
            HEAVE_SIGMA_M if isinstance(trajectory, SmoothedTrajectory) else 0.0,
        )
        sigmas = np.array([config.lidars[n].sigma.sigmas() for n in names])
        with progress.stage("measuring the alignment", None):
            start = sharper(clouds, (AFTER, BEFORE))
            structure, best = align(clouds, clouds.placed[start], sigmas, not config.ground.use)
            found = _measured(
                recording.name,
                clouds,
                (start, structure, best),
                errors,
                (*notes, *recording.warnings(), *trajectory.warnings, *no_target),
                before,
            )
    if tracked is not None:
        found = replace(found, unseen=unseen_words(tracked))
    if held.found is None:
        sentences = (*found.verdict.sentences, *held.sentences)
        return replace(found, verdict=replace(found.verdict, sentences=sentences))
    verdict = with_held_out(found.verdict, held.found, before)
    return replace(found, held_out=held.found, verdict=verdict)


def _way(
    recording: Recording,
    smoothed: tuple[VehicleTrajectory, SmoothedTrajectory | None],
    motions: Mapping[int, MotionData],
    calibration: Calibration,
    extrinsics: Extrinsics,
    config: Config,
    progress: Progress,
) -> Way:
    """The vehicle's poses at the scans to measure, by the motion data.

    `smoothed` are the rough trajectory and, if its heading drifts, where walls put the vehicle.

    Raises:
        TrajectoryError: the heading is uncertain, and no walls tell it.
    """
    rough, by_walls = smoothed
    names = extrinsics.T_vehicle_lidar
    chosen = {name: choose_scans(recording.scan_stamps_ns(name), rough) for name in names}
    least_ns = 2 * MERGE_NS if isinstance(rough, GivenTrajectory) else COMMON_NS
    nodes = _nodes(chosen, extrinsics, rough.span_ns, least_ns)
    with progress.stage("smoothing the trajectory at the scans", None):
        wanted = nodes
        if by_walls is not None:
            # An estimated time offset moves the one and not the other.
            nodes = moved_to_neighbours(nodes, by_walls.trajectory.stamps_ns, COMMON_NS)
            wanted = np.union1d(nodes, by_walls.trajectory.stamps_ns)
        (trajectory,) = smooth_trajectories(
            [recording], config, [wanted], motions, [rough], by_walls=by_walls is not None
        )
        if by_walls is not None and isinstance(trajectory, SmoothedTrajectory):
            at = by_walls.trajectory.stamps_ns
            trajectory = about_poses(trajectory, at, *by_walls.poses_at(at))
    return Way(
        trajectory,
        chosen,
        lambda taken_ns: pose_covariance(taken_ns, nodes, trajectory, calibration, config),
    )


def _common_lidars(
    recording: Recording, calibration: Calibration, config: Config
) -> tuple[tuple[str, ...], list[str]]:
    """LiDARs to validate, in the config's order, and a note for each that is left out."""
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
        BEFORE: Extrinsics({name: config.lidars[name].guess() for name in names}, {}),
    }


def _with_guesses(names: Sequence[str], calibration: Calibration, config: Config) -> Config:
    """The config with the guesses that the calibration found for LiDARs without any.

    A LiDAR without a guess that is not in the calibration either is left out.
    """
    lidars = {n: of for n, of in config.lidars.items() if n in names or of.initial is not None}
    config = config.model_copy(update={"lidars": lidars})
    for name in names:
        if config.lidars[name].initial is None:
            result = calibration.lidars[name]
            start = result.T_vehicle_lidar if result.guess is None else result.guess.T_vehicle_lidar
            config = with_found_guess(config, name, start)
    return config


def _is_found(config: Config, name: str) -> bool:
    """Whether nobody gave a guess of a LiDAR."""
    return isinstance(config.lidars[name], FoundLidarConfig)


def moved_to_neighbours(stamps_ns: IntArray, others_ns: IntArray, within_ns: int) -> IntArray:
    """Stamps (k,), ascending: (n,) of which those within `within_ns` of others are these others."""
    if not len(others_ns):
        return stamps_ns
    found = others_ns[nearest_node(others_ns, stamps_ns)]
    return np.unique(np.where(np.abs(found - stamps_ns) <= within_ns, found, stamps_ns))


def _nodes(
    chosen: Mapping[str, IntArray],
    extrinsics: Extrinsics,
    span_ns: tuple[int, int],
    least_ns: int,
) -> IntArray:
    """Times of the scans, ascending; times that share a node, within `least_ns`, appear once."""
    taken = [extrinsics.true_ns(name, stamps) for name, stamps in chosen.items()]
    stamps = np.unique(np.clip(np.concatenate([*taken, np.zeros(0, dtype=np.int64)]), *span_ns))
    return without_neighbours(stamps, least_ns)


def _measured(
    drive: str,
    clouds: Clouds,
    aligned: tuple[str, Structure, tuple[gtsam.Pose3, ...]],
    errors: Errors,
    warnings: tuple[str, ...],
    before: str,
) -> Validation:
    """Measures the structure of the best alignment under the extrinsics of all stages."""
    start, structure, best = aligned
    stages: Stages = {
        BEFORE: (clouds.placed[BEFORE], None),
        AFTER: (clouds.placed[AFTER], None),
        BEST: (clouds.placed[start], best),
    }
    surfaces = _surfaces(clouds, structure, stages, errors)
    things = tuple(
        _thing(clouds, f"object {number}", thing, stages)
        for number, thing in enumerate(structure.things, start=1)
    )
    pairs = _pairs(clouds, surfaces, stages)
    thickness = {s: rms([x.thickness[s].merged for x in surfaces]) for s in STAGES}
    alone = {
        stage: {
            name: rms(values)
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
        name: rms([x.expected.alone[name] for x in surfaces if name in x.expected.alone])
        for name in alone[AFTER]
    }
    expected = rms([x.expected.merged for x in surfaces])
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
        verdict=judge(surfaces, things, pairs, (alone, expected_alone), errors, before),
        clouds=clouds,
        best=best,
        warnings=warnings,
        before=before,
    )


def _surfaces(
    clouds: Clouds, structure: Structure, stages: Stages, errors: Errors
) -> list[SurfaceResult]:
    """Walls and poles, numbered by kind."""
    out = []
    numbers: dict[str, int] = {}
    for surface in structure.surfaces:
        kind = "pole"
        if isinstance(surface, Wall):
            kind = "ground" if surface.is_level else "wall"
        numbers[kind] = numbers.get(kind, 0) + 1
        meter = SurfaceMeter(clouds, surface)
        found = {stage: meter.measure(placed, poses) for stage, (placed, poses) in stages.items()}
        out.append(
            SurfaceResult(
                f"{kind} {numbers[kind]}",
                surface,
                meter.points,
                {stage: thickness for stage, (thickness, _) in found.items()},
                {stage: apart for stage, (_, apart) in found.items()},
                meter.expect(
                    stages[AFTER][0], errors, meter.relief_m(*stages[BEST], errors.sigma_range_m)
                ),
            )
        )
    return out


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
            shared = [s for s in surfaces if is_shared(s, (a, b))]
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
                        stage: rms([s.apart[stage][a, b].distance_m for s in shared])
                        for stage in STAGES
                        if shared
                    },
                    rms([s.expected.distance_m[a, b] for s in shared]),
                    {s: float(np.mean([m for m, _ in f])) if f else None for s, f in both.items()},
                    {s: float(np.mean([o for _, o in f])) if f else 0.0 for s, f in both.items()},
                )
            )
    return tuple(out)
