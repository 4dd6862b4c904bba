"""From a solution to the reported result, with a LiDAR that the config fixes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caliv_graph.calibration.assemble import assemble
from caliv_graph.config.guesses import (
    TRUSTED_SIGMAS,
    configured_guess,
    prior_sigmas,
    with_found_guess,
)
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.products import Array
from caliv_graph.uncertainty.observability import UNIT
from caliv_graph.uncertainty.pairs import pair_determined, sigmas_s2v
from tests.samples import MOUNTINGS, make_solution, pose


def test_a_lidar_without_a_guess_is_as_well_known_as_its_pair_with_a_fixed_one() -> None:
    """Clouds tell the pair to 1 mrad and 10 mm; its sigmas were pi rad and 10 m."""
    poses = {name: pose(*MOUNTINGS[name]) for name in ("front", "rear")}
    lidars = {
        name: LidarConfig(
            topic=name, initial=PoseConfig(xyz=xyz, rpy_deg=rpy_deg), fixed=name == "front"
        )
        for name, (xyz, rpy_deg) in MOUNTINGS.items()
        if name in poses
    }
    config = with_found_guess(Config(lidars=lidars, reference="rear"), "rear", poses["rear"])
    between = np.kron([[1.0, -1.0], [-1.0, 1.0]], np.diag(UNIT**-2.0))
    trust = np.kron(np.diag([1.0, 0.0]), np.diag(TRUSTED_SIGMAS**-2.0))
    priors = [prior_sigmas(configured_guess(config, name)) for name in poses]
    known: Array = np.asarray(between + trust, dtype=np.float64)
    solution = make_solution()
    registration = solution.registrations[0]
    front = registration.observation.clouds[0]
    clouds = (front, replace(front, lidar="rear"))
    observation = replace(registration.observation, clouds=clouds)
    solution = replace(
        solution,
        registrations=(replace(registration, observation=observation),),
        cloud_weights=(np.ones(2),),
        T_vehicle_lidar=poses,
        information_data=known,
        information_prior=np.diag(np.concatenate(priors) ** -2.0),
        cov=np.asarray(np.linalg.inv(known), dtype=np.float64),
    )

    result = assemble(solution, config, ())

    np.testing.assert_allclose(sigmas_s2v(result, "rear"), UNIT, rtol=1e-3)
    assert all(result.lidars["rear"].determined.values())
    assert all(pair_determined(result, "front", "rear").values())
    # The reported data do not have the trust.
    rows = slice(0, 6)
    np.testing.assert_allclose(
        np.linalg.eigvalsh(result.information_data[rows, rows]).max(), UNIT[0] ** -2.0, rtol=1e-6
    )
