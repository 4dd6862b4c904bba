"""The solve of structure: strips, sightings, weights and noise go round until nothing moves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import right_to_vehicle_axes, stack, vehicle_axes_difference
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.elimination import factor_of, solved
from caliv_graph.structure.jitter import jitter_sigma_s
from caliv_graph.structure.noise import (
    FIRST_SIGHTING_M,
    SURFACE_BIAS_M,
    fitted_noise,
    range_sigmas,
    robust_weights,
)
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.prior import PosePrior
from caliv_graph.structure.sightings import Sightings, moved_moments, sightings_of
from caliv_graph.structure.standing import Standing, stands_of
from caliv_graph.structure.strips import Strips, find_strips
from caliv_graph.structure.system import (
    Geometry,
    Layout,
    Nuisances,
    Rows,
    State,
    System,
    geometry_of,
    lidar_poses,
    stepped,
    system_of,
    whitened,
)
from caliv_graph.structure.views import Views
from caliv_graph.trajectory.select import VehicleTrajectory

GATES_M = (0.3, 0.15, 0.08, 0.06, 0.06)
"""Distance of a patch from its strip at most, from round to round: from the error of guesses
aligned roughly to a few sigmas of patches and bumps. Not narrower: two real LiDARs saw a wall 20 to
40 mm apart, and would pass for agreeing with those walls alone where they do."""

LAST_STEPS = 5
"""Steps after the last round of strips at most."""

SMALL_SIGMAS = 0.02
"""Step in standard deviations of the extrinsics at which the solve has converged."""

BIAS_M = 0.005
INCIDENCE_BIAS_M = 0.003
GROUND_BIAS_M = 0.003
"""1 sigma of the biases of ranges: of a LiDAR, per unit of 1 / cos(incidence), and on the ground,
which is of one colour: the accuracy that data sheets state, 1 to 3 cm at most, 3 to 5 mm mostly."""


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
        offsets: indices of the LiDARs with a free time offset.
        guesses: n guesses of T_vehicle_lidar.
        guess_information: (6 n, 6 n) of them, vehicle axes.
        range_sigma_m: noise along the beam as stated.
        standing: what is known of how the vehicle stands on the ground.
        views: which scans are from one place.
    """

    patches: DrivePatches
    prior: PosePrior
    pose_of_scan: IntArray
    relative: Array
    twists: Array | None
    offsets: tuple[int, ...]
    guesses: tuple[gtsam.Pose3, ...]
    guess_information: Array
    range_sigma_m: float
    standing: Standing
    views: Views


@dataclass(frozen=True)
class Solved:
    """The outcome: estimate, strips, and the system at the estimate."""

    problem: Problem
    state: State
    strips: Strips
    sightings: Sightings
    weights: Array
    nuisances: Nuisances
    layout: Layout
    geometry: Geometry
    rows: Rows
    system: System
    converged: bool


@dataclass(frozen=True)
class Levels:
    """Noise levels, alike for all strips, with which a round begins: those of `Nuisances`."""

    sighting_m: float
    strip_m: float
    shared_m: float
    surface_m: float = SURFACE_BIAS_M

    @staticmethod
    def of(found: Nuisances) -> Levels:
        """What a round has found, for the strips of the next one."""
        return Levels(
            sighting_m=float(np.median(found.sighting)),
            strip_m=float(np.median(found.strip)),
            shared_m=found.shared,
            surface_m=found.surface,
        )


