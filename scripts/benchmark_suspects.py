"""The ranking of suspects: is the input that the user got wrong named first, and its value right?

Needs the environment that scripts/demo makes:

    .venv/bin/python scripts/benchmark_suspects.py --seeds 5
    .venv/bin/python scripts/benchmark_suspects.py --seeds 1 --rows "lever arm zeros" clean
    .venv/bin/python scripts/benchmark_suspects.py --rows "lever arm zeros" --try-suspects
    .venv/bin/python scripts/benchmark_suspects.py --summary

A figure-eight whose antenna is at (1.2, 0.3, 0.85) m and whose IMU is turned by (1, -2, 5) degrees,
clouds at 2 Hz. Each row changes one input of the config or one clock, and leaves the drive as it
is; signs and directions are drawn per seed. A run is
a line in out/suspects/runs.jsonl, written when it ends; a second start runs the missing ones.
Runs of another version of the program do not count unless --any-version is given. With
--try-suspects the second run of `calibrate --try-suspects` follows each that is called
inconsistent, and the errors of both against the truth are printed.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy

import gtsam
import numpy as np

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the modules beside this script from any folder

from caliv_graph.common.exits import USAGE, exit_code
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import CalivError
from caliv_graph.pipeline import calibrate
from caliv_graph.products import Array, Calibration, GivenPoses, Recording
from caliv_graph.scenario.model import Scenario, load_scenario
from caliv_graph.simulation import SimulatedRecording
from caliv_graph.uncertainty.evaluation import evaluate
from caliv_graph.workflows.suspects import trial_of
from scripts._command import add_beams
from scripts._runs import add_line, code_digest, json_lines
from scripts._tables_rows import View, config_for, true_poses
from scripts._thinned import GroundWaves, ThinnedRecording, cached_selection
from scripts.benchmark_consistency import Faulty

OUT = REPOSITORY / "out" / "suspects"

ARM_M = (1.2, 0.3, 0.85)
IMU_RPY_DEG = (1.0, -2.0, 5.0)
LATE_S = 0.1
DRIFT_M = 0.2


@dataclass(frozen=True)
class Row:
    """A mistake.

    Attributes:
        culprits: names of the input, any of which is right as the first suspect; empty: none.
        config: the config with the mistake, of the right one and a random source.
        recording: the recording with the mistake, of the right one.
        truth: value that the first suspect should take, by its first coordinates; None: not judged.
    """

    culprits: tuple[str, ...] = ()
    config: Callable[[Config, np.random.Generator], Config] = lambda config, _: config
    recording: Callable[[SimulatedRecording], Recording] = lambda recording: recording
    truth: tuple[float, ...] | None = None


def _arm(move: Callable[[np.random.Generator], Array]) -> Callable[..., Config]:
    def change(config: Config, rng: np.random.Generator) -> Config:
        arm = tuple((np.array(ARM_M) + move(rng)).tolist())
        return config.model_copy(update={"gnss": config.gnss.model_copy(update={"lever_arm": arm})})

    return change


def _imu(axis: int, degrees: float) -> Callable[..., Config]:
    def change(config: Config, rng: np.random.Generator) -> Config:
        turn = np.zeros(3)
        turn[axis] = math.radians(degrees) * rng.choice([-1.0, 1.0])
        T = config.imu.T_vehicle_imu
        R = gtsam.Rot3.Expmap(turn).compose(T.pose().rotation())
        rpy_deg = tuple(np.degrees(R.rpy()).tolist())
        imu = config.imu.model_copy(
            update={"T_vehicle_imu": T.model_copy(update={"rpy_deg": rpy_deg})}
        )
        return config.model_copy(update={"imu": imu})

    return change


def _height(config: Config, rng: np.random.Generator) -> Config:
    height = 0.2 * float(rng.choice([-1.0, 1.0]))
    ground = config.ground.model_copy(update={"vehicle_height": height})
    return config.model_copy(update={"ground": ground})


def _guess(config: Config, rng: np.random.Generator) -> Config:
    rear = config.lidars["rear"]
    roll, pitch, yaw = rear.given.rpy_deg
    x, y, z = rear.given.xyz
    way = float(rng.choice([-1.0, 1.0]))
    initial = PoseConfig(xyz=(x, y + 0.8 * way, z), rpy_deg=(roll, pitch, yaw + 15.0 * way))
    lidars = {**config.lidars, "rear": rear.model_copy(update={"initial": initial})}
    return config.model_copy(update={"lidars": lidars})


def _late(*names: str) -> Callable[[SimulatedRecording], Recording]:
    late_ns = dict.fromkeys(names, round(LATE_S * 1e9))
    return lambda recording: Faulty(recording, late_ns=late_ns)


def _drifting(recording: SimulatedRecording) -> Recording:
    """The true poses, with a drift by DRIFT_M from start to end along map x and y."""
    stamps = [s for name in recording.lidars for s in recording.scan_stamps_ns(name)]
    poses = true_poses(recording.truth, stamps)
    part = np.linspace(0.0, 1.0, len(poses.stamps_ns))
    drift = DRIFT_M / math.sqrt(2.0) * np.array([1.0, 1.0, 0.0])
    moved = tuple(
        gtsam.Pose3(T.rotation(), T.translation() + p * drift)
        for T, p in zip(poses.T_map_vehicle, part, strict=True)
    )
    return View(recording, recording.lidars, poses=GivenPoses(poses.stamps_ns, moved))


ROWS = {
    "clean": Row(),
    "lever arm zeros": Row(("gnss.lever_arm",), _arm(lambda _: -np.array(ARM_M)), truth=ARM_M),
    "lever arm 0.2 m off": Row(
        ("gnss.lever_arm",),
        _arm(lambda rng: 0.2 * _horizontal(rng)),
        truth=ARM_M,
    ),
    "lever arm 5 cm per axis": Row(
        ("gnss.lever_arm",), _arm(lambda rng: 0.05 * rng.choice([-1.0, 1.0], 3)), truth=ARM_M
    ),
    "IMU 2 degrees of roll": Row(("imu.T_vehicle_imu",), _imu(0, 2.0), truth=IMU_RPY_DEG),
    "IMU 2 degrees of pitch": Row(("imu.T_vehicle_imu",), _imu(1, 2.0), truth=IMU_RPY_DEG),
    "IMU 90 degrees of roll": Row(("imu.T_vehicle_imu",), _imu(0, 90.0)),
    "vehicle_height 0.2 m off": Row(("ground.vehicle_height",), _height, truth=(0.0,)),
    "both LiDARs 0.1 s late": Row(
        ("lidars.*.time_offset",), recording=_late("front", "rear"), truth=(LATE_S,)
    ),
    "rear LiDAR 0.1 s late": Row(
        ("lidars.rear.time_offset",), recording=_late("rear"), truth=(LATE_S,)
    ),
    "guess 15 degrees and 0.8 m off": Row(("lidars.rear.initial",), _guess),
    "given poses drift by 0.2 m": Row(("poses.drift",), recording=_drifting),
}


def _horizontal(rng: np.random.Generator) -> Array:
    """A unit vector at a random angle, level."""
    angle = rng.uniform(0.0, 2.0 * math.pi)
    return np.array([math.cos(angle), math.sin(angle), 0.0])


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5, help="1 to N (default: 5)")
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS))
    parser.add_argument("--try-suspects", action="store_true", help="the second run as well")
    parser.add_argument("--summary", action="store_true", help="only print what is there")
    parser.add_argument("--any-version", action="store_true", help="count runs of older text too")
    parser.add_argument("--out", type=Path, default=OUT, help="folder (default: out/suspects)")
    add_beams(parser)
    asked = parser.parse_args(arguments)
    path = asked.out / "runs.jsonl"
    if not asked.summary:
        asked.out.mkdir(parents=True, exist_ok=True)
        done = {(r["row"], r["seed"]) for r in lines_of(path, asked.any_version)}
        for seed in range(1, asked.seeds + 1):
            for row in asked.rows:
                if (row, seed) not in done:
                    line = perform(row, seed, asked.beams, asked.try_suspects)
                    add_line(path, line)
                    print(text_of(line), flush=True)
    print(summary(lines_of(path, asked.any_version)))
    return 0


def scenario() -> Scenario:
    """The figure-eight with an antenna and an IMU that are not at the vehicle's origin."""
    model = load_scenario(REPOSITORY / "configs" / "scenarios" / "figure_eight.yaml")
    lidars = {n: m.model_copy(update={"rate_hz": 2.0}) for n, m in model.lidars.items()}
    mounting = PoseConfig(xyz=(0.3, 0.1, 0.4), rpy_deg=IMU_RPY_DEG)
    return model.model_copy(
        update={
            "lidars": lidars,
            "imu": model.imu.model_copy(update={"mounting": mounting}),
            "gnss": model.gnss.model_copy(update={"lever_arm": ARM_M}),
        }
    )


