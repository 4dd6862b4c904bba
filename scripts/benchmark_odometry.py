"""Calibrations of simulated drives of which nothing but the LiDARs was recorded.

    .venv/bin/python scripts/benchmark_odometry.py --seeds 1 2 --out out/odometry

Walls and ground of `yard`. Without motion data S2S is determined, S2V's x and y are not, its roll
and pitch are as good as the vehicle stands parallel to the ground, its yaw as good as it moves
along its x axis. NEES of S2S is 6 on average if the covariance is right, and beyond 20 in 0.3
percent (3 sigma). The rows:

    eight        figure-eight, all clouds taken at one instant, stamps in common
    found        the same drive without any initial guess
    sweeps       sweeps of 0.1 s, the stamps of one LiDAR 50 ms after those of the other
    s-curve      17 s
    arc          17 s
    straight     10 s

With --validate each calibration is validated on its own drive, as it is (right) and with LiDAR 2
turned by 3 mrad about z against the other (turned): the verdict, and chi-square over degrees of
freedom on the strips that are held out, with the calibration and with one without these strips.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config
from caliv_graph.conventions import AXES
from caliv_graph.errors import CalivError
from caliv_graph.pipeline import calibrate
from caliv_graph.products import Calibration, Recording
from caliv_graph.readers import open_recording
from caliv_graph.scenario.model import load_scenario, parse_scenario
from caliv_graph.simulation import write_drive
from caliv_graph.uncertainty.evaluation import evaluate
from caliv_graph.uncertainty.pairs import pair_determined, sigmas_s2v
from caliv_graph.validation import Validation, validate

SCENARIO = Path(__file__).resolve().parents[1] / "configs" / "scenarios" / "yard.yaml"
DRIVES: dict[str, dict[str, Any]] = {
    "eight": {},
    "sweeps": {},
    "s-curve": {"kind": "s_curve", "duration_s": 17.0},
    "arc": {"kind": "arc", "duration_s": 17.0},
    "straight": {"kind": "straight", "duration_s": 10.0, "start_xy_m": [-8.0, 0.0]},
}
DRIVEN = {"found": "eight"}
TURNED_RAD = 3e-3
ROWS = ("eight", "found", "sweeps", "s-curve", "arc", "straight")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 1), metavar=("FIRST", "LAST"))
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--validate", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("out/odometry"))
    arguments = parser.parse_args()
    print("S2S: NEES and errors (x y z mm, roll pitch yaw mrad); S2V: errors over sigma")
    for seed in range(arguments.seeds[0], arguments.seeds[1] + 1):
        for row in arguments.rows:
            print(f"{row:9}{seed:3}  {result(row, seed, arguments)}", flush=True)
    return 0


def result(row: str, seed: int, arguments: argparse.Namespace) -> str:
    """Simulates, if the drive is not there, calibrates and compares."""
    kind = DRIVEN.get(row, row)
    folder = arguments.out / f"{kind}_{seed}"
    scenario = parse_scenario(described(kind), f"{kind}.yaml")
    if not (folder / "truth.yaml").is_file():
        write_drive(scenario, folder, seed, threads=1)
    raw = yaml.safe_load((folder / "config.yaml").read_text())
    raw = {key: value for key, value in raw.items() if key not in ("topics", "imu", "gnss")}
    if row == "found":
        for lidar in raw["lidars"].values():
            del lidar["initial"], lidar["sigma"]
    try:
        config = parse_config(raw, "config.yaml", folder)
        calibration = calibrate([open_recording(config)], config, SilentProgress()).calibration
    except CalivError as e:
        return str(e)
    truth = {name: model.mounting.pose() for name, model in scenario.lidars.items()}
    found = evaluate(calibration, truth)
    pair = found["pairs"][0]
    shown = " ".join(f"{1e3 * v:6.2f}" for v in (*pair["translation_m"], *pair["rotation_rad"]))
    open_axes = [a for a, good in pair_determined(calibration, *truth).items() if not good]
    lines = [f"{calibration.status:12} S2S {pair['nees']:5.1f} ({shown})"]
    lines[0] += f", open: {' '.join(open_axes)}" if open_axes else ""
    for name, lidar in calibration.lidars.items():
        item = found["lidars"][name]["s2v"]
        errors = np.concatenate([item["rotation_rad"], item["translation_m"]])
        off = errors / sigmas_s2v(calibration, name)
        axes = [
            f"{axis} {value:5.2f}" if lidar.determined[axis] else f"{axis} open"
            for axis, value in zip(AXES, off, strict=True)
        ]
        lines.append(f"{'':14}S2V {name:6} {', '.join(axes)}")
    if arguments.validate:
        recording = open_recording(config)
        for word, tested in (("right", calibration), ("turned", _turned(calibration))):
            lines.append(f"{'':14}{word:6} {_validated(validate_on(recording, tested, config))}")
    return "\n".join(lines)


def validate_on(recording: Recording, calibration: Calibration, config: Config) -> Validation:
    """The alignment on a drive."""
    return validate(recording, calibration, config, SilentProgress())


def _turned(calibration: Calibration) -> Calibration:
    """The second LiDAR turned against the first."""
    name = list(calibration.lidars)[1]
    result = calibration.lidars[name]
    T = result.T_vehicle_lidar.retract(np.array([0.0, 0.0, TURNED_RAD, 0.0, 0.0, 0.0]))
    lidars = {**calibration.lidars, name: replace(result, T_vehicle_lidar=T)}
    return replace(calibration, lidars=lidars)


def _validated(found: Validation) -> str:
    """The verdict, and the tests on held-out strips."""
    if found.held_out is None:
        return found.verdict.word
    apart = ", ".join(f"{s} {1e3 * d:.1f}" for s, d in found.held_out.distance_m.items())
    tests = found.held_out.tests.items()
    chi2 = ", ".join(f"{stage} {test.chi2:.0f} of {test.dof}" for stage, test in tests)
    walls = f"walls {found.verdict.chi2:.1f} of {found.verdict.dof}"
    return f"{found.verdict.word}: strips {apart} mm, chi2 {chi2}; {walls}"


def described(kind: str) -> dict[str, Any]:
    """The yard with another drive or other sweeps."""
    raw: dict[str, Any] = load_scenario(SCENARIO).model_dump(mode="json", exclude_none=True)
    if kind == "sweeps":
        for k, lidar in enumerate(raw["lidars"].values()):
            lidar["sweep"] = {"duration_s": 0.1, "time_field": "t"}
            lidar["phase_s"] = 0.05 * k
    elif DRIVES[kind]:
        raw["drive"] = dict(DRIVES[kind])
    return raw


if __name__ == "__main__":
    sys.exit(main())
