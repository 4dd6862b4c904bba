"""How the vehicle stands on the ground, as evidence for the ranking of suspects.

Its height above the ground is in the graph as the config has it; that its horizontal plane is
parallel to the ground is assumed here, where the config does not say so. The ground is either in
the graph, as a plane per drive, or in the terms of structure (`README.md`, section 11).
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.calibration.ground_factors import normal_jacobian, plane_normal
from caliv_graph.calibration.structure import rows_of_lidars, rows_of_offsets, rows_of_parameters
from caliv_graph.calibration.vehicle_parameters import KEYS
from caliv_graph.conventions import key_ground, key_height, key_offset
from caliv_graph.geometry.se3 import right_to_vehicle_axes, skew
from caliv_graph.products import Array, IntArray, Solution, Stance, StructureTerm
from caliv_graph.trajectory.tilt import BODY_SIGMA_RAD


@dataclass(frozen=True)
class StanceRows:
    """Height and tilt of the vehicle on the ground, `rows z + residual`, z the graph's variables.

    Attributes:
        rows: (s, M).
        residual: (s,) at the estimate.
        weight: (s, s) of them.
        in_graph: (s, s) what of it the graph has already.
        by_height: (s,) 1 for a height: what an error of `vehicle_height` takes off it; else 0.
    """

    rows: Array
    residual: Array
    weight: Array
    in_graph: Array
    by_height: Array


def stance_rows(solution: Solution) -> list[StanceRows]:
    """Of each drive whose ground is seen; heights only where the config states one."""
    terms = {term.drive: term for term in solution.structure if term.stance is not None}
    out = [_of_term(solution, term) for term in terms.values()]
    out += _heights_in_graph(solution)
    (drives, _), tilted = drives_and_stamps(solution), "ground_tilt" in solution.factor_kinds
    for drive in sorted(set(drives.tolist())):
        if key_ground(drive) in solution.linearised.starts and drive not in terms and not tilted:
            out.append(_tilt_in_graph(solution, drive, np.flatnonzero(drives == drive).tolist()))
    return out


def drives_and_stamps(solution: Solution) -> tuple[IntArray, IntArray]:
    """(n,) drive and stamp of every pose, in the order of the graph."""
    places = np.array(list(solution.T_map_vehicle), dtype=np.int64).reshape(-1, 2)
    return places[:, 0], places[:, 1]


def _of_term(solution: Solution, term: StructureTerm) -> StanceRows:
    """Of a drive whose ground is in its structure."""
    stance = term.stance
    assert stance is not None
    by_graph, moved = _coordinates(solution, term)
    rows, residual = stance.rows @ by_graph, stance.value + stance.rows @ moved
    start = solution.linearised.starts.get(key_height(term.drive))
    if start is not None and stance.height_sigma_m is not None:
        height_m = float(solution.values.atVector(key_height(term.drive))[0])
        return _tilt_beside_height(stance, rows, residual, start, height_m)
    weight, in_graph, by_height = _weights(stance)
    return StanceRows(rows, residual, weight, in_graph, by_height)


def _tilt_beside_height(
    stance: Stance, rows: Array, residual: Array, start: int, height_m: float
) -> StanceRows:
    """The tilt of a term, given the error of the height, which is a variable of the graph.

    Args:
        stance: of the term.
        rows: (s, M) by the graph's variables, height first.
        residual: (s,) at the estimate.
        start: where the error of the height is among the graph's variables.
        height_m: this error at the estimate.
    """
    follow = stance.cov[1:, 0] / stance.cov[0, 0]
    by_graph = rows[1:] - np.outer(follow, rows[0])
    by_graph[:, start] += follow
    cov = stance.cov[1:, 1:] - np.outer(follow, stance.cov[0, 1:])
    tilts = len(follow)
    return StanceRows(
        rows=by_graph,
        residual=residual[1:] + follow * (height_m - residual[0]),
        weight=np.asarray(np.linalg.inv(cov + BODY_SIGMA_RAD**2 * np.eye(tilts)), np.float64),
        in_graph=np.zeros((tilts, tilts)),
        by_height=np.zeros(tilts),
    )


def _weights(stance: Stance) -> tuple[Array, Array, Array]:
    """(s, s) weight of height and tilt with what is assumed of them, that in the term; (s,) which.

    A term has the height alone: what is left of its assumed sigma and of what the ground tells.
    """
    s = len(stance.value)
    cov, in_graph = stance.cov + np.diag(np.full(s, BODY_SIGMA_RAD**2)), np.zeros((s, s))
    by_height = np.zeros(s)
    if stance.height_sigma_m is not None:
        by_height[0] = 1.0
        cov[0, 0] = stance.cov[0, 0] + stance.height_sigma_m**2
        in_graph[0, 0] = 1.0 / cov[0, 0]
    return np.asarray(np.linalg.inv(cov), np.float64), in_graph, by_height


def _coordinates(solution: Solution, term: StructureTerm) -> tuple[Array, Array]:
    """The coordinates of a term by the graph's variables, (N, M), and at the estimate, (N,).

    What the graph does not have is held, as `calibration.structure` holds it.
    """
    graph, values = solution.linearised, solution.values
    places = list(solution.T_map_vehicle)
    rows = np.zeros((len(term.gradient), len(graph.gradient)))
    moved = np.zeros(len(term.gradient))
    row = 0
    for stamp_ns, T in zip(term.stamps_ns.tolist(), term.T_map_vehicle, strict=True):
        place = (term.drive, stamp_ns)
        start = 6 * places.index(place)
        rows[row : row + 6, start : start + 6] = np.eye(6)
        moved[row : row + 6] = T.localCoordinates(solution.T_map_vehicle[place])
        row += 6
    for name, own in rows_of_parameters(term).items():
        value = term.parameters[name]
        if KEYS[name] in graph.starts:
            start, size = graph.starts[KEYS[name]], own.stop - own.start
            rows[own, start : start + size] = np.eye(size)
            if isinstance(value, gtsam.Rot3):
                moved[own] = value.localCoordinates(values.atRot3(KEYS[name]))
            else:
                moved[own] = values.atVector(KEYS[name]) - value
    # A late clock lifts the ground where the vehicle pitches: without its column the row would not
    # be that of the graph, and taking the height out of the graph would leave negative information.
    for name, at in rows_of_offsets(term).items():
        key = key_offset(solution.lidars.index(name)) if name in solution.lidars else -1
        if key in graph.starts:
            rows[at, graph.starts[key]] = 1.0
            moved[at] = values.atVector(key)[0]
        moved[at] -= term.time_offsets_s[name]
    first = len(graph.gradient) - 6 * len(solution.lidars)
    for name, own in rows_of_lidars(term).items():
        if name in solution.lidars:
            now = solution.T_vehicle_lidar[name]
            i = solution.lidars.index(name)
            to_right = right_to_vehicle_axes(now).T
            rows[own, first:] = to_right @ graph.to_vehicle_axes[6 * i : 6 * i + 6]
            moved[own] = term.T_vehicle_lidar[name].localCoordinates(now)
    return rows, moved


def _heights_in_graph(solution: Solution) -> list[StanceRows]:
    """The priors of the heights of drives whose ground is in the graph."""
    graph, out = solution.linearised, []
    for index, kind in enumerate(solution.factor_kinds):
        if kind != "ground_height":
            continue
        factor = solution.graph.at(index)
        key = factor.keys()[0]
        if key not in graph.starts:
            continue
        row = np.zeros((1, len(graph.gradient)))
        row[0, graph.starts[key]] = 1.0
        weight = np.asarray(factor.linearize(solution.values).information())
        out.append(
            StanceRows(row, solution.values.atVector(key), weight, weight, by_height=np.ones(1))
        )
    return out


def _tilt_in_graph(solution: Solution, drive: int, mine: list[int]) -> StanceRows:
    """The mean tilt of the vehicle against the plane of a drive; `mine` are its poses."""
    graph, poses = solution.linearised, list(solution.T_map_vehicle.values())
    plane = solution.values.atVector(key_ground(drive))
    normal, by_plane = plane_normal(plane), normal_jacobian(plane)
    start = graph.starts[key_ground(drive)]
    rows, tilt = np.zeros((2, len(graph.gradient))), np.zeros(2)
    for i in mine:
        R_vehicle_map = poses[i].rotation().matrix().T
        seen = R_vehicle_map @ normal
        tilt += seen[:2] / len(mine)
        rows[:, 6 * i : 6 * i + 3] = skew(seen)[:2] / len(mine)
        rows[:, start : start + 3] += (R_vehicle_map @ by_plane)[:2] / len(mine)
    weight = np.eye(2) / BODY_SIGMA_RAD**2
    return StanceRows(rows, tilt, weight, np.zeros((2, 2)), by_height=np.zeros(2))
