"""From the solved graph to the reported result: every LiDAR, joint covariance, provenance."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

import caliv_graph
from caliv_graph.calibration.requirements import unmet_requirements
from caliv_graph.calibration.structure import lidars_with_structure
from caliv_graph.calibration.vehicle_parameters import drive_parameters
from caliv_graph.config.guesses import configured_guess
from caliv_graph.config.load import dump_config
from caliv_graph.config.model import Config
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.products import (
    Array,
    Calibration,
    Guess,
    Recording,
    Solution,
    StructureSummary,
    StructureTerm,
    VehicleParameter,
)
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.uncertainty.assemble import assemble_matrices
from caliv_graph.uncertainty.observability import assess, limited_axes
from caliv_graph.wording.directions import named, same_as_parameters
from caliv_graph.wording.remedies import Evidence, with_height_set

DRIVES = "drive_sha256"
"""Key of the provenance: digests of the drives a calibration was made from."""

MARKS = "drive_marks"
"""Key of the provenance: marks of the messages of each drive, in the order of the digests."""

SLOW_ERRORS = "slow_errors"
"""Key of the provenance: correlated errors of the motion data."""

MOTION = "motion"
"""Key of the provenance of drives without motion data: what their poses are by."""


def assemble(
    solution: Solution,
    config: Config,
    recordings: Sequence[Recording],
    digests: Sequence[str] = (),
    trajectories: Sequence[VehicleTrajectory] = (),
    marks: Sequence[Sequence[str]] = (),
) -> Calibration:
    """The reported result: every LiDAR of the config, in its order, in right perturbations.

    `recordings`, their `digests` (`drive_digest`) and `marks` (`drive_marks`) go to the provenance.
    `trajectories` are those of the drives.
    """
    uncertainty = named(
        assess(
            solution.information_data,
            solution.information_prior,
            solution.T_vehicle_lidar,
            solution.held,
        ),
        solution.T_vehicle_lidar,
        evidence_of_terms(solution.structure, bool(solution.registrations)),
    )
    if config.ground.use and config.ground.vehicle_height is not None:
        stands = height_is_used(solution.structure, bool(solution.registrations))
        undetermined, weak = (
            tuple(
                with_height_set(direction, config.ground.sigma, stands) for direction in directions
            )
            for directions in (uncertainty.undetermined, uncertainty.weak)
        )
        uncertainty = replace(uncertainty, undetermined=undetermined, weak=weak)
    uncertainty = same_as_parameters(
        uncertainty, solution.information_data, solution.information_knowing
    )
    guesses = {name: configured_guess(config, name) for name in config.lidar_order()}
    information_data, gradient = _without_trust(solution, guesses)
    draft = assemble_matrices(
        {name: solution.T_vehicle_lidar[name] for name in solution.lidars},
        guesses,
        solution.cov,
        solution.information_data,
        uncertainty,
        solution.reference,
        _scans_used(solution),
        gradient,
        solution.time_offsets,
        lidars_with_structure(solution.structure),
        information_data,
    )
    provenance = _provenance(config, recordings, solution, digests)
    if any(marks):
        provenance[MARKS] = [list(of) for of in marks]
    result = replace(
        draft,
        provenance=provenance,
        vehicle={**_vehicle(solution), **drive_parameters(trajectories)},
        structure=structure_summary(solution.structure, tuple(guesses)),
    )
    return unmet_requirements(result, config)


def height_is_used(terms: Sequence[StructureTerm], target: bool) -> bool:
    """Whether the ground that the vehicle stands on was seen, by strips or, with a target, planes.

    Without motion data it is in the statement of the odometry.
    """
    if any(term.stance is not None or term.odometry_of for term in terms):
        return True
    return target and all(term.on_ground for term in terms)


def evidence_of_terms(terms: Sequence[StructureTerm], target: bool) -> Evidence:
    """What the LiDARs saw: structure by its terms, a `target` or none."""
    if not lidars_with_structure(terms):
        return "target"
    if any(term.odometry_of for term in terms):
        return "odometry"
    return "both" if target else "structure"


def _without_trust(solution: Solution, guesses: Mapping[str, Guess]) -> tuple[Array, Array | None]:
    """Information and gradient of the data (vehicle axes), without what `fixed: true` added.

    A trusted extrinsic is a guess: two calibrations that share it must not count it twice.
    """
    information = solution.information_data.copy()
    gradient = None if solution.gradient_data is None else solution.gradient_data.copy()
    seen = {c.lidar for r in solution.registrations for c in r.observation.clouds}
    seen |= lidars_with_structure(solution.structure)
    for i, name in enumerate(solution.lidars):
        rows = slice(6 * i, 6 * i + 6)
        guess = guesses[name]
        if not guess.fixed:
            continue
        certainty = guess.sigmas**-2.0
        information[rows, rows] -= np.diag(certainty)
        if gradient is not None:
            moved = vehicle_axes_difference(solution.T_vehicle_lidar[name], guess.T_vehicle_lidar)
            gradient[rows] += certainty * moved
        if name not in seen:
            # Only the rounding of large numbers is left.
            information[rows], information[:, rows] = 0.0, 0.0
            if gradient is not None:
                gradient[rows] = 0.0
    return information, gradient


def structure_summary(
    terms: Sequence[StructureTerm], lidars: Sequence[str]
) -> StructureSummary | None:
    """The structure of all drives, counted; None if there is none. `lidars` are in their order."""
    if not terms:
        return None
    strips = [strip for term in terms for strip in term.strips if strip.weight > 0.0]
    seen: dict[tuple[int, int], set[str]] = {}
    sightings: dict[str, int] = {}
    for strip in strips:
        seen.setdefault((strip.drive, strip.surface), set()).update(strip.scans)
        for name, scans in strip.scans.items():
            sightings[name] = sightings.get(name, 0) + scans
    pairs = itertools.combinations([name for name in lidars if name in sightings], 2)
    return StructureSummary(
        strips=len(strips),
        surfaces=len(seen),
        sightings={name: sightings[name] for name in lidars if name in sightings},
        shared={pair: sum(set(pair) <= by for by in seen.values()) for pair in pairs},
        offset_m=float(np.sqrt(np.mean([term.offset_m**2 for term in terms]))),
    )


def _vehicle(solution: Solution) -> dict[str, VehicleParameter]:
    """Parameters of the vehicle, with the axes of S2V that they limit."""
    return {
        name: replace(
            found,
            limits=limited_axes(
                solution.information_data,
                solution.information_knowing[name],
                solution.information_prior,
            ),
        )
        for name, found in solution.vehicle.items()
    }


def _scans_used(solution: Solution) -> dict[str, int]:
    """Per LiDAR, the scans whose clouds carry at least half their weight."""
    out: dict[str, int] = {}
    for registration, weights in zip(solution.registrations, solution.cloud_weights, strict=True):
        for cloud, weight in zip(registration.observation.clouds, weights, strict=True):
            out[cloud.lidar] = out.get(cloud.lidar, 0) + int(weight >= 0.5)
    return out


def _motion(solution: Solution) -> dict[str, str]:
    """What the poses are by, where there are no motion data."""
    tracked = [term.odometry_of for term in solution.structure if term.odometry_of]
    if not tracked:
        return {}
    text = (
        f"odometry of lidar '{tracked[0]}'; S2V roll and pitch by the ground's normal, yaw by the "
        "direction of travel, x and y by the guess alone"
    )
    return {MOTION: text}


def _slow_errors(solution: Solution) -> dict[str, object]:
    """The correlated errors of the motion data that the sigmas allow for, with their source."""
    levels = [level for level in solution.sensor_noise if level.time_s is not None]
    if not levels:
        return {}
    return {
        SLOW_ERRORS: [
            {
                "name": level.name,
                "sigma": float(f"{level.sigma:.6g}"),
                "unit": level.unit,
                "from": level.source,
            }
            for level in levels
        ]
    }


def _provenance(
    config: Config, recordings: Sequence[Recording], solution: Solution, digests: Sequence[str]
) -> dict[str, object]:
    """Versions, what was asked, and what the solve found out about its input."""
    # Where the drive lies on this machine is no part of what was asked.
    asked = config.model_copy(update={"data": config.data.model_copy(update={"path": None})})
    return {
        "caliv_graph": caliv_graph.__version__,
        "config_sha256": hashlib.sha256(dump_config(asked).encode()).hexdigest(),
        "mode": solution.mode,
        "robust_kernel": config.robust.kernel,
        "recordings": [Path(r.name).absolute().name for r in recordings],
        **({DRIVES: list(digests)} if digests else {}),
        **_motion(solution),
        **_slow_errors(solution),
        **({} if solution.pose_noise is None else {"pose_noise": asdict(solution.pose_noise)}),
        "registration_scale": solution.registration_scale,
        "iterations": solution.iterations,
        "converged": solution.converged,
    }
