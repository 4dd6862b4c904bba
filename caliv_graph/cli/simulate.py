"""`caliv-graph simulate`: a drive with known truth from a scenario."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from caliv_graph.cli import streams
from caliv_graph.cli.options import AsJson, Force

if TYPE_CHECKING:
    from caliv_graph.simulation import SimulatedDrive

_MOST_THREADS = 4
"""More threads do not speed up the ray casting of one cloud."""


def simulate(
    scenario: Annotated[
        Path,
        typer.Argument(
            metavar="SCENARIO.yaml", help="The drive; configs/scenarios/ has commented examples."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the drive.")],
    seed: Annotated[
        int,
        typer.Option("--seed", metavar="N", help="Seed of all noise and of the initial guesses."),
    ] = 0,
    output: Annotated[
        Literal["bag", "caliv", "both"],
        typer.Option(
            "--format",
            help="A ROS 2 bag (MCAP) with raw sensors, a CaLiV folder with vehicle poses, or both.",
        ),
    ] = "bag",
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Simulate a drive past a target, with known truth.

    DIR contains drive/ (the bag), caliv/ (the CaLiV folder), truth.yaml (true extrinsics),
    trajectory.tum (true poses), scenario.yaml (the effective scenario) and config.yaml, ready to
    run, with errors of the initial guesses as in the scenario.

    Example: caliv-graph simulate configs/scenarios/figure_eight.yaml --out drive/ --seed 1
    """
    from caliv_graph.common.files import check_output_folder
    from caliv_graph.simulation import load_scenario, write_drive
    from caliv_graph.simulation.simulate import CONTENT

    described = load_scenario(scenario)
    check_output_folder(out, CONTENT, force)
    threads = min(_MOST_THREADS, os.cpu_count() or 1)
    with streams.progress_on_stdout(as_json) as progress:
        drive = write_drive(
            described,
            out,
            seed,
            output=output,
            force=force,
            threads=threads,
            progress=progress,
        )
    if as_json:
        streams.show_json(_document(drive, described.name, seed))
    else:
        _say(drive, described.name, seed)


def _say(drive: SimulatedDrive, name: str, seed: int) -> None:
    streams.say(f"{name}, seed {seed}: {drive.duration_s:.1f} s")
    for lidar, scans in drive.scans.items():
        if not scans.points:
            streams.say(f"{lidar}: all clouds are empty")
            continue
        seen = [count for count in scans.target_points if count]
        target = f"{len(seen)} with a target of up to {max(seen)} points" if seen else "no target"
        streams.say(
            f"{lidar}: {len(scans.points)} clouds of {min(scans.points)} to {max(scans.points)} "
            f"points, {target}"
        )
    streams.say(
        f"Written to {drive.folder}. Next: caliv-graph calibrate {drive.folder}/config.yaml "
        "--out result"
    )


def _document(drive: SimulatedDrive, name: str, seed: int) -> dict[str, Any]:
    return {
        "scenario": name,
        "seed": seed,
        "out": str(drive.folder),
        "duration_s": drive.duration_s,
        "lidars": {
            lidar: {"points": list(scans.points), "target_points": list(scans.target_points)}
            for lidar, scans in drive.scans.items()
        },
    }
