"""From a scenario to a bag or a CaLiV folder with known truth."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from caliv_graph.common.files import check_output_folder, output_folder
from caliv_graph.common.progress import Progress, SilentProgress
from caliv_graph.readers.caliv_folder import POSES_FILE
from caliv_graph.scenario.model import Scenario
from caliv_graph.simulation.caliv_folder import CALIV_FOLDER, CalivWriter, check_frames
from caliv_graph.simulation.recording import SimulatedRecording, SimulatedScan, simulate_drive
from caliv_graph.simulation.writer import (
    BAG_FOLDER,
    write_config,
    write_scenario,
    write_trajectory,
    write_truth,
)

if TYPE_CHECKING:
    from caliv_graph.simulation.bag import BagWriter

Format = Literal["bag", "caliv", "both"]

CONTENT = (
    "truth.yaml",
    "trajectory.tum",
    "config.yaml",
    "scenario.yaml",
    f"{CALIV_FOLDER}/input/{POSES_FILE}",
    f"{CALIV_FOLDER}/input/sensor_[0-9]*/[0-9]*.pcd",
    f"{BAG_FOLDER}/metadata.yaml",
    f"{BAG_FOLDER}/*.mcap",
)
"""Content of the folder of a simulated drive, for `files.output_folder`."""


@dataclass(frozen=True)
class SimulatedScans:
    """Points per written scan of one LiDAR, and those on a target, in the order of stamps."""

    points: tuple[int, ...]
    target_points: tuple[int, ...]


@dataclass(frozen=True)
class SimulatedDrive:
    """A drive that was written, with the sizes of the clouds per LiDAR."""

    folder: Path
    duration_s: float
    scans: dict[str, SimulatedScans]


def write_drive(
    scenario: Scenario,
    out_dir: Path,
    seed: int,
    *,
    output: Format = "bag",
    force: bool = False,
    threads: int = 2,
    progress: Progress | None = None,
) -> SimulatedDrive:
    """Simulates a drive and writes it with its truth.

    Writes `drive/` (a ROS 2 bag), or `caliv/input/`, or both; `truth.yaml`; `trajectory.tum`;
    `config.yaml` (ready to run, with a perturbed initial guess) and `scenario.yaml` (the effective
    one). The same scenario and seed give the same bytes.

    `trajectory.tum` has true poses. With a bag: every 10 ms and at the stamps of all clouds, in the
    clock of the bag, without heave, because IMU and GNSS do not measure it. With a CaLiV folder
    only: at all frames, from 0 s, with heave, because the given poses include it.

    Args:
        scenario: the drive.
        out_dir: folder to write; it appears when it is complete.
        seed: seed of all draws.
        output: which format to write; with a bag, `config.yaml` is for the bag.
        force: replace an older simulated drive at `out_dir`.
        threads: threads that cast rays; the result does not depend on it.
        progress: advanced at each time at which clouds are taken.

    Raises:
        ConfigError: the format cannot represent the scenario, or the seed is negative.
        OutputError: `out_dir` exists, or cannot be written.
        CalivError: open3d cannot be loaded.
    """
    has_bag, has_caliv = output != "caliv", output != "bag"
    if has_caliv:
        check_frames(scenario)
    recording = simulate_drive(scenario, seed, threads)
    # Checked before the simulation, which takes long.
    check_output_folder(out_dir, CONTENT, force)
    with output_folder(out_dir, CONTENT, force) as folder:
        with ExitStack() as stack:
            writers: list[BagWriter | CalivWriter] = []
            if has_bag:
                # rosbags takes 0.25 s to import, and a CaLiV folder does not need it.
                from caliv_graph.simulation.bag import BagWriter

                writers.append(stack.enter_context(BagWriter(folder / BAG_FOLDER, recording)))
            if has_caliv:
                caliv = CalivWriter(folder / CALIV_FOLDER, recording)
                writers.append(stack.enter_context(caliv))
            scans = _write_scans(recording, writers, has_bag, progress or SilentProgress())
        write_trajectory(folder / "trajectory.tum", recording, has_bag)
        write_config(folder / "config.yaml", recording, has_bag)
        write_truth(
            folder / "truth.yaml", recording.truth.T_vehicle_lidar, recording.truth.time_offset_s
        )
        write_scenario(folder / "scenario.yaml", scenario, seed)
    return SimulatedDrive(out_dir, recording.truth.drive.duration_s, scans)


def _write_scans(
    recording: SimulatedRecording,
    writers: Sequence[BagWriter | CalivWriter],
    has_bag: bool,
    progress: Progress,
) -> dict[str, SimulatedScans]:
    """Writes all clouds; returns their sizes. Without a bag, empty clouds are not written."""
    is_target = np.isin(recording.world.names, recording.world.targets)
    counts: dict[str, list[tuple[int, int]]] = {name: [] for name in recording.lidars}
    times = {stamp for name in recording.lidars for stamp in recording.complete_stamps_ns(name)}

    def complete_ns(taken: SimulatedScan) -> int:
        return recording.complete_ns(taken.scan)

    by_lidar = (recording.scans_with_truth(name) for name in recording.lidars)
    merged = heapq.merge(*by_lidar, key=complete_ns)
    with progress.stage("simulating", len(times)) as advance:
        for _, together in itertools.groupby(merged, key=complete_ns):
            for taken in together:
                for writer in writers:
                    writer.write(taken.scan)
                on_target = is_target[taken.objects[taken.objects >= 0]]
                if has_bag or len(taken.objects):
                    counts[taken.scan.lidar].append((len(taken.objects), int(on_target.sum())))
            advance()
    return {
        name: SimulatedScans(tuple(n for n, _ in of), tuple(n for _, n in of))
        for name, of in counts.items()
    }


def simulate_caliv(
    scenario: Scenario,
    out_dir: Path,
    seed: int,
    *,
    force: bool = False,
    threads: int = 2,
    progress: Progress | None = None,
) -> SimulatedDrive:
    """Simulates a drive and writes it as a CaLiV folder with its truth: see `write_drive`."""
    return write_drive(
        scenario, out_dir, seed, output="caliv", force=force, threads=threads, progress=progress
    )
