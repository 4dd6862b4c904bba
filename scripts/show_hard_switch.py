"""What the hard switch of `solve.mode: auto` does to error and claimed sigma, by simulation.

    .venv/bin/python scripts/show_hard_switch.py
    .venv/bin/python scripts/show_hard_switch.py --result result/calibration.yaml

Two LiDARs of the paper's vehicle. The data determine every direction to a tenth of a scaled unit
(0.1 mrad, 1 mm), but for the rotation of both about the turn centre, 9.16 m to the right, along
which the sigma of the data is a given multiple of that of the guesses. Errors of data and guesses
are drawn; `step_with_prior_in_null_space` and the Bayesian combination, in which guesses count as
one more measurement, give estimates. `caliv_graph/uncertainty/README.md` quotes the tables.

With --result: how far a calibration is from the thresholds. Ratios of sigmas along the scaled
eigenvectors, which `spectrum` takes, and of the generalized eigenproblem of data and guesses;
diagonal of the projector on the undetermined subspace; estimate and sigmas with other scaled units.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import scipy.linalg
from scipy.special import ndtr

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # for the modules beside this script, run from anywhere

from caliv_graph.config.lidars import PoseSigmaConfig
from caliv_graph.conventions import AXES
from caliv_graph.fusion.terms import fuse, guess_of, own_term
from caliv_graph.geometry.se3 import skew, vehicle_axes_difference
from caliv_graph.products import Array, Calibration
from caliv_graph.results.calibration_file import read_calibration
from caliv_graph.uncertainty.observability import (
    UNDETERMINED_RATIO,
    UNIT,
    WEAK_RATIO,
    covariance_with_prior_in_null_space,
    scaling,
    spectrum,
    step_with_prior_in_null_space,
)
from scripts._command import exit_code_of, positive

LIDARS_XYZ_M = ((2.0, 0.0, 2.0), (-0.4, 0.0, 2.0))
RADIUS_M = 9.16
ELSEWHERE = 0.1
"""Sigma of the data along all other directions, scaled units."""

RATIOS = (0.1, 0.25, 0.4, 0.49, 0.51, 0.75, 1.0, 2.0, 5.0)
WRONG_GUESS = 3.0
"""Sigma of the guesses' errors over the stated one, in the second table."""

THRESHOLDS = (0.25, 0.5, 1.0)
LIMITS = (2.5, 3.0, 4.0, 5.0, 6.0, 10.0)
TESTS = 25
"""Of a drive with two LiDARs: 12 axes against guesses, 6 score tests, 2 counts of outliers, the
scale of the registrations, a height and two tilts, a heading."""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--draws", type=positive, default=4000, help="per row (default: 4000)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--result", type=Path, nargs="+", metavar="CALIBRATION.yaml")
    asked = parser.parse_args(arguments)
    tables = (
        (margins(path) for path in asked.result)
        if asked.result
        else (*switch_tables(asked.draws, asked.seed), threshold_table(), limit_table())
    )
    return exit_code_of(partial(_shown, tables))


def _shown(tables: Iterator[str] | Sequence[str]) -> int:
    for table in tables:
        print(table, end="\n\n")
    return 0


def turn_centre_direction() -> Array:
    """(12,) rotation of both LiDARs about the turn centre, scaled, of length 1."""
    parts = []
    for xyz in LIDARS_XYZ_M:
        arm = np.array(xyz) - np.array([0.0, -RADIUS_M, 0.0])
        parts += [np.array([0.0, 0.0, 1.0]), skew(np.array([0.0, 0.0, 1.0])) @ arm]
    v = np.concatenate(parts) / scaling(len(LIDARS_XYZ_M))
    return np.asarray(v / np.linalg.norm(v))


def switch_tables(draws: int, seed: int) -> tuple[str, str]:
    """Error and claimed sigma along the direction, in sigmas of the guesses, by the ratio.

    Returns:
        For guesses as good as their sigmas say, and for guesses that are `WRONG_GUESS` times worse.
    """
    rng = np.random.default_rng(seed)
    head = "| `auto` RMSE | claimed | NEES / 12 | Bayes RMSE | claimed | NEES / 12 |"
    tables = []
    for guess_error in (1.0, WRONG_GUESS):
        lines = [f"| data / guess sigma | undetermined {head}", "|---|---|---|---|---|---|---|---|"]
        for ratio in RATIOS:
            lost, found = _errors(ratio, guess_error, draws, rng)
            cells = [f"{ratio:g}", "yes" if lost else "no"]
            for rmse, claimed, nees in found:
                cells += [f"{rmse:.2f}", f"{claimed:.2f}", f"{nees:.2f}"]
            lines.append(f"| {' | '.join(cells)} |")
        tables.append("\n".join(lines))
    return tables[0], tables[1]