def perform(name: str, seed: int, beams: Path, try_suspects: bool = False) -> dict[str, Any]:
    """Simulates and calibrates once, or twice; returns the line to write."""
    row, model = ROWS[name], scenario()
    drive = ThinnedRecording(model, cached_selection(model, beams), seed, waves=GroundWaves())
    recording = row.recording(drive)
    config = row.config(config_for(drive, {}), np.random.default_rng(seed))
    line: dict[str, Any] = {"row": name, "seed": seed, "code": code_digest()}
    begun = time.process_time()
    try:
        done = calibrate([recording], config, SilentProgress())
    except CalivError as e:
        return {**line, "exit": USAGE, "said": [str(e)], "suspects": []}
    calibration, truth = done.calibration, drive.truth.T_vehicle_lidar
    tried: dict[str, Any] = {}
    trial = trial_of(calibration, config) if try_suspects else None
    if trial is not None:
        second = calibrate([recording], trial.config, SilentProgress()).calibration
        tried["tried"] = {
            "change": trial.change,
            "exit": exit_code(second),
            "said": list(second.contradictions),
            "worst_before": _worst_error(calibration, truth),
            "worst_after": _worst_error(second, truth),
        }
    first = calibration.suspects[:3]
    return {
        **line,
        "exit": exit_code(calibration),
        "said": list(calibration.contradictions),
        "suspects": [
            {
                "input": s.input,
                "value": s.value,
                "sigma": s.sigma,
                "change": s.change,
                "sigmas": s.sigmas,
                "explains": s.explains,
                "determined": s.determined,
            }
            for s in first
        ],
        "bounds": {s.input: s.sigma for s in calibration.suspects},
        "correlated": [n.name for n in done.solution.sensor_noise if n.time_s is not None],
        "cpu_s": time.process_time() - begun,
        **tried,
    }


