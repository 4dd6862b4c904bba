"""The structure that is held out: a calibration without it, and how well it lies on it.

A third of the tiles of the map is held out. The structure of the others is solved as `calibrate`
solves it, and the strips of the held-out third are measured with the guesses, with the calibration
in the file, and with that one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from caliv_graph.calibration.drift import about_walls
from caliv_graph.calibration.pose_priors import pose_priors
from caliv_graph.calibration.sensor_noise import usual_noise
from caliv_graph.calibration.structure_evidence import StructureEvidence
from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.errors import SolveError, TrajectoryError
from caliv_graph.products import Array, BoolArray, Calibration, MotionData, Recording
from caliv_graph.structure.distances import (
    Measured,
    OtherStrips,
    at_extrinsics,
    at_extrinsics_on_the_poses,
    at_guesses,
    at_the_solve,
    other_strips,
)
from caliv_graph.structure.held_out import HeldOut, hold_out
from caliv_graph.structure.own_body import without_own_body
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.problem import Problem, first_state, part_of, placed_patches
from caliv_graph.structure.read import read_patches
from caliv_graph.structure.relative import relative_problem
from caliv_graph.structure.slow_errors import slow_errors
from caliv_graph.structure.solve import Solved, solve_structure
from caliv_graph.structure.strips import TILE_M
from caliv_graph.structure.term import aligned_start, odometry_of, problem_of, usable
from caliv_graph.trajectory.select import VehicleTrajectory, smooth_trajectories
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.validation.clouds import Extrinsics
from caliv_graph.validation.covariances import pose_noise
from caliv_graph.validation.findings import (
    AFTER,
    BEFORE,
    WITHOUT,
    HeldOutStructure,
    HeldOutTest,
    HeldStrip,
    Pair,
)
from caliv_graph.validation.solved_anew import pair_tests
from caliv_graph.wording.held_out import no_held_out_sentence


@dataclass(frozen=True)
class HeldOutOutcome:
    """What came of holding out a third of the structure.

    Attributes:
        found: what the LiDARs differ by on it; None: there is none.
        sentences: why there is none.
        used: the solve without it, of a drive without motion data: its poses are the best there
            are. Else None.
        about_walls: the trajectory where walls put the vehicle, if its heading drifts; else None.
    """

    found: HeldOutStructure | None
    sentences: tuple[str, ...] = ()
    used: Solved | None = None
    about_walls: SmoothedTrajectory | None = None


@dataclass(frozen=True)
class _Drive:
    """A drive that is to be measured: its problem, and the third that is held out."""

    problem: Problem
    held: HeldOut


def measure_held_out(
    recording: Recording,
    rough: VehicleTrajectory,
    motions: Mapping[int, MotionData],
    calibration: Calibration,
    extrinsics: Extrinsics,
    config: Config,
    progress: Progress,
) -> HeldOutOutcome:
    """What the LiDARs differ by on the held-out structure, and the solve without it.

    Args:
        recording: the drive.
        rough: its trajectory.
        motions: its motion data.
        calibration: that of the file.
        extrinsics: the same, of the LiDARs to validate.
        config: guesses, noise, ground.
        progress: reports the stages.

    Raises:
        RecordingError: a cloud could not be read.
        TrajectoryError: the motion data are unusable.
    """
    if not config.structure.use:
        return HeldOutOutcome(None)
    names = list(extrinsics.T_vehicle_lidar)
    config = config.model_copy(update={"lidars": {n: config.lidars[n] for n in names}})
    (patches,) = read_patches([recording], [rough], config, progress, keep_level=True)
    patches, _ = without_own_body(patches, rough, config)
    if not len(patches.scan):
        return _nothing("no LiDAR sees flat surfaces")
    with progress.stage("calibrating without a third of the structure", None):
        stamps = np.unique(patches.stamps_ns)
        (trajectory,) = smooth_trajectories([recording], config, [stamps], motions, by_walls=True)
        try:
            about = _about_walls(trajectory, patches, extrinsics, config)
        except (SolveError, TrajectoryError) as error:
            return _nothing(error.what)
        drive = _drive(patches, about, calibration, extrinsics, config)
        try:
            other = _without(drive, about, config)
        except SolveError as error:
            return _nothing(error.what)
        if other is None:
            return _nothing("too little of it stands still")
        # Poses by the LiDARs' own odometry hang on the extrinsics alone.
        own = odometry_of([trajectory]) is not None
        measure = at_extrinsics_on_the_poses if own else at_extrinsics
        cov = _covariance(drive.problem, calibration, names)
        measured = {
            BEFORE: at_guesses(other),
            AFTER: measure(other, extrinsics.T_vehicle_lidar, extrinsics.time_offset_s, cov),
            WITHOUT: at_the_solve(other),
        }
        first = len(drive.problem.offsets)
        pairs = pair_tests(other.used, extrinsics, cov[first:, first:], calibration.reference)
    found = replace(_found(other, drive.held, measured), pairs=pairs)
    moved = about if isinstance(about, SmoothedTrajectory) and about.elsewhere else None
    return HeldOutOutcome(found, (), other.used if own else None, moved)


def _about_walls(
    trajectory: VehicleTrajectory, patches: DrivePatches, extrinsics: Extrinsics, config: Config
) -> VehicleTrajectory:
    """The trajectory; linearised where walls put the vehicle if its heading drifts.

    By all strips, held-out ones too: where motion data are linearised is no evidence.
    """
    structure = StructureEvidence((patches,), errors=slow_errors)
    (about,), _ = about_walls([trajectory], structure, extrinsics.T_vehicle_lidar, {}, config)
    return about


def _nothing(why: str) -> HeldOutOutcome:
    return HeldOutOutcome(None, (no_held_out_sentence(why),))


def _drive(
    patches: DrivePatches,
    trajectory: VehicleTrajectory,
    calibration: Calibration,
    extrinsics: Extrinsics,
    config: Config,
) -> _Drive:
    """The problem of all strips, and which are held out: by place, with the calibration."""
    noise = usual_noise(config.noise)
    # As for the calibration: its pieces of ground are believed too much.
    on_planes = [name for name, result in calibration.lidars.items() if result.saw_target]
    patches = usable(patches, trajectory, extrinsics.T_vehicle_lidar, config, on_planes)
    priors = pose_priors(
        [trajectory],
        {0: np.unique(patches.stamps_ns)},
        noise.heave_m,
        pose_noise(calibration, config),
        config,
    )
    free = config.free_offsets() or extrinsics.time_offset_s.keys()
    problem = problem_of(patches, priors[0], trajectory, config, noise.heave_m, {}, frozenset(free))
    placed = placed_patches(problem, first_state(problem, extrinsics.T_vehicle_lidar))
    moments = placed.moments_map
    positions = moments[:, :3, 3] / moments[:, 3, 3, None]
    return _Drive(problem, hold_out(patches, positions, placed.normals_map))


def _without(drive: _Drive, trajectory: VehicleTrajectory, config: Config) -> OtherStrips | None:
    """The solve without the held-out third, from the guesses of the config, and that third."""
    problem, held = drive.problem, drive.held.patches
    rest = part_of(problem, ~held)
    if not len(rest.patches.scan) or not held.any():
        return None
    guesses = {name: lidar.guess() for name, lidar in config.lidars.items()}
    start = aligned_start([rest.patches], [trajectory], guesses, config)
    odometry = odometry_of([trajectory])
    if odometry is not None:
        rest = relative_problem(rest, odometry, start, config)
    used = solve_structure(rest, start)
    return None if used is None else other_strips(used, part_of(problem, held))


def _covariance(problem: Problem, calibration: Calibration, names: Sequence[str]) -> Array:
    """Joint covariance of the free time offsets and of the extrinsics, as the file states it."""
    order = list(calibration.lidars)
    rows = [6 * order.index(name) + axis for name in names for axis in range(6)]
    stated = [calibration.lidars[names[i]].time_offset for i in problem.offsets]
    offsets = [0.0 if offset is None else offset[1] ** 2 for offset in stated]
    out = np.zeros((len(offsets) + len(rows),) * 2)
    out[: len(offsets), : len(offsets)] = np.diag(offsets)
    out[len(offsets) :, len(offsets) :] = calibration.cov_joint[np.ix_(rows, rows)]
    return out


def _found(other: OtherStrips, held: HeldOut, measured: Mapping[str, Measured]) -> HeldOutStructure:
    """The strips one by one, and the tests."""
    seen = np.flatnonzero(other.hub >= 0)
    tested = other.regular[other.strip_of]
    strips = [_strip(other, int(k), number, measured) for number, k in enumerate(seen, start=1)]
    return HeldOutStructure(
        tiles_map_m=np.asarray(TILE_M * held.tiles, np.float64),
        tile_m=TILE_M,
        tiles_of=held.of,
        strips=tuple(strips),
        tests={stage: _test(of, tested) for stage, of in measured.items() if of.cov_m2 is not None},
        distance_m={
            stage: float(np.sqrt(np.mean(of.distances_m[tested] ** 2))) if tested.any() else 0.0
            for stage, of in measured.items()
        },
    )


def _strip(other: OtherStrips, k: int, number: int, measured: Mapping[str, Measured]) -> HeldStrip:
    names = other.problem.patches.lidars
    at = np.flatnonzero(other.strip_of == k)
    pairs: list[Pair] = [(names[other.hub[k]], names[other.lidar_of[i]]) for i in at]
    known = {stage: of for stage, of in measured.items() if of.cov_m2 is not None}
    return HeldStrip(
        name=f"strip {number}",
        surface=int(other.strips.surface[k]),
        centre_map=other.strips.centres_map[k],
        normal_map=other.strips.normals_map[k],
        scans={name: int(n) for name, n in zip(names, other.scans[k], strict=True) if n},
        tested=bool(other.regular[k]) and len(at) > 0,
        distance_m={
            stage: {p: float(of.distances_m[i]) for p, i in zip(pairs, at, strict=True)}
            for stage, of in measured.items()
        },
        sigma_m={
            stage: {p: _sigma(of, int(i)) for p, i in zip(pairs, at, strict=True)}
            for stage, of in known.items()
        },
        thickness_m={stage: float(of.thickness_m[k]) for stage, of in measured.items()},
        expected_thickness_m={
            stage: float(of.expected_m[k])
            for stage, of in known.items()
            if of.expected_m is not None
        },
    )


def _sigma(of: Measured, i: int) -> float:
    assert of.cov_m2 is not None
    return float(np.sqrt(of.cov_m2[i, i]))


def _test(of: Measured, tested: BoolArray) -> HeldOutTest:
    """The chi-square of the distances on regular strips, with their joint covariance."""
    assert of.cov_m2 is not None
    d, cov = of.distances_m[tested], of.cov_m2[np.ix_(tested, tested)]
    if not len(d):
        return HeldOutTest(0.0, 0, None, 0.0)
    chi2 = max(float(d @ np.linalg.solve(cov, d)), 0.0)
    expected = float(np.sqrt(np.trace(cov) / len(d)))
    return HeldOutTest(chi2, len(d), float(chdtrc(len(d), chi2)), expected)
