"""Simulating a drive: scenario in, CaLiV folder with known truth out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np

from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import ConfigError
from caliv_graph.files import output_folder
from caliv_graph.geometry.se3 import pose_from_mounting
from caliv_graph.products import Array, IntArray
from caliv_graph.progress import Progress, SilentProgress
from caliv_graph.readers.caliv_folder import FRAME_PERIOD_NS, POSES_FILE
from caliv_graph.simulation.drives import Drive, make_drive
from caliv_graph.simulation.lidar import LidarReturns, SimulatedLidar
from caliv_graph.simulation.noise import (
    Stream,
    noisy_poses,
    perturbed_mounting,
    random_stream,
    vehicle_heights,
)
from caliv_graph.simulation.scenario import Scenario
from caliv_graph.simulation.worlds import RayCaster, World, make_world
from caliv_graph.simulation.writer import (
    CALIV_FOLDER,
    sensor_folders,
    write_config,
    write_ego_poses,
    write_pcd,
    write_scenario,
    write_truth,
    write_tum,
)

CONTENT = (
    "truth.yaml",
    "trajectory.tum",
    "config.yaml",
    "scenario.yaml",
    f"{CALIV_FOLDER}/input/{POSES_FILE}",
    f"{CALIV_FOLDER}/input/sensor_[0-9]*/[0-9]*.pcd",
)
"""What the folder of a simulated drive holds, for `files.output_folder`."""

STRIDE_TOLERANCE = 1e-6
"""How far from a whole number a LiDAR's period may be, in frames: rounding of the YAML's rate."""


@dataclass(frozen=True)
class SimulatedScans:
    """What one LiDAR recorded.

    Attributes:
        points: points of each scan that was written, in order of their frames.
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


def _frame_strides(scenario: Scenario) -> dict[str, int]:
    """Every how many frames each LiDAR takes a cloud."""
    strides = {}
    for name, model in scenario.lidars.items():
        period = NANOSECONDS_PER_SECOND / model.rate_hz / FRAME_PERIOD_NS
        stride = round(period)
        if stride < 1 or abs(period - stride) > STRIDE_TOLERANCE * period:
            raise ConfigError(
                f"lidars.{name}.rate_hz: a CaLiV folder has a frame every "
                f"{FRAME_PERIOD_NS / NANOSECONDS_PER_SECOND:g} s, of which {model.rate_hz:g} Hz "
                f"would need one every {period:.3g}. Take 10 Hz divided by a whole number"
            )
        strides[name] = stride
    return strides


def _frames(
    scenario: Scenario,
    world: World,
    drive: Drive,
    z_map: Array,
    strides: Mapping[str, int],
    seed: int,
    threads: int,
) -> Iterator[tuple[int, dict[str, LidarReturns]]]:
    """Number of each frame, and the returns of the LiDARs that take a cloud in it."""
    caster = RayCaster(world, threads)
    lidars = {
        name: SimulatedLidar(
            model, world, caster, scenario.crop, random_stream(seed, Stream.LIDAR, index)
        )
        for index, (name, model) in enumerate(scenario.lidars.items())
    }
    for frame, z in enumerate(z_map):
        scans = {}
        for name, lidar in lidars.items():
            if frame % strides[name] == 0:
                offset_ns = round(scenario.lidars[name].time_offset_s * NANOSECONDS_PER_SECOND)
                taken_ns = np.array([frame * FRAME_PERIOD_NS - offset_ns])
                (T_map_vehicle,) = drive.poses(taken_ns, z)
                scans[name] = lidar.scan(T_map_vehicle)
        yield frame, scans


def simulate_caliv(
    scenario: Scenario,
    out_dir: Path,
    seed: int,
    *,
    force: bool = False,
    threads: int = 2,
    progress: Progress | None = None,
) -> SimulatedDrive:
    """Simulates a drive and writes it as a CaLiV folder with its truth.

    Writes `caliv/input/`, `truth.yaml`, `trajectory.tum` (true poses of all frames), `config.yaml`
    (ready to run, with a perturbed initial guess) and `scenario.yaml` (the effective one). The same
    scenario and seed give the same bytes. A scan without a single return is not written.

    Args:
        scenario: the drive.
        out_dir: folder to write; it appears when everything is in it.
        seed: of all that is drawn.
        force: replace an older simulated drive at `out_dir`.
        threads: threads that cast rays; the result does not depend on it.
        progress: told of each frame; None: nobody is.

    Raises:
        ConfigError: a rate that a CaLiV folder cannot express, or a negative seed.
        OutputError: `out_dir` exists, or cannot be written.
        CalivError: open3d cannot be loaded.
    """
    strides = _frame_strides(scenario)
    drive = make_drive(scenario.drive)
    world = make_world(scenario.world)
    last_ns = round(drive.duration_s * NANOSECONDS_PER_SECOND)
    stamps_ns: IntArray = np.arange(0, last_ns + 1, FRAME_PERIOD_NS, dtype=np.int64)
    z_map = world.ground_z_map + vehicle_heights(
        scenario.suspension, len(stamps_ns), random_stream(seed, Stream.SUSPENSION)
    )
    T_map_vehicle = drive.poses(stamps_ns, z_map)
    T_map_vehicle_given = noisy_poses(
        stamps_ns, T_map_vehicle, scenario.poses, random_stream(seed, Stream.POSES)
    )
    guesses = {
        name: perturbed_mounting(
            model.mounting, scenario.initial_guess, random_stream(seed, Stream.INITIAL_GUESS, index)
        )
        for index, (name, model) in enumerate(scenario.lidars.items())
    }

    sensors = dict(zip(scenario.lidars, sensor_folders(scenario), strict=True))
    is_target = np.isin(world.names, world.targets)
    ego_poses: dict[str, list[tuple[int, gtsam.Pose3]]] = {s: [] for s in sensors.values()}
    points: dict[str, list[int]] = {name: [] for name in sensors}
    target_points: dict[str, list[int]] = {name: [] for name in sensors}
    with output_folder(out_dir, CONTENT, force) as folder:
        clouds = folder / CALIV_FOLDER / "input"
        for sensor in sensors.values():
            (clouds / sensor).mkdir(parents=True)
        with (progress or SilentProgress()).stage("simulating", len(stamps_ns)) as advance:
            for frame, scans in _frames(scenario, world, drive, z_map, strides, seed, threads):
                for name, returns in scans.items():
                    if not len(returns.points_lidar):
                        continue
                    sensor = sensors[name]
                    write_pcd(clouds / sensor / f"{frame}.pcd", returns.points_lidar)
                    ego_poses[sensor].append((frame, T_map_vehicle_given[frame]))
                    points[name].append(len(returns.points_lidar))
                    target_points[name].append(int(is_target[returns.objects].sum()))
                advance()
        write_ego_poses(clouds / POSES_FILE, ego_poses)
        write_tum(folder / "trajectory.tum", stamps_ns, T_map_vehicle)
        write_config(folder / "config.yaml", scenario, world, guesses, drive.duration_s, seed)
        write_truth(
            folder / "truth.yaml",
            {name: pose_from_mounting(model.mounting) for name, model in scenario.lidars.items()},
            {name: model.time_offset_s for name, model in scenario.lidars.items()},
        )
        write_scenario(folder / "scenario.yaml", scenario, seed)
    return SimulatedDrive(
        folder=out_dir,
        duration_s=drive.duration_s,
        scans={
            name: SimulatedScans(tuple(points[name]), tuple(target_points[name]))
            for name in sensors
        },
    )