def relative_motions(patches: DrivePatches, trajectory: VehicleTrajectory) -> Array:
    """(N, 4, 4) T of the vehicle at each patch's time in the vehicle frame at the scan's stamp."""
    stamps = patches.stamps_ns[patches.scan]
    begin, end = trajectory.span_ns
    own = np.clip(stamps + np.round(1e9 * patches.time_s).astype(np.int64), begin, end)
    # Thousands of patches share a time to a millisecond.
    times, inverse = np.unique(own // 200_000, return_inverse=True)
    R, t = trajectory.poses_at(np.clip(times * 200_000, begin, end))
    R, t = R[inverse.ravel()], t[inverse.ravel()]
    R_s, t_s = trajectory.poses_at(patches.stamps_ns)
    R_s, t_s = R_s[patches.scan], t_s[patches.scan]
    out = np.zeros((len(stamps), 4, 4))
    out[:, :3, :3] = np.swapaxes(R_s, 1, 2) @ R
    out[:, :3, 3] = np.einsum("nji,nj->ni", R_s, t - t_s)
    out[:, 3, 3] = 1.0
    still = patches.time_s == 0.0
    out[still] = np.eye(4)
    return out


def solve_structure(problem: Problem, start: Mapping[str, gtsam.Pose3]) -> Solved | None:
    """Solves one drive from rough extrinsics; None if there is no structure.

    Args:
        problem: the drive.
        start: T_vehicle_lidar to begin with, per LiDAR.

    Raises:
        SolveError: the system is singular.
    """
    state = first_state(problem, start)
    range_sigma = range_sigmas(problem.patches, problem.range_sigma_m)
    found: Solved | None = None
    levels = Levels(FIRST_SIGHTING_M, FIRST_SIGHTING_M, FIRST_SIGHTING_M)
    for gate in GATES_M:
        found = _round(problem, state, range_sigma, gate, levels)
        if found is None:
            return None
        found = _settled(found, steps=2)
        levels = Levels.of(found.nuisances)
        state = found.state
    if found is None:
        return None
    found = _settled(found, steps=LAST_STEPS)
    jittering = _with_jitter(found)
    return _without_dents(found if jittering is None else _settled(jittering, steps=LAST_STEPS))


def _with_jitter(found: Solved) -> Solved | None:
    """The same estimate with a jitter of every scan's stamp; None where the data show none."""
    problem = found.problem
    if problem.twists is None:
        return None
    first, scans = found.layout.plane, len(problem.patches.stamps_ns)
    layout = replace(found.layout, jitters=scans)
    errors = np.insert(found.state.errors, np.full(scans, first), 0.0)
    state = replace(found.state, errors=errors)
    geometry = geometry_at(problem, state, found.sightings, layout)

    def at(nuisances: Nuisances) -> tuple[Rows, System]:
        return _whitened(
            problem,
            state,
            geometry,
            found.strips,
            found.sightings,
            found.weights,
            nuisances,
            layout,
        )

    _, system = at(found.nuisances)
    H, b = with_guesses(problem, state, system)
    sigma_s = jitter_sigma_s(H, b, layout)
    if sigma_s == 0.0:
        return None
    nuisances = replace(found.nuisances, jitter_s=sigma_s)
    rows, system = at(nuisances)
    return replace(
        found,
        state=state,
        nuisances=nuisances,
        layout=layout,
        geometry=geometry,
        rows=rows,
        system=system,
    )


def _without_dents(found: Solved) -> Solved:
    """The same estimate, its information without what dents of the ground tell.

    The steps use them: derivatives that are not those of the residuals do not lead to the estimate.
    """
    problem, state, sightings = found.problem, found.state, found.sightings
    geometry = geometry_at(problem, state, sightings, found.layout, dents=False)
    rows, system = _whitened(
        problem,
        state,
        geometry,
        found.strips,
        sightings,
        found.weights,
        found.nuisances,
        found.layout,
    )
    return replace(found, rows=rows, system=replace(system, b=found.system.b))


def linearised(
    problem: Problem,
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
    range_sigma_m: Array,
    levels: Levels,
) -> Solved | None:
    """The system at known extrinsics and poses with stated noise; None if there is no structure.

    Args:
        problem: the drive; its pose prior is at the known poses.
        T_vehicle_lidar: per LiDAR.
        range_sigma_m: (L,) noise along the beam of each LiDAR.
        levels: noise.

    Raises:
        SolveError: the system is singular.
    """
    state = first_state(problem, T_vehicle_lidar)
    found = _round(problem, state, range_sigma_m, GATES_M[-1], levels)
    return None if found is None else _without_dents(found)


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
    )


