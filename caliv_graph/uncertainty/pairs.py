"""Sigmas of LiDARs and of pairs of LiDARs, and which axes of a pair are determined."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np

from caliv_graph.conventions import AXES
from caliv_graph.geometry.covariance import (
    parent_axes_covariance,
    relative_covariance,
    relative_jacobian,
)
from caliv_graph.geometry.se3 import right_to_vehicle_axes
from caliv_graph.products import Array, Calibration
from caliv_graph.uncertainty.assemble import second_order
from caliv_graph.uncertainty.observability import (
    AXIS_SHARE,
    LIDAR_SHARE,
    UNDETERMINED_RATIO,
    UNIT,
    scaling,
    undetermined_basis,
)


def sensor_pairs(lidars: Iterable[str], reference: str) -> tuple[tuple[str, str], ...]:
    """Every pair of LiDARs once, as (from, to).

    `to` is the reference if it belongs to the pair (the paper's L2), else the later of the two.
    """
    return tuple(
        (second, first) if first == reference else (first, second)
        for first, second in itertools.combinations(lidars, 2)
    )


def pair_covariance(calibration: Calibration, source: str, to: str) -> Array:
    """Covariance of `T_to_from`, (6, 6), right perturbation (frame of `from`), priors included."""
    a, b = (calibration.lidars[name].T_vehicle_lidar for name in (source, to))
    rows = _rows(calibration, source, to)
    return relative_covariance(a, b, calibration.cov_joint[np.ix_(rows, rows)])


def sigmas_s2v(calibration: Calibration, name: str) -> Array:
    """(6,) sigmas of a LiDAR's extrinsic in vehicle axes, rad and m."""
    lidar = calibration.lidars[name]
    return np.sqrt(np.diag(parent_axes_covariance(lidar.T_vehicle_lidar, lidar.cov)))


def sigmas_s2s(calibration: Calibration, source: str, to: str) -> Array:
    """(6,) sigmas of `source` against `to` in vehicle axes, rad and m."""
    cov = pair_covariance(calibration, source, to)
    T_vehicle_source = calibration.lidars[source].T_vehicle_lidar
    return np.sqrt(np.diag(parent_axes_covariance(T_vehicle_source, cov)))


def pair_determined(calibration: Calibration, source: str, to: str) -> dict[str, bool]:
    """Which axes of `T_to_from` the data determine, by the rule of `observability.assess`.

    The undetermined subspace is mapped to the pair. Per axis of `conventions.AXES`: rotation about,
    shift along the axes of `to`.
    """
    results = [calibration.lidars[name] for name in (source, to)]
    if not all(result.placed for result in results):
        return dict.fromkeys(AXES, False)
    known = _known_of_found(calibration, source, to)
    if not calibration.undetermined:
        return known
    names = list(calibration.lidars)
    basis = undetermined_basis(calibration.undetermined, names)
    T_from, T_to = (result.T_vehicle_lidar for result in results)
    J = relative_jacobian(T_from, T_to)
    J[:, :6] @= right_to_vehicle_axes(T_from).T
    J[:, 6:] @= right_to_vehicle_axes(T_to).T
    J = right_to_vehicle_axes(T_to.between(T_from)) @ J
    rows = _rows(calibration, source, to)
    seen = (J * scaling(2) / UNIT[:, None]) @ basis[rows]
    shares = np.sum(seen**2, axis=1)
    total = float(shares.sum())
    return {
        axis: known[axis] and bool(total <= LIDAR_SHARE or share <= AXIS_SHARE * total)
        for axis, share in zip(AXES, shares, strict=True)
    }


def _known_of_found(calibration: Calibration, source: str, to: str) -> dict[str, bool]:
    """Per axis of `T_to_from`, whether its sigma is below what counts as determined.

    Asked only where one of the two has no guess, as `assemble.determined_axes` asks of one LiDAR:
    along undetermined directions the covariance is then that of nothing known, and other axes take
    part in it.
    """
    guesses = [calibration.lidars[name].guess for name in (source, to)]
    found = [guess.sigmas for guess in guesses if guess is not None and guess.found]
    if not found:
        return dict.fromkeys(AXES, True)
    T_vehicle_from, T_vehicle_to = (calibration.lidars[n].T_vehicle_lidar for n in (source, to))
    cov = parent_axes_covariance(
        T_vehicle_to.between(T_vehicle_from), pair_covariance(calibration, source, to)
    )
    sigmas = np.sqrt(np.diag(cov) + second_order(cov))
    # Two found guesses are off independently. Each is as sure in all directions.
    limits = UNDETERMINED_RATIO * np.sqrt(np.sum(np.square(found), axis=0))
    return {axis: bool(yes) for axis, yes in zip(AXES, sigmas <= limits, strict=True)}


def _rows(calibration: Calibration, *lidars: str) -> list[int]:
    """Rows of the joint matrices that belong to these LiDARs, in the order of the arguments."""
    names = list(calibration.lidars)
    return [6 * names.index(lidar) + axis for lidar in lidars for axis in range(6)]
