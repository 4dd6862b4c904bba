"""Is `compare` right? P-values of unmoved mounts, and the detection rate of moved ones.

    .venv/bin/python scripts/benchmark_compare.py
    .venv/bin/python scripts/benchmark_compare.py --result result/calibration.yaml
    .venv/bin/python scripts/benchmark_compare.py --from-sensors 50

Quick form: pairs of calibrations are drawn from the stated covariance of one calibration of the
scenario. This tests the tests. With `--from-sensors N`, N pairs of drives are simulated from raw
sensors and calibrated, which tests the covariance too. These calibrations are kept below
out/compare and not repeated. A mount is moved by changing the second result.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: one process per core

import numpy as np
from scipy.stats import binomtest, kstest

from caliv_graph.calibration.assemble import DRIVES
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.conventions import AXES
from caliv_graph.errors import CalivError
from caliv_graph.fusion.compare import ALPHA, Comparison, compare
from caliv_graph.fusion.terms import guess_of, own_term
from caliv_graph.geometry.se3 import retract_vehicle_axes
from caliv_graph.pipeline import calibrate
from caliv_graph.products import Array, Calibration
from caliv_graph.results.calibration_file import read_calibration, write_calibration
from caliv_graph.scenario.model import load_scenario
from caliv_graph.simulation.writer import config_of
from caliv_graph.uncertainty.observability import scaling, spectrum
from scripts._thinned import GroundWaves, ThinnedRecording, cached_selection

REPOSITORY = Path(__file__).resolve().parents[1]
SCENARIOS = REPOSITORY / "configs" / "scenarios"
OUT = REPOSITORY / "out" / "compare"

TURN_RAD = np.radians(0.1)
SIGMAS = 5.0

LABELS = ("first", "second")

Pair = tuple[Calibration, Calibration]


@dataclass(frozen=True)
class Move:
    """A movement to detect.

    Attributes:
        text: what it is.
        lidars: LiDARs that are moved.
        axis: index of `conventions.AXES`.
        size: rad or m; None: five predicted sigmas of the difference.
    """

    text: str
    lidars: tuple[str, ...]
    axis: int
    size: float | None


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenario", default="figure_eight", metavar="NAME")
    parser.add_argument("--result", type=Path, metavar="CALIBRATION.yaml", help="to draw from")
    parser.add_argument("--pairs", type=int, default=200, help="pairs drawn (default: 200)")
    parser.add_argument("--from-sensors", type=int, metavar="N", help="pairs of simulated drives")
    parser.add_argument("--seed", type=int, default=1, help="of what is drawn (default: 1)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: 1)")
    asked = parser.parse_args(arguments)
    try:
        if asked.from_sensors:
            pairs = measured_pairs(asked.scenario, asked.from_sensors, asked.jobs)
        else:
            result = asked.result
            if result is None:
                (result,) = calibrated(asked.scenario, [1], asked.jobs)
            pairs = list(drawn_pairs(read_calibration(result), asked.pairs, asked.seed))
    except CalivError as e:
        parser.error(str(e))
    print(null_table(pairs), flush=True)
    print(power_table(pairs), flush=True)
    return 0


# ------------------------------------------------------------------ pairs


def drawn_pairs(calibration: Calibration, count: int, seed: int) -> Iterator[Pair]:
    """Pairs of calibrations with errors drawn from the stated data covariance of one."""
    rng = np.random.default_rng(seed)
    root = data_root(calibration)
    for pair in range(count):
        first, second = (
            at(calibration, root @ rng.normal(size=root.shape[1]), f"{pair}{which}")
            for which in LABELS
        )
        yield first, second


def data_root(calibration: Calibration) -> Array:
    """(6n, k) root of the data's covariance along what they determine, vehicle axes."""
    information = own_term(calibration, "result").information
    guesses = [guess_of(calibration, name).sigmas for name in calibration.lidars]
    split = spectrum(information, np.diag(np.concatenate(guesses) ** -2.0))
    determined = ~split.undetermined
    unit = scaling(len(guesses))
    return np.asarray(
        unit[:, None] * split.vectors[:, determined] / np.sqrt(split.information[determined])
    )


def at(calibration: Calibration, e: Array, source: str) -> Calibration:
    """The calibration with its data's optimum moved by e (vehicle axes)."""
    return replace(
        moved(calibration, e),
        gradient_data=np.zeros(len(e)),
        provenance={**calibration.provenance, DRIVES: [source]},
    )


def moved(calibration: Calibration, e: Array) -> Calibration:
    """The calibration after its mounts have moved by e (vehicle axes)."""
    lidars = {
        name: replace(
            lidar,
            T_vehicle_lidar=retract_vehicle_axes(lidar.T_vehicle_lidar, e[6 * i : 6 * i + 6]),
        )
        for i, (name, lidar) in enumerate(calibration.lidars.items())
    }
    return replace(calibration, lidars=lidars)


def measured_pairs(scenario: str, count: int, jobs: int) -> list[Pair]:
    """Pairs of calibrations of simulated drives."""
    results = [read_calibration(p) for p in calibrated(scenario, range(1, 2 * count + 1), jobs)]
    return list(zip(results[::2], results[1::2], strict=True))


