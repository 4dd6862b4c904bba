"""Time and memory of a calibration from a long bag.

Needs the environment that scripts/demo makes: .venv/bin/python scripts/benchmark_bag.py

Writes a bag of 10 minutes (`--minutes`) with 4 LiDARs (`--lidars`) that look to all sides, at 10 Hz
with 30,000 points per cloud (`--points`), each point with its time, 12 GB in all; IMU, GNSS and
velocity as in the paper. The vehicle drives figure-eights past a chair in a walled yard, one lap a
minute. Only the clouds of the first lap are simulated; later laps repeat them with new stamps. IMU,
GNSS and velocity are never repeated. Then `caliv-graph calibrate` runs in its own process on 2
cores (`--cores`). The bag is first dropped from the page cache, if the file system allows it
(`--warm`: it stays). The bag is deleted at the end.
"""

from __future__ import annotations

import argparse
import heapq
import json
import math
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: the matrices are small

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the module beside this script from any folder

import numpy as np
from rosbags.interfaces import Connection
from scipy.special import jn_zeros

from caliv_graph.common.progress import PlainProgress, Progress, SilentProgress
from caliv_graph.conventions import AXES, NANOSECONDS_PER_SECOND
from caliv_graph.errors import CalivError
from caliv_graph.products import Array, Calibration
from caliv_graph.results.calibration_file import read_calibration
from caliv_graph.results.truth_file import read_truth
from caliv_graph.scenario.drives import CurvatureProfile
from caliv_graph.scenario.model import Scenario, parse_scenario
from caliv_graph.simulation.bag import BagWriter
from caliv_graph.simulation.recording import SimulatedRecording
from caliv_graph.simulation.writer import BAG_FOLDER, write_config, write_truth
from caliv_graph.uncertainty.evaluation import evaluate
from caliv_graph.uncertainty.pairs import sigmas_s2s
from scripts._command import COMMAND, Usage, between, calibrate_measured, exit_code_of

RATE_HZ = 10.0
LAP_S = 60
"""Clouds per lap, a whole number: after a lap the vehicle is at the same pose."""
SPEED_M_S = 2.0
LAP_M = SPEED_M_S * LAP_S
STANDSTILL_S, RAMP_S = 1.0, 1.5
FIELD_OF_VIEW_DEG = (120.0, 25.0)
POINT_BYTES = 16
"""x, y, z and the time, 4 bytes each."""

TURN_RAD = float(jn_zeros(0, 1)[0])
"""Amplitude of the heading over a lap, the first zero of the Bessel function J0. If the heading is
a sine of path length, the path advances by J0(amplitude) per length: here not at all."""

LEAST_SPEEDUP = 3.0
MOST_MEMORY_MB = 2048.0
"""Smallest ratio of drive time to calibration time, and largest peak memory."""

SPARE_DISK = 1.15


@dataclass(frozen=True)
class FigureEights(CurvatureProfile):
    """Endless closed figure-eights: the heading is a sine of path length.

    Attributes:
        lap_m: path length of a lap.
    """

    lap_m: float = LAP_M

    def curvature(self, distance_m: Array) -> Array:
        """Curvature in 1/m, any shape."""
        turn = 2.0 * math.pi / self.lap_m
        return np.asarray(TURN_RAD * turn * np.cos(turn * distance_m))

    def heading(self, distance_m: Array) -> Array:
        """The integral of the curvature, in radians, any shape."""
        return np.asarray(TURN_RAD * np.sin(2.0 * math.pi / self.lap_m * distance_m))


class LapsRecording(SimulatedRecording):
    """A simulated drive of figure-eights, with the scenario's curvature replaced."""

    def __init__(self, scenario: Scenario, seed: int, threads: int = 1) -> None:
        """Draws the errors that hold for the whole drive; see `SimulatedRecording`."""
        super().__init__(scenario, seed, threads)
        drive = replace(self.truth.drive, curvature=FigureEights(0.0))
        self.truth = replace(self.truth, drive=drive)

    def original_ns(self, lidar: str, stamp_ns: int) -> int:
        """Stamp of the cloud of the first lap that a cloud repeats, or its own stamp."""
        begin_ns = self.truth.start_ns + _nanoseconds(STANDSTILL_S + RAMP_S)
        # While the vehicle slows down, it is not at the pose of a lap before.
        end_ns = self.truth.end_ns - _nanoseconds(RAMP_S)
        after_ns = _nanoseconds(self.scenario.lidars[lidar].sweep_s)
        if not begin_ns <= stamp_ns <= end_ns - after_ns:
            return stamp_ns
        return stamp_ns - (stamp_ns - begin_ns) // _nanoseconds(LAP_S) * _nanoseconds(LAP_S)


