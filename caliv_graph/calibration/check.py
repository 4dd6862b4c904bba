"""Do the data contradict each other or the initial guesses? All tests of a solved graph."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from caliv_graph.calibration.score_tests import (
    assumptions,
    cloud_counts,
    registration_sigma,
    score_tests,
    typical_speed,
)
from caliv_graph.errors import SolveError
from caliv_graph.products import (
    Calibration,
    MotionData,
    Recording,
    Solution,
)
from caliv_graph.trajectory.heading import HeadingDisagreement, heading_disagreement
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.uncertainty import consistency
from caliv_graph.wording.contradictions import contradiction_sentence


def _headings(
    trajectories: Sequence[VehicleTrajectory], motions: Mapping[int, MotionData]
) -> dict[int, HeadingDisagreement]:
    """Per drive that tells it, how the orientation source and the direction of travel differ."""
    out = {}
    for index, trajectory in enumerate(trajectories):
        if isinstance(trajectory, SmoothedTrajectory):
            disagreement = heading_disagreement(trajectory, motions[index])
            if disagreement is not None:
                out[index] = disagreement
    return out


def check(
    calibration: Calibration,
    solution: Solution,
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    motions: Mapping[int, MotionData],
) -> tuple[Calibration, tuple[str, ...]]:
    """Tests a calibration against its data and its initial guesses.

    Args:
        calibration: the result.
        solution: the solved graph.
        recordings: the drives.
        trajectories: one per drive.
        motions: what each drive, by its index, tells of the vehicle's motion.

    Returns:
        The calibration, inconsistent if something contradicts something; and warnings: headings
        that disagree, and what could not be tested.
    """
    headings = _headings(trajectories, motions)
    drives = [Path(recording.name).name for recording in recordings]
    trusted = [
        name for name, lidar in calibration.lidars.items() if lidar.guess and lidar.guess.fixed
    ]
    untested: tuple[str, ...] = ()
    try:
        between = score_tests(solution, trajectories, trusted)
    except SolveError as e:
        # The result stands; that it was tested must not be believed.
        between = ()
        untested = (f"parts of the drive were not tested against each other: {e}",)
    found = consistency.contradictions(
        consistency.CheckInputs(
            lidars=calibration.lidars,
            score_tests=between,
            counts=cloud_counts(solution, trajectories),
            registration_scale=solution.registration_scale,
            registration_sigma=registration_sigma(solution),
            assumed=assumptions(solution, drives),
            headings=[
                consistency.Heading(
                    drives[index],
                    heading.yaw_rad,
                    heading.sigma_rad,
                    told_apart=heading.measured or math.isfinite(heading.axle_m),
                    measured=heading.measured,
                )
                for index, heading in headings.items()
            ],
            speed_m_s=typical_speed(solution, trajectories),
        )
    )
    if found:
        sentences = tuple(contradiction_sentence(each) for each in found)
        calibration = replace(calibration, status="inconsistent", contradictions=sentences)
    disagreements = (heading.warning for heading in headings.values() if heading.warning)
    return calibration, (*disagreements, *untested)
