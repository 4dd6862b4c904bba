"""The variables of structure: where each stands, an estimate of them, and a step from it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import gtsam
import numpy as np

from caliv_graph.config.range_errors import GROUND_FRAME
from caliv_graph.geometry.chart import PoseChart
from caliv_graph.geometry.se3 import stack, tangent_axes
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.structure.beams import BeamErrors
from caliv_graph.structure.bends import BENDS
from caliv_graph.trajectory.imu import exp_so3

BIASES = 3
"""Biases of a LiDAR that hold for the whole drive: bias, growth with incidence, on the ground."""


@dataclass(frozen=True)
class Nuisances:
    """1 sigma of errors of the LiDARs that are estimated beside all else, metres.

    Attributes:
        bias: bias of the ranges of a LiDAR.
        incidence: growth of that bias with 1 / cos(incidence).
        ground: bias of a LiDAR on all level strips: asphalt is darker than walls are.
        surface: bias of a LiDAR on a surface: colour, gloss.
        strip: (K,) how far a LiDAR sees each strip from where others do: bumps, other beams.
        bend: (K,) of the bends of each strip, 1/m (`bends.py`); not metres.
        sighting: (K,) offset of each strip from scan to scan.
        sighting_tilt: (K,) tilt of each strip from scan to scan, rad; not metres.
        strip_tilt: (K,) tilt that a LiDAR sees each strip have in all scans against what others
            see, rad; not metres.
        lidar_offsets: (L, 2) what a LiDAR adds to `sighting`, on level strips and on others: noise
            that is more than it seems. Zero of the LiDAR that has the least; empty: of all.
        tilt_times: (L, 2) how much larger both tilts are of each LiDAR, on level strips and on
            others; empty: of none.
        shared: offset of a surface from scan to scan, which its strips share: incidence, and how
            the beams fall, change along a wall slowly.
        repeated: share of the variances of `sighting` and `shared` that is the same in all scans
            from one place, beyond what `strip` has of it.
        ground_frame: (4,) turn, rad, and height in which a LiDAR sees all level strips.
        beams: (E,) of the errors of the beams of all LiDARs, as in `Layout.beams`: m, rad, rad,
            m/rad, rad/rad, by their kinds.
        jitter_s: of the stamp of each scan, s; 0: no such variables.
        turn_rad_s: (P, 3) of the angular velocity within scans (`Problem.turn_rad_s`); not metres.
    """

    bias: float
    incidence: float
    ground: float
    surface: float
    strip: Array
    sighting: Array
    sighting_tilt: Array
    strip_tilt: Array
    shared: float
    repeated: float
    ground_frame: Array = field(default_factory=partial(np.zeros, GROUND_FRAME))
    beams: Array = field(default_factory=lambda: np.zeros(0))
    bend: Array = field(default_factory=lambda: np.zeros(0))
    jitter_s: float = 0.0
    turn_rad_s: Array = field(default_factory=lambda: np.zeros((0, 3)))
    tilt_times: Array = field(default_factory=lambda: np.zeros((0, 2)))
    lidar_offsets: Array = field(default_factory=lambda: np.zeros((0, 2)))

    def of_lidar(self, strip: IntArray, lidar: IntArray, level: BoolArray) -> Array:
        """(n,) `lidar_offsets` on strips (n,) of LiDARs (n,); `level` (K,) as in `tilts`."""
        if not len(self.lidar_offsets):
            return np.zeros(len(strip))
        return self.lidar_offsets[lidar, np.where(level[strip], 0, 1)]

    def offsets(self, strip: IntArray, lidar: IntArray, level: BoolArray) -> Array:
        """(n,) offset of strips (n,) from scan to scan as LiDARs (n,) see them."""
        return np.hypot(self.sighting[strip], self.of_lidar(strip, lidar, level))

    def errors(
        self, strip: IntArray, lidar: IntArray, level: BoolArray
    ) -> tuple[Array, Array, Array]:
        """`offsets` and both `tilts`."""
        return self.offsets(strip, lidar, level), *self.tilts(strip, lidar, level)

    def tilts(self, strip: IntArray, lidar: IntArray, level: BoolArray) -> tuple[Array, Array]:
        """(n,) `sighting_tilt` and `strip_tilt` of strips (n,) as LiDARs (n,) see them.

        `level` (K,) are the strips that are ground.
        """
        own, repeated = self.sighting_tilt[strip], self.strip_tilt[strip]
        if not len(self.tilt_times):
            return own, repeated
        times = self.tilt_times[lidar, np.where(level[strip], 0, 1)]
        return own * times, repeated * times


@dataclass(frozen=True)
class State:
    """An estimate; M poses, n LiDARs, K strips.

    Attributes:
        R_map_vehicle: (M, 3, 3).
        t_map_vehicle: (M, 3) metres.
        moved: (6 M + p,) where poses and parameters of the vehicle are from the pose prior, T0 of
            a pose: `T0^-1 T` in `chart`; with the errors of the rates, `rates` more.
        T_vehicle_lidar: n poses.
        offsets_s: (n,) time offsets; zero where they are not free.
        centres_map: (K, 3) points of the planes.
        normals_map: (K, 3).
        errors: (D,) errors of LiDARs, height and tilt, bends at their coordinates; else zero.
        chart: of `moved`.
    """

    R_map_vehicle: Array
    t_map_vehicle: Array
    moved: Array
    T_vehicle_lidar: tuple[gtsam.Pose3, ...]
    offsets_s: Array
    centres_map: Array
    normals_map: Array
    errors: Array
    chart: PoseChart = field(default_factory=PoseChart)


@dataclass(frozen=True)
class Layout:
    """Where each variable is among the D coordinates of the system.

    In this order: poses (6 each), parameters of the vehicle, errors of the rates by which points
    were moved (`rates`, if any were), time offsets, extrinsics (6), bias of each LiDAR, its growth
    with incidence, and that on the ground (3), errors of the beams of each LiDAR, if they err
    (kind by kind, of each all nodes), frame in which each LiDAR sees the ground, if it is rough
    (turn in lidar axes and height, 4), error of the vehicle's height and tilt above the ground (3),
    errors of the angular velocity within the scans at each pose, if there are any (3), jitter of
    the stamp of each scan, if there is any; and what belongs to one surface each: planes (two
    tilts, offset), bends of each strip, if they are bent (`BENDS` times K), bias of each LiDAR on
    each surface, offset of each LiDAR on each strip.
    """

    poses: int
    parameters: int
    offsets: tuple[int, ...]
    lidars: int
    surface_of: tuple[int, ...]
    jitters: int = 0
    rates: int = 0
    turns: int = 0
    beams: tuple[BeamErrors, ...] = ()
    bent: bool = False
    ground_frames: int = 0

    @property
    def strips(self) -> int:
        """K."""
        return len(self.surface_of)

    @property
    def surfaces(self) -> int:
        """Number of surfaces."""
        return max(self.surface_of, default=-1) + 1

    @property
    def rate(self) -> int:
        """First error of the rates."""
        return 6 * self.poses + self.parameters

    @property
    def offset(self) -> int:
        """First time offset; before it is what the pose prior is on."""
        return self.rate + self.rates

    @property
    def extrinsic(self) -> int:
        """First coordinate of the extrinsics."""
        return self.offset + len(self.offsets)

    @property
    def error(self) -> int:
        """First coordinate of the biases of the LiDARs."""
        return self.extrinsic + 6 * self.lidars

    @property
    def plane(self) -> int:
        """First coordinate of the planes, and of all that belongs to one surface."""
        return self.jitter + self.jitters

    @property
    def turn(self) -> int:
        """First error of the angular velocity within the scans at a pose."""
        return self.standing + 3

    @property
    def jitter(self) -> int:
        """First jitter of a stamp."""
        return self.turn + self.turns

    @property
    def standing(self) -> int:
        """Error of the vehicle's height above ground, and the two of its tilt."""
        return self.ground_frame + GROUND_FRAME * self.ground_frames

    @property
    def ground_frame(self) -> int:
        """First turn in which a LiDAR sees the ground; after the errors of the beams."""
        return self.beam + sum(errors.size for errors in self.beams)

    @property
    def beam(self) -> int:
        """First error of the beams of a LiDAR at some elevation."""
        return self.error + BIASES * self.lidars

    @property
    def bend(self) -> int:
        """First bend of a strip; after the planes."""
        return self.plane + 3 * self.strips

    @property
    def surface_error(self) -> int:
        """First bias of a LiDAR on a surface."""
        return self.bend + BENDS * self.strips * self.bent

    @property
    def strip_error(self) -> int:
        """First offset of a LiDAR on a strip."""
        return self.surface_error + self.lidars * self.surfaces

    @property
    def size(self) -> int:
        """D."""
        return self.strip_error + self.lidars * self.strips

    def error_columns(self) -> IntArray:
        """Coordinates of all errors of the LiDARs and of bends, as in `error_sigmas`."""
        return np.concatenate(
            [np.arange(self.error, self.standing), np.arange(self.bend, self.size)]
        )

    def error_sigmas(self, nuisances: Nuisances) -> Array:
        """1 sigma of each error of the LiDARs and each bend."""
        of_lidar = np.array([nuisances.bias, nuisances.incidence, nuisances.ground])
        return np.concatenate(
            [
                np.tile(of_lidar, self.lidars),
                nuisances.beams,
                np.tile(nuisances.ground_frame, self.ground_frames),
                np.tile(nuisances.bend, BENDS * self.bent),
                np.full(self.lidars * self.surfaces, nuisances.surface),
                np.tile(nuisances.strip, self.lidars),
            ]
        )

    def of_surfaces(self) -> list[IntArray]:
        """Coordinates that belong to each surface."""
        surface = np.array(self.surface_of, dtype=np.int64)
        strips = np.arange(self.strips)
        where = [self.plane + 3 * strips + i for i in range(3)]
        where += [self.bend + self.strips * i + strips for i in range(BENDS * self.bent)]
        where += [self.strip_error + self.strips * i + strips for i in range(self.lidars)]
        own = [np.arange(self.surfaces)] * self.lidars
        of = np.concatenate([surface] * len(where) + own)
        where += [self.surface_error + self.surfaces * i + own[0] for i in range(self.lidars)]
        columns = np.concatenate(where)
        order = np.argsort(of, kind="stable")
        ends = np.cumsum(np.bincount(of, minlength=self.surfaces))[:-1]
        return [np.sort(part) for part in np.split(columns[order], ends)]


