"""Repeatability: the two halves of a drive, each calibrated by itself, compared with each other.

The first stages of `pipeline.calibrate` run once. The target's clouds are then split into two
halves, and each half is solved. The two results are tested against each other like those of two
drives (`fusion.compare`): with their joint covariance, along the directions that both determine.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.calibration.assemble import assemble
from caliv_graph.calibration.estimate import estimate
from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config, StructureConfig
from caliv_graph.conventions import AXES
from caliv_graph.errors import RegistrationError, SolveError, TargetError
from caliv_graph.fusion.compare import Comparison, Movement, compare
from caliv_graph.fusion.terms import drive_digest
from caliv_graph.odometry.run import needs_odometry
from caliv_graph.pipeline import Prepared, prepare
from caliv_graph.products import (
    Calibration,
    MotionData,
    Recording,
    TargetCloud,
    TargetObservation,
)
from caliv_graph.validation.findings import Validation, worst_of
from caliv_graph.validation.verdict import CONTRADICTION
from caliv_graph.wording.halves import alike_sentence, elsewhere_sentence

PASS_GAP_NS = 5_000_000_000
"""Gap between two clouds of the target after which a new pass begins."""

WITHOUT_TARGET = "without a target the drive is not halved: both halves would see the same walls"
WITHOUT_MOTION = (
    "without motion data no target is used, and the drive is not halved: both halves would see the "
    "same walls"
)


@dataclass(frozen=True)
class Repeatability:
    """The halves of a drive against each other.

    Attributes:
        halves: names of the halves, in words.
        comparison: comparison of the two results; None if a half could not be calibrated.
        by_passes: whether they are passes of the target. If not, they share the errors of the
            trajectory, and agree better than two drives would.
        reason: the reason why there is no comparison.
        results: calibration of each half; empty without a comparison.
    """

    halves: tuple[str, str]
    comparison: Comparison | None
    by_passes: bool = False
    reason: str = ""
    results: tuple[Calibration, ...] = ()


Halves = tuple[tuple[TargetCloud, ...], tuple[TargetCloud, ...]]


def split(observation: TargetObservation, fewest: int) -> Halves | None:
    """Splits the clouds of a target into two halves by passes.

    Args:
        observation: the clouds of the target.
        fewest: number of clouds that each LiDAR needs in each half.

    Returns:
        The two halves; None if a LiDAR passed the target only once.
    """
    halves: tuple[list[TargetCloud], list[TargetCloud]] = ([], [])
    for name in dict.fromkeys(cloud.lidar for cloud in observation.clouds):
        clouds = [cloud for cloud in observation.clouds if cloud.lidar == name]
        stamps = np.array([cloud.stamp_ns for cloud in clouds], dtype=np.int64)
        begins = np.flatnonzero(np.diff(stamps) > PASS_GAP_NS) + 1
        begins = begins[(begins >= fewest) & (len(clouds) - begins >= fewest)]
        if not len(begins):
            return None
        middle = int(begins[np.abs(begins - len(clouds) / 2).argmin()])
        halves[0].extend(clouds[:middle])
        halves[1].extend(clouds[middle:])
    return tuple(halves[0]), tuple(halves[1])


def alternate(observation: TargetObservation) -> Halves:
    """Splits the clouds of a target into two halves alternately, per LiDAR."""
    halves: tuple[list[TargetCloud], list[TargetCloud]] = ([], [])
    for name in dict.fromkeys(cloud.lidar for cloud in observation.clouds):
        clouds = [cloud for cloud in observation.clouds if cloud.lidar == name]
        halves[0].extend(clouds[::2])
        halves[1].extend(clouds[1::2])
    return tuple(halves[0]), tuple(halves[1])


def split_halves(
    recording: Recording,
    config: Config,
    progress: Progress,
    p_value: float,
    motion: MotionData | None = None,
) -> Repeatability:
    """Calibrates the two halves of a drive and compares them.

    If every LiDAR passes the target twice, the halves are the passes, and their errors are almost
    independent. Otherwise each half has every other scan. Such halves share the errors of the
    trajectory, so they agree better than two drives would.

    Args:
        recording: the drive.
        config: as for `calibrate`.
        progress: reports every stage.
        p_value: probability of a false alarm over all tests.
        motion: the recording's motion data, if they have been read already.

    Raises:
        RecordingError, TrajectoryError: the recording could not be read.
    """
    motion = recording.motion() if motion is None else motion
    if needs_odometry(motion, config):
        return Repeatability(("", ""), None, reason=WITHOUT_MOTION)
    # Both halves would have the same structure, and agree by it.
    config = config.model_copy(update={"structure": StructureConfig(use=False)})
    try:
        prepared = prepare([recording], config, {0: motion}, progress)
    except TargetError as e:
        return Repeatability(("", ""), None, reason=str(e))
    observations, config = prepared.observations, prepared.config
    if not observations:
        return Repeatability(("", ""), None, reason=WITHOUT_TARGET)
    fewest = config.extraction.min_scans
    names, halves = ("first passes", "later passes"), [split(o, fewest) for o in observations]
    by_passes = None not in halves
    if not by_passes:
        names = ("every other scan", "the scans in between")
        halves = [alternate(o) for o in observations]
    digest = drive_digest(motion)
    results: list[Calibration] = []
    for half, name in enumerate(names):
        parts = tuple(
            replace(o, clouds=of[half]) for o, of in zip(observations, halves, strict=True) if of
        )
        try:
            with progress.stage(f"calibrating by half the scans: {name}", None):
                results.append(
                    _calibrated(
                        recording,
                        replace(prepared, observations=parts),
                        config,
                        progress,
                        f"{digest} {name}",
                    )
                )
        except (TargetError, RegistrationError, SolveError) as e:
            return Repeatability(names, None, by_passes, f"{name}: {e}")
    comparison = compare(results[0], results[1], names, p_value)
    return Repeatability(names, comparison, by_passes, results=tuple(results))


def with_halves(found: Validation, calibration: Calibration, repeated: Repeatability) -> Validation:
    """The validation with the test of the calibration in the file against each half of the drive.

    A difference beyond 5 sigma contradicts it. Halves of the calibrated drive have errors in common
    with it: there the test is conservative. A half that contradicts itself tests nothing.
    """
    p_value = CONTRADICTION / max(len(repeated.results), 1)
    alike: list[tuple[str, float]] = []
    elsewhere, told = [], False
    for name, result in zip(repeated.halves, repeated.results, strict=False):
        if result.contradictions:
            continue
        # The file is the second: where it has the LiDARs, less where the half has them.
        comparison = compare(result, calibration, (name, "the calibration"), p_value)
        tested = [m for m in comparison.movements if m.dof]
        off = [worst_of(m.lidars, m.movement, m.sigma, m.determined) for m in tested if m.moved]
        if off:
            elsewhere.append(elsewhere_sentence(name, max(off, key=lambda of: of.sigmas)))
        elif tested:
            alike.append((name, min(m.p_corrected for m in tested)))
            told |= any(_tells_what_level_ground_does_not(m) for m in tested)
    if elsewhere:
        return replace(found, verdict=found.verdict.also(elsewhere, contradicts=True))
    if alike:
        verdict = found.verdict.also((alike_sentence(alike),))
        if verdict.only_level and told:
            verdict = replace(verdict, word="good", only_level=False)
        return replace(found, verdict=verdict)
    return found


def _tells_what_level_ground_does_not(movement: Movement) -> bool:
    """Whether x, y and yaw of one LiDAR against another were compared."""
    axes = dict(zip(AXES, movement.determined, strict=True))
    return len(movement.lidars) > 1 and axes["x"] and axes["y"] and axes["yaw"]


def _calibrated(
    recording: Recording,
    prepared: Prepared,
    config: Config,
    progress: Progress,
    digest: str,
) -> Calibration:
    stamps = {cloud.stamp_ns for o in prepared.observations for cloud in o.clouds}
    own = [ground for ground in prepared.grounds if ground.stamp_ns in stamps]
    solution = estimate(prepared.observations, prepared.trajectories, config, progress, own)
    return assemble(solution, config, [recording], [digest])
