"""The ranking of suspects: is the input that the user got wrong named first, and its value right?

Needs the environment that scripts/demo makes:

    .venv/bin/python scripts/benchmark_suspects.py --seeds 5
    .venv/bin/python scripts/benchmark_suspects.py --seeds 1 --rows "lever arm zeros" clean
    .venv/bin/python scripts/benchmark_suspects.py --rows "lever arm zeros" --try-suspects
    .venv/bin/python scripts/benchmark_suspects.py --summary

By the installed command: `simulate` writes a figure-eight whose antenna is at (1.2, 0.3, 0.85) m
and whose IMU is turned by (1, -2, 5) degrees, with clouds at 2 Hz; `calibrate` runs with the config
of each row, in which one input is wrong. In some rows a clock is. Signs and directions are drawn
per seed. A run is a line in out/suspects/runs.jsonl, written when it ends; a second start runs the
missing ones. Runs of another version of the program do not count unless --any-version is given.
With --try-suspects, the second run that follows each inconsistent one is compared with the truth
as well.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gtsam
import numpy as np
import yaml
from rosbags.typesys import Stores, get_typestore

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the modules beside this script from any folder

from caliv_graph.common.exits import DEFECT, DONE, INCONSISTENT, UNMET, USAGE
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import CalivError
from caliv_graph.products import Array
from caliv_graph.results.calibration_file import read_calibration
from caliv_graph.results.names import CALIBRATION_FILE, SUSPECT_FOLDER
from caliv_graph.results.truth_file import read_truth
from caliv_graph.scenario.model import dump_scenario, load_scenario
from caliv_graph.simulation.writer import BAG_FOLDER, topic_of_lidar
from scripts._bags import copied
from scripts._command import calibrate_measured, exit_code_of, positive, run_command
from scripts._judged import outcome_of, worst
from scripts._runs import add_line, code_digest, json_lines, performed

OUT = REPOSITORY / "out" / "suspects"

ARM_M = (1.2, 0.3, 0.85)
IMU_RPY_DEG = (1.0, -2.0, 5.0)
LATE_S = 0.1
DRIFT_M = 0.2

LARGEST_SIGMAS = 3.0
"""Errors over their sigmas that a value may have."""

Raw = dict[str, Any]


@dataclass(frozen=True)
class Row:
    """A mistake.

    Attributes:
        culprits: names of the input, any of which is right as the first suspect; empty: none.
        edit: changes the config, in place, with a random source.
        late: LiDARs whose stamps are late by LATE_S.
        twice: whether the rear LiDAR's topic has the clouds of the front one.
        truth: value that the first suspect should take, by its first coordinates; None: not judged.
        refused: whether nothing can be solved: exit 2 and all the culprits' names are right.
    """

    culprits: tuple[str, ...] = ()
    edit: Callable[[Raw, np.random.Generator], None] = lambda raw, rng: None
    late: tuple[str, ...] = ()
    twice: bool = False
    truth: tuple[float, ...] | None = None
    refused: bool = False


def _arm(
    move: Callable[[np.random.Generator], Array],
) -> Callable[[Raw, np.random.Generator], None]:
    def edit(raw: Raw, rng: np.random.Generator) -> None:
        raw["gnss"]["lever_arm"] = (np.array(ARM_M) + move(rng)).tolist()

    return edit


def _unknown_arm(raw: Raw, _: np.random.Generator) -> None:
    raw["gnss"] = {"lever_arm": None}


def _imu(axis: int, degrees: float) -> Callable[[Raw, np.random.Generator], None]:
    def edit(raw: Raw, rng: np.random.Generator) -> None:
        turn = np.zeros(3)
        turn[axis] = math.radians(degrees) * rng.choice([-1.0, 1.0])
        R = gtsam.Rot3.Expmap(turn).compose(gtsam.Rot3.RzRyRx(*np.radians(IMU_RPY_DEG)))
        raw["imu"]["T_vehicle_imu"]["rpy_deg"] = np.degrees(R.rpy()).tolist()

    return edit


def _height(raw: Raw, rng: np.random.Generator) -> None:
    raw["ground"]["vehicle_height"] = 0.2 * float(rng.choice([-1.0, 1.0]))


def _guess(raw: Raw, rng: np.random.Generator) -> None:
    way = float(rng.choice([-1.0, 1.0]))
    initial = raw["lidars"]["rear"]["initial"]
    initial["xyz"][1] += 0.8 * way
    initial["rpy_deg"][2] += 15.0 * way


def _drifting(raw: Raw, _: np.random.Generator) -> None:
    del raw["imu"], raw["gnss"], raw["topics"]
    raw["data"]["poses"] = DRIFTING_FILE


TWICE_FOLDER = "twice"
"""Beside a config: the bag with the clouds of the front LiDAR under both topics."""

DRIFTING_FILE = "drifting.tum"
"""Beside a config: the true poses, with a drift by DRIFT_M from start to end along map x and y."""

ROWS = {
    "clean": Row(),
    "lever arm zeros": Row(("gnss.lever_arm",), _arm(lambda _: -np.array(ARM_M)), truth=ARM_M),
    "lever arm 0.2 m off": Row(
        ("gnss.lever_arm",), _arm(lambda rng: 0.2 * _horizontal(rng)), truth=ARM_M
    ),
    "lever arm 5 cm per axis": Row(
        ("gnss.lever_arm",), _arm(lambda rng: 0.05 * rng.choice([-1.0, 1.0], 3)), truth=ARM_M
    ),
    "lever arm null": Row((), _unknown_arm, truth=ARM_M),
    "IMU 2 degrees of roll": Row(("imu.T_vehicle_imu",), _imu(0, 2.0), truth=IMU_RPY_DEG),
    "IMU 2 degrees of pitch": Row(("imu.T_vehicle_imu",), _imu(1, 2.0), truth=IMU_RPY_DEG),
    "IMU 90 degrees of roll": Row(("imu.T_vehicle_imu",), _imu(0, 90.0), refused=True),
    "vehicle_height 0.2 m off": Row(("ground.vehicle_height",), _height, truth=(0.0,)),
    "two topics with the same clouds": Row(("'front'", "'rear'"), twice=True, refused=True),
    "both LiDARs 0.1 s late": Row(
        ("lidars.*.time_offset",), late=("front", "rear"), truth=(LATE_S,)
    ),
    "rear LiDAR 0.1 s late": Row(("lidars.rear.time_offset",), late=("rear",), truth=(LATE_S,)),
    "guess 15 degrees and 0.8 m off": Row(("lidars.rear.initial",), _guess),
    "given poses drift by 0.2 m": Row(("poses.drift",), _drifting),
}


def _horizontal(rng: np.random.Generator) -> Array:
    """A unit vector at a random angle, level."""
    angle = rng.uniform(0.0, 2.0 * math.pi)
    return np.array([math.cos(angle), math.sin(angle), 0.0])


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=positive, default=5, help="1 to N (default: 5)")
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS))
    parser.add_argument("--jobs", type=positive, default=1, help="at a time (default: 1)")
    parser.add_argument("--try-suspects", action="store_true", help="the second run as well")
    parser.add_argument("--summary", action="store_true", help="only print what is there")
    parser.add_argument("--any-version", action="store_true", help="count runs of older text too")
    parser.add_argument("--out", type=Path, default=OUT, help="folder (default: out/suspects)")
    asked = parser.parse_args(arguments)
    path = asked.out / "runs.jsonl"
    if not asked.summary:
        asked.out.mkdir(parents=True, exist_ok=True)
        done = {(r["row"], r["seed"]) for r in lines_of(path, asked.any_version)}
        missing = [
            (row, seed, asked.try_suspects)
            for seed in range(1, asked.seeds + 1)
            for row in asked.rows
            if (row, seed) not in done
        ]
        for _, line in performed(perform, missing, asked.jobs):
            if isinstance(line, Exception):
                raise line
            add_line(path, line)
            print(text_of(line), flush=True)
    print(summary(lines_of(path, asked.any_version)))
    return 0


def perform(task: tuple[str, int, bool]) -> dict[str, Any]:
    """Simulates and calibrates once, or twice; returns the line to write.

    Raises:
        CalivError: the drive could not be simulated.
    """
    name, seed, try_suspects = task
    row, rng = ROWS[name], np.random.default_rng(seed)
    line: dict[str, Any] = {"row": name, "seed": seed, "code": code_digest(), "suspects": []}
    with TemporaryDirectory(prefix="suspects_") as temporary:
        folder = Path(temporary) / "drive"
        simulate(folder, seed, row.late)
        write_drift(folder)
        raw = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
        if row.twice:
            copy_of_front(folder)
            raw["data"]["path"] = TWICE_FOLDER
        row.edit(raw, rng)
        config, result = folder / "edited.yaml", Path(temporary) / "result"
        config.write_text(yaml.safe_dump(raw), encoding="utf-8")
        try:
            options = ("--try-suspects",) if try_suspects else ()
            usage = calibrate_measured(config, result, options=options)
        except CalivError as e:
            refused = f"exit code {USAGE}:" in str(e)
            return {**line, "exit": USAGE if refused else DEFECT, "said": [str(e)]}
        line |= {"cpu_s": usage.cpu_s, **_result(result, read_truth(folder / "truth.yaml"))}
        if (result / SUSPECT_FOLDER).is_dir():
            line["tried"] = _result(result / SUSPECT_FOLDER, read_truth(folder / "truth.yaml"))
    return line


def simulate(folder: Path, seed: int, late: Sequence[str]) -> None:
    """Writes the figure-eight with an antenna and an IMU that are not at the vehicle's origin.

    Raises:
        CalivError: `simulate` failed.
    """
    model = load_scenario(REPOSITORY / "configs" / "scenarios" / "figure_eight.yaml")
    lidars = {
        name: lidar.model_copy(
            update={"rate_hz": 2.0, "time_offset_s": LATE_S if name in late else 0.0}
        )
        for name, lidar in model.lidars.items()
    }
    mounting = PoseConfig(xyz=(0.3, 0.1, 0.4), rpy_deg=IMU_RPY_DEG)
    model = model.model_copy(
        update={
            "lidars": lidars,
            "imu": model.imu.model_copy(update={"mounting": mounting}),
            "gnss": model.gnss.model_copy(update={"lever_arm": ARM_M}),
        }
    )
    scenario = folder.with_name("scenario.yaml")
    scenario.write_text(dump_scenario(model), encoding="utf-8")
    run_command("simulate", scenario, "--out", folder, "--seed", seed)


def copy_of_front(folder: Path) -> None:
    """Copies the bag of a drive, the rear LiDAR's clouds replaced by those of the front one."""
    front, rear = (topic_of_lidar(name) for name in ("front", "rear"))
    store = get_typestore(Stores.ROS2_HUMBLE)
    with copied(folder / BAG_FOLDER, folder / TWICE_FOLDER, store) as bag:
        for connection, stamp, data in bag.messages():
            if connection.topic != rear:
                bag.write(connection.topic, stamp, data)
            if connection.topic == front:
                bag.write(rear, stamp, data)


