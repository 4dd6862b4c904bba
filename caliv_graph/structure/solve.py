"""The solve of structure: strips, sightings, weights and noise go round until nothing moves."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial

import gtsam
import numpy as np

from caliv_graph.common.memory import give_back_freed_arrays, give_back_freed_memory
from caliv_graph.config.range_errors import RangeErrors
from caliv_graph.geometry.se3 import vehicle_axes_difference
from caliv_graph.products import Array, BoolArray, IntArray, MountSlip
from caliv_graph.structure.beams import usual_sigmas
from caliv_graph.structure.bends import USUAL_PER_M
from caliv_graph.structure.elimination import Further, covariance_of, factor_of, solved
from caliv_graph.structure.jitter import Clocks, jitter_sigma_s, told_clocks, told_of_jitters
from caliv_graph.structure.layout import Layout, Nuisances, State, stepped
from caliv_graph.structure.noise import (
    FIRST_SIGHTING_M,
    fitted_noise,
    range_sigmas,
    seen_signs,
)
from caliv_graph.structure.problem import (
    Problem,
    add_hold,
    alike,
    first_state,
    geometry_at,
    groups_of,
    layout_of,
    placed_patches,
    placed_sightings,
    slipped_apart,
    with_hold,
)
from caliv_graph.structure.residuals import Geometry
from caliv_graph.structure.rows import Rows, whitened
from caliv_graph.structure.sightings import Sightings
from caliv_graph.structure.slips import ToldSlips, slip_coupling, told_slips
from caliv_graph.structure.standing import Stands, stands_of
from caliv_graph.structure.strips import Strips, find_strips
from caliv_graph.structure.system import System, system_of
from caliv_graph.structure.thinning import (
    on_all_coordinates,
    on_all_poses,
    some_scans,
    with_scans,
)
from caliv_graph.structure.tilts import FIRST_TILT_PER_M, USUAL_RAD
from caliv_graph.structure.weights import bend_weights, ground_weights, robust_weights

ROUGH_GATES_M = (0.3, 0.15, 0.08)
GATES_M = (0.06, 0.06)
"""Distance of a patch from its strip at most, from round to round: from the error of guesses
aligned roughly, with some of the scans, to a few sigmas of patches and bumps, with all. Not
narrower: two real LiDARs saw a wall 20 to 40 mm apart, and would pass for agreeing with those walls
alone where they do."""

LAST_STEPS = 5
STEPS = (2, LAST_STEPS)
"""Steps in each of the rounds with all scans, and after stamps were found to jitter: at most, but
for wild ones."""

SMALL_SIGMAS = 0.02
"""Step in standard deviations of the extrinsics at which the solve has converged."""

WILD_GATES = 0.5
"""Last step of a round, in gates at the median range of the patches, up to which strips may be cut
anew. A wild one passes: with the noise levels of the round before, a rosette that looks back along
a street was turned by -9 mrad, and by the next step back. Cut between the two, walls and window
frames were joined as if the LiDAR were 45 mm aside, and it stayed there (S2S at 8.8 sigmas)."""


Pair = tuple[float, float]


@dataclass(frozen=True)
class Estimate:
    """An estimate of a drive, its strips, and the noise at which it is to be linearised.

    It is without the residuals, which take 70 MB and more: nobody keeps two. `unbent` (K,) are the
    smallest weights that strips had by their bends (`weights.bend_weights`) in this round: the bend
    of a strip without weight is not estimated any more.
    """

    problem: Problem
    state: State
    strips: Strips
    sightings: Sightings
    weights: Array
    nuisances: Nuisances
    layout: Layout
    unbent: Array
    converged: bool

    def levels(self) -> Levels:
        """Its noise levels, for the strips of another round."""
        found = self.nuisances
        level = self.strips.level
        tilt_per_m = found.sighting_tilt / found.sighting
        return Levels(
            sighting_m=float(np.median(found.sighting)),
            strip_m=float(np.median(found.strip)),
            shared_m=found.shared,
            surface_m=found.surface,
            bias_m=found.bias,
            beams=found.beams,
            bend_per_m=_medians(found.bend, level, (USUAL_PER_M, USUAL_PER_M)),
            tilt_per_m=_medians(tilt_per_m, level, FIRST_TILT_PER_M),
            strip_tilt_rad=_medians(found.strip_tilt, level, (USUAL_RAD, USUAL_RAD)),
            tilt_times=found.tilt_times,
            lidar_offsets=found.lidar_offsets,
        )

    def stands(self) -> Stands:
        """The level strip below each pose with a scan, where there is one.

        As the strips are now: one that hardly any sighting holds may have turned upright since.
        """
        state = self.state
        stands = stands_of(
            state.R_map_vehicle,
            state.t_map_vehicle,
            state.centres_map,
            state.normals_map,
            self.problem.standing,
        )
        return stands.only(np.isin(stands.pose, self.problem.pose_of_scan))


@dataclass(frozen=True)
class Sighted(Estimate):
    """An estimate with its residuals."""

    geometry: Geometry

    def rows(self) -> Rows:
        """The residuals in units of their noise."""
        problem, sightings = self.problem, self.sightings
        lidar = problem.patches.scan_lidar[sightings.scan]
        return whitened(
            self.geometry,
            sightings,
            groups_of(sightings, self.strips),
            problem.views.count[sightings.scan],
            alike(problem, sightings),
            self.nuisances.errors(sightings.strip, lidar, self.strips.level),
            self.nuisances,
            self.weights,
            self.layout,
        )


@dataclass(frozen=True)
class Solved(Estimate):
    """The outcome: an estimate, the system there, and what it tells of clocks that are held.

    Attributes:
        system: the linearised system.
        offsets_m: (Q,) `Geometry.offsets_m`.
        plane_rows: (Q, 3) `Geometry.plane_rows`.
        clocks: of LiDARs whose clocks are held.
        slips: of mounts that slip; None: not tested.
    """

    system: System
    offsets_m: Array
    plane_rows: Array
    clocks: Clocks = field(default_factory=Clocks)
    slips: ToldSlips | None = None

    @cached_property
    def factor(self) -> tuple[Array, Array]:
        """Of its information with what holds the extrinsics (`elimination.factor_of`)."""
        H, _ = with_hold(self.problem, self.state, self.system)
        return factor_of(H)


def with_residuals(found: Estimate, dents: bool = True) -> Sighted:
    """An estimate with its residuals; `dents` as in `residuals.geometry_of`."""
    geometry = geometry_at(found.problem, found.state, found.sightings, found.layout, dents)
    return Sighted(**vars(without_residuals(found)), geometry=geometry)


def without_residuals(found: Estimate) -> Estimate:
    """An estimate without its residuals."""
    return Estimate(**{each.name: getattr(found, each.name) for each in fields(Estimate)})


def _linearised(held: list[Sighted]) -> System:
    """The linearised system at the estimate in `held`, which is taken out.

    It takes most of the memory: nobody keeps two, and residuals are let go of when its rows are
    there.
    """
    rows, found = _rows_of(held)
    return _system(rows, found)


def _linearised_with_slips(held: list[Sighted]) -> tuple[System, Further]:
    """`_linearised`, and with it the coordinates of slips (`slips.py`)."""
    rows, found = _rows_of(held)
    of_scans = found.problem.patches
    apart = slip_coupling(rows[0], found.layout, of_scans.scan_lidar, of_scans.stamps_ns)
    system = _system(rows, found)
    return system, apart.reduced(system.surfaces)


def _rows_of(held: list[Sighted]) -> tuple[list[Rows], Estimate]:
    """The rows of the estimate in `held`, which is taken out, and the estimate."""
    before = held.pop()
    rows, found = [before.rows()], without_residuals(before)
    del before
    give_back_freed_arrays()
    return rows, found


def _system(rows: list[Rows], found: Estimate) -> System:
    """The system of an estimate with `rows`, which are taken out."""
    return system_of(  # it lets go of the rows, which nobody else may hold
        rows.pop(),
        found.state,
        found.layout,
        found.problem.prior,
        found.nuisances,
        found.problem.standing,
        found.stands(),
    )


def _with_gradient(found: Sighted) -> tuple[Estimate, Array]:
    """An estimate without its residuals, and the gradient (R,) of its system."""
    estimate, held = without_residuals(found), [found]
    del found
    return estimate, _linearised(held).b


@dataclass(frozen=True)
class Levels:
    """Noise levels, alike for all strips, with which a round begins: those of `Nuisances`.

    `beams` is (E,), as of `Nuisances`, or None: as is usual; `tilt_times` and
    `lidar_offsets` are as there. Pairs are
    of level strips, and of others: `bend_per_m`, tilts of sightings in offsets (`tilt_per_m`), and
    what a LiDAR repeats of tilts (`strip_tilt_rad`).
    """

    sighting_m: float
    strip_m: float
    shared_m: float
    surface_m: float
    bias_m: float
    strip_tilt_rad: Pair
    beams: Array | None = None
    bend_per_m: Pair = (USUAL_PER_M, USUAL_PER_M)
    tilt_per_m: Pair = FIRST_TILT_PER_M
    tilt_times: Array = field(default_factory=lambda: np.zeros((0, 2)))
    lidar_offsets: Array = field(default_factory=lambda: np.zeros((0, 2)))

    @staticmethod
    def first(sighting_m: float, strip_m: float, shared_m: float, ranges: RangeErrors) -> Levels:
        """Some levels, and what is known of the ranges before any data."""
        ground, others = FIRST_TILT_PER_M
        strip_tilt_rad = strip_m * ground, strip_m * others
        surface_m, bias_m = ranges.surface_m, ranges.offsets.usual
        return Levels(sighting_m, strip_m, shared_m, surface_m, bias_m, strip_tilt_rad)


def _medians(of_strips: Array, level: BoolArray, none: Pair) -> Pair:
    """Medians of level strips, and of others; where there are no such, that of `none`."""
    kinds = (level, ~level)
    ground, others = (
        float(np.median(of_strips[of])) if of.any() else usual
        for of, usual in zip(kinds, none, strict=True)
    )
    return ground, others


def solve_structure(problem: Problem, start: Mapping[str, gtsam.Pose3]) -> Solved | None:
    """Solves one drive from rough extrinsics; None if there is no structure.

    Args:
        problem: the drive.
        start: T_vehicle_lidar to begin with, per LiDAR.

    Raises:
        SolveError: the system is singular.
    """
    own, poses = with_scans(problem, np.ones(len(problem.pose_of_scan), dtype=bool))
    range_sigma = range_sigmas(problem.patches, problem.range_sigma_m)
    state, levels = _rough(own, start, range_sigma)
    found: Estimate | None = None
    for gate, steps in zip(GATES_M, STEPS, strict=True):
        found = _round(own, state, range_sigma, gate, levels)
        if found is None:
            return None
        found = without_residuals(_settled(found, steps, tame_m=WILD_GATES * gate))
        levels, state = found.levels(), found.state
    if found is None:
        return None
    clocks, slips = Clocks(), None
    if own.twists is None:
        found, gradient = _with_gradient(with_residuals(found))
    else:
        jittering, system, clocks, slips = _with_jitter(found)
        gradient = system.b[: found.layout.plane]
        systems = [system]
        del system
        if jittering is not None:
            found, gradient = _with_gradient(_settled(jittering, LAST_STEPS, systems))
        systems.clear()
    # Handed over, as its prior on the poses with scans is not needed beside that on all.
    held = [found]
    del own, found
    return replace(_on_all_poses(held, problem, poses, gradient), clocks=clocks, slips=slips)


def solve_roughly(problem: Problem, start: Mapping[str, gtsam.Pose3]) -> Solved | None:
    """`solve_structure` with the fewest steps that find the strips: for what is not the result.

    All channels of a LiDAR are taken as alike.

    Raises:
        SolveError: the system is singular.
    """
    problem = replace(problem, beam_nodes=(), bent=False)
    range_sigma = range_sigmas(problem.patches, problem.range_sigma_m)
    state, levels = _rough(problem, start, range_sigma)
    found = _round(problem, state, range_sigma, GATES_M[0], levels)
    if found is None:
        return None
    settled = _settled(found, STEPS[0], tame_m=WILD_GATES * GATES_M[0])
    found, gradient = _with_gradient(settled)
    return _on_all_poses([found], problem, np.arange(len(problem.prior.stamps_ns)), gradient)


def measured_slip(problem: Problem, start: Mapping[str, gtsam.Pose3], slip: MountSlip) -> MountSlip:
    """The slip of one LiDAR with its size by a rough solve in which it is two LiDARs.

    The linear estimate is too small: what is seen from farther off than the gates is left out.

    Raises:
        SolveError: the system is singular.
    """
    names = problem.patches.lidars
    own = names.index(slip.lidars[0])
    apart = slipped_apart(problem, own, slip.since_s)
    before = start[names[own]]
    range_sigma = range_sigmas(apart.patches, apart.range_sigma_m)
    begun = {**start, apart.patches.lidars[-1]: before}
    state, _ = _rough(replace(apart, beam_nodes=(), bent=False), begun, range_sigma)
    T = state.T_vehicle_lidar
    return replace(slip, change=vehicle_axes_difference(T[-1], T[own]))


def _rough(
    problem: Problem, start: Mapping[str, gtsam.Pose3], range_sigma: Array
) -> tuple[State, Levels]:
    """The estimate after the rounds with wide gates, of some of the scans, and noise levels."""
    some, poses = with_scans(problem, some_scans(problem.patches))
    # Channels differ by less than these gates; their errors take half of the time of a step.
    some = replace(some, beam_nodes=(), bent=False)
    rough = first_state(some, start)
    levels = Levels.first(
        FIRST_SIGHTING_M, FIRST_SIGHTING_M, FIRST_SIGHTING_M, problem.range_errors
    )
    more, beam = sum(nodes.errors.size for nodes in problem.beam_nodes), 0
    for gate in ROUGH_GATES_M:
        found = _round(some, rough, range_sigma, gate, levels)
        if found is None:
            break
        found = without_residuals(_settled(found, 2, tame_m=WILD_GATES * gate, tilts=False))
        levels = replace(found.levels(), beams=None, bend_per_m=levels.bend_per_m)
        rough, beam = found.state, found.layout.beam
    if len(rough.errors):
        rough = replace(rough, errors=np.insert(rough.errors, np.full(more, beam), 0.0))
    return on_all_poses(problem.prior, poses, rough), levels


def _with_jitter(found: Estimate) -> tuple[Estimate | None, System, Clocks, ToldSlips]:
    """The same estimate with a jitter of every scan's stamp; None where the data show none.

    And its system. Where there is none, the jitters are its last coordinates, without a prior. And
    what they tell of clocks that are held, and what is told of mounts that slip.
    """
    problem = found.problem
    first, scans = found.layout.plane, len(problem.patches.stamps_ns)
    layout = replace(found.layout, jitters=scans)
    errors = np.insert(found.state.errors, np.full(scans, first), 0.0)
    state = replace(found.state, errors=errors)
    jittering = replace(found, state=state, layout=layout)
    give_back_freed_memory()
    system, of_slips = _linearised_with_slips([with_residuals(jittering)])
    give_back_freed_memory()
    # The hold in place, and out again: a copy would be as large as the system.
    held = slice(layout.offset, layout.error)
    without = system.H[held, held].copy(), system.b[held].copy()
    add_hold(problem, state, layout, system.H, system.b)
    with_held = system.b.copy()
    system.b[held] = without[1]
    # What is held is no evidence of a slip: a wrong guess would be one where little else is seen.
    both = np.column_stack([with_held, system.b])
    together, pull = told_of_jitters(system.H, both, layout, of_slips)
    system.H[held, held] = without[0]
    A, u = together[:scans, :scans], pull[:scans, 0]
    names = problem.patches.lidars
    clocks = Clocks()
    if not layout.offsets:
        clocks = Clocks.told(names, *told_clocks(A, u, problem.patches.scan_lidar, len(names)))
    sigma_s = jitter_sigma_s(A, u)
    told = told_slips(together, pull[:, 1], sigma_s, problem.patches.scan_lidar, len(names))
    slips = ToldSlips(names, problem.patches.stamps_ns, *told, state.T_vehicle_lidar)
    if sigma_s == 0.0:
        return None, system, clocks, slips
    own = np.arange(layout.jitter, layout.plane)
    system.H[own, own] += sigma_s**-2.0
    nuisances = replace(found.nuisances, jitter_s=sigma_s)
    return replace(jittering, nuisances=nuisances), system, clocks, slips


def _on_all_poses(
    held: list[Estimate], problem: Problem, poses: IntArray, gradient: Array
) -> Solved:
    """The estimate in `held`, taken out, with all poses of a drive, of which it has some (p,).

    Its information is without what dents of the ground tell. The steps use them: derivatives that
    are not those of the residuals do not lead to the estimate. `gradient` is with them.
    """
    found = held.pop()
    b = on_all_coordinates(gradient, problem.prior, poses)
    state = on_all_poses(problem.prior, poses, found.state)
    layout = replace(found.layout, poses=len(problem.prior.stamps_ns))
    found = replace(found, problem=problem, state=state, layout=layout)
    give_back_freed_memory()
    sighted = with_residuals(found, dents=False)
    offsets_m = sighted.geometry.offsets_m(found.sightings)
    plane_rows = sighted.geometry.plane_rows(found.sightings)
    handed = [sighted]
    del sighted
    system = replace(_linearised(handed), b=b)
    return Solved(**vars(found), system=system, offsets_m=offsets_m, plane_rows=plane_rows)


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
    if found is None:
        return None
    found, gradient = _with_gradient(with_residuals(found))
    return _on_all_poses([found], problem, np.arange(len(problem.prior.stamps_ns)), gradient)


def _round(
    problem: Problem,
    state: State,
    range_sigma: Array,
    gate_m: float,
    levels: Levels,
) -> Estimate | None:
    """New strips and sightings at an estimate."""
    placed = placed_patches(problem, state)
    strips = find_strips(placed.moments_map, placed.normals_map, problem.patches.scan, gate_m)
    if not strips.count:
        return None
    sightings = placed_sightings(problem, placed, strips, range_sigma)
    if not sightings.count:
        return None
    layout = layout_of(problem, strips)
    errors = np.zeros(layout.size)
    # The biases of the LiDARs go on; those on surfaces and strips, numbered anew, begin again.
    of_lidars = slice(layout.error, layout.turn)  # and of the vehicle's stand
    errors[of_lidars] = state.errors[of_lidars] if len(state.errors) else 0.0
    state = replace(
        state, centres_map=strips.centres_map, normals_map=strips.normals_map, errors=errors
    )
    nuisances = Nuisances(
        bias=levels.bias_m,
        incidence=problem.range_errors.incidence_m,
        ground=problem.range_errors.ground_m,
        ground_frame=problem.range_errors.ground_frame,
        surface=levels.surface_m,
        strip=np.full(strips.count, levels.strip_m),
        sighting=np.full(strips.count, levels.sighting_m),
        sighting_tilt=levels.sighting_m * np.where(strips.level, *levels.tilt_per_m),
        strip_tilt=np.where(strips.level, *levels.strip_tilt_rad),
        shared=levels.shared_m,
        repeated=0.0,
        beams=usual_sigmas(layout.beams, problem.range_errors)
        if levels.beams is None or not layout.beams
        else levels.beams,
        bend=np.where(strips.level, *levels.bend_per_m),
        turn_rad_s=problem.turn_rad_s,
        tilt_times=levels.tilt_times,
        lidar_offsets=levels.lidar_offsets,
    )
    weights = np.ones(sightings.count)
    unbent = np.ones(strips.count)
    return Estimate(
        problem, state, strips, sightings, weights, nuisances, layout, unbent, converged=False
    )


def _settled(
    found: Estimate,
    steps: int,
    systems: list[System] | None = None,
    tame_m: float = math.inf,
    tilts: bool = True,
) -> Sighted:
    """Gauss-Newton steps; after each one the noise levels and the robust weights.

    The system of the first step is taken out of `systems`, where it is there. While a step moves
    patches by more than `tame_m` there may be more than `steps`, up to `LAST_STEPS`.
    """
    held = [with_residuals(found)]
    for number in range(max(steps, LAST_STEPS)):
        # New strips, and each step, leave behind in pieces what the next one would come on top of.
        give_back_freed_memory()
        size, moved_m = _step(held, systems or [], tilts)
        if number > 0 and size < SMALL_SIGMAS:
            return replace(held.pop(), converged=True)
        if number + 1 >= steps and moved_m <= tame_m:
            break
    return replace(held.pop(), converged=False)


def _step(held: list[Sighted], systems: list[System], tilts: bool) -> tuple[float, float]:
    """Puts the estimate after a step in the place of the one in `held`.

    Returns the size of the step in sigmas of the extrinsics, and by how many metres some extrinsic
    moves the LiDAR's patches of median range, the vehicle held. The system is taken out of
    `systems`, where it is there.
    """
    found = without_residuals(held[0])
    problem, layout, sightings = found.problem, found.layout, found.sightings
    level, lidar = found.strips.level, problem.patches.scan_lidar[sightings.scan]
    own = found.nuisances.offsets(sightings.strip, lidar, level)
    sigma_m = np.hypot(own, found.nuisances.shared)
    seen = seen_signs(held[0].geometry, sightings, found.weights, layout, sigma_m)
    system = systems.pop() if systems else _linearised(held)
    held.clear()
    factor, b = _factor(found, system)
    d = system.surfaces.follow(solved(factor, b))
    give_back_freed_arrays()
    after = with_residuals(replace(found, state=stepped(found.state, layout, d)))
    geometry, state = after.geometry, after.state
    nuisances = fitted_noise(
        geometry,
        seen,
        sightings,
        groups_of(sightings, found.strips),
        lidar,
        problem.views,
        found.weights,
        partial(system.surfaces.solve, factor),
        partial(covariance_of, factor),
        layout,
        found.nuisances,
        state.errors,
        problem.range_errors,
        level,
        tilts,
    )
    own = nuisances.offsets(sightings.strip, lidar, level)
    by_offset = robust_weights(geometry.offsets_m(sightings), sightings, own, nuisances.shared)
    unbent = np.minimum(found.unbent, bend_weights(state.errors, layout, nuisances, level))
    of_ground = ground_weights(geometry, sightings, lidar, level) * unbent[sightings.strip]
    weights = np.minimum(by_offset, of_ground)
    step = d[layout.extrinsic : layout.error]
    cov = covariance_of(factor, np.arange(layout.extrinsic, layout.error))
    held.append(replace(after, weights=weights, nuisances=nuisances, unbent=unbent))
    sigmas = math.sqrt(float(step @ np.linalg.solve(cov, step)))
    turns, shifts = np.linalg.norm(step.reshape(-1, 2, 3), axis=2).T
    return sigmas, float(np.max(turns * problem.patches.reach_m + shifts))


def _factor(found: Estimate, system: System) -> tuple[tuple[Array, Array], Array]:
    """Factor of the system with the hold, which takes its memory, and its right-hand side."""
    add_hold(found.problem, found.state, found.layout, system.H, system.b)
    return factor_of(system.H, overwrite=True), system.b
