"""Statistics of the runs of benchmark_tables, limits, published figures, and tables as text."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from caliv_graph.conventions import AXES
from caliv_graph.products import Array
from scripts._tables_rows import Errors

SHOWN = ("x", "y", "z", "roll", "pitch", "yaw")
"""Translations in mm, rotations in mrad."""

_ORDER = [AXES.index(axis) for axis in SHOWN]
NONE = math.nan

RATIO_LIMIT = 1.25
"""Limit of RMSE over predicted sigma, before three standard errors are added."""

CONSERVATIVE = 0.8
"""Smallest ratio of the mean NEES to its expected value."""

SECONDS_LIMIT = 15.0

DEGREES_OF_FREEDOM = 6


@dataclass(frozen=True)
class Line:
    """One run as a line of a file.

    Attributes:
        seed: seed of all draws.
        failure: reason for a missing result, or empty.
        status: of the calibration.
        undetermined: directions, as they are named.
        seconds: of CPU.
        quantities: 'S2V front', 'S2S front to rear', ...
        code: digest of the program's text.
    """

    seed: int
    failure: str
    status: str
    undetermined: tuple[str, ...]
    seconds: Mapping[str, float]
    quantities: Mapping[str, Errors]
    code: str = ""


def line_of(raw: Mapping[str, Any]) -> Line:
    """A run, from the line of a file."""
    return Line(
        seed=raw["seed"],
        failure=raw["failure"],
        status=raw.get("status", ""),
        undetermined=tuple(raw.get("undetermined", ())),
        seconds=raw.get("seconds", {}),
        quantities={
            name: Errors(
                tuple(e["error"]),
                None if e["sigma"] is None else tuple(e["sigma"]),
                tuple(e["determined"]),
                e["nees"],
            )
            for name, e in raw.get("quantities", {}).items()
        },
        code=raw.get("code", ""),
    )


@dataclass(frozen=True)
class Statistics:
    """Statistics of one quantity over the runs of a row; (6,) in the order of `SHOWN`, mm and mrad.

    Runs that did not determine an axis are left out of that axis; NaN if no run is left.

    Attributes:
        runs: number of runs.
        determined: (6,) number of runs that determined an axis.
        mean: mean error, with its sign.
        spread: standard deviation of the error about its mean; NaN with less than two runs.
        mean_abs: mean absolute error.
        rmse: root mean square error.
        largest: largest absolute error.
        sigma: root mean square of the stated sigmas; NaN without.
        held: mean absolute error of the runs that did *not* determine the axis: the guess's error.
        nees: mean NEES of all six axes; NaN without a covariance.
        nees_runs: number of runs in this mean.
    """

    runs: int
    determined: Array
    mean: Array
    spread: Array
    mean_abs: Array
    rmse: Array
    largest: Array
    sigma: Array
    held: Array
    nees: float
    nees_runs: int

    @property
    def ratio(self) -> Array:
        """(6,) RMSE over sigma."""
        return np.asarray(self.rmse / self.sigma)

    @property
    def mean_over_sigma(self) -> Array:
        """(6,) absolute mean error over sigma."""
        return np.asarray(np.abs(self.mean) / self.sigma)

    @property
    def bias(self) -> Array:
        """(6,) mean error in standard errors of this mean; NaN if the errors do not scatter."""
        error = self.spread / np.sqrt(np.maximum(self.determined, 1.0))
        return np.asarray(self.mean / np.where(error > 0.0, error, NONE))

    def ratio_limits(self) -> Array:
        """(6,) limits of `ratio`: that of n normal draws has a standard error of 1 / sqrt(2 n)."""
        return np.asarray(RATIO_LIMIT + 3.0 / np.sqrt(2.0 * np.maximum(self.determined, 1.0)))


def nees_interval(runs: int) -> tuple[float, float]:
    """95% interval of the mean NEES of n runs, each chi-square with 6 degrees of freedom."""
    dof = DEGREES_OF_FREEDOM * runs
    return float(chi2.ppf(0.025, dof)) / runs, float(chi2.ppf(0.975, dof)) / runs


def nees_is_right(mean: float, runs: int) -> bool:
    """Whether it is within three standard errors of 6, or at most 20% smaller."""
    error = 3.0 * math.sqrt(2.0 * DEGREES_OF_FREEDOM / runs)
    low = min(DEGREES_OF_FREEDOM - error, CONSERVATIVE * DEGREES_OF_FREEDOM)
    return low <= mean <= DEGREES_OF_FREEDOM + error


def statistics(runs: Sequence[Errors]) -> Statistics:
    """Statistics of one quantity."""
    scale = np.array([1e3] * 6)
    signed = np.array([run.error for run in runs])[:, _ORDER] * scale
    error = np.abs(signed)
    determined = np.array([run.determined for run in runs], bool)[:, _ORDER]
    stated = [run.sigma or (NONE,) * 6 for run in runs]
    sigma = np.array(stated)[:, _ORDER] * scale
    nees = [run.nees for run in runs if run.nees is not None]
    return Statistics(
        runs=len(runs),
        determined=determined.sum(axis=0).astype(np.float64),
        mean=_per_axis(np.mean, signed, determined),
        spread=_per_axis(_spread, signed, determined),
        mean_abs=_per_axis(np.mean, error, determined),
        rmse=_per_axis(_rms, error, determined),
        largest=_per_axis(np.max, error, determined),
        sigma=_per_axis(_rms, sigma, determined),
        held=_per_axis(np.mean, error, ~determined),
        nees=float(np.mean(nees)) if nees else NONE,
        nees_runs=len(nees),
    )


def _spread(values: Array) -> float:
    return float(values.std(ddof=1)) if len(values) > 1 else NONE


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _per_axis(of: Callable[[Array], float], values: Array, taken: Array) -> Array:
    return np.array(
        [
            float(of(v[t])) if t.any() else NONE
            for v, t in zip(values.T, taken.T.astype(bool), strict=True)
        ]
    )


def by_quantity(lines: Sequence[Line]) -> dict[str, Statistics]:
    """Statistics of every quantity of a row; failed runs are left out."""
    names = list(dict.fromkeys(name for line in lines for name in line.quantities))
    return {
        name: statistics([line.quantities[name] for line in lines if name in line.quantities])
        for name in names
    }


# ------------------------------------------------------------------ figures to beat


def limits(scenario: str, quantity: str) -> tuple[float, ...] | None:
    """Limits of the mean absolute errors, mm and mrad, `SHOWN`; NaN: no limit."""
    return _LIMITS.get(scenario, {}).get(quantity[:3])


_LIMITS: Mapping[str, Mapping[str, tuple[float, ...]]] = {
    "paper_arc": {
        "S2S": (6.0, 5.5, 1.0, 0.15, 0.15, 0.5),
        "S2V": (NONE, 10.0, 6.0, 0.2, 0.2, 4.5),
    },
    "s_curve": {
        "S2S": (8.0, 9.0, 1.0, 0.15, 0.15, 0.55),
        "S2V": (10.0, 9.0, 6.0, 0.3, 0.25, 0.55),
    },
    "figure_eight": {
        "S2S": (4.0, 3.5, 1.0, 0.1, 0.1, 0.3),
        "S2V": (3.0, 2.5, 6.0, 0.12, 0.12, 0.25),
    },
    "tri_lidar": {
        "S2S": (5.0, 5.0, 1.5, 0.15, 0.15, 0.35),
        "S2V": (4.0, 3.5, 6.0, 0.15, 0.15, 0.3),
    },
}

PUBLISHED: Mapping[str, Mapping[str, tuple[float, ...]]] = {
    "CaLiV, as published": {
        "S2S front to rear": (1.1, 15.4, 20.0, 4.3, 7.0, 0.5),
        "S2V front": (NONE, NONE, NONE, 4.2, 4.7, 8.2),
        "S2V rear": (NONE, 16.0, NONE, 1.4, 2.4, 8.3),
    },
    "CaLiV, true poses": {
        "S2V front": (NONE, NONE, NONE, 1.3, 0.7, 8.4),
        "S2V rear": (NONE, NONE, NONE, 1.3, 0.7, 8.4),
    },
    "mlcc, true poses": {"S2S front to rear": (5564.2, 469.1, 2251.1, 111.6, 322.2, 128.6)},
    "SensorX2Car, true poses": {
        "S2V front": (NONE, NONE, NONE, 4.6, 1.9, NONE),
        "S2V rear": (NONE, NONE, NONE, 4.6, 1.9, NONE),
    },
    "Multi-LiCa, true poses": {
        "S2V front": (NONE, NONE, NONE, NONE, 5.6, NONE),
        "S2V rear": (NONE, NONE, NONE, NONE, 5.6, NONE),
    },
}
"""Tables I to III of the paper: mean absolute errors over 100 runs on its arc, mm and mrad. It does
not name the LiDAR of table III."""


@dataclass(frozen=True)
class OtherSystem:
    """One run of another system on a simulated drive, measured with its own program.

    Attributes:
        name: name of the system.
        scenario: scenario of the comparison.
        row: our row in the comparison.
        quantity: the quantity it estimated.
        errors: mm and mrad in the order of `SHOWN`, NaN for axes it does not estimate.
        target: whether our errors have to be smaller. False if it had the true mount of a LiDAR or
            started from the truth.
    """

    name: str
    scenario: str
    row: str
    quantity: str
    errors: tuple[float, ...]
    target: bool = True


_FRONT, _REAR, _BOTH = "S2V front", "S2V rear", "S2S front to rear"

OTHERS: tuple[OtherSystem, ...] = (
    OtherSystem(
        "CaLiV's program, from the truth", "paper_arc", "auto", _BOTH,
        (1.3, -7.6, -20.4, -0.2, 0.1, -0.9), False,
    ),
    OtherSystem(
        "CaLiV's program", "paper_arc", "auto", _BOTH, (42.0, 196.0, 1043.0, -63.0, -27.0, -10.0)
    ),
    OtherSystem(
        "mlcc, true mount of one LiDAR", "paper_arc", "auto", _BOTH,
        (3.2, -0.9, 4.0, -0.1, 0.4, 0.15), False,
    ),
    OtherSystem("mlcc", "paper_arc", "auto", _BOTH, (-30.0, -6.0, 0.7, 0.0, 0.1, 1.6)),
    *(
        OtherSystem(name, scenario, "auto_parallel", lidar, errors)
        for scenario in ("paper_arc", "figure_eight")
        for name, errors in (
            ("SensorX2Car", (NONE, NONE, 2.0, 0.02, 0.08, NONE)),
            ("Multi-LiCa", (NONE, NONE, 1.0, NONE, 0.08, NONE)),
        )
        for lidar in (_FRONT, _REAR)
    ),
    *(
        OtherSystem("scan matching and hand-eye", "figure_eight", "auto", quantity, errors)
        for quantity, errors in (
            (_FRONT, (-6.5, -2.0, NONE, 0.0, 0.1, 0.0)),
            (_REAR, (-1.6, -4.1, NONE, 0.1, 0.1, 0.25)),
            (_BOTH, (-4.9, 1.5, NONE, -0.1, 0.0, -0.25)),
        )
    ),
)  # fmt: skip
"""Their single runs; mm and mrad."""


def root_sum_square(errors: Sequence[float], axes: slice, like: Sequence[float]) -> float:
    """Root sum square over those of the axes in which `like` has a number; NaN if it has none."""
    values = np.array(errors)[axes][np.isfinite(np.array(like)[axes])]
    return float(np.sqrt((values**2).sum())) if len(values) else NONE


def other_systems(lines_of: Callable[[str, str], Sequence[Line]], seeds: int = 20) -> str:
    """Other systems and ours, mean over the seeds; empty if there is no run yet.

    The z of all systems that use the ground includes the drive's error of the vehicle's height. The
    result of the ground alone on our drives is printed too.
    """
    rows = []
    for other in OTHERS:
        ours = _runs(lines_of(other.scenario, other.row), other.quantity, seeds)
        if not ours:
            continue
        cells = ""
        for axes, digits in ((slice(0, 3), 1), (slice(3, 6), 2)):
            theirs = root_sum_square(other.errors, axes, other.errors)
            mean, verdict = _mean_of_ours(ours, axes, other.errors), ""
            if math.isfinite(theirs):
                verdict = ("hit" if mean <= theirs else "MISS") if other.target else "no target"
                verdict = "undetermined" if math.isnan(mean) else verdict
            cells += f"{_number(theirs, digits):>9}{_number(mean, digits + 1):>8} {verdict:13}"
        rows.append(_other(other.name, other, len(ours), cells))
        alone = _runs(lines_of(other.scenario, "ground"), other.quantity, seeds)
        if other.row == "auto_parallel" and alone:
            cells = ""
            for axes, digits in ((slice(0, 3), 1), (slice(3, 6), 2)):
                theirs = _mean_of_ours(alone, axes, other.errors)
                mean = _mean_of_ours(ours, axes, other.errors)
                cells += f"{_number(theirs, digits):>9}{_number(mean, digits + 1):>8} {'':13}"
            rows.append(_other("  the same axes, our drives", other, len(alone), cells))
    if not rows:
        return ""
    heading = (
        f"  {'':34}{'drive':14}{'of':20}{'ours: row':15}{'n':>4}"
        f"{'mm':>9}{'ours':>8} {'':13}{'mrad':>9}{'ours':>8}"
    )
    return "\n".join(
        [
            "",
            "Other systems (one run each) and ours (mean over seeds): root sum square over",
            "the axes that theirs estimates, translations in mm and rotations in mrad",
            heading,
            *rows,
        ]
    )


def _runs(lines: Sequence[Line], quantity: str, seeds: int) -> list[Errors]:
    return [
        line.quantities[quantity]
        for line in lines
        if line.seed <= seeds and quantity in line.quantities
    ]


def _mean_of_ours(runs: Sequence[Errors], axes: slice, like: Sequence[float]) -> float:
    """Mean root sum square, mm and mrad; NaN if an axis was undetermined or none is compared."""
    usable = np.isfinite(np.array(like)[axes])
    determined = np.array([run.determined for run in runs], bool)[:, _ORDER][:, axes]
    if not usable.any() or not determined[:, usable].all():
        return NONE
    return float(
        np.mean([root_sum_square([1e3 * run.error[i] for i in _ORDER], axes, like) for run in runs])
    )


def _other(name: str, other: OtherSystem, n: int, cells: str) -> str:
    line = f"  {name:34}{other.scenario:14}{other.quantity:20}{other.row:15}{n:4}{cells}"
    return line.rstrip()


# ------------------------------------------------------------------ text


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def axis_cells(values: Array | Sequence[float], marks: Sequence[str] = ("",) * 6) -> str:
    """Values per axis in the columns of `HEADING`, each with a mark behind it."""
    out = ""
    for i, (value, mark) in enumerate(zip(np.asarray(values).tolist(), marks, strict=True)):
        # Millimetres to hundredths, milliradians to thousandths.
        out += f"{_number(value, 2 if i < 3 else 3) + mark:>13}"
    return out


HEADING = "".join(f"{axis + (' mm' if axis in 'xyz' else ' mrad'):>13}" for axis in SHOWN)


def row_table(
    scenario: str,
    text: str,
    lines: Sequence[Line],
    predicted: Mapping[str, Sequence[float]] | None = None,
    *,
    judged: bool = False,
) -> str:
    """All statistics of one row of one scenario.

    Args:
        scenario: its name.
        text: what the row is.
        lines: its runs.
        predicted: the planner's sigmas per quantity, `AXES`, rad and m.
        judged: whether `limits` apply to it.
    """
    done = [line for line in lines if not line.failure]
    out = [f"\n{scenario} · {text}: n = {len(done)} of {len(lines)}"]
    if done:
        statuses = Counter(line.status for line in done if line.status)
        seconds = np.array([line.seconds.get("total", NONE) for line in done])
        counted = ", ".join(f"{status} {n}" for status, n in statuses.most_common())
        verdict = _verdict(float(np.mean(seconds)) <= SECONDS_LIMIT) if judged else ""
        out[0] += (
            f"{', ' + counted if counted else ''}; {np.mean(seconds):.1f} s of CPU each, "
            f"{np.max(seconds):.1f} s at most{verdict}"
        )
    out += [f"  seed {line.seed}: {line.failure}" for line in lines if line.failure]
    named: dict[str, list[str]] = {}
    for direction in (d for line in done for d in dict.fromkeys(line.undetermined)):
        # Numbers in the names vary from run to run: 9.14 or 9.17 m per rad.
        named.setdefault(re.sub(r"\d+(\.\d+)?", "#", direction), []).append(direction)
    out += [f"  undetermined in {len(alike)}: {alike[0]}" for alike in named.values()]
    for name, s in by_quantity(done).items():
        out += _quantity(scenario, name, s, (predicted or {}).get(name), judged)
    for kind in ("S2V", "S2S"):
        of_kind = [
            e.nees for x in done for q, e in x.quantities.items() if q[:3] == kind and e.nees
        ]
        if of_kind and done:
            mean = float(np.mean(of_kind))
            out.append(
                f"  NEES of {kind}, all: {mean:.2f}"
                + (_verdict(nees_is_right(mean, len(done))) if judged else "")
            )
    return "\n".join(out)


def _verdict(kept: bool) -> str:
    return " hit" if kept else " MISS"


def _quantity(
    scenario: str,
    name: str,
    s: Statistics,
    predicted: Sequence[float] | None,
    judged: bool,
) -> Iterator[str]:
    yield f"  {name + f', n = {s.runs}':26}{HEADING}"
    yield f"    {'mean absolute error':22}{axis_cells(s.mean_abs)}"
    if np.isfinite(s.held).any():
        counts = [f"{round(s.runs - n)}x" if n < s.runs else "" for n in s.determined]
        yield f"    {'  not determined':22}" + "".join(f"{c:>13}" for c in counts)
        brackets = [f"({_number(v, 2)})" if math.isfinite(v) else "" for v in s.held]
        yield f"    {'  of the guess there':22}" + "".join(f"{c:>13}" for c in brackets)
    limit = limits(scenario, name) if judged else None
    if limit is not None:
        # An axis held at the guess has a limit too: the guess's own error.
        values = np.where(np.isfinite(s.mean_abs), s.mean_abs, s.held)
        marks = [
            "" if math.isnan(m) else _verdict(v <= m) for v, m in zip(values, limit, strict=True)
        ]
        yield f"    {'  limit':22}{axis_cells(limit, marks)}"
    yield f"    {'RMSE':22}{axis_cells(s.rmse)}"
    yield f"    {'largest':22}{axis_cells(s.largest)}"
    if np.isfinite(s.sigma).any():
        yield f"    {'sigma, rms':22}{axis_cells(s.sigma)}"
        marks = [
            "" if not judged or math.isnan(v) else _verdict(v <= m)
            for v, m in zip(s.ratio, s.ratio_limits(), strict=True)
        ]
        yield f"    {'RMSE / sigma':22}{axis_cells(s.ratio, marks)}"
    if predicted is not None:
        planned = np.array(predicted)[_ORDER] * 1e3
        planned = np.where(s.determined > 0, planned, NONE)
        yield f"    {'sigma as planned':22}{axis_cells(planned)}"
        yield f"    {'RMSE / planned':22}{axis_cells(s.rmse / planned)}"
    if s.nees_runs:
        low, high = nees_interval(s.nees_runs)
        yield (
            f"    NEES {s.nees:.2f}, n = {s.nees_runs}, 95% of right ones "
            f"{low:.2f} to {high:.2f}"
            + (_verdict(nees_is_right(s.nees, s.nees_runs)) if judged else "")
        )


def comparison(scenario: str, rows: Mapping[str, tuple[str, Sequence[Line]]]) -> str:
    """Mean absolute errors of all rows of a scenario, quantity by quantity; and those of the paper.

    Args:
        scenario: its name.
        rows: text and runs by name.
    """
    found = {name: by_quantity(lines) for name, (_, lines) in rows.items()}
    quantities = list(dict.fromkeys(q for of_row in found.values() for q in of_row))
    out = [f"\n{scenario}: mean absolute error by row; (in brackets: held at the guess)"]
    for quantity in quantities:
        out.append(f"  {quantity:44}{HEADING}")
        if scenario == "paper_arc":
            for name, figures in PUBLISHED.items():
                if quantity in figures:
                    out.append(f"    {name + ', n = 100':42}{axis_cells(figures[quantity])}")
        for name, of_row in found.items():
            if quantity not in of_row:
                continue
            s = of_row[quantity]
            cells = ""
            for i, count in enumerate(s.determined):
                digits = 2 if i < 3 else 3
                text = f"({_number(s.held[i], digits)})"
                if count:
                    of = "" if count == s.runs else f" of {count:.0f}"
                    text = _number(s.mean_abs[i], digits) + of
                cells += f"{text:>13}"
            out.append(f"    {rows[name][0] + f', n = {s.runs}':42}{cells}")
    return "\n".join(out)