class RepeatingWriter(BagWriter):
    """Writes a bag with clouds repeated under other stamps, without simulating them again."""

    _data: bytes | memoryview = b""

    def _write(self, connection: Connection, record_ns: int, message: Any) -> None:
        self._data = self._store.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, record_ns, self._data)

    @property
    def written(self) -> bytes:
        """The message written last, serialised."""
        return bytes(self._data)

    def write_again(self, lidar: str, stamp_ns: int, data: bytes) -> None:
        """Writes a serialised cloud with another stamp, after all other messages before it.

        Args:
            lidar: name of its LiDAR.
            stamp_ns: new stamp.
            data: the message, as in `written`.
        """
        sweep_s = self._scenario.lidars[lidar].sweep_s
        record_ns = stamp_ns + _nanoseconds(sweep_s)
        self._write_others(record_ns)
        seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS_PER_SECOND)
        # CDR: four bytes with the encoding, then the stamp at the start of the header.
        stamp = np.array([seconds, nanoseconds], "<u4").tobytes()
        self._writer.write(self._clouds[lidar], record_ns, data[:4] + stamp + data[12:])


@dataclass(frozen=True)
class WorstError:
    """The axis between two LiDARs with the largest error in sigmas; m or rad."""

    what: str
    error: float
    sigma: float


def main() -> int:
    arguments = parse_arguments()
    return exit_code_of(lambda: benchmark(arguments))


