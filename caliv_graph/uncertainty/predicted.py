"""Covariance that a calibration will have, from the information of the data alone."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.config.guesses import prior_sigmas
from caliv_graph.products import Array, Calibration, Direction, Guess, Uncertainty
from caliv_graph.uncertainty.assemble import assemble_matrices
from caliv_graph.uncertainty.observability import (
    assess,
    covariance_with_prior_in_null_space,
    spectrum,
)
from caliv_graph.uncertainty.pairs import pair_determined, sensor_pairs, sigmas_s2s, sigmas_s2v


@dataclass(frozen=True)
class PredictedCovariance:
    """What to expect of a calibration.

    Matrices are in *vehicle axes*, LiDARs in the order of `lidars`, six coordinates each, rotation
    before translation, rad and m.

    Attributes:
        lidars: those that take part.
        information_data: (6n, 6n) without any prior, all other variables eliminated.
        information_prior: (6n, 6n) of the initial guesses, or of what stands for them in the
            solve where there is none.
        cov: (6n, 6n) of the solve in `solve.mode: auto`. `calibration` has that of the result, in
            which a LiDAR without an initial guess is unknown where the data determine nothing.
        uncertainty: directions and verdicts.
        offsets_s: LiDAR -> 1 sigma of its time offset in seconds, where one was asked for.
        calibration: the same as a result whose extrinsics are the assumed ones, LiDARs that never
            see a target with their guesses.
    """

    lidars: tuple[str, ...]
    information_data: Array
    information_prior: Array
    cov: Array
    uncertainty: Uncertainty
    offsets_s: Mapping[str, float]
    calibration: Calibration

    @property
    def unseeing(self) -> tuple[str, ...]:
        """LiDARs that never see a target."""
        return tuple(name for name in self.calibration.lidars if name not in self.lidars)

    @property
    def sigma_s2v(self) -> dict[str, Array]:
        """LiDAR -> (6,) 1 sigma of its extrinsic, vehicle axes."""
        return {name: sigmas_s2v(self.calibration, name) for name in self.calibration.lidars}

    @property
    def sigma_s2s(self) -> dict[tuple[str, str], Array]:
        """(from, to) -> (6,) 1 sigma, vehicle axes at the origin of `from`."""
        return {(a, b): sigmas_s2s(self.calibration, a, b) for a, b in self._pairs}

    @property
    def determined_s2s(self) -> dict[tuple[str, str], dict[str, bool]]:
        """(from, to) -> axis -> whether the data determine it, in the axes of `to`."""
        return {(a, b): pair_determined(self.calibration, a, b) for a, b in self._pairs}

    @property
    def undetermined(self) -> tuple[Direction, ...]:
        """Directions that the data will not determine."""
        return self.uncertainty.undetermined

    @property
    def weak(self) -> tuple[Direction, ...]:
        """Directions that the data determine only weakly."""
        return self.uncertainty.weak

    @property
    def _pairs(self) -> tuple[tuple[str, str], ...]:
        return sensor_pairs(self.lidars, self.calibration.reference)


def predict_covariance(
    information_data: Array,
    lidars: Sequence[str],
    reference: str,
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
    guesses: Mapping[str, Guess],
    scans: Mapping[str, int],
    offsets_s: Mapping[str, float],
    structure: Collection[str] = (),
) -> PredictedCovariance:
    """Verdicts and sigmas from the data's information.

    Directions come without text; `wording.directions.named_prediction` adds it.

    Args:
        information_data: (6n, 6n) vehicle axes, LiDARs in the order of `lidars`.
        lidars: those that take part.
        reference: the LiDAR that pairs are taken against.
        T_vehicle_lidar: approximate extrinsic of each of them.
        guesses: of every LiDAR, in the order of the result.
        scans: LiDAR -> number of clouds of a target; absent: none.
        offsets_s: LiDAR -> 1 sigma of its time offset.
        structure: names of the LiDARs that see structure.
    """
    solved = {name: T_vehicle_lidar[name] for name in lidars}
    prior = np.diag(np.concatenate([prior_sigmas(guesses[name]) for name in lidars]) ** -2.0)
    uncertainty = assess(information_data, prior, solved)
    cov = covariance_with_prior_in_null_space(prior, spectrum(information_data, prior))
    return PredictedCovariance(
        lidars=tuple(lidars),
        information_data=information_data,
        information_prior=prior,
        cov=cov,
        uncertainty=uncertainty,
        offsets_s=dict(offsets_s),
        calibration=assemble_matrices(
            solved,
            guesses,
            cov,
            information_data,
            uncertainty,
            reference,
            scans,
            structure=structure,
        ),
    )