def calibrated(scenario: str, seeds: Sequence[int], jobs: int) -> list[Path]:
    """Calibrations of a simulated scenario; missing ones are made."""
    cached_selection(load_scenario(SCENARIOS / f"{scenario}.yaml"), OUT / "beams")
    make = partial(calibrated_once, scenario)
    if jobs == 1:
        return [make(seed) for seed in seeds]
    # Spawned, because threads of open3d do not survive a fork.
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        return list(pool.map(make, seeds))


def calibrated_once(scenario: str, seed: int) -> Path:
    path = OUT / f"{scenario}-{seed}.yaml"
    if not path.exists():
        model = load_scenario(SCENARIOS / f"{scenario}.yaml")
        selection = cached_selection(model, OUT / "beams")
        recording = ThinnedRecording(model, selection, seed, waves=GroundWaves())
        config = parse_config(config_of(recording, has_bag=True), f"{scenario}.yaml", SCENARIOS)
        write_calibration(calibrate([recording], config, SilentProgress()).calibration, path)
        print(f"{scenario} seed {seed}: calibrated", flush=True)
    return path


# ------------------------------------------------------------------ tables


def null_table(pairs: Sequence[Pair]) -> str:
    """P-values of pairs without movement."""
    found = [compare(*pair, LABELS) for pair in pairs]
    lines = [
        f"\nNothing has moved: {len(pairs)} pairs. Uniform p-values give a large p of the "
        "Kolmogorov-Smirnov test, and one in a hundred below 0.01",
        f"  {'test':28}{'KS p':>8}{'mean p':>8}{'p < 0.01':>10}{'p < 0.05':>10}",
    ]
    columns: dict[str, Callable[[Comparison], float]] = {
        name_of(m.lidars): partial(p_of, number) for number, m in enumerate(found[0].movements)
    }
    columns["all at once"] = lambda comparison: comparison.p_value
    for name, read in columns.items():
        p = np.array([read(comparison) for comparison in found])
        uniform = kstest(p, "uniform").pvalue
        lines.append(
            f"  {name:28}{uniform:8.3f}{p.mean():8.3f}{np.mean(p < 0.01):10.1%}"
            f"{np.mean(p < 0.05):10.1%}"
        )
    alarms = sum(comparison.moved for comparison in found)
    low, high = binomtest(alarms, len(found)).proportion_ci(0.95, method="wilson")
    lines.append(
        f"  verdict, corrected: {alarms} false alarms of {len(found)} ({alarms / len(found):.1%}, "
        f"95% within {low:.1%} to {high:.1%}; asked for at most {ALPHA:.0%})"
    )
    return "\n".join(lines)


def p_of(number: int, comparison: Comparison) -> float:
    return comparison.movements[number].p_value


def name_of(lidars: Sequence[str]) -> str:
    return f"S2V {lidars[0]}" if len(lidars) == 1 else f"S2S {lidars[0]} to {lidars[1]}"


def power_table(pairs: Sequence[Pair]) -> str:
    """Detection rate of moved mounts."""
    lines = [
        "\nA mount has moved. Found: by a test of a LiDAR or pair that moved, p < 0.01; by the "
        "verdict, corrected for the number of tests",
        f"  {'move':44}{'size':>12}{'test':>8}{'verdict':>9}",
    ]
    least = {"test": 1.0, "verdict": 1.0}
    for move in moves(list(pairs[0][0].lidars)):
        by_test, by_verdict, sizes = [], [], []
        for first, second in pairs:
            e, size = perturbation(first, second, move)
            found = compare(first, moved(second, e), LABELS)
            concerned = [m for m in found.movements if len(set(m.lidars) & set(move.lidars)) > 0]
            by_test.append(any(m.p_value < ALPHA for m in concerned))
            by_verdict.append(found.moved)
            sizes.append(size)
        unit = "mrad" if move.axis < 3 else "mm"
        lines.append(
            f"  {move.text:44}{1e3 * np.mean(sizes):8.3f} {unit:3}{np.mean(by_test):8.0%}"
            f"{np.mean(by_verdict):9.0%}"
        )
        least["test"] = min(least["test"], float(np.mean(by_test)))
        least["verdict"] = min(least["verdict"], float(np.mean(by_verdict)))
    lines.append(f"  least: {least['test']:.0%} by a test, {least['verdict']:.0%} by the verdict")
    return "\n".join(lines)


def moves(lidars: Sequence[str]) -> Iterator[Move]:
    """Movements by 0.1 degrees and by five sigmas, of each LiDAR and of all together."""
    groups: Mapping[str, tuple[str, ...]] = {
        **{f"'{name}'": (name,) for name in lidars},
        "all LiDARs": tuple(lidars),
    }
    for group, names in groups.items():
        for axis, name in enumerate(AXES):
            if axis < 3:
                yield Move(f"{group}: 0.1 degrees of {name}", names, axis, float(TURN_RAD))
            yield Move(f"{group}: {SIGMAS:g} sigmas of {name}", names, axis, None)


def perturbation(first: Calibration, second: Calibration, move: Move) -> tuple[Array, float]:
    """(6n,) the movement, and its size. Five sigmas refer to the first LiDAR that is moved."""
    names = list(first.lidars)
    rows = [6 * names.index(name) + move.axis for name in move.lidars]
    size = move.size
    if size is None:
        variances = [np.sum(data_root(c) ** 2, axis=1)[rows[0]] for c in (first, second)]
        size = SIGMAS * float(np.sqrt(sum(variances)))
    e = np.zeros(6 * len(names))
    e[rows] = size
    return e, size


if __name__ == "__main__":
    sys.exit(main())