def parse_arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Makes a long bag with several LiDARs, calibrates from it, and prints time, "
        "memory and errors.",
        epilog="Exit codes: 0 fast and small enough; 3 not; 2 it could not be tried.",
    )
    number = parser.add_argument
    number("--minutes", type=between(float, 0.5, 60), default=10.0, help="default: 10")
    number("--lidars", type=between(int, 1, 8), default=4, help="default: 4")
    number(
        "--points",
        type=between(int, 1, 500_000),
        default=30_000,
        help="per cloud (default: 30000)",
    )
    number(
        "--cores", type=between(int, 1, 1024), default=2, help="for the calibration (default: 2)"
    )
    number("--seed", type=between(int, 1, 2**31), default=1, help="default: 1")
    parser.add_argument(
        "--search", action="store_true", help="a config that does not say where the target is"
    )
    parser.add_argument("--warm", action="store_true", help="leave the bag in the page cache")
    parser.add_argument("--zstd", action="store_true", help="compress the bag's chunks")
    parser.add_argument(
        "--folder", type=Path, help="where to make the temporary folder (default: the system's)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    return parser.parse_args(given)


def benchmark(arguments: argparse.Namespace) -> int:
    if not COMMAND.is_file():
        raise CalivError(f"{COMMAND}: no such command. Run scripts/demo, which makes .venv with it")
    scenario = scenario_of(arguments)
    recording = LapsRecording(scenario, arguments.seed, arguments.cores)
    progress = SilentProgress() if arguments.json else PlainProgress(_say)
    with tempfile.TemporaryDirectory(prefix="caliv_bag_", dir=arguments.folder) as name:
        folder = Path(name)
        check_disk(recording, arguments.points, folder)
        size_mb = write_laps(recording, folder, progress)
        if not arguments.warm:
            drop_from_cache(folder / BAG_FOLDER)
        usage = calibrate_measured(folder / "config.yaml", folder / "result", arguments.cores)
        worst = worst_error(folder, scenario.reference)
    duration_s = recording.truth.drive.duration_s
    kept = duration_s >= LEAST_SPEEDUP * usage.wall_s and usage.peak_mb <= MOST_MEMORY_MB
    if arguments.json:
        _say(json.dumps(document(duration_s, size_mb, usage, worst, kept), indent=2))
    else:
        clouds = sum(len(recording.scan_stamps_ns(lidar)) for lidar in recording.lidars)
        _say(f"\nA bag of {duration_s:.0f} s, {clouds} clouds of {arguments.points} points, ")
        _say(text(duration_s, size_mb, usage, worst))
    return 0 if kept else 3


def scenario_of(arguments: argparse.Namespace) -> Scenario:
    """LiDARs that look to all sides, and a chair beside the crossing in a walled yard."""
    width_deg, height_deg = FIELD_OF_VIEW_DEG
    channels = max(2, round(math.sqrt(arguments.points * height_deg / width_deg) * 1.26))
    columns = max(1, round(arguments.points / channels))
    lidars = {}
    for i in range(arguments.lidars):
        yaw_deg = 360.0 * i / arguments.lidars
        turn = math.radians(yaw_deg)
        lidars[f"lidar_{i + 1}"] = {
            # All around the middle of the roof, nose down.
            "mounting": {
                "xyz": [round(1.0 + math.cos(turn), 4), round(0.8 * math.sin(turn), 4), 2.0],
                "rpy_deg": [0.0, 10.0, yaw_deg],
            },
            "horizontal_fov_deg": [-0.5 * width_deg, 0.5 * width_deg],
            "vertical_fov_deg": [-0.5 * height_deg, 0.5 * height_deg],
            "channels": channels,
            "horizontal_resolution_deg": width_deg / columns,
            "rate_hz": RATE_HZ,
            "phase_s": round(i / (RATE_HZ * arguments.lidars), 4),
            "sweep": {"time_field": "t"},
        }
    middle_m = 0.5 * lap_length_m()
    wall_m, height_m = 80.0, 12.0
    sides = {"east": (1, 0), "west": (-1, 0), "north": (0, 1), "south": (0, -1)}
    walls = {
        f"wall_{side}": {
            "shape": "box",
            "xy_m": [0.5 * wall_m * x, middle_m + 0.5 * wall_m * y],
            "size_m": [0.5 if x else wall_m, 0.5 if y else wall_m, height_m],
        }
        for side, (x, y) in sides.items()
    }
    chair = {"shape": "chair", "xy_m": [10.0, middle_m], "yaw_deg": 160.0}
    raw = {
        "name": "laps",
        # Figure-eights replace the straight line: see `LapsRecording`.
        "drive": {
            "kind": "straight",
            "duration_s": 60.0 * arguments.minutes,
            "standstill_s": STANDSTILL_S,
            "ramp_s": RAMP_S,
            "speed_m_s": SPEED_M_S,
        },
        "lidars": lidars,
        "world": {"objects": {"chair": chair, **walls}, "targets": ["chair"]},
        "bag": {"compression": "zstd" if arguments.zstd else "none"},
        "config_target": "search" if arguments.search else "region",
    }
    return parse_scenario(raw, "laps")


def lap_length_m() -> float:
    """Largest distance of a figure-eight from its start, perpendicular to the start, metres."""
    s = np.linspace(0.0, 0.5 * LAP_M, 2001)
    return float(np.trapezoid(np.sin(FigureEights(0.0).heading(s)), s))


def check_disk(recording: SimulatedRecording, points: int, folder: Path) -> None:
    """Raises if the disk has no room for the bag."""
    clouds = {name: recording.scan_stamps_ns(name) for name in recording.lidars}
    total = sum(len(stamps) for stamps in clouds.values())
    first = min(total, round((LAP_S + 10.0) * RATE_HZ * len(clouds)))
    needed = SPARE_DISK * (total + first) * points * POINT_BYTES
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise CalivError(
            f"{folder}: {free / 1e9:.1f} GB are free, the bag needs {needed / 1e9:.1f} GB. Give "
            "--folder another disk, or take fewer --minutes or --points"
        )


def write_laps(recording: LapsRecording, folder: Path, progress: Progress) -> float:
    """Writes the bag, its truth and a config.

    Args:
        recording: the drive.
        folder: an empty folder.
        progress: advanced at every cloud.

    Returns:
        Size of the bag in MB.
    """
    stamps = {name: recording.scan_stamps_ns(name) for name in recording.lidars}
    first = {
        name: {s for s in stamps[name] if recording.original_ns(name, s) == s} for name in stamps
    }
    casting = {name: recording.scans(name, first[name]) for name in stamps}
    order: Iterator[tuple[int, str]] = heapq.merge(
        *([(s, name) for s in stamps[name]] for name in stamps)
    )
    places: dict[tuple[str, int], tuple[int, int]] = {}
    total = sum(map(len, stamps.values()))
    with (
        tempfile.TemporaryFile(dir=folder) as spool,
        RepeatingWriter(folder / BAG_FOLDER, recording) as bag,
        progress.stage("writing the bag", total) as advance,
    ):
        for stamp_ns, lidar in order:
            original = lidar, recording.original_ns(lidar, stamp_ns)
            if original[1] == stamp_ns:
                bag.write(next(casting[lidar]))
                places[original] = _keep(spool, bag.written)
            else:
                place, size = places[original]
                spool.seek(place)
                bag.write_again(lidar, stamp_ns, spool.read(size))
            advance()
    write_config(folder / "config.yaml", recording, has_bag=True)
    write_truth(
        folder / "truth.yaml", recording.truth.T_vehicle_lidar, recording.truth.time_offset_s
    )
    return sum(file.stat().st_size for file in (folder / BAG_FOLDER).iterdir()) / 1e6


def _keep(spool: IO[bytes], data: bytes) -> tuple[int, int]:
    """Appends to a file; returns its offset and size."""
    place = spool.seek(0, os.SEEK_END)
    return place, spool.write(data)


def drop_from_cache(folder: Path) -> None:
    """Drops the bag from the page cache, like a bag of another day."""
    if not hasattr(os, "posix_fadvise"):
        return
    for file in folder.iterdir():
        with file.open("rb") as opened:
            os.fsync(opened.fileno())
            os.posix_fadvise(opened.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def worst_error(folder: Path, reference: str) -> WorstError | None:
    """The largest error in sigmas between a LiDAR and the reference; None: only one LiDAR."""
    calibration = read_calibration(folder / "result/calibration.yaml")
    return worst_error_of(calibration, read_truth(folder / "truth.yaml"), reference)


def worst_error_of(
    calibration: Calibration, truth: Mapping[str, Any], reference: str
) -> WorstError | None:
    """Like `worst_error`, for a calibration that was read."""
    found = []
    for pair in evaluate(calibration, truth)["pairs"]:
        if pair["to"] != reference:
            continue
        sigmas = sigmas_s2s(calibration, pair["from"], pair["to"])
        errors = [*pair["rotation_rad"], *pair["translation_m"]]
        found += [
            WorstError(f"{axis} of {pair['from']} against {pair['to']}", error, float(sigma))
            for axis, error, sigma in zip(AXES, errors, sigmas, strict=True)
        ]
    return max(found, key=lambda worst: abs(worst.error) / worst.sigma, default=None)


def text(duration_s: float, size_mb: float, usage: Usage, worst: WorstError | None) -> str:
    """The result for a person."""
    speedup = duration_s / usage.wall_s
    rest = usage.wall_s - sum(usage.stages_s.values())
    stages = {**usage.stages_s, "start-up, first pass over the bag, files": rest}
    lines = [
        f"{size_mb:.0f} MB, by 'caliv-graph calibrate' (exit code {usage.code}):",
        f"  {usage.wall_s:8.1f} s   wall time ({usage.cpu_s:.1f} s of CPU)",
        *(f"  {seconds:8.1f} s     {stage}" for stage, seconds in stages.items()),
        f"  {speedup:8.2f} x   real time (at least {LEAST_SPEEDUP:g}: "
        f"{'kept' if speedup >= LEAST_SPEEDUP else 'MISSED'})",
        f"  {usage.peak_mb:8.0f} MB  peak memory (at most {MOST_MEMORY_MB:.0f}: "
        f"{'kept' if usage.peak_mb <= MOST_MEMORY_MB else 'MISSED'})",
    ]
    if worst is not None:
        unit = "mm" if worst.what[0] in "xyz" and worst.what[:3] != "yaw" else "mrad"
        lines.append(
            f"  {abs(worst.error) / worst.sigma:8.1f}     sigmas is the largest error between "
            f"LiDARs: {worst.what}, {1e3 * worst.error:.2f} {unit}"
        )
    return "\n".join(lines)


def document(
    duration_s: float, size_mb: float, usage: Usage, worst: WorstError | None, kept: bool
) -> dict[str, Any]:
    """The result as plain values."""
    return {
        "duration_s": duration_s,
        "bag_mb": size_mb,
        "speedup": duration_s / usage.wall_s,
        **{**vars(usage), "stages_s": dict(usage.stages_s)},
        "worst_s2s": None if worst is None else vars(worst),
        "kept": kept,
    }


def _nanoseconds(seconds: float) -> int:
    return round(seconds * NANOSECONDS_PER_SECOND)


def _say(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