def part_of(problem: Problem, keep: BoolArray) -> Problem:
    """The same drive with some of its patches (N,)."""
    return replace(problem, patches=problem.patches.part(keep), relative=problem.relative[keep])


def _round(
    problem: Problem,
    state: State,
    range_sigma: Array,
    gate_m: float,
    levels: Levels,
) -> Solved | None:
    """New strips and sightings at an estimate."""
    placed = placed_patches(problem, state)
    strips = find_strips(placed.moments_map, placed.normals_map, problem.patches.scan, gate_m)
    if not strips.count:
        return None
    sightings = placed_sightings(problem, placed, strips, range_sigma)
    layout = layout_of(problem, strips)
    errors = np.zeros(layout.size)
    # The biases of the LiDARs go on; those on surfaces and strips, numbered anew, begin again.
    of_lidars = slice(layout.error, layout.plane)  # and of the vehicle's stand
    errors[of_lidars] = state.errors[of_lidars] if len(state.errors) else 0.0
    state = replace(
        state, centres_map=strips.centres_map, normals_map=strips.normals_map, errors=errors
    )
    nuisances = Nuisances(
        bias=BIAS_M,
        incidence=INCIDENCE_BIAS_M,
        ground=GROUND_BIAS_M,
        surface=levels.surface_m,
        strip=np.full(strips.count, levels.strip_m),
        sighting=np.full(strips.count, levels.sighting_m),
        shared=levels.shared_m,
        repeated=0.0,
    )
    weights = np.ones(sightings.count)
    geometry = geometry_at(problem, state, sightings, layout)
    rows, system = _whitened(
        problem, state, geometry, strips, sightings, weights, nuisances, layout
    )
    return Solved(
        problem, state, strips, sightings, weights, nuisances, layout, geometry, rows, system, False
    )


@dataclass(frozen=True)
class PlacedPatches:
    """All N patches of a drive at an estimate.

    Attributes:
        moments_at_stamp: (N, 4, 4) in the lidar frame at the stamps of their scans.
        normals_at_stamp: (N, 3) likewise.
        R_map_lidar: (N, 3, 3) at these stamps.
        t_map_lidar: (N, 3) metres.
    """

    moments_at_stamp: Array
    normals_at_stamp: Array
    R_map_lidar: Array
    t_map_lidar: Array

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
    moments, normals = _at_stamp(problem, state, lidar)
    R, t = lidar_poses(state, lidar, problem.pose_of_scan[scan], problem.twists)
    return PlacedPatches(moments, normals, R, t)


def placed_sightings(
    problem: Problem, placed: PlacedPatches, strips: Strips, range_sigma_m: Array
) -> Sightings:
    """Sightings of strips; `range_sigma_m` (L,) is the noise along the beam of each LiDAR."""
    own = np.where(strips.of_patch >= 0, strips.of_patch, 0)
    normals = np.einsum("nji,nj->ni", placed.R_map_lidar, strips.normals_map[own])
    return sightings_of(problem.patches, placed.moments_at_stamp, normals, strips, range_sigma_m)


def layout_of(problem: Problem, strips: Strips) -> Layout:
    """The coordinates of a drive with some strips."""
    return Layout(
        poses=len(problem.prior.stamps_ns),
        parameters=len(problem.prior.parameter_information),
        offsets=problem.offsets,
        lidars=len(problem.patches.lidars),
        surface_of=tuple(strips.surface.tolist()),
    )


def _at_stamp(problem: Problem, state: State, lidar: IntArray) -> tuple[Array, Array]:
    """Moments and normals of all patches in the lidar frame at their scans' stamps."""
    patches = problem.patches
    if not patches.time_s.any():
        return patches.moments, patches.normal_lidar
    T = np.array([T.matrix() for T in state.T_vehicle_lidar])
    inverse = np.array([T.inverse().matrix() for T in state.T_vehicle_lidar])
    moved = inverse[lidar] @ problem.relative @ T[lidar]
    R, t = moved[:, :3, :3], moved[:, :3, 3]
    normals = np.einsum("nij,nj->ni", R, patches.normal_lidar)
    return moved_moments(patches.moments, R, t), normals


