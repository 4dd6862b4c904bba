"""All figures of report.html, by the section of the page that shows them."""

from __future__ import annotations

from collections.abc import Sequence

from caliv_graph.products import Calibration, Solution
from caliv_graph.report.figures.alignment import scene_figure, target_figures
from caliv_graph.report.figures.drawing import Figure
from caliv_graph.report.figures.fit import convergence_figure, residual_figure, weight_figure
from caliv_graph.report.figures.strips import strip_figure, thickness_figure
from caliv_graph.report.figures.trajectory import correction_figure, motion_figure, path_figure
from caliv_graph.report.figures.uncertainty import (
    correlation_figure,
    sigma_figure,
    spectrum_figure,
)
from caliv_graph.report.residuals import all_residuals
from caliv_graph.results.run import RunRecord
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.wording.guesses import before_words

MOST_SOLID = 2
"""Placements, and drives, that get a 3-D view: a browser draws about a dozen views at once."""


def report_figures(
    calibration: Calibration, solution: Solution, record: RunRecord
) -> dict[str, list[Figure]]:
    """Per section its figures, in the order of the page; a section may be empty."""
    kinds = all_residuals(solution, record)
    unguessed = [name for name, lidar in calibration.lidars.items() if lidar.without_guess]
    sections: dict[str, Sequence[Figure | None]] = {
        "extrinsics": [sigma_figure(calibration)],
        "observability": [spectrum_figure(solution), correlation_figure(calibration)],
        "alignment": [
            *_targets(calibration, solution),
            *_scenes(calibration, record),
        ],
        "residuals": [residual_figure(kind, n) for n, kind in enumerate(kinds, start=1)],
        "structure": [
            *(
                strip_figure(term, record.drives[term.drive])
                for term in solution.structure[:MOST_SOLID]
            ),
            thickness_figure(solution, before_words(list(calibration.lidars), unguessed)),
        ],
        "weights": [weight_figure(solution, list(calibration.lidars))],
        "trajectory": _trajectories(calibration, solution, record),
        "convergence": [convergence_figure(solution)],
    }
    return {name: [f for f in found if f is not None] for name, found in sections.items()}


def _targets(calibration: Calibration, solution: Solution) -> list[Figure]:
    out = []
    for placement in range(len(solution.registrations)):
        solid, flat = target_figures(placement, solution, calibration)
        # The flat one first: it has a first picture, which is there at once.
        out += [flat, solid] if placement < MOST_SOLID else [flat]
    return out


def _scenes(calibration: Calibration, record: RunRecord) -> list[Figure | None]:
    drives = zip(record.drives[:MOST_SOLID], record.trajectories, strict=False)
    return [
        scene_figure(drive, trajectory, record.scene.get(drive, ()), calibration, name)
        for drive, (name, trajectory) in enumerate(drives)
    ]


def _trajectories(
    calibration: Calibration, solution: Solution, record: RunRecord
) -> list[Figure | None]:
    out: list[Figure | None] = []
    drives = zip(record.drives, record.trajectories, strict=True)
    for drive, (name, trajectory) in enumerate(drives):
        out.append(path_figure(drive, trajectory, solution, name, list(calibration.lidars)))
        if isinstance(trajectory, SmoothedTrajectory):
            out.append(motion_figure(drive, trajectory, name))
        out.append(correction_figure(drive, trajectory, solution, name))
    return out