def _worst_error(
    calibration: Calibration, T_vehicle_lidar: Mapping[str, gtsam.Pose3]
) -> tuple[float, float]:
    """Largest error of an extrinsic's rotation (rad) and of its x or y (m)."""
    errors = evaluate(calibration, T_vehicle_lidar)["lidars"].values()
    s2v = [of["s2v"] for of in errors]
    turn = max(float(np.abs(of["rotation_rad"]).max()) for of in s2v)
    return turn, max(float(np.abs(of["translation_m"][:2]).max()) for of in s2v)


def lines_of(path: Path, any_version: bool) -> list[dict[str, Any]]:
    """The runs of a file that count, without incomplete lines."""
    return [line for line in json_lines(path) if any_version or line["code"] == code_digest()]


def hit(line: Mapping[str, Any]) -> bool:
    """Whether the run says what is wrong: exit 4 (or 2) and the culprit first."""
    culprits = ROWS[line["row"]].culprits
    if not culprits:
        return bool(line["exit"] == 0)
    if line["exit"] == USAGE:
        return any(name in said for name in culprits for said in line["said"])
    return line["exit"] == 4 and bool(line["suspects"]) and line["suspects"][0]["input"] in culprits


def worst_sigmas(line: Mapping[str, Any]) -> float | None:
    """Error of the first suspect's value over its sigma, the worst coordinate; None: unknown.

    A coordinate that the run calls not determined has no value.
    """
    truth = ROWS[line["row"]].truth
    if truth is None or not line["suspects"] or not hit(line):
        return None
    first = line["suspects"][0]
    off = np.abs(np.array(first["value"][: len(truth)]) - np.array(truth))
    told = np.array(first["determined"] or [True] * len(truth))[: len(truth)]
    return float((off / np.array(first["sigma"][: len(truth)]))[told].max())


def text_of(line: Mapping[str, Any]) -> str:
    """A run in one line."""
    if line["suspects"]:
        first = line["suspects"][0]
        told = first["determined"] or [True] * len(first["value"])
        numbers = [
            f"{value:.3f}+-{sigma:.3f}" if known else "not determined"
            for value, sigma, known in zip(first["value"], first["sigma"], told, strict=True)
        ]
        found = f"{first['input']} {' '.join(numbers)}, {first['sigmas']:.1f} sigma"
    else:
        found = line["said"][0] if line["said"] else ""
    worst = worst_sigmas(line)
    off = "" if worst is None else f", value off by {worst:.1f} sigma"
    mark = "hit" if hit(line) else "MISSED"
    text = f"{line['row']}, seed {line['seed']}: exit {line['exit']}, {mark}: {found}{off}"
    if "tried" in line:
        tried = line["tried"]
        before, after = (
            f"{1e3 * turn:.1f} mrad, {1e3 * shift:.0f} mm"
            for turn, shift in (tried["worst_before"], tried["worst_after"])
        )
        text += f"; with {tried['change']} exit {tried['exit']}, errors {before} -> {after}"
    return text


def summary(lines: Sequence[Mapping[str, Any]]) -> str:
    """A line per row, its runs below."""
    out = []
    for row in ROWS:
        runs = sorted((x for x in lines if x["row"] == row), key=lambda x: int(x["seed"]))
        if not runs:
            continue
        off = [worst for worst in map(worst_sigmas, runs) if worst is not None]
        value = (
            f", value within 3 sigma in {sum(x <= 3.0 for x in off)} of {len(off)}" if off else ""
        )
        out.append(f"{row}: {sum(map(hit, runs))} of {len(runs)}{value}")
        out += [f"  {text_of(line)}" for line in runs]
    return "\n".join(out)


if __name__ == "__main__":
    sys.exit(main())