def _errors(
    ratio: float, guess_error: float, draws: int, rng: np.random.Generator
) -> tuple[bool, list[tuple[float, float, float]]]:
    """Whether the direction is undetermined; RMSE, claimed sigma, NEES / 12 of both estimators."""
    unit = scaling(len(LIDARS_XYZ_M))
    v = turn_centre_direction()
    sigmas = np.tile(PoseSigmaConfig().sigmas(), len(LIDARS_XYZ_M))
    prior = np.diag(sigmas**-2.0)
    sigma_prior = float(v @ (prior * np.outer(unit, unit)) @ v) ** -0.5
    scaled = (np.eye(12) - np.outer(v, v)) / ELSEWHERE**2 + np.outer(v, v) / (
        ratio * sigma_prior
    ) ** 2
    D = scaled / np.outer(unit, unit)
    root = np.linalg.cholesky(scaled) / unit[:, None]
    split = spectrum(D, prior)
    # From the truth: the data pull by c ~ N(0, D), the guesses are off by their errors.
    pulls = rng.normal(size=(draws, 12)) @ root.T
    offsets = guess_error * sigmas * rng.normal(size=(draws, 12))
    auto = np.array(
        [
            step_with_prior_in_null_space(D, c, prior, offset, split)
            for c, offset in zip(pulls, offsets, strict=True)
        ]
    )
    bayes = np.linalg.solve(D + prior, (pulls - offsets @ prior).T).T
    out = []
    for errors, cov in (
        (auto, covariance_with_prior_in_null_space(prior, split)),
        (bayes, np.asarray(np.linalg.inv(D + prior))),
    ):
        along = (errors / unit) @ v / sigma_prior
        claimed = math.sqrt(v @ (cov / np.outer(unit, unit)) @ v) / sigma_prior
        white = np.linalg.solve(np.linalg.cholesky(cov), errors.T)
        nees = float((white**2).sum(axis=0).mean() / 12.0)
        out.append((float(np.sqrt(np.mean(along**2))), claimed, nees))
    return bool(split.undetermined.any()), out


def threshold_table() -> str:
    """RMSE of the switch over that of the Bayesian combination, beside each threshold."""
    lines = [
        "| threshold | RMSE over Bayes just below | just above | claimed sigma grows by |",
        "|---|---|---|---|",
    ]
    for r in THRESHOLDS:
        below, above = math.hypot(1.0, r), math.hypot(1.0, 1.0 / r)
        lines.append(f"| {r:g} | {below:.2f} | {above:.2f} | {1.0 / r:g} |")
    return "\n".join(lines)


def limit_table() -> str:
    """Probability of a false alarm, per test and of a drive, by the limit in sigmas."""
    lines = [f"| limit (sigma) | per test | {TESTS} tests, one drive in |", "|---|---|---|"]
    for limit in LIMITS:
        p = 2.0 * float(ndtr(-limit))
        of_drive = -math.expm1(TESTS * math.log1p(-p))
        lines.append(f"| {limit:g} | {p:.1e} | {1.0 / of_drive:,.3g} |")
    return "\n".join(lines)


def margins(path: Path) -> str:
    """How far a calibration is from the thresholds of directions and of axes."""
    calibration = read_calibration(path)
    names = list(calibration.lidars)
    D = own_term(calibration, str(path)).information
    sigmas = np.concatenate([guess_of(calibration, name).sigmas for name in names])
    prior = np.diag(sigmas**-2.0)
    split = spectrum(D, prior)
    used = np.sort(split.sigma_data / split.sigma_prior)[::-1]
    values = scipy.linalg.eigh(D, prior, eigvals_only=True)
    with np.errstate(divide="ignore"):
        generalized = np.sort(np.maximum(values, 0.0) ** -0.5)[::-1]
    rows = [
        (
            name,
            " ".join(f"{ratio:.3g}" for ratio in ratios[:5]),
            int((ratios > UNDETERMINED_RATIO).sum()),
            int(((ratios > WEAK_RATIO) & (ratios <= UNDETERMINED_RATIO)).sum()),
        )
        for name, ratios in (("scaled eigenvectors", used), ("generalized", generalized))
    ]
    lines = [
        f"{path}",
        "| | largest data / guess sigmas | undetermined | weak |",
        "|---|---|---|---|",
        *(f"| {a} | {b} | {c} | {d} |" for a, b, c, d in rows),
    ]
    if split.undetermined.any():
        diagonal = np.sum(split.vectors[:, split.undetermined] ** 2, axis=1).reshape(-1, 6)
        lines += ["", f"| LiDAR | sum of P_ii | P_ii / sum: {' | '.join(AXES)} |", "|---" * 8 + "|"]
        for name, part in zip(names, diagonal, strict=True):
            cells = " | ".join(f"{x:.3f}" for x in part / part.sum())
            lines.append(f"| {name} | {part.sum():.3f} | {cells} |")
    return "\n".join([*lines, "", *_other_units(calibration, path)])


def _other_units(calibration: Calibration, path: Path) -> Iterator[str]:
    """What becomes of estimate and sigmas if a scaled unit is 5 or 20 mm instead of 10."""
    term = own_term(calibration, str(path))
    guesses = {name: guess_of(calibration, name) for name in calibration.lidars}
    usual = fuse([term], guesses)
    sigma = np.sqrt(np.diag(usual.cov))
    yield "| a unit of | undetermined | estimate moves by at most | sigmas change by at most |"
    yield "|---|---|---|---|"
    for factor in (0.5, 2.0):
        UNIT[3:] *= factor
        try:
            other = fuse([term], guesses)
            lost = int(spectrum(term.information, usual.prior).undetermined.sum())
        finally:
            UNIT[3:] /= factor
        moved = np.concatenate(
            [
                vehicle_axes_difference(T, usual.T_vehicle_lidar[name])
                for name, T in other.T_vehicle_lidar.items()
            ]
        )
        change = np.abs(np.sqrt(np.diag(other.cov)) / sigma - 1.0).max()
        yield (
            f"| {10.0 * factor:g} mm | {lost} | {np.abs(moved / sigma).max():.3f} sigma | "
            f"{change:.1%} |"
        )


if __name__ == "__main__":
    sys.exit(main())
