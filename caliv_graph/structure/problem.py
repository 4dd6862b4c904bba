"""What the solve of one drive is given, and where its patches and residuals are at an estimate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from caliv_graph.config.range_errors import UNSTATED, RangeErrors
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.geometry.se3 import (
    right_to_vehicle_axes,
    stack,
    tangent_axes,
    vehicle_axes_difference,
)
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.beams import BeamNodes, beam_groups
from caliv_graph.structure.layout import Layout, State
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.prior import PosePrior
from caliv_graph.structure.residuals import Geometry, geometry_of, joined, lidar_poses
from caliv_graph.structure.sightings import Sightings, moved_moments, sightings_of
from caliv_graph.structure.standing import Standing
from caliv_graph.structure.strips import Strips
from caliv_graph.structure.system import System
from caliv_graph.structure.views import Views
from caliv_graph.trajectory.select import VehicleTrajectory

OFFSET_SIGMA_S = 0.05
"""1 sigma of a time offset: half a revolution at 10 Hz."""

TOGETHER = 2048
"""Sightings whose residuals are made at a time: what they are made of takes twice as much memory as
they do."""

SAME_TIME_NS = 200_000
"""Times of patches this near have one pose: 0.1 ms at most from their own, 0.2 mm at 2 m/s."""


@dataclass(frozen=True)
class Problem:
    """What the solve of one drive is given.

    Attributes:
        patches: of the drive.
        prior: what the motion data say of the poses.
        pose_of_scan: (S,) index of the pose of each scan.
        relative: (N, 4, 4) motion of the vehicle from the stamp of its scan to each patch's own
            time.
        twists: (M, 6) velocity at each pose; None: no time offset is free, and no stamp jitters.
        accelerations: (M, 6) their change per second; None: no time offset is free.
        offsets: indices of the LiDARs with a free time offset.
        guesses: n guesses of T_vehicle_lidar, for what the strips were like with them.
        held_at: n T_vehicle_lidar that hold what structure does not determine.
        held_information: (6 n, 6 n) of them, vehicle axes.
        range_sigma_m: noise along the beam as stated.
        standing: what is known of how the vehicle stands on the ground.
        views: which scans are from one place.
        range_errors: what is stated of the errors of the ranges.
        turn_rad_s: (P, 3) 1 sigma of the errors of the angular velocity within the scans at each of
            the P poses with a scan, vehicle axes (`turns.py`); empty: points are taken at once.
        beam_nodes: of each LiDAR, where its beams err (`beams.py`); empty: none do.
        bent: whether strips are bent (`bends.py`); else they are flat.
    """

    patches: DrivePatches
    prior: PosePrior
    pose_of_scan: IntArray
    relative: Array
    twists: Array | None
    offsets: tuple[int, ...]
    guesses: tuple[gtsam.Pose3, ...]
    held_at: tuple[gtsam.Pose3, ...]
    held_information: Array
    range_sigma_m: float
    standing: Standing
    views: Views
    range_errors: RangeErrors = UNSTATED
    accelerations: Array | None = None
    turn_rad_s: Array = field(default_factory=lambda: np.zeros((0, 3)))
    beam_nodes: tuple[BeamNodes, ...] = ()
    bent: bool = False

    @property
    def turn_of_scan(self) -> IntArray:
        """(S,) which of the poses with a scan each has."""
        return np.unique(self.pose_of_scan, return_inverse=True)[1].ravel()


def relative_motions(patches: DrivePatches, trajectory: VehicleTrajectory) -> Array:
    """(N, 4, 4) T of the vehicle at each patch's time in the vehicle frame at the scan's stamp."""
    begin, end = trajectory.span_ns
    own = np.clip(patches.taken_ns, begin, end)
    # Thousands of patches share a time to a tenth of a millisecond. Rounded, not cut off: a time
    # that is too early by the mean shifts all LiDARs along the motion.
    # Not of a cloud without a sweep, in which nothing is left of the rounding but its error.
    rounded = (own + SAME_TIME_NS // 2) // SAME_TIME_NS * SAME_TIME_NS
    own = np.where(patches.swept_scans[patches.scan], rounded, own)
    times, inverse = np.unique(own, return_inverse=True)
    R, t = trajectory.poses_at(np.clip(times, begin, end))
    R, t = R[inverse.ravel()], t[inverse.ravel()]
    R_s, t_s = trajectory.poses_at(patches.stamps_ns)
    R_s, t_s = R_s[patches.scan], t_s[patches.scan]
    out = np.zeros((len(own), 4, 4))
    out[:, :3, :3] = np.swapaxes(R_s, 1, 2) @ R
    out[:, :3, 3] = np.einsum("nji,nj->ni", R_s, t - t_s)
    out[:, 3, 3] = 1.0
    still = patches.time_s == 0.0
    out[still] = np.eye(4)
    return out


def first_state(problem: Problem, start: Mapping[str, gtsam.Pose3]) -> State:
    """The poses of the motion data, some T_vehicle_lidar, and no strips yet."""
    names = problem.patches.lidars
    R, t = stack(problem.prior.T_map_vehicle)
    return State(
        R_map_vehicle=R,
        t_map_vehicle=t,
        moved=np.zeros(len(problem.prior.gradient)),
        T_vehicle_lidar=tuple(start[name] for name in names),
        offsets_s=np.zeros(len(names)),
        centres_map=np.zeros((0, 3)),
        normals_map=np.zeros((0, 3)),
        errors=np.zeros(0),
        chart=problem.prior.chart,
    )


def part_of(problem: Problem, keep: BoolArray) -> Problem:
    """The same drive with some of its patches (N,)."""
    return replace(problem, patches=problem.patches.part(keep), relative=problem.relative[keep])


SLIP = np.repeat([0.2, 0.3], 3)
"""1 sigma of the slip of a mount, rad and m: more than any that still carries its LiDAR."""

LATER = "{} later"
"""Name of a LiDAR after the slip of its mount."""


def slipped_apart(problem: Problem, lidar: int, since_s: float) -> Problem:
    """The same drive with a LiDAR that is another one, the last, from a time on.

    `since_s` counts from the first scan. Without errors of beams, which have each their own LiDAR.
    """
    patches, n = problem.patches, len(problem.patches.lidars)
    passed_s = (patches.stamps_ns - patches.stamps_ns.min()) / NANOSECONDS_PER_SECOND
    later = (patches.scan_lidar == lidar) & (passed_s >= since_s - 1e-6)
    held = np.zeros((6 * (n + 1), 6 * (n + 1)))
    own = slice(6 * lidar, 6 * lidar + 6)
    held[: 6 * n, : 6 * n] = problem.held_information
    where = np.linalg.inv(problem.held_information[own, own]) + np.diag(SLIP**2)
    held[6 * n :, 6 * n :] = np.linalg.inv(where)
    moved_with = patches.moved_with
    return replace(
        problem,
        patches=replace(
            patches,
            lidars=(*patches.lidars, LATER.format(patches.lidars[lidar])),
            scan_lidar=np.where(later, n, patches.scan_lidar),
            moved_with=(*moved_with, moved_with[lidar]) if moved_with else (),
        ),
        offsets=(*problem.offsets, n) if lidar in problem.offsets else problem.offsets,
        guesses=(*problem.guesses, problem.guesses[lidar]),
        held_at=(*problem.held_at, problem.held_at[lidar]),
        held_information=held,
        beam_nodes=(),
    )


@dataclass(frozen=True)
class PlacedPatches:
    """All N patches of a drive at an estimate.

    Attributes:
        moments_at_stamp: (N, 4, 4) in the lidar frame at the stamps of their scans.
        origins_at_stamp: (N, 3) where the LiDAR was when it saw each, likewise.
        normals_at_stamp: (N, 3) likewise.
        scatter_at_stamp: (N, 3) `DrivePatches.scatter_along_beam_m`, likewise.
        R_map_lidar: (N, 3, 3) at these stamps.
        t_map_lidar: (N, 3) metres.
        T_vehicle_lidar: of each LiDAR, with which the points were moved to the stamps.
    """

    moments_at_stamp: Array
    origins_at_stamp: Array
    normals_at_stamp: Array
    scatter_at_stamp: Array
    R_map_lidar: Array
    t_map_lidar: Array
    T_vehicle_lidar: tuple[gtsam.Pose3, ...]

    @property
    def moments_map(self) -> Array:
        """(N, 4, 4)."""
        return moved_moments(self.moments_at_stamp, self.R_map_lidar, self.t_map_lidar)

    @property
    def normals_map(self) -> Array:
        """(N, 3)."""
        return np.asarray(np.einsum("nij,nj->ni", self.R_map_lidar, self.normals_at_stamp))


def placed_patches(problem: Problem, state: State) -> PlacedPatches:
    """The patches of a drive at an estimate."""
    scan = problem.patches.scan
    lidar = problem.patches.scan_lidar[scan]
    moved = _at_stamp(problem, state, lidar)
    R, t = lidar_poses(
        state, lidar, problem.pose_of_scan[scan], problem.twists, problem.accelerations
    )
    return PlacedPatches(*moved, R, t, state.T_vehicle_lidar)


def placed_sightings(
    problem: Problem, placed: PlacedPatches, strips: Strips, range_sigma_m: Array
) -> Sightings:
    """Sightings of strips; `range_sigma_m` (L,) is the noise along the beam of each LiDAR."""
    own = np.where(strips.of_patch >= 0, strips.of_patch, 0)
    back = np.swapaxes(placed.R_map_lidar, 1, 2)
    normals = np.einsum("nij,nj->ni", back, strips.normals_map[own])
    bent = None
    if problem.bent and strips.count:
        centres = np.einsum("nij,nj->ni", back, strips.centres_map[own] - placed.t_map_lidar)
        bent = centres, tangent_axes(strips.normals_map)[own] @ placed.R_map_lidar
    beams = None
    if problem.beam_nodes:
        lidar = problem.patches.scan_lidar[problem.patches.scan]
        since = _motion_since_stamp(problem, placed.T_vehicle_lidar, lidar)
        beams = beam_groups(problem.patches, problem.beam_nodes, normals, *since)
    return sightings_of(
        problem.patches,
        placed.moments_at_stamp,
        placed.origins_at_stamp,
        normals,
        placed.scatter_at_stamp,
        strips,
        range_sigma_m,
        placed.T_vehicle_lidar,
        beams,
        bent,
    )


def layout_of(problem: Problem, strips: Strips) -> Layout:
    """The coordinates of a drive with some strips."""
    return Layout(
        poses=len(problem.prior.stamps_ns),
        parameters=len(problem.prior.parameter_information),
        rates=problem.prior.rates,
        offsets=problem.offsets,
        lidars=len(problem.patches.lidars),
        surface_of=tuple(strips.surface.tolist()),
        turns=problem.turn_rad_s.size,
        beams=tuple(nodes.errors for nodes in problem.beam_nodes),
        bent=problem.bent,
        ground_frames=len(problem.patches.lidars) * problem.range_errors.sees_ground_apart,
    )


def _at_stamp(problem: Problem, state: State, lidar: IntArray) -> tuple[Array, Array, Array, Array]:
    """The first four of `PlacedPatches`."""
    patches = problem.patches
    scatter = patches.scatter_along_beam_m
    if not patches.time_s.any():
        return patches.moments, np.zeros_like(scatter), patches.normal_lidar, scatter
    R, t = _motion_since_stamp(problem, state.T_vehicle_lidar, lidar)
    normals, scatter = (np.einsum("nij,nj->ni", R, v) for v in (patches.normal_lidar, scatter))
    return moved_moments(patches.moments, R, t), t, normals, scatter


def _motion_since_stamp(
    problem: Problem, T_vehicle_lidar: tuple[gtsam.Pose3, ...], lidar: IntArray
) -> tuple[Array, Array]:
    """R (N, 3, 3) and t (N, 3) of the LiDAR of each patch in its own frame at the scan's stamp."""
    T = np.array([T.matrix() for T in T_vehicle_lidar])
    inverse = np.array([T.inverse().matrix() for T in T_vehicle_lidar])
    moved = inverse[lidar] @ problem.relative @ T[lidar]
    return moved[:, :3, :3], moved[:, :3, 3]


