"""Covariance that a calibration will have, from the information of the data alone.

Shared by `observability`, which looks at a recorded drive before it is calibrated, and by `plan`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import block_diag

from caliv_graph.conventions import AXES
from caliv_graph.geometry.se3 import right_to_vehicle_axes, skew
from caliv_graph.products import Array, Calibration, Direction, LidarResult, Uncertainty
from caliv_graph.uncertainty.observability import (
    assess,
    covariance_with_prior_in_null_space,
    spectrum,
)
from caliv_graph.uncertainty.pairs import pair_determined, sensor_pairs


@dataclass(frozen=True)
class PredictedCovariance:
    """What to expect of a calibration.

    Matrices are in *vehicle axes*, LiDARs in the order of `lidars`, six coordinates each, rotation
    before translation, rad and m.

    Attributes:
        lidars: those that take part.
        unseeing: those that do not: they never see a target.
        information_data: (6n, 6n) without any prior, all other variables eliminated.
        information_prior: (6n, 6n) of the initial guesses.
        cov: (6n, 6n) of the result of `solve.mode: auto`.
        uncertainty: directions and verdicts.
        sigma_s2v: LiDAR -> (6,) 1 sigma of its extrinsic; that of its guess if it takes no part.
        sigma_s2s: (from, to) -> (6,) 1 sigma of the one relative to the other, in vehicle axes at
            the origin of `from`.
        determined_s2s: (from, to) -> axis -> whether the data determine it, in the axes of `to`.
        offsets_s: LiDAR -> 1 sigma of its time offset in seconds, where one was asked for.
        calibration: the same as a result whose extrinsics are the assumed ones, to judge
            `require` and `limits` by.
    """

    lidars: tuple[str, ...]
    unseeing: tuple[str, ...]
    information_data: Array
    information_prior: Array
    cov: Array
    uncertainty: Uncertainty
    sigma_s2v: Mapping[str, Array]
    sigma_s2s: Mapping[tuple[str, str], Array]
    determined_s2s: Mapping[tuple[str, str], Mapping[str, bool]]
    offsets_s: Mapping[str, float]
    calibration: Calibration

    @property
    def undetermined(self) -> tuple[Direction, ...]:
        """Directions that the data will not determine."""
        return self.uncertainty.undetermined

    @property
    def weak(self) -> tuple[Direction, ...]:
        """Directions that the data determine only weakly."""
        return self.uncertainty.weak


def predict_covariance(
    information_data: Array,
    lidars: Sequence[str],
    reference: str,
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
    guess_sigmas: Mapping[str, Array],
    scans: Mapping[str, int],
    offsets_s: Mapping[str, float],
) -> PredictedCovariance:
    """Verdicts and sigmas from the data's information.

    Directions come without text; `wording.directions.named_prediction` adds it.

    Args:
        information_data: (6n, 6n) vehicle axes, LiDARs in the order of `lidars`.
        lidars: those that take part.
        reference: the LiDAR that pairs are taken against.
        T_vehicle_lidar: approximate extrinsic of every LiDAR.
        guess_sigmas: LiDAR -> (6,) of its initial guess, vehicle axes.
        scans: LiDAR -> number of clouds of a target; absent: none.
        offsets_s: LiDAR -> 1 sigma of its time offset.
    """
    every = list(T_vehicle_lidar)
    lidars = tuple(lidars)
    prior = np.diag(np.concatenate([guess_sigmas[name] for name in lidars]) ** -2.0)
    uncertainty = assess(information_data, prior, {n: T_vehicle_lidar[n] for n in lidars})
    cov = covariance_with_prior_in_null_space(prior, spectrum(information_data, prior))
    # All of the config's LiDARs, those without data with their guesses.
    rows = [6 * every.index(name) + axis for name in lidars for axis in range(6)]
    cov_every = np.diag(np.concatenate([guess_sigmas[name] for name in every]) ** 2.0)
    information_every = np.zeros_like(cov_every)
    cov_every[np.ix_(rows, rows)] = cov
    information_every[np.ix_(rows, rows)] = information_data
    calibration = _as_calibration(
        uncertainty, reference, T_vehicle_lidar, cov_every, information_every, scans
    )
    pairs = sensor_pairs(lidars, reference)
    sigma = np.sqrt(np.diag(cov_every)).reshape(-1, 6)
    return PredictedCovariance(
        lidars=lidars,
        unseeing=tuple(name for name in every if name not in lidars),
        information_data=information_data,
        information_prior=prior,
        cov=cov,
        uncertainty=uncertainty,
        sigma_s2v=dict(zip(every, sigma, strict=True)),
        sigma_s2s={(a, b): _pair_sigma(cov_every, T_vehicle_lidar, a, b) for a, b in pairs},
        determined_s2s={(a, b): pair_determined(calibration, a, b) for a, b in pairs},
        offsets_s=dict(offsets_s),
        calibration=calibration,
    )


def _as_calibration(
    uncertainty: Uncertainty,
    reference: str,
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
    cov: Array,
    information: Array,
    scans: Mapping[str, int],
) -> Calibration:
    """A result at the assumed extrinsics; matrices (6n, 6n) of all of them, vehicle axes."""
    to_right = block_diag(*(right_to_vehicle_axes(T).T for T in T_vehicle_lidar.values()))
    nothing = dict.fromkeys(AXES, False)
    cov_right = to_right @ cov @ to_right.T
    return Calibration(
        status="partial" if uncertainty.undetermined else "ok",
        reference=reference,
        lidars={
            name: LidarResult(
                T_vehicle_lidar=T,
                cov=cov_right[6 * i : 6 * i + 6, 6 * i : 6 * i + 6],
                determined=dict(uncertainty.determined.get(name, nothing)),
                scans_used=scans.get(name, 0),
                saw_target=scans.get(name, 0) > 0,
            )
            for i, (name, T) in enumerate(T_vehicle_lidar.items())
        },
        cov_joint=cov_right,
        information_data=to_right @ information @ to_right.T,
        undetermined=uncertainty.undetermined,
        weak=uncertainty.weak,
        unmet=(),
        provenance={},
    )


def _pair_sigma(
    cov: Array, T_vehicle_lidar: Mapping[str, gtsam.Pose3], source: str, to: str
) -> Array:
    """(6,) of T_vehicle_source against T_vehicle_to T_to_source, as `evaluate` defines S2S errors.

    Args:
        cov: of all extrinsics, vehicle axes.
        T_vehicle_lidar: the extrinsics, in the same order.
        source: the LiDAR whose error it is.
        to: the LiDAR it is relative to.
    """
    names = list(T_vehicle_lidar)
    J = np.zeros((6, len(cov)))
    at_source, at_to = (6 * names.index(name) for name in (source, to))
    J[:, at_source : at_source + 6] = np.eye(6)
    J[:, at_to : at_to + 6] = -np.eye(6)
    # A rotation w of `to` moves a point fixed to it, at the origin of `source`, by w x arm.
    arm = T_vehicle_lidar[source].translation() - T_vehicle_lidar[to].translation()
    J[3:, at_to : at_to + 3] = skew(arm)
    return np.asarray(np.sqrt(np.diag(J @ cov @ J.T)))
