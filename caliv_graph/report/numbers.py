"""Numbers and poses as text, in tables on a terminal and on pages. Degrees exist here only."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from caliv_graph.conventions import AXES
from caliv_graph.geometry.covariance import parent_axes_covariance
from caliv_graph.products import Array, Calibration, LidarResult
from caliv_graph.uncertainty.pairs import pair_covariance, pair_determined, sensor_pairs

SHOWN_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""Order of the axes in tables."""

_MOST_DECIMALS = 6


NO_VALUE = "?"
"""The value of what neither the drive nor an initial guess tells."""


@dataclass(frozen=True)
class Cell:
    """One axis of a pose in a table.

    Attributes:
        value: the value to two digits of its sigma; if not determined, that of the initial guess
            to one digit and in brackets, or `NO_VALUE` where there was no guess.
        sigma: the sigma with the same decimals; empty if not determined.
        determined: whether the drive determined the axis.
    """

    value: str
    sigma: str
    determined: bool


@dataclass(frozen=True)
class PairCells:
    """The extrinsic `T_to_from` of a pair, a cell per axis of `SHOWN_AXES`, in the axes of `to`."""

    source: str
    to: str
    cells: list[Cell]


def pose_and_sigmas(T_parent_child: gtsam.Pose3, cov: Array) -> tuple[Array, Array]:
    """(6,) roll, pitch, yaw, x, y, z of a pose and (6,) sigmas in the parent's axes; rad and m.

    `cov` is (6, 6), right perturbation, rad and m.
    """
    sigmas = np.sqrt(np.diag(parent_axes_covariance(T_parent_child, cov)))
    values = np.concatenate([T_parent_child.rotation().rpy(), T_parent_child.translation()])
    return values, sigmas


def pose_cells(
    T_parent_child: gtsam.Pose3, cov: Array, determined: Mapping[str, bool], guessed: bool = True
) -> list[Cell]:
    """A pose as a cell per axis of `SHOWN_AXES`, in metres and degrees.

    `cov` is (6, 6), right perturbation, rad and m. `guessed`: whether an initial guess has a value
    for what is not determined.
    """
    values, sigmas = pose_and_sigmas(T_parent_child, cov)
    values[:3], sigmas[:3] = np.degrees(values[:3]), np.degrees(sigmas[:3])
    cells = []
    for axis in SHOWN_AXES:
        value, sigma = float(values[AXES.index(axis)]), float(sigmas[AXES.index(axis)])
        if determined[axis]:
            decimals = decimals_of(sigma, 2)
            cells.append(Cell(fixed(value, decimals), f"{sigma:.{decimals}f}", True))
        else:
            held = f"({fixed(value, decimals_of(sigma, 1))})"
            cells.append(Cell(held if guessed else NO_VALUE, "", False))
    return cells


def pair_cells(calibration: Calibration) -> list[PairCells]:
    """The extrinsic of every pair of LiDARs, each pair once."""
    out = []
    for source, to in sensor_pairs(calibration.lidars, calibration.reference):
        T_vehicle_from = calibration.lidars[source].T_vehicle_lidar
        T_to_from = calibration.lidars[to].T_vehicle_lidar.between(T_vehicle_from)
        cov = pair_covariance(calibration, source, to)
        guessed = not any(calibration.lidars[name].without_guess for name in (source, to))
        cells = pose_cells(T_to_from, cov, pair_determined(calibration, source, to), guessed)
        out.append(PairCells(source, to, cells))
    return out


def scans_text(result: LidarResult) -> str:
    """Scans of a target that were used, or what the extrinsic rests on without them."""
    if result.saw_target:
        return str(result.scans_used)
    return "structure" if result.saw_structure else "none"


def value_and_sigma(value: float, sigma: float) -> str:
    """A value to two digits of its sigma, and the sigma below it."""
    decimals = decimals_of(sigma, 2)
    return f"{fixed(value, decimals)}\n±{sigma:.{decimals}f}"


def decimals_of(sigma: float, digits: int) -> int:
    """Decimals that show this many digits of a sigma."""
    if not sigma > 0.0:
        return 3
    return min(max(digits - 1 - math.floor(math.log10(sigma)), 0), _MOST_DECIMALS)


def fixed(value: float, decimals: int) -> str:
    """A number with a fixed number of decimals, without a minus sign before zeros."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def two_digits(value: Any) -> str:
    """A number to two significant digits, with an exponent only if it is very small."""
    value = float(value)
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.2g}"


def rounded(value: Any, digits: int = 6) -> float:
    """A number rounded to significant digits."""
    return float(f"{float(value):.{digits}g}")
