"""What structure says of extrinsics and poses: everything else eliminated."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
import scipy.linalg

from caliv_graph.common.memory import give_back_freed_memory
from caliv_graph.config.guesses import configured_guess
from caliv_graph.config.model import Config
from caliv_graph.config.range_errors import range_errors
from caliv_graph.errors import SolveError
from caliv_graph.geometry.quadratic import without_errors
from caliv_graph.geometry.se3 import unstack
from caliv_graph.products import Array, IntArray, MountSlip, Strip, StructureTerm
from caliv_graph.structure.align import align_patches
from caliv_graph.structure.beams import AZIMUTH, CHANNEL_KINDS, beam_nodes, parts_of
from caliv_graph.structure.elimination import factor_of, half_solved
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.prior import PosePrior
from caliv_graph.structure.problem import Problem, relative_motions
from caliv_graph.structure.read import level, lidars_above_ground
from caliv_graph.structure.relative import (
    held_sigmas,
    relative_problem,
    relative_quadratic,
    start_about,
)
from caliv_graph.structure.slips import SAID_SIGMAS
from caliv_graph.structure.solve import Solved, measured_slip, solve_structure
from caliv_graph.structure.stance import (
    STANDING,
    MeanTilt,
    mean_tilt,
    stance_of,
    standing_errors,
    strips_above_ground_m,
)
from caliv_graph.structure.standing import Standing
from caliv_graph.structure.strips import LEVEL
from caliv_graph.structure.thickness import (
    by_strip,
    thickness_at_estimate,
    thickness_at_guesses,
)
from caliv_graph.structure.turns import turn_sigmas
from caliv_graph.structure.views import views_of
from caliv_graph.trajectory.factors import tangent_size
from caliv_graph.trajectory.odometry import OdometryPoses
from caliv_graph.trajectory.select import (
    GivenTrajectory,
    VehicleTrajectory,
    accelerations_at,
    twists_at,
)


def structure_terms(
    patches: Sequence[DrivePatches],
    priors: Sequence[PosePrior],
    kept_ns: Sequence[IntArray],
    trajectories: Sequence[VehicleTrajectory],
    start: Mapping[str, gtsam.Pose3],
    held: Mapping[str, gtsam.Pose3],
    config: Config,
    free_offsets: frozenset[str],
    heave_m: float,
    aligned: bool,
    on_planes: Collection[tuple[int, str]] = (),
) -> tuple[StructureTerm, ...]:
    """The term of each drive that has structure.

    Args:
        patches: of each drive, those of the ground included.
        priors: per drive what the motion data say of the poses at the stamps of its patches' scans
            and at those that are kept.
        kept_ns: per drive the stamps of the poses that the terms are to be on, ascending.
        trajectories: of each drive, for the motion within sweeps.
        start: rough T_vehicle_lidar.
        held: those of LiDARs that a target has placed: the terms are linearised near them.
        config: guesses and noise.
        free_offsets: LiDARs whose time offset is estimated.
        heave_m: 1 sigma of the heave.
        aligned: the strips lie on each other at `start` already.
        on_planes: drives and LiDARs whose fitted ground planes stand where pieces are few.

    Raises:
        SolveError: a system is singular.
    """
    odometry = odometry_of(trajectories)
    if odometry is not None:
        start = start_about(odometry, start, config)
    if not aligned:
        start = aligned_start(patches, trajectories, start, config)
    out = []
    # Each is as large as a system: the one that the rates are added to is not kept.
    left = list(priors)
    del priors
    for own, kept, trajectory in zip(patches, kept_ns, trajectories, strict=True):
        prior = left.pop(0)
        of_drive = {name for drive, name in on_planes if drive == own.drive}
        used = usable(own, trajectory, start, config, of_drive)
        if not len(used.scan):
            continue
        used = used.followed(start)
        places = np.searchsorted(prior.stamps_ns, kept)
        problem = problem_of(used, prior, trajectory, config, heave_m, held, free_offsets)
        del prior
        if odometry is not None:
            problem = relative_problem(problem, odometry, start, config)
        # What the aligning and the solve leave behind in pieces would come on top of what follows.
        give_back_freed_memory()
        found = solve_structure(problem, start)
        if found is None:
            continue
        own_odometry = odometry_of([trajectory])
        slip = _slip(found, problem, own_odometry)
        del problem
        give_back_freed_memory()
        handed = [found]
        del found
        if own_odometry is None:
            out.append(replace(term_of(handed.pop(), places), slip=slip))
        else:
            term = term_of_odometry(handed.pop(), places, own_odometry, config)
            out.append(replace(term, slip=slip))
    return tuple(out)


def _slip(found: Solved, problem: Problem, odometry: OdometryPoses | None) -> MountSlip | None:
    """The slip that a solved drive would rather have; None: not tested."""
    if found.slips is None:
        return None
    slip = found.slips.slip()
    if odometry is not None and odometry.lidar not in (*slip.lidars, *slip.others):
        # Poses are of this LiDAR: if its mount slips, another one seems to.
        slip = replace(slip, others=(*slip.others, odometry.lidar))
    if len(slip.lidars) > 1 or slip.sigmas < SAID_SIGMAS:
        return slip
    start = dict(zip(problem.patches.lidars, found.state.T_vehicle_lidar, strict=True))
    try:
        return measured_slip(problem, start, slip)
    except SolveError:
        return slip


def odometry_of(trajectories: Sequence[VehicleTrajectory]) -> OdometryPoses | None:
    """The odometry of the first drive that has one; None: motion data tell the poses."""
    given = (t.odometry for t in trajectories if isinstance(t, GivenTrajectory))
    return next((odometry for odometry in given if odometry is not None), None)


def aligned_start(
    patches: Sequence[DrivePatches],
    trajectories: Sequence[VehicleTrajectory],
    start: Mapping[str, gtsam.Pose3],
    config: Config,
) -> Mapping[str, gtsam.Pose3]:
    """T_vehicle_lidar at which the strips are found first, from rough ones; trusted ones stay."""
    odometry = odometry_of(trajectories)
    if odometry is not None:
        held = held_sigmas(odometry, config)
    else:
        sigmas = {name: configured_guess(config, name).sigmas for name in config.lidars}
        held = {n: np.zeros(6) if config.lidars[n].fixed else s for n, s in sigmas.items()}
    return align_patches(patches, trajectories, start, held).T_vehicle_lidar


def usable(
    patches: DrivePatches,
    trajectory: VehicleTrajectory,
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
    config: Config,
    on_planes: Collection[str] = (),
) -> DrivePatches:
    """The patches without those of the ground of LiDARs for whose ground the strips do not stand.

    Of none they do where the config does without the ground. `on_planes` are as for
    `read.lidars_above_ground`.
    """
    standing = np.zeros(len(patches.lidars), dtype=bool)
    if config.ground.use:
        standing = lidars_above_ground(patches, trajectory, T_vehicle_lidar, on_planes)
    if standing.all():
        return patches
    is_level = level(patches, trajectory, T_vehicle_lidar)
    return patches.part(~is_level | standing[patches.scan_lidar[patches.scan]])


GROUND_SIGHTINGS = 50
"""Fewest sightings of level strips with which they stand for the ground planes of a LiDAR."""


PLACED_RAD, PLACED_M = 0.02, 0.1
"""1 sigma that holds a LiDAR where a target has placed it, roughly. Level ground alone leaves yaw,
x and y open. Linearised at a guess, 50 mrad of yaw away, a term turns the LiDAR by half of that
times every tilt that is found later: 0.1 mrad for 4 mrad, more than its sigma."""


def problem_of(
    patches: DrivePatches,
    prior: PosePrior,
    trajectory: VehicleTrajectory,
    config: Config,
    heave_m: float,
    held: Mapping[str, gtsam.Pose3],
    free_offsets: frozenset[str] = frozenset(),
) -> Problem:
    """What the solve of one drive is given; `held` are LiDARs that a target has placed."""
    offsets = tuple(i for i, name in enumerate(patches.lidars) if name in free_offsets)
    stamps = prior.stamps_ns.tolist()
    pose_of_scan = np.searchsorted(prior.stamps_ns, patches.stamps_ns)
    # An odometry is made of the same scans: its rates have no error apart from them.
    if patches.swept_scans.any() and odometry_of([trajectory]) is None:
        prior = prior.with_rates()
    guesses = {name: configured_guess(config, name) for name in patches.lidars}
    placed = np.repeat([PLACED_RAD, PLACED_M], 3)
    sigmas = [
        np.minimum(guess.sigmas, placed) if name in held else guess.sigmas
        for name, guess in guesses.items()
    ]
    return Problem(
        patches=patches,
        prior=prior,
        pose_of_scan=pose_of_scan,
        relative=relative_motions(patches, trajectory),
        twists=twists_at(trajectory, stamps),
        accelerations=accelerations_at(trajectory, stamps) if offsets else None,
        offsets=offsets,
        guesses=tuple(guess.T_vehicle_lidar for guess in guesses.values()),
        held_at=tuple(held.get(n, guess.T_vehicle_lidar) for n, guess in guesses.items()),
        held_information=np.diag(np.concatenate(sigmas) ** -2.0),
        range_sigma_m=config.noise.lidar_range_m,
        standing=standing_of(config, heave_m),
        views=views_of(patches, pose_of_scan, prior),
        range_errors=range_errors(config.noise),
        turn_rad_s=turn_sigmas(patches, pose_of_scan, trajectory),
        beam_nodes=beam_nodes(patches),
        bent=True,
    )


def standing_of(config: Config, heave_m: float) -> Standing:
    """What a config says of how the vehicle stands on the ground."""
    ground = config.ground
    tilt = ground.parallel_sigma_deg if ground.use else None
    return Standing(
        height_m=ground.vehicle_height if ground.use else None,
        height_sigma_m=ground.sigma,
        tilt_sigma_rad=None if tilt is None else math.radians(tilt),
        heave_m=heave_m,
        sway_rad=math.radians(config.noise.sway_deg),
    )


FRAME_PART = 1.0 / 60.0
"""Part of the tilt of strips from scan to scan that is alike in all of them, 1 sigma: what dents,
footprints, and beams that err otherwise than by channels do is not independent 3600 times over."""

FRAME_ARM_M = 5.0
"""Range at which a turn of the frame moves a surface by as much as its shift does."""


LASERS = 4
"""Lasers that take turns in a LiDAR whose beams are in no rows: Livox has 1 to 6. Each has an
azimuth of its own, and the mean of all is a turn of the LiDAR about its axis that nothing shows."""


def frame_sigmas(found: Solved) -> Array:
    """(L, 6) 1 sigma of turn (rad) and shift (m) of the frame in which a LiDAR sees all strips."""
    tilts, patches = found.nuisances.sighting_tilt, found.problem.patches
    turn_rad = FRAME_PART * float(np.median(tilts)) if len(tilts) else 0.0
    out = np.tile(np.repeat([turn_rad, FRAME_ARM_M * turn_rad], 3), (len(patches.lidars), 1))
    azimuth_rad = found.problem.range_errors.beam_priors[AZIMUTH].usual / math.sqrt(LASERS)
    out[sorted(patches.without_rows), 2] = math.hypot(turn_rad, azimuth_rad)
    return out


def term_of(found: Solved, kept: IntArray) -> StructureTerm:
    """The quadratic on the poses `kept` (m,), parameters, time offsets and extrinsics.

    The marginal of motion data and structure together, less that of the motion data alone, which
    are in the calibration's graph already. It lets go of `found` when it has what it needs of it:
    the matrices that follow are as large.
    """
    layout, system, prior = found.layout, found.system, found.problem.prior
    strips = strips_of(found)  # before the matrices below: it takes as much as they do
    poses = (6 * kept[:, None] + np.arange(6)).ravel()
    parameters = np.arange(6 * layout.poses, layout.rate)
    of_motion = np.concatenate([poses, parameters])
    keep = np.concatenate([of_motion, np.arange(layout.offset, layout.error)])
    by_now = _parameters_by_now(found)
    motion, motion_gradient = prior.marginal_at(found.state.moved, kept)
    # How the vehicle stands is kept at first: others test what is assumed of it.
    stand = np.arange(layout.standing, layout.standing + STANDING)
    tilt = mean_tilt(found)
    of_tilt = np.zeros((0, len(system.H))) if tilt is None else tilt.rows
    state, names = found.state, found.problem.patches.lidars
    above_m = strips_above_ground_m(found)
    term = partial(
        StructureTerm,
        drive=found.problem.patches.drive,
        stamps_ns=prior.stamps_ns[kept],
        T_map_vehicle=unstack(state.R_map_vehicle[kept], state.t_map_vehicle[kept]),
        parameters=_parameters(found),
        time_offsets_s={names[i]: float(state.offsets_s[i]) for i in layout.offsets},
        T_vehicle_lidar=dict(zip(names, state.T_vehicle_lidar, strict=True)),
        strips=strips,
        offset_m=float(np.median(found.nuisances.sighting)),
        ground=lidars_with_ground(found),
        clocks=found.clocks.late,
        clocks_apart=found.clocks.apart,
        channels=channel_sizes(found),
        warnings=(_no_ground(found.problem.patches.drive, above_m),) if above_m else (),
        on_ground=not above_m,
    )
    stated, frame = found.problem.standing, frame_sigmas(found)
    known, offset = prior.parameter_information, prior.parameter_offset
    b, held = system.b, [system.H]
    del found, system, prior
    give_back_freed_memory()
    both, both_gradient, rows, cov = _marginal(
        held.pop(), b, np.concatenate([keep, stand]), of_tilt
    )
    own = np.arange(len(poses), len(of_motion))
    _to_perturbations(motion, motion_gradient, own, by_now)
    # The graph of the calibration has the priors of the parameters.
    both[np.ix_(own, own)] -= known
    both_gradient[own] += known @ (offset + state.moved[parameters])
    _to_perturbations(both, both_gradient, own, by_now)
    rows[:, own] = rows[:, own] @ by_now
    if tilt is not None:
        tilt = MeanTilt(tilt.value + rows[:, -1], rows[:, :-1], tilt.cov + cov)
    frames = np.zeros((len(both), 6 * len(names)))
    frames[len(keep) - frames.shape[1] : len(keep)] = np.diag(frame.ravel())
    both, both_gradient = without_errors(both, both_gradient, frames)
    now = state.errors[stand]
    stance = stance_of(stated, float(now[0]), both, both_gradient, tilt)
    standing = standing_errors(stated, now, both, both_gradient)
    information, gradient, *_ = _marginal(both, both_gradient, np.arange(len(keep)))
    own_part = slice(0, len(of_motion))
    information[own_part, own_part] -= motion
    gradient[own_part] -= motion_gradient
    return term(
        information=information,
        gradient=gradient,
        stance=None if above_m else stance,
        standing=None if tilt is None else standing,
    )


def _no_ground(drive: int, above_m: float) -> str:
    """The warning that the level surfaces below the vehicle carry no wheels."""
    return (
        f"drive {drive + 1}: the level surfaces below the vehicle are {above_m:.2f} m above the "
        "ground by ground.vehicle_height: the wheels do not stand on them, and the height of the "
        "LiDARs is not told by it. Set min_range of the LiDARs beyond the vehicle's own body, and "
        "check ground.vehicle_height and the z of the guesses"
    )


def channel_sizes(found: Solved) -> dict[str, tuple[float, float, float]]:
    """LiDAR -> 1 sigma of range (m), elevation and azimuth (rad) of a channel, by the median one.

    Of the LiDARs whose channels are seen; between elevations errors are not those of channels.
    """
    out: dict[str, list[float]] = {}
    for lidar, _, own in parts_of(found.layout.beams):
        if found.layout.beams[lidar].kinds == CHANNEL_KINDS:
            name = found.problem.patches.lidars[lidar]
            out.setdefault(name, []).append(float(np.median(found.nuisances.beams[own])))
    return {name: (r, e, a) for name, (r, e, a) in out.items()}


def term_of_odometry(
    found: Solved, kept: IntArray, odometry: OdometryPoses, config: Config
) -> StructureTerm:
    """The term of a drive without motion data: it says nothing of the poses `kept` (m,)."""
    term = term_of(found, np.zeros(0, dtype=np.int64))
    names, T = found.problem.patches.lidars, found.state.T_vehicle_lidar
    at = names.index(odometry.lidar)
    H, b = relative_quadratic(term.information, term.gradient, T, at)
    if odometry.statement is not None:
        own = slice(6 * at, 6 * at + 6)
        said, pull = odometry.statement.gaussian(T[at], config.ground.vehicle_height)
        H[own, own] += said
        b[own] += pull
    size = 6 * len(kept)
    information = np.zeros((size + len(b), size + len(b)))
    information[size:, size:] = H
    state = found.state
    return replace(
        term,
        stance=None,
        standing=None,
        clocks={},
        clocks_apart={},
        stamps_ns=found.problem.prior.stamps_ns[kept],
        T_map_vehicle=unstack(state.R_map_vehicle[kept], state.t_map_vehicle[kept]),
        information=information,
        gradient=np.concatenate([np.zeros(size), b]),
        odometry_of=odometry.lidar,
    )


def lidars_with_ground(found: Solved) -> frozenset[str]:
    """LiDARs of which level strips determine the ground."""
    level_strips = found.state.normals_map[:, 2] > LEVEL
    own = level_strips[found.sightings.strip] & (found.weights > 0.0)
    lidar = found.problem.patches.scan_lidar[found.sightings.scan]
    names = found.problem.patches.lidars
    count = np.bincount(lidar[own], minlength=len(names))
    return frozenset(n for n, c in zip(names, count, strict=True) if c >= GROUND_SIGHTINGS)


def _marginal(
    H: Array, b: Array, keep: IntArray, rows: Array | None = None
) -> tuple[Array, Array, Array, Array]:
    """The quadratic with all coordinates but `keep` (k,) eliminated, and rows (r, D) on `keep`.

    Information (k, k) and gradient (k,); the rows (r, k + 1), the rest following `keep`, what they
    are at its zero last; and their covariance (r, r) by the rest, `keep` being known. It lets go of
    H when it has its parts.
    """
    rest = np.ones(len(H), dtype=bool)
    rest[keep] = False
    inside = H[np.ix_(keep, keep)]
    rows = np.zeros((0, len(H))) if rows is None else rows
    on_keep, on_rest = rows[:, keep], rows[:, rest]
    if not rest.any():
        on_zero = np.column_stack([on_keep, np.zeros(len(rows))])
        return inside.copy(), b[keep].copy(), on_zero, np.zeros((len(rows), len(rows)))
    right = np.column_stack([H[np.ix_(keep, rest)].T, b[rest], on_rest.T])
    of_rest = [H[np.ix_(rest, rest)]]
    del H
    half = half_solved(factor_of(of_rest.pop(), overwrite=True), right)
    known = half.T @ half
    k = len(keep)
    information = inside - known[:k, :k]
    follow = known[k + 1 :, : k + 1]
    return (
        0.5 * (information + information.T),
        b[keep] - known[:k, k],
        np.column_stack([on_keep - follow[:, :-1], follow[:, -1]]),
        known[k + 1 :, k + 1 :],
    )


def _parameters(found: Solved) -> dict[str, Array | gtsam.Rot3]:
    """Parameters of the vehicle at the estimate."""
    out: dict[str, Array | gtsam.Rot3] = {}
    at = 6 * found.layout.poses
    for name, value in found.problem.prior.parameters.items():
        d = found.state.moved[at : at + tangent_size(value)]
        at += len(d)
        out[name] = value.retract(d) if isinstance(value, gtsam.Rot3) else value + d
    return out


def _parameters_by_now(found: Solved) -> Array:
    """(p, p) derivative of where the parameters are from their prior by right perturbations."""
    at, blocks = 6 * found.layout.poses, [np.zeros((0, 0))]
    for value in found.problem.prior.parameters.values():
        moved = found.state.moved[at : at + tangent_size(value)]
        at += len(moved)
        turns = isinstance(value, gtsam.Rot3)
        blocks.append(gtsam.Rot3.LogmapDerivative(moved) if turns else np.eye(len(moved)))
    return np.asarray(scipy.linalg.block_diag(*blocks), np.float64)


def _to_perturbations(H: Array, b: Array, parameters: IntArray, by_now: Array) -> None:
    """Makes the parameters of a quadratic right perturbations of where they are now, in place."""
    H[parameters] = by_now.T @ H[parameters]
    H[:, parameters] = H[:, parameters] @ by_now
    b[parameters] = by_now.T @ b[parameters]


def strips_of(found: Solved) -> tuple[Strip, ...]:
    """The strips at the estimate, for the report."""
    patches, strips, sightings = found.problem.patches, found.strips, found.sightings
    lidar = patches.scan_lidar[sightings.scan]
    weight = found.weights * sightings.moments[:, 3, 3]
    out = []
    before_m, after_m = thickness_at_guesses(found), thickness_at_estimate(found)
    for k, own in enumerate(by_strip(sightings, strips.count)):
        scans, residuals = {}, {}
        for i, name in enumerate(patches.lidars):
            of_lidar = own[lidar[own] == i]
            total = float(weight[of_lidar].sum())
            if total > 0.0:
                scans[name] = len(of_lidar)
                residuals[name] = float(found.offsets_m[of_lidar] @ weight[of_lidar]) / total
        out.append(
            Strip(
                drive=patches.drive,
                surface=int(strips.surface[k]),
                centre_map=found.state.centres_map[k],
                normal_map=found.state.normals_map[k],
                scans=scans,
                residuals_m=residuals,
                scatter_m=float(after_m[k]),
                before_m=float(before_m[k]),
                weight=float(found.weights[own].mean()) if len(own) else 0.0,
            )
        )
    return tuple(out)
