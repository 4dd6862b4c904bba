"""The early stages, common to all that solves: trajectory, target, ground."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from caliv_graph.config import Config
from caliv_graph.products import GroundObservation, MotionData, Recording, TargetObservation
from caliv_graph.progress import Progress
from caliv_graph.targets import extract_targets
from caliv_graph.targets.ground_planes import measure_grounds
from caliv_graph.trajectory.select import VehicleTrajectory, smooth_trajectories


@dataclass(frozen=True)
class Prepared:
    """Recorded drives, ready to be solved.

    Attributes:
        trajectories: one per drive, with a node at every scan that sees a target.
        observations: the targets' clouds.
        grounds: the ground as the LiDARs saw it.
        warnings: what a person should know, a line each.
    """

    trajectories: tuple[VehicleTrajectory, ...]
    observations: tuple[TargetObservation, ...]
    grounds: tuple[GroundObservation, ...]
    warnings: tuple[str, ...]


def prepare(
    recordings: Sequence[Recording],
    config: Config,
    motions: Mapping[int, MotionData],
    progress: Progress,
) -> Prepared:
    """Smooths the trajectories and finds target and ground along them.

    Args:
        recordings: opened drives.
        config: topics, noise, target, ground.
        motions: what each drive, by its index, tells of the vehicle's motion.
        progress: told of every stage.

    Raises:
        CalivError: something is wrong with the input; the message says what to do.
    """
    with progress.stage("smoothing the trajectory", None):
        rough = smooth_trajectories(recordings, config, [[] for _ in recordings], motions)
    observations = extract_targets(recordings, rough, config, progress)
    grounds, ground_warnings = measure_grounds(recordings, rough, observations, config, progress)
    with progress.stage("smoothing the trajectory at the target's scans", None):
        stamps = _stamps_seen(len(recordings), observations)
        del rough  # a graph of its own, which nobody asks any more
        trajectories = smooth_trajectories(recordings, config, stamps, motions)
    warnings = [w for r in recordings for w in r.warnings()]
    warnings += [w for t in trajectories for w in t.warnings]
    warnings += [w for o in observations for w in o.warnings]
    return Prepared(
        tuple(trajectories), tuple(observations), tuple(grounds), (*warnings, *ground_warnings)
    )


def _stamps_seen(drives: int, observations: Sequence[TargetObservation]) -> list[list[int]]:
    """Per drive the stamps of the scans that see a target."""
    seen = {(cloud.drive, cloud.stamp_ns) for o in observations for cloud in o.clouds}
    return [sorted(stamp for d, stamp in seen if d == drive) for drive in range(drives)]
