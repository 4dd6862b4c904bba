"""Distances of points from their strips, and their derivatives by all variables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import scipy.sparse

from caliv_graph.config.range_errors import GROUND_FRAME
from caliv_graph.geometry.se3 import skew, stack, tangent_axes, twist_by_turn
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.beams import SeenBeams
from caliv_graph.structure.bends import BENDS
from caliv_graph.structure.layout import BIASES, Layout, State
from caliv_graph.structure.sightings import Sightings
from caliv_graph.structure.strips import LEVEL
from caliv_graph.trajectory.imu import exp_so3
from caliv_graph.trajectory.rates import by_rates

DENT_RAD = 0.05
"""Largest angle of a strip to its tile that is a dent of the ground. What is steeper, such as a
bonnet, is a surface of its own."""


EXTRINSIC_ROWS = slice(6, 12)
"""Where the derivatives by the extrinsic are in `Geometry.by`: after the pose."""

PLANE_ROWS = slice(12, 15)
"""Where the derivatives by the plane are in `Geometry.by`: after pose and extrinsic."""

BEAM_ROWS = 20
"""Where those by errors of the beams begin: after the plane and five errors of the LiDAR."""


@dataclass(frozen=True)
class Geometry:
    """Residuals of all sightings as linear functions of h = (p, 1), and their derivatives.

    Attributes:
        plain: (Q, 4) the residual, metres.
        placed: (Q, 4) the part of it that is by places of points, not by errors of their beams.
        by: (Q, C, 4) its derivatives.
        columns: (Q, C) coordinates of these.
        normals_lidar: (Q, 3) normals of the strips in the lidar frame at the scan's stamp.
        beams: what of `by` is by errors of the beams; None: they have none.
    """

    plain: Array
    placed: Array
    by: Array
    columns: IntArray
    normals_lidar: Array
    beams: SeenBeams | None = None

    def offsets_m(self, sightings: Sightings) -> Array:
        """(Q,) distance of the middle of each sighting from its plane."""
        return np.asarray(np.einsum("qi,qi->q", self.plain, _middles(sightings)))

    def plane_rows(self, sightings: Sightings) -> Array:
        """(Q, 3) derivatives of `offsets_m` by the planes."""
        return np.asarray(np.einsum("qci,qi->qc", self.by[:, PLANE_ROWS], _middles(sightings)))

    def offset_rows(self, sightings: Sightings, size: int) -> scipy.sparse.csr_array:
        """(Q, `size`) derivatives of `offsets_m`."""
        data = np.einsum("qci,qi->qc", self.by, _middles(sightings))
        return rows_of(data[:, None], self.columns, size)


def _middles(sightings: Sightings) -> Array:
    centroid = sightings.centroids_lidar
    return np.concatenate([centroid, np.ones((len(centroid), 1))], axis=1)


def rows_of(data: Array, columns: IntArray, size: int) -> scipy.sparse.csr_array:
    """A sparse matrix (r q, `size`) of r rows (q, r, C) each with the same columns (q, C)."""
    q, r, c = data.shape
    column = np.repeat(columns.astype(np.int32), r, axis=0).ravel()
    ends = np.arange(0, q * r * c + 1, c, dtype=np.int32)
    return scipy.sparse.csr_array((data.ravel(), column, ends), shape=(q * r, size))


def lidar_poses(
    state: State,
    lidar: IntArray,
    pose: IntArray,
    twists: Array | None,
    accelerations: Array | None = None,
) -> tuple[Array, Array]:
    """R_map_lidar (Q, 3, 3) and t_map_lidar (Q, 3) of LiDARs at poses, time offsets included.

    `twists` and `accelerations` as in `geometry_of`.
    """
    late = _late_motion(state, lidar, pose, _turned(state, twists), _turned(state, accelerations))
    return _in_map(state, pose, *_lidars_at_stamps(state, lidar, pose, late))


def _turned(state: State, twists: Array | None) -> Array | None:
    """(M, 6) twists (M, 6) of the first poses, in the axes of the present ones; None: of None.

    The velocities in the map are what is known. A vehicle whose axes nobody knows (`rpy_deg: null`)
    turns by 30 mrad and more until all is solved: its yaw rate held in its own axes, a time offset
    would tilt each scan in a curve.
    """
    if twists is None:
        return None
    R = exp_so3(state.moved[: 6 * len(twists)].reshape(-1, 6)[:, :3])
    turn, shift = twists[:, :3], twists[:, 3:]
    # The axes turn about the pivot of the chart: their origin moves to another point of the body.
    pivot = state.chart.pivot_vehicle
    shift = shift + np.cross(turn, pivot - R @ pivot)
    return np.asarray(np.einsum("mji,mkj->mki", R, np.stack([turn, shift], 1)).reshape(-1, 6))


def _late_motion(
    state: State, lidar: IntArray, pose: IntArray, twists: Array | None, accelerations: Array | None
) -> Array | None:
    """(Q, 6) motion from the stamp back to the late scan itself, `-o (xi - o a / 2)`.

    Of twists and accelerations in present axes; None where no LiDAR is late.
    """
    if twists is None or not state.offsets_s.any():
        return None
    offset_s = state.offsets_s[lidar][:, None]
    if accelerations is None:
        return -offset_s * twists[pose]
    return -offset_s * (twists[pose] - 0.5 * offset_s * accelerations[pose])


def _lidars_at_stamps(
    state: State, lidar: IntArray, pose: IntArray, late: Array | None
) -> tuple[Sequence[gtsam.Pose3], IntArray]:
    """Where LiDARs of late scans are, from the vehicle at the stamps, and (Q,) which is whose.

    `Exp(late) E`, `late` (Q, 6) the same for the same LiDAR and pose; None: none is.
    """
    if late is None:
        return state.T_vehicle_lidar, lidar
    both = pose * len(state.offsets_s) + lidar
    _, first, own = np.unique(both, return_index=True, return_inverse=True)
    T = [gtsam.Pose3.Expmap(late[q]).compose(state.T_vehicle_lidar[lidar[q]]) for q in first]
    return T, own


def _in_map(
    state: State, pose: IntArray, T_vehicle_lidar: Sequence[gtsam.Pose3], own: IntArray
) -> tuple[Array, Array]:
    """R_map_lidar (Q, 3, 3) and t_map_lidar (Q, 3) at poses, `own` (Q,) says of which LiDAR."""
    R_e, t_e = stack(T_vehicle_lidar)
    R_v, t_v = state.R_map_vehicle[pose], state.t_map_vehicle[pose]
    return R_v @ R_e[own], t_v + np.einsum("qij,qj->qi", R_v, t_e[own])


def _inverse_adjoints(poses: Sequence[gtsam.Pose3]) -> Array:
    """(n, 6, 6) right perturbations of `X T` by right ones of X, of n poses T."""
    return np.array([np.asarray(T.inverse().AdjointMap()) for T in poses])


def geometry_of(
    state: State,
    sightings: Sightings,
    layout: Layout,
    lidar: IntArray,
    pose: IntArray,
    twists: Array | None,
    dents: bool = True,
    turn: IntArray | None = None,
    accelerations: Array | None = None,
) -> Geometry:
    """Residuals `n^T (L p - c)` of the points of all sightings, as functions of h = (p, 1).

    Args:
        state: where they are linearised.
        sightings: Q of them.
        layout: the coordinates.
        lidar: (Q,) index of the LiDAR of each.
        pose: (Q,) index of the pose of each.
        twists: (M, 6) velocity at each pose, right perturbation per second; None: no offset is
            free.
        dents: whether dents of the ground tell where a LiDAR is (`smooth_normals`).
        turn: (Q,) which error of the angular velocity each has, where the layout has any.
        accelerations: (M, 6) change of `twists` per second, for clouds that are late; None: zero.
    """
    q = sightings.count
    strip = sightings.strip
    surface = np.array(layout.surface_of, dtype=np.int64)[strip]
    pivot = state.chart.pivot_vehicle
    now, change = _turned(state, twists), _turned(state, accelerations)
    late = _late_motion(state, lidar, pose, now, change)
    at_stamps, own_stamp = _lidars_at_stamps(state, lidar, pose, late)
    R, t = _in_map(state, pose, at_stamps, own_stamp)
    centre, normal = state.centres_map[strip], state.normals_map[strip]
    m = np.einsum("qji,qj->qi", R, normal)
    error_columns = _error_columns(layout, lidar, surface, strip)
    by_error = _by_error(sightings, normal[:, 2] > LEVEL)

    plain = np.zeros((q, 4))
    plain[:, :3] = m
    plain[:, 3] = np.einsum("qi,qi->q", normal, t - centre)
    of_beams = np.einsum("qe,qei->qi", state.errors[error_columns], by_error)

    normals = state.normals_map if dents else smooth_normals(state.normals_map, layout)
    smooth = np.einsum("qji,qj->qi", R, normals[strip])
    by_extrinsic = np.zeros((q, 6, 4))
    by_extrinsic[:, :3, :3] = -skew(smooth)
    by_extrinsic[:, 3:, 3] = smooth
    back = _inverse_adjoints(state.T_vehicle_lidar)
    by_pose = np.swapaxes(back[lidar], 1, 2) @ by_extrinsic
    by_own_pose = by_pose
    if late is not None:
        at_scans = _inverse_adjoints(at_stamps)[own_stamp]
        by_own_pose = np.swapaxes(at_scans, 1, 2) @ by_extrinsic
        by_own_pose[:, :3] += np.swapaxes(twist_by_turn(late, pivot), 1, 2) @ by_pose
    if twists is not None and now is not None and layout.rates:
        apart_s = sightings.time_s[:, None]
        # Points of other times were moved to the stamp with these twists and extrinsics, and are
        # to be with the present ones.
        made_with = _inverse_adjoints(sightings.T_vehicle_lidar)[lidar]
        before = np.einsum("qij,qj->qi", made_with, twists[pose])
        present = np.einsum("qij,qj->qi", back[lidar], now[pose])
        plain += np.einsum("qc,qci->qi", apart_s * (present - before), by_extrinsic)
        by_turn = np.swapaxes(twist_by_turn(apart_s * now[pose], pivot), 1, 2) @ by_pose
        by_own_pose = np.concatenate([by_own_pose[:, :3] + by_turn, by_own_pose[:, 3:]], axis=1)
        by_extrinsic = by_extrinsic + _by_compensation(sightings.time_s, present, by_extrinsic)
    B = tangent_axes(normal)
    by_plane = np.zeros((q, 3, 4))
    by_plane[:, :2, :3] = B @ R
    by_plane[:, :2, 3] = np.einsum("qki,qi->qk", B, t - centre)
    by_plane[:, 2, 3] = -1.0
    parts = [by_own_pose, by_extrinsic, by_plane, by_error]
    columns = [
        6 * pose[:, None] + np.arange(6),
        layout.extrinsic + 6 * lidar[:, None] + np.arange(6),
        layout.plane + 3 * strip[:, None] + np.arange(3),
        error_columns,
    ]
    then, swept = None if now is None else now[pose], None
    if then is not None and change is not None:
        # Points of a late sweep moved with the velocity of then.
        offset_s = state.offsets_s[lidar][:, None]
        swept = -sightings.time_s[:, None] * change[pose]
        plain += np.einsum("qc,qci->qi", offset_s * swept, by_pose)
        then = then - offset_s * change[pose]
    moved = _by_motion(state, sightings, layout, lidar, then, swept, by_pose)
    if layout.turns and turn is not None:
        # What the gyroscope erred since the stamp: X Exp(tau w) in the place of X.
        own = layout.turn + 3 * turn[:, None] + np.arange(3)
        by_turn_rate = sightings.time_s[:, None, None] * by_pose[:, :3]
        moved.append((by_turn_rate, own, state.errors[own]))
    beams = sightings.beams
    if beams is not None:
        beams = beams.turned(by_extrinsic[:, 2])
        own = layout.beam + beams.column
        of_beams += np.einsum("qc,qci->qi", state.errors[own], beams.by)
        parts.append(beams.by)
        columns.append(own)
    if layout.ground_frames:
        own = layout.ground_frame + GROUND_FRAME * lidar[:, None] + np.arange(GROUND_FRAME)
        ground = normal[:, 2] > LEVEL
        by_frame = np.zeros((q, GROUND_FRAME, 4))
        by_frame[ground, :3] = by_extrinsic[ground, :3]
        by_frame[ground, 3, 3] = 1.0
        moved.append((by_frame, own, state.errors[own]))
    if layout.bent:
        own = layout.bend + layout.strips * np.arange(BENDS) + strip[:, None]
        bends = np.zeros((q, BENDS, 4)) if sightings.bends is None else sightings.bends
        moved.append((bends, own, state.errors[own]))
    for by, own, value in moved:
        plain += np.einsum("qc,qci->qi", value, by)
        parts.append(by)
        columns.append(own)
    by, column = np.concatenate(parts, axis=1), np.concatenate(columns, axis=1)
    return Geometry(plain + of_beams, plain, by, column, m, _beams_within(sightings, by))


def joined(parts: Iterable[Geometry], sightings: Sightings) -> Geometry:
    """The residuals of all sightings, from those of some at a time, in their order."""
    whole: list[Array] = []
    begin = 0
    for part in parts:
        some = [part.plain, part.placed, part.by, part.columns, part.normals_lidar]
        whole = whole or [np.empty((sightings.count, *of.shape[1:]), of.dtype) for of in some]
        own = slice(begin, begin + len(part.plain))
        for to, of in zip(whole, some, strict=True):
            to[own] = of
        begin = own.stop
    plain, placed, by, columns, normals_lidar = whole
    beams = _beams_within(sightings, by)
    return Geometry(plain, placed, by, np.asarray(columns, np.int64), normals_lidar, beams)


def _beams_within(sightings: Sightings, by: Array) -> SeenBeams | None:
    """What errors of the beams do, within all derivatives.

    No second copy: of many channels it is half of all.
    """
    beams = sightings.beams
    if beams is None:
        return None
    return replace(beams, by=by[:, BEAM_ROWS : BEAM_ROWS + beams.column.shape[1]])


def _by_compensation(time_s: Array, twists_lidar: Array, by_extrinsic: Array) -> Array:
    """(Q, 6, 4) further derivatives by the extrinsic: points were moved in time with it.

    A point taken tau later is at `X Exp(tau xi) E p`: a right perturbation of E there is one by
    `Ad(Exp(tau xi_lidar))` at the stamp. With it, a turn of the LiDAR on the vehicle that the
    vehicle's poses make up for is told by nothing, the rates following the poses.
    """
    turn, shift = skew(twists_lidar[:, :3]), skew(twists_lidar[:, 3:])
    ad = np.zeros((len(time_s), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = turn
    ad[:, 3:, :3] = shift
    return np.asarray(time_s[:, None, None] * (np.swapaxes(ad, 1, 2) @ by_extrinsic))


def _by_motion(
    state: State,
    sightings: Sightings,
    layout: Layout,
    lidar: IntArray,
    twists: Array | None,
    swept: Array | None,
    by_pose: Array,
) -> list[tuple[Array, IntArray, Array]]:
    """What moves a whole scan, or its points by their times, as errors of its pose do.

    Each with its derivatives (Q, c, 4), their coordinates (Q, c), and the values (Q, c) that are
    not in the poses of `state` yet. `twists` (Q, 6) are those when the points were taken, `swept`
    (Q, 6) the motion within the sweep by a second of lateness; None: none.
    """
    q = sightings.count
    out = []
    if layout.rates:
        # Points taken tau later: X Exp(tau e) in the place of X.
        own = np.broadcast_to(layout.rate + np.arange(layout.rates), (q, layout.rates))
        turning = np.zeros((q, 3)) if twists is None else twists[:, :3]
        by_errors = np.swapaxes(by_rates(turning), 1, 2) @ by_pose
        out.append((sightings.time_s[:, None, None] * by_errors, own, state.moved[own]))
    if twists is None or not (layout.offsets or layout.jitters):
        return out
    by_time = -np.einsum("qi,qij->qj", twists, by_pose)[:, None]
    if layout.jitters:
        own = layout.jitter + sightings.scan[:, None]
        out.append((by_time, own, state.errors[own]))
    if layout.offsets:
        by_offset = by_time.copy()
        if swept is not None:
            by_offset += np.einsum("qi,qij->qj", swept, by_pose)[:, None]
        place = np.full(layout.lidars, -1)
        place[list(layout.offsets)] = layout.offset + np.arange(len(layout.offsets))
        by_offset[place[lidar] < 0] = 0.0
        out.append((by_offset, np.maximum(place[lidar], 0)[:, None], np.zeros((q, 1))))
    return out


def smooth_normals(normals_map: Array, layout: Layout) -> Array:
    """(K, 3) normals by which a motion of a LiDAR changes the distances from the strips.

    Of level strips that of their tile: dents of the ground are no flat pieces, and which of them a
    beam meets depends on where it falls. They tell height and tilt, a ramp tells more.
    """
    surface = np.array(layout.surface_of, dtype=np.int64)
    level = normals_map[:, 2] > LEVEL
    total = np.stack([np.bincount(surface, n, layout.surfaces) for n in normals_map.T], axis=1)
    mean = total / np.linalg.norm(total, axis=1)[:, None]
    dent = level & (np.einsum("ki,ki->k", mean[surface], normals_map) > math.cos(DENT_RAD))
    return np.where(dent[:, None], mean[surface], normals_map)


def _error_columns(layout: Layout, lidar: IntArray, surface: IntArray, strip: IntArray) -> IntArray:
    """(Q, 5) columns of the errors of each sighting, in the order of `_by_error`."""
    of_surface = layout.surface_error + layout.surfaces * lidar + surface
    of_strip = layout.strip_error + layout.strips * lidar + strip
    first = layout.error + BIASES * lidar
    return np.stack([first, first + 1, first + 2, of_surface, of_strip], axis=1)


def _by_error(sightings: Sightings, level: BoolArray) -> Array:
    """(Q, 5, 4) what each error of a LiDAR adds to the residual, linear in h = (p, 1).

    Errors: bias of the ranges (`sightings.seen_ranges`), its growth with 1 / cos(incidence), bias
    on the ground (`level` strips), bias on the surface, offset on the strip.
    """
    out = np.zeros((sightings.count, 5, 4))
    out[:, 4, 3] = 1.0
    by_range = sightings.by_range
    if by_range is None:
        return out
    out[:, 0] = by_range
    out[:, 1] = -by_range
    out[:, 1, 3] += 1.0
    out[:, 2] = np.where(level[:, None], by_range, 0.0)
    out[:, 3] = by_range
    return out
