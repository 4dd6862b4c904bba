"""What walls and ground of a planned drive determine, by the system that `calibrate` solves.

It is linearised at the true poses and extrinsics, under the information of the planned motion.
Clouds of targets are added on the same poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caliv_graph.calibration.heave import poses_with_heave
from caliv_graph.geometry.se3 import joint_right_to_vehicle_axes, unstack
from caliv_graph.planning.assumptions import Assumptions
from caliv_graph.planning.faces import faces_of
from caliv_graph.planning.information import (
    RIDGE,
    Columns,
    add_clouds,
    add_ground,
    bias_information,
    eliminated,
    height_sigma_of,
    source_of,
)
from caliv_graph.planning.motion import PlannedMotion, plan_motion
from caliv_graph.planning.patches import planned_patches
from caliv_graph.planning.recorded_route import RecordedRoute
from caliv_graph.planning.recorded_walls import RecordedWalls
from caliv_graph.planning.sightings import Sighting, placements, sees_ground
from caliv_graph.products import Array, IntArray
from caliv_graph.scenario.drives import Route
from caliv_graph.scenario.model import Scenario
from caliv_graph.structure.beams import beam_nodes
from caliv_graph.structure.prior import PosePrior
from caliv_graph.structure.problem import Problem
from caliv_graph.structure.solve import Levels, Solved, linearised
from caliv_graph.structure.standing import Standing
from caliv_graph.structure.term import lidars_with_ground
from caliv_graph.structure.views import views_of
from caliv_graph.trajectory.chain import POSE, Chain

SIGHTING_M = 0.002
STRIP_M = 0.002
SHARED_M = 0.002
"""1 sigma of the offset of a strip from scan to scan, of a strip from LiDAR to LiDAR, and of a
surface from scan to scan. A calibration estimates them, 0.2 to 0.4 mm in a simulated yard. Real
walls have joints, paint and gloss: a fifth of the range noise of a usual LiDAR."""

GROUND = -1
"""Number of the ground among the objects."""

RECORDED_WALLS = "walls of the drive"
"""Name of all walls of a recorded drive, which does not tell where one ends."""


@dataclass(frozen=True)
class SeenWalls:
    """The walls of one drive that its LiDARs see.

    Attributes:
        scans: (wall, LiDAR) -> number of scans that are used of it.
        strips: (LiDAR, LiDAR) -> number of strips of walls that both see.
        shared: (LiDAR, LiDAR) -> the walls that these strips are on.
    """

    scans: Mapping[tuple[str, str], int]
    strips: Mapping[tuple[str, str], int]
    shared: Mapping[tuple[str, str], tuple[str, ...]]


@dataclass(frozen=True)
class PlannedStructure:
    """The structure of one drive, linearised.

    Attributes:
        found: at the true poses.
        motion: the planned motion.
        nodes: (m,) nodes of the motion that the poses are.
        walls: who sees what.
    """

    found: Solved
    motion: PlannedMotion
    nodes: IntArray
    walls: SeenWalls


def plan_structure(
    scenario: Scenario,
    drive: Route,
    sightings: Sequence[Sighting],
    assumptions: Assumptions,
    recorded: RecordedWalls | None = None,
) -> PlannedStructure | None:
    """The structure of a drive; None if it passes none, or if none is to be used.

    `recorded` walls replace those of the scenario. Ground without walls is structure, too, as in
    `calibrate`; a quick prediction (`Assumptions.stride`) has it from the planes of each scan, and
    so has a recorded drive, of whose ground the slopes are not known.
    """
    if not assumptions.structure:
        return None
    # Of many candidates: cells take a second each.
    by_planes = assumptions.stride > 1 or (recorded is None and isinstance(drive, RecordedRoute))
    names: tuple[str, ...] = (RECORDED_WALLS,)
    if recorded is not None:
        if assumptions.ground == "none":
            recorded = recorded.part(~recorded.level)
        patches, relative = recorded.patches, recorded.relative
        face = np.where(recorded.level, GROUND, 0)
    else:
        faces = faces_of(scenario)
        if not faces.flat.any() and (by_planes or assumptions.ground == "none"):
            return None
        patches, face = planned_patches(scenario, drive, faces, assumptions.ground != "none")
        relative, names = np.broadcast_to(np.eye(4), (len(face), 4, 4)), faces.names
    if not len(face) or (by_planes and not (face != GROUND).any()):
        return None
    stamps = np.unique(
        np.concatenate([patches.stamps_ns, *(s.stamps_ns[s.used] for s in sightings)])
    )
    motion = plan_motion(drive, scenario, stamps, source_of(scenario, assumptions))
    nodes = np.unique(motion.nodes_of(stamps))
    n = len(scenario.lidars)
    prior = _pose_prior(motion, nodes, assumptions.heave_sigma_m)
    if recorded is not None:
        poses = recorded.poses(prior.stamps_ns, prior.T_map_vehicle)
        prior = replace(prior, T_map_vehicle=poses)
    pose_of_scan = np.searchsorted(nodes, motion.nodes_of(patches.stamps_ns))
    mountings = tuple(model.mounting.pose() for model in scenario.lidars.values())
    problem = Problem(
        patches=patches,
        prior=prior,
        pose_of_scan=pose_of_scan,
        relative=relative,
        twists=motion.twist[nodes] if assumptions.time_offset else None,
        offsets=tuple(range(n)) if assumptions.time_offset else (),
        guesses=mountings,
        held_at=mountings,
        held_information=np.zeros((6 * n, 6 * n)),
        range_sigma_m=0.0,
        standing=Standing(
            height_m=0.0 if assumptions.ground == "height" else None,
            height_sigma_m=height_sigma_of(scenario, assumptions),
            tilt_sigma_rad=None,
            heave_m=assumptions.heave_sigma_m,
            sway_rad=0.0,
        ),
        views=views_of(patches, pose_of_scan, prior),
        range_errors=assumptions.ranges,
        beam_nodes=beam_nodes(patches),
        bent=True,
    )
    found = linearised(
        problem,
        dict(zip(scenario.lidars, mountings, strict=True)),
        np.array([model.range_sigma_m for model in scenario.lidars.values()])
        if recorded is None
        else recorded.range_sigma_m,
        Levels.first(SIGHTING_M, STRIP_M, SHARED_M, assumptions.ranges)
        if recorded is None
        # Which channels there are depends on the pieces that are used.
        else replace(recorded.levels, beams=None),
    )
    if found is None:
        return None
    return PlannedStructure(found, motion, nodes, _seen_walls(found, face, names))


def _pose_prior(motion: PlannedMotion, nodes: IntArray, heave_m: float) -> PosePrior:
    """The planned motion's information on some poses, heave included."""
    n, width = motion.diagonal.shape[:2]
    chain = Chain(motion.diagonal, motion.coupling, np.zeros((n, width, 0)), np.zeros((0, 0)))
    m = len(nodes)
    back = np.linalg.inv(motion.to_vehicle)
    information = chain.pose_information(nodes).reshape(m, POSE, m, POSE)
    information = np.einsum("ab,ibjc,cd->iajd", back.T, information, back, optimize=True)
    information = information.reshape(POSE * m, POSE * m)
    if heave_m > 0.0:
        information = poses_with_heave(information, heave_m)
    return PosePrior(
        stamps_ns=motion.nodes_ns[nodes],
        T_map_vehicle=unstack(motion.R_map_vehicle[nodes], motion.position_map[nodes]),
        parameters={},
        information=information,
        gradient=np.zeros(POSE * m),
        parameter_information=np.zeros((0, 0)),
        parameter_offset=np.zeros(0),
    )


