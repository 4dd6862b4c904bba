"""Stamps that are late: what they do to S2V, and whether the clocks are found.

Needs the environment that scripts/demo makes:

    .venv/bin/python scripts/benchmark_clocks.py --scenarios yard figure_eight --seeds 3 --jobs 2

Every run simulates a drive, makes the stamps of one sensor late, and calibrates it with the config
that `simulate` writes, from raw sensors or from poses (50 Hz, white errors of 5 mm and 0.5 mrad).
Errors are of S2V x of all LiDARs, against their sigmas; NEES is 6 on average if the covariance is
right. `--exact` takes all clocks as exact.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: one process per core

import numpy as np

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the modules beside this script from any folder

from caliv_graph.common.exits import exit_code
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.errors import CalivError
from caliv_graph.geometry.se3 import right_to_vehicle_axes
from caliv_graph.pipeline import calibrate
from caliv_graph.products import GivenPoses, MotionData
from caliv_graph.readers.forwarding import ForwardingRecording
from caliv_graph.scenario.model import Scenario, load_scenario
from caliv_graph.simulation.recording import SimulatedRecording, simulate_drive
from caliv_graph.simulation.writer import config_of
from caliv_graph.uncertainty.evaluation import evaluate
from scripts._given_poses import given_poses, stamps_of

FOLDER = REPOSITORY / "configs" / "scenarios"

POSE_SIGMAS = np.repeat([5e-4, 5e-3], 3)

EXACT = {
    "gnss": {"time_offset_sigma_s": 0.0},
    "imu": {"time_offset_sigma_s": 0.0},
    "noise": {"pose_time_offset_s": 0.0},
}
"""Sections of a config that takes all clocks as exact."""

ROWS: dict[str, tuple[str, float]] = {
    "on time": ("", 0.0),
    "GNSS 3 ms late": ("gnss", 0.003),
    "GNSS 5 ms late": ("gnss", 0.005),
    "GNSS 20 ms late": ("gnss", 0.020),
    "GNSS 50 ms late": ("gnss", 0.050),
    "IMU 5 ms late": ("imu", 0.005),
    "all LiDARs 5 ms late": ("lidars", 0.005),
    "one LiDAR 1 ms late": ("lidar", 0.001),
    "one LiDAR 3 ms late": ("lidar", 0.003),
    "poses, on time": ("poses", 0.0),
    "poses 10 ms late": ("poses", 0.010),
}
"""Name of a row -> whose stamps are late, and by how many seconds; `lidar`: those of the last one;
`poses`: poses are given."""


@dataclass(frozen=True)
class Late(ForwardingRecording):
    """A simulated drive with stamps of `gnss` and `imu` that are late by these seconds.

    With `poses` among them it has poses in the place of raw sensors.
    """

    late_s: Mapping[str, float]

    def motion(self) -> MotionData:
        motion = super().motion()
        late_ns = {sensor: round(1e9 * late_s) for sensor, late_s in self.late_s.items()}
        if "poses" in late_ns:
            return MotionData(motion.name, poses=self._poses(late_ns["poses"]))
        gnss, imu = motion.gnss, motion.imu
        if gnss is not None:
            gnss = replace(gnss, stamps_ns=gnss.stamps_ns + late_ns.get("gnss", 0))
        if imu is not None:
            imu = replace(imu, stamps_ns=imu.stamps_ns + late_ns.get("imu", 0))
        return replace(motion, gnss=gnss, imu=imu)

    def _poses(self, late_ns: int) -> GivenPoses:
        drive = self.recording
        assert isinstance(drive, SimulatedRecording)
        n = len(stamps_of(drive))
        errors = np.random.default_rng(drive.seed).normal(0.0, POSE_SIGMAS, (n, 6))
        return given_poses(drive, errors, late_ns)


@dataclass(frozen=True)
class Outcome:
    """One run: exit code or the reason of a failure; errors and sigmas of S2V x, NEES, clocks."""

    status: str
    errors_m: tuple[float, ...] = ()
    sigmas_m: tuple[float, ...] = ()
    nees: tuple[float, ...] = ()
    clocks: str = ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenarios", nargs="+", default=["yard"], metavar="NAME")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--seeds", type=int, default=3, help="seeds 1 to N (default: 3)")
    parser.add_argument("--jobs", type=int, default=1, help="at a time (default: 1)")
    parser.add_argument("--exact", action="store_true", help="take all clocks as exact")
    asked = parser.parse_args()
    seeds = range(1, asked.seeds + 1)
    cells = [(scenario, row) for scenario in asked.scenarios for row in asked.rows]
    tasks = [(scenario, row, seed, asked.exact) for scenario, row in cells for seed in seeds]
    with ProcessPoolExecutor(asked.jobs, get_context("spawn")) as pool:
        outcomes = pool.map(run, tasks)
        for scenario, row in cells:
            print(line(scenario, row, [next(outcomes) for _ in seeds]), flush=True)
    return 0


def run(task: tuple[str, str, int, bool]) -> Outcome:
    """Simulates, calibrates and compares once."""
    name, row, seed, exact = task
    sensor, late_s = ROWS[row]
    scenario = load_scenario(FOLDER / f"{name}.yaml")
    if sensor in ("lidars", "lidar"):
        late = list(scenario.lidars) if sensor == "lidars" else list(scenario.lidars)[-1:]
        scenario = with_late_lidars(scenario, late, late_s)
    drive = simulate_drive(scenario, seed)
    raw = config_of(drive, has_bag=sensor != "poses")
    if sensor == "poses":
        raw.pop("noise", None)
    if exact:
        for section, keys in EXACT.items():
            raw.setdefault(section, {}).update(keys)
    try:
        config = parse_config(raw, f"{name}.yaml", FOLDER)
        found = calibrate([Late(drive, {sensor: late_s})], config, SilentProgress()).calibration
    except CalivError as e:
        return Outcome(str(e))
    errors: dict[str, Any] = evaluate(found, drive.truth.T_vehicle_lidar)["lidars"]
    sigmas = {}
    for lidar, result in found.lidars.items():
        axes = right_to_vehicle_axes(result.T_vehicle_lidar)
        sigmas[lidar] = float(np.sqrt((axes @ result.cov @ axes.T)[3, 3]))
    clocks = [
        f"{key.removesuffix('_time_offset')} {1e3 * float(of.value[0]):+.1f} +- "
        f"{1e3 * float(of.sigma[0]):.1f}"
        for key, of in found.vehicle.items()
        if key.endswith("_time_offset")
    ]
    told = any("ms later than" in s or "ms earlier than" in s for s in found.warnings)
    return Outcome(
        f"exit {exit_code(found)}{', LiDARs apart' if told else ''}",
        tuple(float(of["s2v"]["translation_m"][0]) for of in errors.values()),
        tuple(sigmas[lidar] for lidar in errors),
        tuple(float(of["s2v"]["nees"]) for of in errors.values()),
        ", ".join(clocks),
    )


def with_late_lidars(scenario: Scenario, late: Sequence[str], late_s: float) -> Scenario:
    """The stamps of some LiDARs late alike."""
    lidars = {
        name: lidar.model_copy(update={"time_offset_s": late_s}) if name in late else lidar
        for name, lidar in scenario.lidars.items()
    }
    return scenario.model_copy(update={"lidars": lidars})


def line(scenario: str, row: str, outcomes: Sequence[Outcome]) -> str:
    """RMSE of S2V x, rms of its sigma, mean NEES; exit codes, and the clocks of the first seed."""
    done = [o for o in outcomes if o.errors_m]
    status = "; ".join(sorted({o.status for o in outcomes}))
    if not done:
        return f"{scenario:14}{row:22} {status}"
    error, sigma, nees = (
        np.concatenate([np.array(getattr(o, name)) for o in done])
        for name in ("errors_m", "sigmas_m", "nees")
    )
    return (
        f"{scenario:14}{row:22}S2V x {1e3 * np.sqrt(np.mean(error**2)):6.2f} mm, sigma "
        f"{1e3 * np.sqrt(np.mean(sigma**2)):5.2f}, NEES {np.mean(nees):7.1f}, {status}; "
        f"seed 1, ms: {done[0].clocks or 'none'}"
    )


if __name__ == "__main__":
    sys.exit(main())
