"""S2V and the noise that is found where poses are given whose errors wander.

    .venv/bin/python scripts/benchmark_given_poses.py --scenarios yard --seeds 3
    .venv/bin/python scripts/benchmark_given_poses.py --scenarios figure_eight --time-s 30
    .venv/bin/python scripts/benchmark_given_poses.py --scenarios street --hz 5 --slow-mm 0

Drives of `configs/scenarios` are simulated in memory and calibrated with the config that `simulate`
writes, without a word on the noise of the poses. These come at --hz, with white errors of
--white-mm and a tenth of a milliradian for each of them, and Gauss-Markov ones of --slow-mm and a
twentieth of a milliradian for each, over --time-s. It prints errors, sigmas and the noise that was
found.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy

import numpy as np

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the modules beside this script from any folder

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.errors import CalivError
from caliv_graph.pipeline import calibrate
from caliv_graph.products import MotionData
from caliv_graph.readers.forwarding import ForwardingRecording
from caliv_graph.scenario.model import load_scenario
from caliv_graph.simulation.noise import gauss_markov
from caliv_graph.simulation.recording import SimulatedRecording, simulate_drive
from caliv_graph.simulation.writer import config_of
from scripts._given_poses import given_poses, stamps_of
from scripts._judged import outcome_of, rows_of

FOLDER = REPOSITORY / "configs" / "scenarios"

WHITE_RAD_PER_M, SLOW_RAD_PER_M = 0.1, 0.05
"""White and slow errors of rotation for each metre of those of position."""


@dataclass(frozen=True)
class Errors:
    """How given poses err: white and slow errors (m), the time of these, seconds, and the rate."""

    white_m: float
    slow_m: float
    time_s: float
    rate_hz: float


@dataclass(frozen=True)
class Wandering(ForwardingRecording):
    """A simulated drive with given poses in the place of raw sensors."""

    errors: Errors

    def motion(self) -> MotionData:
        drive, of = self.recording, self.errors
        assert isinstance(drive, SimulatedRecording)
        rng = np.random.default_rng([drive.seed, 7])
        period_ns = round(1e9 / of.rate_hz)
        stamps = stamps_of(drive, period_ns)
        white = of.white_m * np.repeat([WHITE_RAD_PER_M, 1.0], 3)
        errors = rng.normal(0.0, white, (len(stamps), 6))
        slow = of.slow_m * np.repeat([SLOW_RAD_PER_M, 1.0], 3)
        errors += slow * gauss_markov(stamps, of.time_s, rng, 6)
        poses = given_poses(drive, errors, period_ns=period_ns)
        return MotionData(super().motion().name, poses=poses)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenarios", nargs="+", default=["yard"], metavar="NAME")
    parser.add_argument("--hz", type=float, default=50.0, help="(default: 50)")
    parser.add_argument("--white-mm", type=float, default=3.0, help="(default: 3)")
    parser.add_argument("--slow-mm", type=float, default=10.0, help="(default: 10)")
    parser.add_argument("--time-s", type=float, default=10.0, help="(default: 10)")
    parser.add_argument("--seeds", type=int, default=3, help="seeds 1 to N (default: 3)")
    asked = parser.parse_args(arguments)
    errors = Errors(1e-3 * asked.white_mm, 1e-3 * asked.slow_mm, asked.time_s, asked.hz)
    for scenario in asked.scenarios:
        for seed in range(1, asked.seeds + 1):
            print(text_of(scenario, seed, errors), flush=True)
    return 0


def text_of(scenario: str, seed: int, errors: Errors) -> str:
    """Simulates, calibrates and compares once; what to print."""
    drive = simulate_drive(load_scenario(FOLDER / f"{scenario}.yaml"), seed)
    raw = config_of(drive, has_bag=False)
    raw.pop("noise", None)
    title = (
        f"{scenario}, seed {seed}, poses at {errors.rate_hz:g} Hz, white errors of "
        f"{1e3 * errors.white_m:g} mm, slow ones of {1e3 * errors.slow_m:g} mm over "
        f"{errors.time_s:g} s"
    )
    try:
        config = parse_config(raw, f"{scenario}.yaml", FOLDER)
        run = calibrate([Wandering(drive, errors)], config, SilentProgress())
    except CalivError as e:
        return f"{title}: {e}"
    outcome = outcome_of(run.calibration, drive.truth.T_vehicle_lidar)
    noise = run.solution.pose_noise
    assert noise is not None
    lines = [
        f"{title}: exit {outcome['exit']}; found white {1e3 * noise.white_rotation_rad:.2f} mrad, "
        f"{1e3 * noise.white_position_m:.1f} mm, slow {1e3 * noise.drift_rotation_rad:.2f} mrad, "
        f"{1e3 * noise.drift_position_m:.1f} mm over {noise.drift_time_s:.0f} s"
    ]
    return "\n".join([*lines, *rows_of(outcome)])


if __name__ == "__main__":
    sys.exit(main())
