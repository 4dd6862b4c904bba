"""Bound on S2S from one still view of a target: distinct beams, range noise, geometry.

    .venv/bin/python scripts/show_static_bound.py
    .venv/bin/python scripts/show_static_bound.py --shared-mm 0 1 3 --patch 0.05 0.1 0.2

The vehicle of `configs/scenarios/static.yaml` stands before a chair that both LiDARs see. All scans
of a LiDAR have the same beams on the same spots. Ranges are averaged over the scans, what the scans
share is not. The shape is unknown: planes in cells of the chair, place and slopes estimated.
`caliv_graph/registration/README.md`, section 10, derives the bound. Printed are 1 sigma of S2S, in
vehicle axes: of the target alone.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # for the modules beside this script, run from anywhere

from caliv_graph.conventions import AXES
from caliv_graph.geometry.se3 import tangent_axes
from caliv_graph.products import Array
from caliv_graph.registration.quadratic import NORMAL_SIGMA_RAD
from caliv_graph.registration.surfels import STEEP
from caliv_graph.scenario.drives import make_drive
from caliv_graph.scenario.model import Scenario, load_scenario
from caliv_graph.scenario.world import make_world
from caliv_graph.simulation.lidar import beam_directions, beams_through_sphere
from caliv_graph.simulation.rays import RayCaster
from scripts._command import exit_code_of, positive

SCENARIO = REPOSITORY / "configs" / "scenarios" / "static.yaml"


@dataclass(frozen=True)
class Spots:
    """What the beams of both LiDARs meet of the target.

    Attributes:
        points: (N, 3) metres, map.
        normals: (N, 3) towards the LiDAR.
        cosines: (N,) of incidence.
        second: (N,) 1 for the second LiDAR, 0 for the first.
        origin: (3,) of the second LiDAR, map.
    """

    points: Array
    normals: Array
    cosines: Array
    second: Array
    origin: Array


def spots_of(scenario: Scenario) -> Spots:
    """The spots of the first two LiDARs on the first target, at the start of the drive."""
    world = make_world(scenario.world)
    caster = RayCaster(world, 1)
    target = world.targets[0]
    centre, radius_m = world.bounding_sphere(target)
    (X,) = make_drive(scenario.drive).poses(np.zeros(1, np.int64), world.ground_z_map)
    parts: list[tuple[Array, Array, Array, Array]] = []
    for model in list(scenario.lidars.values())[:2]:
        T = X.compose(model.mounting.pose())
        directions = beam_directions(model).reshape(-1, 3)
        near = beams_through_sphere(directions, T.transformTo(centre), radius_m)
        directions = directions[near] @ T.rotation().matrix().T
        origin = np.tile(T.translation(), (len(directions), 1))
        ranges, objects, normals = caster.cast_with_normals(origin, directions)
        met = objects == world.names.index(target)
        directions, normals = directions[met], normals[met]
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        along = np.einsum("na,na->n", directions, normals)
        normals *= -np.sign(along)[:, None]
        points = origin[met] + directions * ranges[met, None]
        second = np.full(len(points), float(len(parts)))
        parts.append((points, normals, np.abs(along), second))
    points, normals, cosines, second = (np.concatenate(p) for p in zip(*parts, strict=True))
    return Spots(points, normals, cosines, second, T.translation())


def information(spots: Spots, variances: Array, patch_m: float) -> Array:
    """(6, 6) of the second LiDAR's pose against the first: the planes of all cells eliminated.

    `variances` (N,) are those of the heights.
    """
    cells: dict[tuple[int, ...], list[int]] = defaultdict(list)
    axis = np.abs(spots.normals).argmax(axis=1)
    for i in np.flatnonzero(spots.cosines > STEEP).tolist():
        place = np.floor(spots.points[i] / patch_m).astype(int).tolist()
        side = int(spots.normals[i, axis[i]] > 0.0)
        cells[(*place, int(axis[i]), side)].append(i)
    H = np.zeros((6, 6))
    for own in cells.values():
        points, normals = spots.points[own], spots.normals[own]
        lever = np.cross(points - spots.origin, normals)
        J = np.hstack([lever, normals]) * spots.second[own, None]
        tangents = tangent_axes(normals.mean(axis=0))
        away = (points - points.mean(axis=0)) @ tangents.T
        G = np.column_stack([np.ones(len(own)), away])
        root = 1.0 / np.sqrt(variances[own])[:, None]
        J, G = root * J, root * G
        prior = np.diag([0.0, NORMAL_SIGMA_RAD**-2.0, NORMAL_SIGMA_RAD**-2.0])
        H += J.T @ J - J.T @ G @ np.linalg.solve(G.T @ G + prior, G.T @ J)
    return H


def bound(spots: Spots, range_m: float, shared_m: float, scans: int, patch_m: float) -> Array:
    """(6,) 1 sigma of S2S, rad and m."""
    variances = (spots.cosines * range_m) ** 2 / scans + shared_m**2
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(information(spots, variances, patch_m)))))


def parser() -> argparse.ArgumentParser:
    """Of the command line."""
    out = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    out.add_argument("--scans", type=positive, default=80, help="of each LiDAR (default: 80)")
    out.add_argument(
        "--shared-mm", type=float, nargs="+", default=[0.0, 1.0, 3.0], help="1 sigma of a height"
    )
    out.add_argument(
        "--patch", type=float, nargs="+", default=[0.05, 0.1, 0.2], help="size of a cell, metres"
    )
    return out


def main() -> int:
    """Prints the table."""
    args = parser().parse_args()
    scenario = load_scenario(SCENARIO)
    spots = spots_of(scenario)
    range_m = next(iter(scenario.lidars.values())).range_sigma_m
    print("cell m  shared mm  " + "  ".join(f"{axis:>5}" for axis in AXES) + "   (mrad, mm)")
    for patch_m in args.patch:
        for shared_mm in args.shared_mm:
            sigma = 1e3 * bound(spots, range_m, 1e-3 * shared_mm, args.scans, patch_m)
            figures = "  ".join(f"{s:5.2f}" for s in sigma)
            print(f"{patch_m:6.2f}  {shared_mm:9.1f}  {figures}")
    return 0


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
