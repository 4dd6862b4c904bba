"""Is the right object taken for the target, and is what is wrong with a drive named?

Needs the environment that scripts/demo makes:

    .venv/bin/python scripts/benchmark_search.py --rows walker --seeds 20
    .venv/bin/python scripts/benchmark_search.py --rows drum clocks guess --seeds 5 --calibrate

No config names a region. Without --calibrate a run ends with the clouds of the chosen object (some
15 s); with it the drive is calibrated and compared with the truth. Runs that are in the file of
results are not repeated, unless the program has changed.
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

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the modules beside this script from any folder

from threadpoolctl import threadpool_limits

from caliv_graph.calibration.choose import choose_static, displaced
from caliv_graph.common.exits import USAGE, exit_code
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import CalivError
from caliv_graph.pipeline import calibrate
from caliv_graph.scenario.model import InitialGuessModel, Scenario, load_scenario
from caliv_graph.scenario.world_models import CylinderModel, WalkerModel
from caliv_graph.simulation import SimulatedRecording
from caliv_graph.targets.cloud.extract import extract_targets
from caliv_graph.targets.search import find_target
from caliv_graph.targets.search.misplaced import realigned
from caliv_graph.trajectory.select import smooth_trajectories
from scripts._command import exit_code_of, positive
from scripts._runs import add_line, code_digest, json_lines
from scripts._tables_rows import compared, config_for

SCENARIOS = REPOSITORY / "configs" / "scenarios"

LATE_S = 0.1
OFF_DEG = 15.0
OFF_M = (0.6, -0.5)
"""Stamps of the row `clocks`; error of a guess of the row `guess`, forward and left."""

RIGHT_M = 1.0
"""The chosen object is the right one within this: guesses displace it by half a metre."""

OFF_LIDAR = "rear"


@dataclass(frozen=True)
class Row:
    """A kind of drive.

    Attributes:
        scenario: the drive.
        named: words that a contradiction must have; empty: there must be none.
        config: changes the config.
    """

    scenario: Callable[[], Scenario]
    named: tuple[str, ...] = ()
    config: Callable[[Config], Config] = lambda config: config


def _searched(name: str, **changes: object) -> Scenario:
    scenario = load_scenario(SCENARIOS / f"{name}.yaml")
    return scenario.model_copy(update={"config_target": "search", **changes})


def _coarse() -> Scenario:
    return _searched("noisy", initial_guess=InitialGuessModel(rotation_deg=5.0, translation_m=0.5))


def _stroller() -> Scenario:
    scenario = _searched("figure_eight", crop=None)
    walker = WalkerModel(from_xy_m=(10.8, -0.8), to_xy_m=(10.8, 0.8), speed_m_s=1.3)
    return scenario.model_copy(
        update={"world": scenario.world.model_copy(update={"walkers": {"stroller": walker}})}
    )


def _drum() -> Scenario:
    scenario = _searched("figure_eight")
    drum = CylinderModel(xy_m=scenario.world.objects["chair"].xy_m)
    objects = {**scenario.world.objects, "chair": drum}
    return scenario.model_copy(
        update={"world": scenario.world.model_copy(update={"objects": objects})}
    )


def _offsets(config: Config) -> Config:
    solve = config.solve.model_copy(update={"time_offset": True})
    return config.model_copy(update={"solve": solve})


def _late() -> Scenario:
    scenario = _searched("figure_eight")
    lidars = {
        name: model.model_copy(update={"time_offset_s": LATE_S})
        for name, model in scenario.lidars.items()
    }
    return scenario.model_copy(update={"lidars": lidars})


def _off(config: Config) -> Config:
    lidar = config.lidars[OFF_LIDAR]
    (x, y, z), (roll, pitch, yaw) = lidar.given.xyz, lidar.given.rpy_deg
    initial = PoseConfig(xyz=(x + OFF_M[0], y + OFF_M[1], z), rpy_deg=(roll, pitch, yaw + OFF_DEG))
    lidars = {**config.lidars, OFF_LIDAR: lidar.model_copy(update={"initial": initial})}
    return config.model_copy(update={"lidars": lidars})


ROWS: Mapping[str, Row] = {
    "walker": Row(lambda: _searched("noisy"), config=_offsets),
    "coarse": Row(_coarse, config=_offsets),
    "stroller": Row(_stroller),
    "drum": Row(_drum),
    "clocks": Row(_late, ("stamps are late", "'front' by +0.1", "'rear' by +0.1")),
    "guess": Row(
        lambda: _searched("figure_eight"), (f"'{OFF_LIDAR}'", "initial guess is off"), _off
    ),
}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--seeds", type=positive, default=5, help="1 to N (default: 5)")
    parser.add_argument("--first", type=positive, default=1, help="first seed (default: 1)")
    parser.add_argument("--calibrate", action="store_true", help="calibrate, and compare")
    parser.add_argument(
        "--out", type=Path, default=REPOSITORY / "out" / "search.jsonl", help="file of results"
    )
    asked = parser.parse_args(arguments)
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    for row in asked.rows:
        lines = []
        for seed in range(asked.first, asked.first + asked.seeds):
            key = {"row": row, "seed": seed, "calibrated": asked.calibrate, "code": code_digest()}
            done = [line for line in json_lines(asked.out) if key.items() <= line.items()]
            line = done[0] if done else {**key, **run(row, seed, asked.calibrate)}
            if not done:
                add_line(asked.out, line)
            lines.append(line)
            print(f"  {shown(line)}", flush=True)
        right, named = sum(line["right"] for line in lines), sum(line["named"] for line in lines)
        codes = [line["exit"] for line in lines if "exit" in line]
        counts = ", ".join(f"exit {code}: {codes.count(code)}" for code in sorted(set(codes)))
        print(f"{row}: right object {right} of {len(lines)}, right words {named}; {counts or '-'}")
    return 0


def shown(line: Mapping[str, Any]) -> str:
    """One run in a line."""
    parts = [f"{line['row']} {line['seed']}: {line['said']}"]
    parts += [f"{key} {line[key]}" for key in ("off_m", "exit", "worst_sigma") if key in line]
    return ", ".join([*parts, *line["contradictions"]])


def run(name: str, seed: int, calibrated: bool) -> dict[str, Any]:
    """One run: whether the chosen object is the target, and whether the right words were said."""
    row, begun = ROWS[name], time.perf_counter()
    scenario = row.scenario()
    recording = SimulatedRecording(scenario, seed)
    config = row.config(config_for(recording, {}))
    try:
        out = (_calibrated if calibrated else _found)(recording, config)
    except CalivError as e:
        out = {"said": str(e), "contradictions": [], "exit": USAGE}
    if "place" in out:
        truth = scenario.world.objects[scenario.world.targets[0]].xy_m
        out["off_m"] = round(math.dist(out.pop("place"), truth), 2)
    said = " ".join(out["contradictions"])
    named = all(word in said for word in row.named) and bool(said) == bool(row.named)
    right = out.get("off_m", math.inf) < RIGHT_M
    return {**out, "right": right, "named": named, "s": round(time.perf_counter() - begun)}


def _found(recording: SimulatedRecording, config: Config) -> dict[str, Any]:
    """As `pipeline.prepare`, without what follows the extraction."""
    quiet = SilentProgress()
    with threadpool_limits(limits=1):
        trajectories = smooth_trajectories([recording], config, [[]], {0: recording.motion()})
        searched = find_target([recording], trajectories, config, quiet)
        config, misplaced = realigned(config, searched)
        observations = extract_targets(
            [recording], trajectories, config, quiet, choose_static, searched
        )
        contradictions = (*misplaced, *displaced(observations, trajectories, config))
    first = observations[0]
    return {
        "place": first.centre_map[:2].tolist(),
        "said": "; ".join((first.name, *first.warnings)),
        "contradictions": list(contradictions),
    }


def _calibrated(recording: SimulatedRecording, config: Config) -> dict[str, Any]:
    done = calibrate([recording], config, SilentProgress())
    errors = compared(done.calibration, recording.truth.T_vehicle_lidar, {}).quantities
    worst = max(
        abs(error) / sigma
        for each in errors.values()
        if each.sigma is not None
        for error, sigma, known in zip(each.error, each.sigma, each.determined, strict=True)
        if known
    )
    return {
        "place": done.observations[0].centre_map[:2].tolist(),
        "said": "; ".join((done.observations[0].name, *done.calibration.warnings)),
        "contradictions": list(done.calibration.contradictions),
        "exit": exit_code(done.calibration),
        "worst_sigma": round(worst, 1),
    }


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