def write_drift(folder: Path) -> None:
    """The true poses of a drive, as TUM, with a drift."""
    poses = np.loadtxt(folder / "trajectory.tum")
    part = np.linspace(0.0, 1.0, len(poses))
    poses[:, 1:3] += DRIFT_M / math.sqrt(2.0) * part[:, np.newaxis]
    np.savetxt(folder / DRIFTING_FILE, poses, "%.9f")


def _result(folder: Path, truth: Mapping[str, gtsam.Pose3]) -> dict[str, Any]:
    """What a run says, and how far it is off."""
    path = folder / CALIBRATION_FILE
    written = yaml.safe_load(path.read_text(encoding="utf-8"))
    return {
        **outcome_of(read_calibration(path), truth),
        "suspects": written.get("suspects", [])[:3],
        "vehicle": written.get("vehicle", {}),
    }


def lines_of(path: Path, any_version: bool) -> list[dict[str, Any]]:
    """The runs of a file that count, without incomplete lines."""
    return [line for line in json_lines(path) if any_version or line["code"] == code_digest()]


def hit(line: Mapping[str, Any]) -> bool:
    """Whether the run says what is wrong: exit 4 (or 2) and the culprit first.

    Without a culprit: exit 0, and no error beyond LARGEST_SIGMAS where a value is estimated.
    """
    row = ROWS[line["row"]]
    if not row.culprits:
        off = worst_sigmas(line)
        known = off is None or max(off, worst(line["errors"])) <= LARGEST_SIGMAS
        return line["exit"] in (DONE, UNMET) and known
    if line["exit"] == USAGE:
        return all(name in said for name in row.culprits for said in line["said"])
    first = line["suspects"][:1]
    return line["exit"] == INCONSISTENT and bool(first) and first[0]["input"] in row.culprits