def information_with_structure(
    scenario: Scenario,
    drive: Route,
    sightings: Sequence[Sighting],
    structure: PlannedStructure,
    assumptions: Assumptions,
) -> Array:
    """Information of one drive on extrinsics and time offsets; everything else is eliminated.

    Returns:
        As `information.drive_information`, of all LiDARs of the scenario in its order.
    """
    used = [s for s in sightings if len(s.used)]
    layout, nodes = structure.found.layout, structure.nodes
    names = list(scenario.lidars)
    # The ground of a LiDAR counts once, as in `calibrate`.
    with_planes: frozenset[str] = frozenset()
    if assumptions.ground != "none":
        seeing = {name for name, model in scenario.lidars.items() if sees_ground(model)}
        with_planes = frozenset(seeing) - lidars_with_ground(structure.found)
    columns = Columns(
        names,
        assumptions.time_offset,
        list(dict.fromkeys(s.placement for s in used)),
        assumptions.ground if with_planes else "none",
    )
    k, m = columns.size, len(nodes)
    H = np.zeros((len(structure.motion.nodes_ns), POSE + k, POSE + k))
    by_name = {p.name: p for p in placements(scenario)}
    for sighting in used:
        placement = by_name[sighting.placement]
        add_clouds(H, structure.motion, scenario, sighting, placement, columns)
    if with_planes and used:
        stamps = np.unique(np.concatenate([s.stamps_ns[s.used] for s in used]))
        add_ground(H, structure.motion, scenario, drive, stamps, columns, assumptions, with_planes)
    H = H[nodes]
    # Coordinates: those of `columns`, then poses, then errors of LiDARs and of the vehicle's stand.
    errors = k + POSE * m + np.arange(layout.plane - layout.error)
    if columns.ground == "height":
        # One error of the vehicle's height, above planes and strips. The system has its prior.
        stand = layout.standing - layout.error
        errors[stand] = columns.height
        errors[stand + 1 :] -= 1
    total = np.zeros((max(k + POSE * m, errors.max(initial=0) + 1),) * 2)
    total[:k, :k] = H[:, POSE:, POSE:].sum(axis=0)
    each = k + POSE * np.arange(m)[:, None] + np.arange(POSE)
    total[each[:, :, None], each[:, None]] += H[:, :POSE, :POSE]
    total[each, :k] += H[:, :POSE, POSE:]
    total[:k, k : k + POSE * m] = total[k : k + POSE * m, :k].T
    rest = np.arange(columns.kept, k)
    total[rest, rest] += RIDGE
    total[columns.all_biases, columns.all_biases] += bias_information(columns, assumptions)
    own = np.concatenate(
        [
            k + np.arange(POSE * m),
            6 * len(names) + np.arange(len(layout.offsets)),
            np.arange(6 * len(names)),
            errors,
        ]
    )
    total[np.ix_(own, own)] += _in_vehicle_axes(structure.found)
    return eliminated(total, columns.kept)