def groups_of(sightings: Sightings, strips: Strips) -> IntArray:
    """(Q,) a number for scan and surface of each sighting."""
    surface = strips.surface[sightings.strip]
    return np.asarray(sightings.scan * (int(strips.surface.max()) + 1) + surface)


def alike(problem: Problem, sightings: Sightings) -> IntArray:
    """(Q,) number of sightings that the LiDAR of each has of its strip."""
    lidars = len(problem.patches.lidars)
    both = sightings.strip * lidars + problem.patches.scan_lidar[sightings.scan]
    return np.asarray(np.bincount(both)[both])


def geometry_at(
    problem: Problem, state: State, sightings: Sightings, layout: Layout, dents: bool = True
) -> Geometry:
    """Residuals of the sightings at an estimate."""
    turn_of_scan = problem.turn_of_scan

    def of(some: Sightings) -> Geometry:
        return geometry_of(
            state,
            some,
            layout,
            problem.patches.scan_lidar[some.scan],
            problem.pose_of_scan[some.scan],
            problem.twists,
            dents,
            turn_of_scan[some.scan],
            problem.accelerations,
        )

    if sightings.count <= TOGETHER:
        return of(sightings)
    starts = range(0, sightings.count, TOGETHER)
    return joined((of(sightings.only(slice(i, i + TOGETHER))) for i in starts), sightings)


def with_hold(problem: Problem, state: State, system: System) -> tuple[Array, Array]:
    """The system's H and b with what holds the extrinsics where structure does not."""
    H, b = system.H.copy(), system.b.copy()
    add_hold(problem, state, system.layout, H, b)
    return H, b


def add_hold(problem: Problem, state: State, layout: Layout, H: Array, b: Array) -> None:
    """Adds what holds the extrinsics to H (R, R) and b (R,) of a system, in place."""
    own = slice(layout.extrinsic, layout.error)
    axes = np.zeros((6 * layout.lidars, 6 * layout.lidars))
    away = np.zeros(6 * layout.lidars)
    pairs = zip(state.T_vehicle_lidar, problem.held_at, strict=True)
    for i, (T, held) in enumerate(pairs):
        part = slice(6 * i, 6 * i + 6)
        axes[part, part] = right_to_vehicle_axes(T)
        away[part] = vehicle_axes_difference(T, held)
    H[own, own] += axes.T @ problem.held_information @ axes
    b[own] -= axes.T @ problem.held_information @ away
    for i in range(layout.offset, layout.extrinsic):
        H[i, i] += OFFSET_SIGMA_S**-2.0