def value_of(line: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The value that is judged: of the first suspect, or of a lever arm that is estimated."""
    row = ROWS[line["row"]]
    if row.truth is None:
        return None
    if not row.culprits:
        arm: Mapping[str, Any] | None = line.get("vehicle", {}).get("lever_arm")
        return arm
    return line["suspects"][0] if line["suspects"] and hit(line) else None


def worst_sigmas(line: Mapping[str, Any]) -> float | None:
    """Error of the judged value over its sigma, the worst coordinate; None: unknown.

    A coordinate that the run calls not determined has no value.
    """
    found, truth = value_of(line), ROWS[line["row"]].truth
    if truth is None or found is None:
        return None
    told = np.array(_told(found))[: len(truth)]
    value, sigma = (np.array(found[key][: len(truth)], float)[told] for key in ("value", "sigma"))
    return float((np.abs(value - np.array(truth)[told]) / sigma).max(initial=0.0))


def _told(found: Mapping[str, Any]) -> list[bool]:
    """Which coordinates of a value are determined."""
    told = found.get("determined", True)
    return list(told) if isinstance(told, list) else [told] * len(found["value"])


def text_of(line: Mapping[str, Any]) -> str:
    """A run in one line."""
    found = line["suspects"][0] if line["suspects"] and line["exit"] != DONE else value_of(line)
    said = line["said"][0] if line["said"] else ""
    if found is not None:
        numbers = [
            f"{value:.3f}+-{sigma:.3f}" if known else "not determined"
            for value, sigma, known in zip(
                found["value"], found["sigma"], _told(found), strict=True
            )
        ]
        said = f"{found.get('input', 'estimated')} {' '.join(numbers)}"
        said += f", {found['sigmas']:.1f} sigma" if "sigmas" in found else ""
    value = worst_sigmas(line)
    off = "" if value is None else f", value off by {value:.1f} sigma"
    errors = f", extrinsics off by {worst(line['errors']):.1f} sigma" if "errors" in line else ""
    mark = "hit" if hit(line) else "MISSED"
    text = f"{line['row']}, seed {line['seed']}: exit {line['exit']}, {mark}: {said}{off}{errors}"
    if "tried" in line:
        tried = line["tried"]
        text += f"; tried again: exit {tried['exit']}, off by {worst(tried['errors']):.1f} sigma"
    return text


def summary(lines: Sequence[Mapping[str, Any]]) -> str:
    """A line per row, its runs below."""
    out = []
    for row in ROWS:
        runs = sorted((x for x in lines if x["row"] == row), key=lambda x: int(x["seed"]))
        if not runs:
            continue
        off = [sigmas for sigmas in map(worst_sigmas, runs) if sigmas is not None]
        within = sum(sigmas <= LARGEST_SIGMAS for sigmas in off)
        value = f", value within 3 sigma in {within} of {len(off)}" if off else ""
        out.append(f"{row}: {sum(map(hit, runs))} of {len(runs)}{value}")
        out += [f"  {text_of(line)}" for line in runs]
    return "\n".join(out)


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
