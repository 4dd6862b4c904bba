"""What one LiDAR saw in a drive: the objects of its scans, placed in the map."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.targets.search.objects import AZIMUTH_BIN_RAD, ScanObject, ScanObjects

FOV_GAP_RAD = math.radians(5.0)
"""A sector at least this wide without any return in any scan is outside the field of view."""

EDGE_RAD = math.radians(0.6)
"""An object within this angle of the edge of the field of view may be cut off by it."""

UPRIGHT = 0.5
"""Cosine of the angle between the LiDAR's z and the vertical, up or down, below which the LiDAR
lies on its side."""


@dataclass(frozen=True)
class Alignment:
    """Correction of the guess of a LiDAR: yaw (rad) and shift (2,) in metres, vehicle axes."""

    yaw_rad: float = 0.0
    shift_m: Array = field(default_factory=lambda: np.zeros(2))


class LidarHistory:
    """What one LiDAR saw in a drive.

    Attributes:
        name: of the LiDAR.
        guess: T_vehicle_lidar.
        scans: the objects of each scan.
        objects: all objects of all scans, n of them.
        scan_of: (n,) index of the scan of each.
        stride: scans in the drive per scan that was read.
        R_map_vehicle: (scans, 3, 3) attitude of the vehicle.
        t_map_vehicle: (scans, 3) metres, position of the vehicle.
        t_vehicle_lidar: (3,) metres, the guess.
        extent_m, points, range_m, bottom_m, top_m: (n,) of each object, see `ScanObject`.
        whole: (n,) whether the full width of the object is in view.
        top_cut: (n,) whether the field of view may end below its top.
    """

    def __init__(
        self,
        name: str,
        T_vehicle_lidar: gtsam.Pose3,
        scans: Sequence[ScanObjects],
        poses: tuple[Array, Array],
        stride: float,
    ) -> None:
        self.name = name
        self.scans = tuple(scans)
        self.stride = stride
        self.R_map_vehicle, self.t_map_vehicle = poses
        self.guess = T_vehicle_lidar
        self._R_guess = T_vehicle_lidar.rotation().matrix()
        self.t_vehicle_lidar = T_vehicle_lidar.translation()
        self.objects: tuple[ScanObject, ...] = tuple(o for s in scans for o in s.objects)
        counts = [len(s.objects) for s in scans]
        self.scan_of: IntArray = np.repeat(np.arange(len(scans)), counts)
        self._base = np.array([o.base for o in self.objects]).reshape(-1, 3)
        self._fov = _field_of_view([s.azimuths for s in scans])
        lowest_rad = min((s.elevation[0] for s in scans), default=0.0)
        highest_rad = max((s.elevation[1] for s in scans), default=0.0)
        self.extent_m = np.array([o.extent_m for o in self.objects])
        self.points = np.array([o.points for o in self.objects], dtype=np.int64)
        self.range_m = np.array([o.range_m for o in self.objects])
        self.bottom_m = np.array([o.bottom_m for o in self.objects])
        self.top_m = np.array([o.top_m for o in self.objects])
        self._azimuth = np.array([o.azimuth for o in self.objects]).reshape(-1, 2)
        low, high = self._azimuth.T
        free: BoolArray = np.array([not o.hidden for o in self.objects], dtype=bool)
        beams = np.array([o.elevation for o in self.objects]).reshape(-1, 2)
        at_low = beams[:, 0] < lowest_rad + EDGE_RAD
        at_high = beams[:, 1] > highest_rad - EDGE_RAD
        # The end of the elevations that is at the top of what stands: none of a LiDAR on its side,
        # where both are at the sides.
        up = float(self._R_guess[2, 2])
        sideways = abs(up) < UPRIGHT
        cut_at_side = (at_low | at_high) & sideways
        self.whole: BoolArray = free & self._in_view(low - EDGE_RAD, high + EDGE_RAD) & ~cut_at_side
        self.top_cut: BoolArray = (at_high if up > 0.0 else at_low) & (not sideways)

    def _in_view(self, begin: Array, end: Array) -> BoolArray:
        """Whether all azimuths from `begin` to `end` (n,) are inside the field of view."""
        first = np.floor(begin / AZIMUTH_BIN_RAD).astype(np.int64)
        last = np.floor(end / AZIMUTH_BIN_RAD).astype(np.int64)
        outside = np.concatenate([[0], np.cumsum(np.tile(~self._fov, 3))])
        n = len(self._fov)
        first, width = first % n, np.clip(last - first, 0, n - 1)
        return np.asarray(outside[first + width + 1] == outside[first])

    def places(self, alignment: Alignment, points_lidar: Array, scan_of: IntArray) -> Array:
        """(n, 3) metres in the map of points (n, 3) of the scans (n,), with the corrected guess."""
        c, s = math.cos(alignment.yaw_rad), math.sin(alignment.yaw_rad)
        R_yaw = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        shift = np.array([*alignment.shift_m, 0.0])
        points = points_lidar @ (R_yaw @ self._R_guess).T + self.t_vehicle_lidar + shift
        moved = np.einsum("nij,nj->ni", self.R_map_vehicle[scan_of], points)
        return np.asarray(moved + self.t_map_vehicle[scan_of])

    def aligned(self, alignment: Alignment) -> gtsam.Pose3:
        """T_vehicle_lidar, the corrected guess."""
        R_yaw = gtsam.Rot3.Yaw(alignment.yaw_rad)
        shift = np.array([*alignment.shift_m, 0.0])
        return gtsam.Pose3(R_yaw.compose(self.guess.rotation()), self.t_vehicle_lidar + shift)

    def bases(self, alignment: Alignment, which: BoolArray | None = None) -> Array:
        """(n, 3) metres in the map, the foot of each object, or of those that `which` (n,) has."""
        if which is None:
            return self.places(alignment, self._base, self.scan_of)
        return self.places(alignment, self._base[which], self.scan_of[which])

    def base_terms(self, which: BoolArray) -> Array:
        """(n, 2, 5) x and y of `bases`, by the factors 1, cos yaw, sin yaw and shift x, y.

        The sums of `places` in another order: what changes there changes here.
        """
        R = self.R_map_vehicle[self.scan_of[which]][:, :2]
        ahead, left, up = (R[:, :, axis] for axis in range(3))
        x, y, z = (self._base[which] @ self._R_guess.T).T[:, :, None]
        fixed = R @ self.t_vehicle_lidar + self.t_map_vehicle[self.scan_of[which], :2] + up * z
        return np.stack([fixed, ahead * x + left * y, left * x - ahead * y, ahead, left], axis=-1)

    def outlines(self, which: BoolArray, alignment: Alignment) -> tuple[Array, IntArray]:
        """Points (m, 3) of these objects in the map, and the scan of each."""
        chosen = np.flatnonzero(which)
        if not len(chosen):
            return np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
        points = [self.objects[i].outline for i in chosen]
        scan_of = np.repeat(self.scan_of[chosen], [len(p) for p in points])
        return self.places(alignment, np.concatenate(points), scan_of), scan_of

    def levers(self, alignment: Alignment) -> Array:
        """(n, 2) derivative of each object's place in the map with respect to yaw, m/rad."""
        arm = self._base @ self._R_guess.T
        c, s = math.cos(alignment.yaw_rad), math.sin(alignment.yaw_rad)
        change = np.column_stack(
            [-s * arm[:, 0] - c * arm[:, 1], c * arm[:, 0] - s * arm[:, 1], np.zeros(len(arm))]
        )
        return np.asarray(np.einsum("nij,nj->ni", self.R_map_vehicle[self.scan_of], change)[:, :2])

    def should_show(
        self, place: Array, ranges_m: tuple[float, float], alignment: Alignment, gate_m: float
    ) -> BoolArray:
        """(scans,) whether an object at a place (3,) in the map should be in view.

        Within the field of view and these ranges, with no occluder.
        """
        c, s = math.cos(alignment.yaw_rad), math.sin(alignment.yaw_rad)
        R_yaw = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        origin = self.t_vehicle_lidar + np.array([*alignment.shift_m, 0.0])
        at_vehicle = np.einsum("nji,nj->ni", self.R_map_vehicle, place - self.t_map_vehicle)
        at = (at_vehicle - origin) @ (R_yaw @ self._R_guess)
        azimuth = np.arctan2(at[:, 1], at[:, 0])
        level_m = np.hypot(*(at_vehicle - origin)[:, :2].T)
        half = gate_m / np.maximum(level_m, 1.0)
        shows = self._in_view(azimuth - half, azimuth + half)
        shows &= (level_m >= ranges_m[0]) & (level_m <= ranges_m[1])
        for i in np.flatnonzero(shows):
            mine = np.flatnonzero(self.scan_of == i)
            low, high = self._azimuth[mine, 0], self._azimuth[mine, 1]
            off = (azimuth[i] - low + math.pi) % (2.0 * math.pi) - math.pi
            before = (off > -half[i]) & (off < high - low + half[i])
            before &= self.range_m[mine] < level_m[i] - gate_m
            shows[i] = not before.any()
        return shows


def _field_of_view(azimuths: Sequence[IntArray]) -> BoolArray:
    """(n,) bins of azimuth, from 0 on, in the field of view: those with returns in any scan."""
    n = round(2.0 * math.pi / AZIMUTH_BIN_RAD)
    seen = np.zeros(n, dtype=bool)
    for bins in azimuths:
        seen[bins % n] = True
    filled = np.flatnonzero(seen)
    for a, b in itertools.pairwise(np.append(filled, filled[:1] + n)):
        if (b - a) * AZIMUTH_BIN_RAD < FOV_GAP_RAD:
            seen[np.arange(a, b) % n] = True
    return seen
