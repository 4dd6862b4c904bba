"""Structure in the calibration graph: one native factor per drive (`README.md`, section 18)."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import gtsam
import numpy as np

from caliv_graph.calibration.graph import CalibrationGraph
from caliv_graph.calibration.problem import Problem, moved_map
from caliv_graph.calibration.vehicle_parameters import KEYS
from caliv_graph.conventions import (
    key_extrinsic,
    key_height,
    key_offset,
    key_parallel,
    key_vehicle,
)
from caliv_graph.products import Array, StandingErrors, StructureTerm
from caliv_graph.trajectory.factors import Gaussian, tangent_size

FAR_RAD, FAR_M = 0.02, 0.1
"""Distance of a LiDAR from where a term was linearised, beyond which it is solved anew. Half of its
square times a slope is what is left out: 0.1 rad of yaw on ground that slopes by 2 % turn the LiDAR
by 0.1 mrad, which is its sigma (`slalom` of the second simulator, seed 11, where the target alone
was 0.1 rad and 0.6 m off)."""

RIDGE = 1e-9
"""Relative ridge under which the constant of a term is computed: a term is semidefinite."""


def structure_graph(
    problem: Problem,
    terms: Sequence[StructureTerm],
    start: Mapping[str, gtsam.Pose3] | None = None,
    standing: Collection[int] = (),
) -> CalibrationGraph:
    """What the structure of each drive says of poses, parameters, time offsets and extrinsics.

    A parameter or an offset that the problem has not is held: a parameter at its value in the
    term, an offset at zero. `start` are extrinsics near the solution: E is linearised there where
    the reference has no structure; None: the guesses. `standing` are drives of which the graph has
    the errors of the vehicle's stand as variables, for ground planes (`ground.drives_with_planes`).

    Raises:
        ValueError: the problem does not have a pose or a LiDAR of a term.
    """
    graph = CalibrationGraph()
    guess = (start or {}).get(problem.reference, problem.guesses[problem.reference])
    for term in terms:
        graph.append_gaussian("structure", _gaussian(problem, term, guess, standing))
    return graph


def lidars_with_structure(terms: Sequence[StructureTerm]) -> frozenset[str]:
    """Names of the LiDARs that some terms say anything of."""
    return frozenset(
        name
        for term in terms
        for name, own in rows_of_lidars(term).items()
        if np.diag(term.information)[own].any()
    )


def far_from(terms: Sequence[StructureTerm], T_vehicle_lidar: Mapping[str, gtsam.Pose3]) -> bool:
    """Whether a LiDAR is so far from where some term was linearised that the term is not right.

    `T_vehicle_lidar` are of all LiDARs that the terms say anything of. A term by the odometry of a
    LiDAR is about that LiDAR's mounting, wherever the calibration puts it.
    """
    for term in (term for term in terms if not term.odometry_of):
        for name in lidars_with_structure([term]):
            away = term.T_vehicle_lidar[name].between(T_vehicle_lidar[name])
            turn = float(np.linalg.norm(gtsam.Rot3.Logmap(away.rotation())))
            if turn > FAR_RAD or float(np.linalg.norm(away.translation())) > FAR_M:
                return True
    return False


def nearest_extrinsics(
    rough: Mapping[str, gtsam.Pose3], terms: Sequence[StructureTerm]
) -> dict[str, gtsam.Pose3]:
    """Where a solve begins: the rough extrinsics, and those of LiDARs that structure places."""
    return {**rough, **{name: T for term in terms for name, T in term.T_vehicle_lidar.items()}}


def rows_of_parameters(term: StructureTerm) -> dict[str, slice]:
    """Where the coordinates of each parameter of the vehicle are in a term, after its poses."""
    out, first = {}, 6 * len(term.stamps_ns)
    for name, value in term.parameters.items():
        out[name] = slice(first, first + tangent_size(value))
        first = out[name].stop
    return out


def rows_of_offsets(term: StructureTerm) -> dict[str, int]:
    """Where the time offset of each LiDAR that has one is in a term, after its parameters."""
    sizes = [tangent_size(value) for value in term.parameters.values()]
    first = 6 * len(term.stamps_ns) + sum(sizes)
    return {name: first + i for i, name in enumerate(term.time_offsets_s)}


def rows_of_lidars(term: StructureTerm) -> dict[str, slice]:
    """Where the coordinates of each LiDAR's extrinsic are in a term."""
    first = len(term.gradient) - 6 * len(term.T_vehicle_lidar)
    return {
        name: slice(first + 6 * i, first + 6 * i + 6) for i, name in enumerate(term.T_vehicle_lidar)
    }


def _rows_of_standing(drive: int, standing: StandingErrors, first: int) -> dict[int, slice]:
    """Keys of the errors of a drive's stand, and where they are, from `first` on."""
    out = {key_height(drive): slice(first, first + 1)} if standing.height else {}
    if standing.tilt:
        after = first + len(out)
        out[key_parallel(drive)] = slice(after, after + 2)
    return out