def stepped(state: State, layout: Layout, d: Array) -> State:
    """The estimate after a step (D,)."""
    m = layout.poses
    steps = [gtsam.Pose3.Expmap(v) for v in d[: 6 * m].reshape(m, 6)]
    R_d, t_d = stack(steps)
    moved = state.moved + d[: layout.offset]
    before = state.moved[: 6 * m].reshape(m, 6)
    for i, (xi, step) in enumerate(zip(before, steps, strict=True)):
        moved[6 * i : 6 * i + 6] = state.chart.coordinates(state.chart.pose(xi).compose(step))
    tangents = d[layout.extrinsic : layout.error].reshape(-1, 6)
    planes = d[layout.plane : layout.bend].reshape(-1, 3)
    errors = np.concatenate([layout.error_columns(), np.arange(layout.standing, layout.plane)])
    all_errors = state.errors.copy()
    all_errors[errors] += d[errors]
    B = tangent_axes(state.normals_map)
    turn = np.cross(state.normals_map, np.einsum("kj,kji->ki", planes[:, :2], B))
    normals = np.einsum("kij,kj->ki", exp_so3(turn), state.normals_map)
    offsets = state.offsets_s.copy()
    offsets[list(layout.offsets)] += d[layout.offset : layout.extrinsic]
    return replace(
        state,
        R_map_vehicle=state.R_map_vehicle @ R_d,
        t_map_vehicle=state.t_map_vehicle + np.einsum("mij,mj->mi", state.R_map_vehicle, t_d),
        moved=moved,
        T_vehicle_lidar=tuple(
            T.retract(v) for T, v in zip(state.T_vehicle_lidar, tangents, strict=True)
        ),
        offsets_s=offsets,
        centres_map=state.centres_map + planes[:, 2:] * state.normals_map,
        normals_map=normals,
        errors=all_errors,
    )
