"""Simulating a drive: scenario in, bag or CaLiV folder with known truth out."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import gtsam
import numpy as np

from caliv_graph.common.files import check_output_folder, output_folder
from caliv_graph.common.progress import Progress, SilentProgress
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import ConfigError
from caliv_graph.products import IntArray
from caliv_graph.readers.caliv_folder import FRAME_PERIOD_NS, POSES_FILE
from caliv_graph.scenario.model import Scenario
from caliv_graph.simulation.noise import Stream, noisy_poses, random_stream
from caliv_graph.simulation.recording import SimulatedRecording, SimulatedScan, simulate_drive
from caliv_graph.simulation.writer import (
    BAG_FOLDER,
    CALIV_FOLDER,
    sensor_folders,
    write_config,
    write_ego_poses,
    write_pcd,
    write_scenario,
    write_truth,
    write_tum,
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
"""What the folder of a simulated drive holds, for `files.output_folder`."""

STRIDE_TOLERANCE = 1e-6
"""How far from a whole number a LiDAR's period may be, in frames: rounding of the YAML's rate."""

TRAJECTORY_PERIOD_NS = NANOSECONDS_PER_SECOND // 100
"""Of the true poses that are written beside a bag, besides those at the stamps of clouds."""


@dataclass(frozen=True)
class SimulatedScans:
    """What one LiDAR recorded.

    Attributes:
        points: points of each scan that was written, in the order of their stamps.
        target_points: how many of them lie on a target.
    """

    points: tuple[int, ...]
    target_points: tuple[int, ...]


@dataclass(frozen=True)
class SimulatedDrive:
    """What was written.

    Attributes:
        folder: where.
        duration_s: duration of the drive.
        scans: per LiDAR.
    """

    folder: Path
    duration_s: float
    scans: dict[str, SimulatedScans]


def _check_frames(scenario: Scenario) -> None:
    """Raises if a CaLiV folder cannot express when a LiDAR takes its clouds."""
    frame_s = FRAME_PERIOD_NS / NANOSECONDS_PER_SECOND
    for name, model in scenario.lidars.items():
        period = NANOSECONDS_PER_SECOND / model.rate_hz / FRAME_PERIOD_NS
        stride = round(period)
        if stride < 1 or abs(period - stride) > STRIDE_TOLERANCE * period:
            raise ConfigError(
                f"lidars.{name}.rate_hz: a CaLiV folder has a frame every {frame_s:g} s, of which "
                f"{model.rate_hz:g} Hz would need one every {period:.3g}. Take 10 Hz divided by a "
                "whole number, or write a bag (--format bag)"
            )
        if round(model.phase_s * NANOSECONDS_PER_SECOND) % FRAME_PERIOD_NS:
            raise ConfigError(
                f"lidars.{name}.phase_s: a CaLiV folder has a frame every {frame_s:g} s and none "
                f"at {model.phase_s:g} s. Write a bag (--format bag), or take 0"
            )
        if model.sweep is not None:
            raise ConfigError(
                f"lidars.{name}.sweep: a CaLiV folder does not tell when each point was taken. "
                "Write a bag (--format bag), or leave 'sweep' out"
            )


def _scans(recording: SimulatedRecording) -> Iterator[tuple[int, Iterator[SimulatedScan]]]:
    """The clouds of all LiDARs in the order in which they are complete, in groups of one time."""

    def complete_ns(taken: SimulatedScan) -> int:
        return recording.complete_ns(taken.scan)

    merged = heapq.merge(
        *(recording.scans_with_truth(name) for name in recording.lidars), key=complete_ns
    )
    return itertools.groupby(merged, key=complete_ns)


class _CalivWriter:
    """Writes clouds and noisy poses as a CaLiV folder."""

    def __init__(self, folder: Path, recording: SimulatedRecording) -> None:
        """Makes the folders.

        Args:
            folder: the folder above `input/`.
            recording: what is written.
        """
        self._clouds = folder / "input"
        self._start_ns = recording.truth.start_ns
        self._sensors = dict(zip(recording.lidars, sensor_folders(recording.scenario), strict=True))
        self._poses: dict[str, list[tuple[int, gtsam.Pose3]]] = {}
        for sensor in self._sensors.values():
            (self._clouds / sensor).mkdir(parents=True)
            self._poses[sensor] = []
        # The poses of a filter know of the heave, unlike those of an IMU.
        stamps_ns, poses = frame_poses(recording)
        self._T_map_vehicle_given = noisy_poses(
            stamps_ns,
            poses,
            recording.scenario.poses,
            random_stream(recording.seed, Stream.POSES),
        )

    def write(self, taken: SimulatedScan) -> None:
        """Writes a cloud, unless it is empty: a PCD without points is none."""
        scan = taken.scan
        if not len(scan.points_lidar):
            return
        frame = (scan.stamp_ns - self._start_ns) // FRAME_PERIOD_NS
        sensor = self._sensors[scan.lidar]
        write_pcd(self._clouds / sensor / f"{frame}.pcd", scan.points_lidar)
        self._poses[sensor].append((frame, self._T_map_vehicle_given[frame]))

    def finish(self) -> None:
        """Writes the poses of all clouds."""
        write_ego_poses(self._clouds / POSES_FILE, self._poses)


def frame_poses(recording: SimulatedRecording) -> tuple[IntArray, tuple[gtsam.Pose3, ...]]:
    """True T_map_vehicle of all frames of a CaLiV folder, heave included.

    Returns:
        (n,) nanoseconds since the start of the drive, and n poses.
    """
    truth = recording.truth
    stamps_ns: IntArray = np.arange(
        0, truth.end_ns - truth.start_ns + 1, FRAME_PERIOD_NS, dtype=np.int64
    )
    return stamps_ns, truth.drive.poses(stamps_ns, truth.level_z_map + truth.heave_m)


def _write_trajectory(path: Path, recording: SimulatedRecording, has_bag: bool) -> None:
    if not has_bag:
        write_tum(path, *frame_poses(recording))
        return
    truth = recording.truth
    stamps = [np.arange(truth.start_ns, truth.end_ns + 1, TRAJECTORY_PERIOD_NS, dtype=np.int64)]
    stamps += [np.array(recording.scan_stamps_ns(name), np.int64) for name in recording.lidars]
    stamps_ns = np.unique(np.concatenate(stamps))
    latitude, longitude, altitude = truth.datum
    write_tum(
        path,
        stamps_ns,
        truth.T_map_vehicle(stamps_ns),
        f"map: ENU, origin at latitude {latitude:.9f} longitude {longitude:.9f} degrees, altitude "
        f"{altitude:.4f} m (WGS84). vehicle: {recording.scenario.name}, without heave",
    )


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

    `trajectory.tum` has true poses. Beside a bag: every 10 ms and at the stamps of all clouds, by
    the clock of the bag, without heave, which is what IMU and GNSS measure. Beside a CaLiV folder
    alone: of all frames, from 0 s, with heave, which is what the given poses measure.

    Args:
        scenario: the drive.
        out_dir: folder to write; it appears when everything is in it.
        seed: of all that is drawn.
        output: what to write; with a bag, `config.yaml` is for the bag.
        force: replace an older simulated drive at `out_dir`.
        threads: threads that cast rays; the result does not depend on it.
        progress: told of each time at which clouds are taken; None: nobody is.

    Raises:
        ConfigError: what a CaLiV folder or a bag cannot express, or a negative seed.
        OutputError: `out_dir` exists, or cannot be written.
        CalivError: open3d cannot be loaded.
    """
    has_bag, has_caliv = output != "caliv", output != "bag"
    if has_caliv:
        _check_frames(scenario)
    recording = simulate_drive(scenario, seed, threads)
    # Nobody should wait for a drive that then has no place to go.
    check_output_folder(out_dir, CONTENT, force)
    is_target = np.isin(recording.world.names, recording.world.targets)
    scans: dict[str, list[tuple[int, int]]] = {name: [] for name in recording.lidars}
    times = {stamp for name in recording.lidars for stamp in recording.complete_stamps_ns(name)}
    with output_folder(out_dir, CONTENT, force) as folder, ExitStack() as writers:
        caliv = _CalivWriter(folder / CALIV_FOLDER, recording) if has_caliv else None
        bag = writers.enter_context(_bag_writer(folder, recording)) if has_bag else None
        with (progress or SilentProgress()).stage("simulating", len(times)) as advance:
            for _, together in _scans(recording):
                for taken in together:
                    on_target = is_target[taken.objects[taken.objects >= 0]]
                    count = (len(taken.objects), int(on_target.sum()))
                    if bag is not None:
                        bag.write(taken.scan)
                    if caliv is not None:
                        caliv.write(taken)
                    if bag is not None or count[0]:
                        scans[taken.scan.lidar].append(count)
                advance()
        if caliv is not None:
            caliv.finish()
        # Here, so that what the bag has buffered is written before the folder is moved.
        writers.close()
        _write_trajectory(folder / "trajectory.tum", recording, has_bag)
        write_config(folder / "config.yaml", recording, has_bag)
        write_truth(
            folder / "truth.yaml", recording.truth.T_vehicle_lidar, recording.truth.time_offset_s
        )
        write_scenario(folder / "scenario.yaml", scenario, seed)
    return SimulatedDrive(
        folder=out_dir,
        duration_s=recording.truth.drive.duration_s,
        scans={
            name: SimulatedScans(tuple(n for n, _ in counts), tuple(n for _, n in counts))
            for name, counts in scans.items()
        },
    )


def _bag_writer(folder: Path, recording: SimulatedRecording) -> BagWriter:
    # rosbags takes a quarter of a second to import, which a CaLiV folder does without.
    from caliv_graph.simulation.bag import BagWriter

    return BagWriter(folder / BAG_FOLDER, recording)


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