def groups_of(sightings: Sightings, strips: Strips) -> IntArray:
    """(Q,) a number for scan and surface of each sighting."""
    surface = strips.surface[sightings.strip]
    return np.asarray(sightings.scan * (int(strips.surface.max()) + 1) + surface)


def geometry_at(
    problem: Problem, state: State, sightings: Sightings, layout: Layout, dents: bool = True
) -> Geometry:
    """Residuals of the sightings at an estimate."""
    scan = sightings.scan
    return geometry_of(
        state,
        sightings,
        layout,
        problem.patches.scan_lidar[scan],
        problem.pose_of_scan[scan],
        problem.twists,
        dents,
    )


def _whitened(
    problem: Problem,
    state: State,
    geometry: Geometry,
    strips: Strips,
    sightings: Sightings,
    weights: Array,
    nuisances: Nuisances,
    layout: Layout,
) -> tuple[Rows, System]:
    group = groups_of(sightings, strips)
    repeated = problem.views.count[sightings.scan]
    rows = whitened(geometry, sightings, group, repeated, nuisances, weights, layout.size)
    stands = stands_of(state.t_map_vehicle, strips.centres_map, strips.normals_map)
    system = system_of(rows, state, layout, problem.prior, nuisances, problem.standing, stands)
    return rows, system


def _settled(found: Solved, steps: int) -> Solved:
    """Gauss-Newton steps; after each one the noise levels and the robust weights."""
    problem, layout, sightings = found.problem, found.layout, found.sightings
    converged = False
    for number in range(steps):
        H, b = with_guesses(problem, found.state, found.system)
        factor = factor_of(H)
        solve = partial(found.system.surfaces.solve, factor)
        d = found.system.surfaces.follow(solved(factor, b))
        state = stepped(found.state, layout, d)
        geometry = geometry_at(problem, state, sightings, layout)
        nuisances = fitted_noise(
            geometry,
            found.geometry,
            sightings,
            groups_of(sightings, found.strips),
            problem.views,
            found.weights,
            solve,
            layout,
            found.nuisances,
            state.errors,
        )
        weights = robust_weights(geometry.offsets_m(sightings), sightings, nuisances)
        rows, system = _whitened(
            problem, state, geometry, found.strips, sightings, weights, nuisances, layout
        )
        own = slice(layout.extrinsic, layout.error)
        converged = number > 0 and float(d[own] @ H[own, own] @ d[own]) < SMALL_SIGMAS**2
        found = replace(
            found,
            state=state,
            weights=weights,
            nuisances=nuisances,
            geometry=geometry,
            rows=rows,
            system=system,
            converged=converged,
        )
        if converged:
            break
    return found


def with_guesses(problem: Problem, state: State, system: System) -> tuple[Array, Array]:
    """The system's H and b with the guesses: they hold what structure does not determine."""
    layout = system.layout
    H, b = system.H.copy(), system.b.copy()
    own = slice(layout.extrinsic, layout.error)
    axes = np.zeros((6 * layout.lidars, 6 * layout.lidars))
    away = np.zeros(6 * layout.lidars)
    pairs = zip(state.T_vehicle_lidar, problem.guesses, strict=True)
    for i, (T, guess) in enumerate(pairs):
        part = slice(6 * i, 6 * i + 6)
        axes[part, part] = right_to_vehicle_axes(T)
        away[part] = vehicle_axes_difference(T, guess)
    H[own, own] += axes.T @ problem.guess_information @ axes
    b[own] -= axes.T @ problem.guess_information @ away
    for i in range(layout.offset, layout.extrinsic):
        H[i, i] += OFFSET_SIGMA_S**-2.0
    return H, b


OFFSET_SIGMA_S = 0.05
"""1 sigma of a time offset: half a revolution at 10 Hz."""