def _in_vehicle_axes(found: Solved) -> Array:
    """The system's matrix with the extrinsics in vehicle axes."""
    H = found.system.H.copy()
    own = slice(found.layout.extrinsic, found.layout.error)
    back = np.linalg.inv(joint_right_to_vehicle_axes(found.state.T_vehicle_lidar))
    H[:, own] = H[:, own] @ back
    H[own] = back.T @ H[own]
    return H


def _seen_walls(found: Solved, face: IntArray, names: Sequence[str]) -> SeenWalls:
    """Who sees which wall, from the sightings of strips; `face` (N,) of each patch."""
    patches, strips, sightings = found.problem.patches, found.strips, found.sightings
    on = strips.of_patch >= 0
    of_strip = np.full(strips.count, GROUND)
    of_strip[strips.of_patch[on]] = face[on]
    lidar = patches.scan_lidar[sightings.scan]
    wall = of_strip[sightings.strip]
    seen = {
        name: set(sightings.strip[(lidar == i) & (wall != GROUND)].tolist())
        for i, name in enumerate(patches.lidars)
    }
    scans: dict[tuple[str, str], int] = {}
    for what in dict.fromkeys(names):
        at = np.isin(wall, [f for f, name in enumerate(names) if name == what])
        for i, name in enumerate(patches.lidars):
            count = len(np.unique(sightings.scan[at & (lidar == i)]))
            if count:
                scans[what, name] = count
    strips_of, shared = {}, {}
    for i, a in enumerate(patches.lidars):
        for b in patches.lidars[i + 1 :]:
            both = sorted(seen[a] & seen[b])
            strips_of[a, b] = len(both)
            shared[a, b] = tuple(dict.fromkeys(sorted(names[of_strip[k]] for k in both)))
    return SeenWalls(scans, strips_of, shared)