def _gaussian(
    problem: Problem, term: StructureTerm, T_vehicle_ref: gtsam.Pose3, standing: Collection[int]
) -> Gaussian:
    """A term as a Gaussian of the graph's variables, about where the term was linearised.

    Structure sees the LiDARs, not the vehicle: a turn of its frame shows nothing, wherever the
    graph has moved the map since (`Gaussian.carried`).
    """
    point = _linearisation_point(problem, term, T_vehicle_ref)
    own_information, own_gradient = term.information, term.gradient
    errors: dict[int, slice] = {}
    if term.standing is not None and term.drive in standing:
        errors = _rows_of_standing(term.drive, term.standing, len(term.gradient))
        own_information, own_gradient = term.standing.kept_in(own_information, own_gradient)
        first = len(term.gradient)
        point |= {
            k: term.standing.value[o.start - first : o.stop - first] for k, o in errors.items()
        }
    columns = _columns(point)
    size = len(own_gradient)
    by_graph = np.zeros((size, sum(tangent_size(value) for value in point.values())))
    held = np.zeros(size)
    row = 0
    for i in _pose_indices(problem, term):
        by_graph[row : row + 6, columns[key_vehicle(i)]] = np.eye(6)
        row += 6
    for name, rows in rows_of_parameters(term).items():
        if KEYS[name] in point:
            by_graph[rows, columns[KEYS[name]]] = np.eye(rows.stop - rows.start)
    for name, at in rows_of_offsets(term).items():
        if name in problem.offsets:
            by_graph[at, columns[key_offset(problem.lidars.index(name))]] = 1.0
        else:
            held[at] = -term.time_offsets_s[name]
    # T_a = E S_a, hence d(T_a) = Ad(S_a^-1) d(E) + d(S_a).
    for name, rows in rows_of_lidars(term).items():
        if name not in problem.lidars:
            continue
        _, *others = problem.extrinsic_keys_of(name)
        by_graph[rows, columns[key_extrinsic()]] = np.eye(6)
        for key in others:
            S = point[key]
            assert isinstance(S, gtsam.Pose3)
            by_graph[rows, columns[key_extrinsic()]] = S.inverse().AdjointMap()
            by_graph[rows, columns[key]] = np.eye(6)
    for key, rows in errors.items():
        by_graph[rows, columns[key]] = np.eye(rows.stop - rows.start)
    information = by_graph.T @ own_information @ by_graph
    information = 0.5 * (information + information.T)
    gradient = by_graph.T @ (own_gradient - own_information @ held)
    constant = _constant(information, gradient)
    return Gaussian(
        tuple(point),
        tuple(point.values()),
        information,
        gradient,
        constant,
        carried=key_extrinsic(),
    )


def _linearisation_point(
    problem: Problem, term: StructureTerm, T_vehicle_ref: gtsam.Pose3
) -> dict[int, gtsam.Pose3 | gtsam.Rot3 | Array]:
    """The graph's variables of a term, where the term was linearised; E, S_a last."""
    missing = lidars_with_structure([term]) - set(problem.lidars)
    if missing:
        raise ValueError(f"lidar '{min(missing)}' has structure, but is not in the problem")
    origin = problem.origins_map[term.drive]
    point: dict[int, gtsam.Pose3 | gtsam.Rot3 | Array] = {
        key_vehicle(i): moved_map(T, -origin)
        for i, T in zip(_pose_indices(problem, term), term.T_map_vehicle, strict=True)
    }
    variables = problem.parameter_values()
    point |= {KEYS[name]: v for name, v in term.parameters.items() if KEYS[name] in variables}
    point |= {
        key_offset(problem.lidars.index(name)): np.array([offset_s])
        for name, offset_s in term.time_offsets_s.items()
        if name in problem.offsets
    }
    E = term.T_vehicle_lidar.get(problem.reference, T_vehicle_ref)
    point[key_extrinsic()] = E
    for name, T in term.T_vehicle_lidar.items():
        if name in problem.lidars:
            for key in problem.extrinsic_keys_of(name)[1:]:
                point[key] = E.between(T)
    return point


def _pose_indices(problem: Problem, term: StructureTerm) -> list[int]:
    """Indices of the poses of a term among those of the problem."""
    index = {pose: i for i, pose in enumerate(problem.poses)}
    poses = [(term.drive, int(stamp)) for stamp in term.stamps_ns]
    missing = [stamp for drive, stamp in poses if (drive, stamp) not in index]
    if missing:
        raise ValueError(f"the pose at {missing[0]} ns has structure, but is not in the problem")
    return [index[pose] for pose in poses]


def _columns(point: Mapping[int, gtsam.Pose3 | gtsam.Rot3 | Array]) -> dict[int, slice]:
    """Where the coordinates of each variable are."""
    out, start = {}, 0
    for key, value in point.items():
        out[key] = slice(start, start + tangent_size(value))
        start += tangent_size(value)
    return out


def _constant(information: Array, gradient: Array) -> float:
    """Twice what the quadratic falls below zero: with it, the factor's error is positive."""
    unit = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-12))
    scaled = information * np.outer(unit, unit) + RIDGE * np.eye(len(unit))
    pull = unit * gradient
    return max(float(pull @ np.linalg.solve(scaled, pull)), 0.0)
