"""The motion of one LiDAR from its own scans: every scan is laid on the map of those before it."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import gtsam
import numpy as np

from caliv_graph.common.progress import Advance
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import cross
from caliv_graph.odometry.surface_map import SurfaceMap, point_to_plane
from caliv_graph.products import Array, IntArray, LidarScan
from caliv_graph.structure.patches import RangeNoise
from caliv_graph.structure.planar import SLOT_S, ScanPatches, SweepMotion, planar_patches
from caliv_graph.structure.sightings import moved_moments
from caliv_graph.trajectory.deskew import checked_times
from caliv_graph.trajectory.imu import exp_so3

MOST_PATCHES = 500
"""Patches of a scan that are laid on the map, an even part: with 20 mm each they place it to
millimetres, far better than the solve of structure needs to begin with."""

PATCH_SIGMA_M = 0.03
"""1 sigma of a patch's distance from the surface of its cell: bumps, and the 20 mrad to which the
normals are known over a metre."""

ACCELERATION_M_S2 = 3.0
ACCELERATION_RAD_S2 = 1.5
"""1 sigma of what the motion changes between two scans: braking, and a fast turn of the wheel. It
decides only where the surfaces leave a direction open."""

FIRST_GATE_M = 1.0
LAST_GATE_M = 0.15
STEPS = 12
"""Distance at most of a patch from its surface in the first and the last step, and their number:
from what a prediction may be off at the range of a wall to five sigmas of a patch."""

SMALL_STEP = 1e-4
"""rad and m, of a last step."""

KEY_MOTION_M = 0.3
KEY_TURN_RAD = 0.05
"""A scan from farther than this from the last one in the map is added to it."""

FEWEST_FACING = 0.3
"""Patches that must face each direction of motion (a rotation counts at `LEVER_M`), for it to be
known to 60 mm. Of 500 patches of the ground alone, whose normals are known to 20 mrad, 0.2 face a
horizontal one by their noise."""

LEVER_M = 10.0
"""A rotation counts as the motion that it gives a point at this range, typical of walls."""

MOST_WEAK_S = 1.0
"""Time that constant velocity may bridge where the surfaces leave a direction open: 1.5 m at the
acceleration above, more than the widest gate."""

LEAST_SHARE = 0.3
"""Share of the patches with a surface near that must lie on it; less: track is lost."""

MOST_SIGMAS = 10.0
"""Change of velocity between two scans, in sigmas of the acceleration, that is none of a vehicle:
30 m/s^2 and 15 rad/s^2."""

BEGINNING = 10
"""Scans by which the velocity at the start is found; then all begins anew."""


@dataclass(frozen=True)
class Track:
    """The motion of a LiDAR.

    Attributes:
        stamps_ns: (n,) of its scans.
        T_map_lidar: n poses at these stamps; the first is the identity.
        patches: n parts of the patches of each scan, lidar frame at their own times.
    """

    stamps_ns: IntArray
    T_map_lidar: tuple[gtsam.Pose3, ...]
    patches: tuple[ScanPatches, ...]


def track(scans: Iterable[LidarScan], sigma_range_m: float, advance: Advance) -> Track:
    """Tracks a LiDAR through its scans, in the order of their stamps.

    Args:
        scans: of the LiDAR.
        sigma_range_m: noise along the beam, 1 sigma.
        advance: reports every scan.

    Raises:
        TrajectoryError: the surfaces around do not determine the motion, track is lost, or times of
            points are invalid.
    """
    source = iter(scans)
    first = list(itertools.islice(source, BEGINNING))
    begun = _Tracker(sigma_range_m, np.zeros(6), begun=False)
    for scan in first:
        begun.follow(scan)
    tracker = _Tracker(sigma_range_m, begun.first_twist(), begun=True)
    for scan in itertools.chain(first, source):
        tracker.follow(scan)
        advance()
    tracker.finish()
    return Track(
        np.array(tracker.stamps_ns, dtype=np.int64), tuple(tracker.poses), tuple(tracker.patches)
    )


class _Tracker:
    """Poses so far, and the map."""

    def __init__(self, sigma_range_m: float, twist: Array, begun: bool) -> None:
        """`twist` (6,) at the first scan, right perturbation per second; `begun`: it is known."""
        self.stamps_ns: list[int] = []
        self.poses: list[gtsam.Pose3] = []
        self.patches: list[ScanPatches] = []
        self._noise = RangeNoise.constant(sigma_range_m)
        self._twist = twist
        self._begun = begun
        self._map = SurfaceMap()
        self._key = gtsam.Pose3()
        self._weak_since_ns: int | None = None

    def first_twist(self) -> Array:
        """(6,) at the first scan, from the poses found."""
        if len(self.poses) < 3:
            return np.zeros(6)
        times = self._seconds(self.stamps_ns[0], np.array(self.stamps_ns))
        moved = np.array([gtsam.Pose3.Logmap(self.poses[0].between(T)) for T in self.poses])
        # Velocity and acceleration.
        basis = np.stack([times, times**2], axis=1)
        return np.asarray(np.linalg.lstsq(basis, moved)[0][0])

    @staticmethod
    def _seconds(begin_ns: int, stamps_ns: IntArray) -> Array:
        return np.asarray((stamps_ns - begin_ns) / NANOSECONDS_PER_SECOND)

    def follow(self, scan: LidarScan) -> None:
        """The pose of the next scan; one without flat surfaces, as if empty, is skipped."""
        if self.poses and scan.stamp_ns <= self.stamps_ns[-1]:
            return
        patches = self._patches_of(scan)
        if not len(patches.time_s):
            return  # nothing to place it by: as if it had not been recorded
        if not self.poses:
            pose = gtsam.Pose3()
            self._insert(pose, patches)
        else:
            seconds = (scan.stamp_ns - self.stamps_ns[-1]) / NANOSECONDS_PER_SECOND
            predicted = self.poses[-1].retract(seconds * self._twist)
            pose, fit = self._registered(predicted, patches, seconds)
            self._judge(scan.stamp_ns, fit)
            self._twist = gtsam.Pose3.Logmap(self.poses[-1].between(pose)) / seconds
            moved = gtsam.Pose3.Logmap(self._key.between(pose))
            if (
                max(
                    np.linalg.norm(moved[3:]) / KEY_MOTION_M,
                    np.linalg.norm(moved[:3]) / KEY_TURN_RAD,
                )
                > 1.0
            ):
                self._insert(pose, patches)
        self.stamps_ns.append(scan.stamp_ns)
        self.poses.append(pose)
        self.patches.append(_thinned(patches))

    def finish(self) -> None:
        """Checks what only the end shows.

        Raises:
            TrajectoryError: there are too few scans, or the end is open.
        """
        if len(self.poses) < BEGINNING:
            raise TrajectoryError(f"{len(self.poses)} scans are too few to track a LiDAR")

    def _judge(self, stamp_ns: int, fit: _Fit) -> None:
        """Raises TrajectoryError where the motion is lost."""
        after_s = (stamp_ns - self.stamps_ns[0]) / NANOSECONDS_PER_SECOND
        if fit.share < LEAST_SHARE:
            raise TrajectoryError(
                f"track is lost {after_s:.1f} s after the start: {100.0 * fit.share:.0f} % of the "
                "flat surfaces lie on those seen before"
            )
        if fit.sigmas > MOST_SIGMAS and self._begun:
            raise TrajectoryError(
                f"track is lost {after_s:.1f} s after the start: it jumps as no vehicle moves"
            )
        if not fit.weak:
            self._weak_since_ns = None
            return
        if self._weak_since_ns is None:
            self._weak_since_ns = stamp_ns
        if stamp_ns - self._weak_since_ns > MOST_WEAK_S * NANOSECONDS_PER_SECOND:
            raise TrajectoryError(
                f"the flat surfaces around leave a direction of motion open {after_s:.1f} s after "
                "the start: ground alone, or parallel walls"
            )

    def _patches_of(self, scan: LidarScan) -> ScanPatches:
        """The patches of a scan, each at its own time."""
        times_s = checked_times(scan)
        if times_s is None or not len(times_s):
            return planar_patches(scan.points_lidar, self._noise)
        first_s = float(times_s.min())
        slots = int((float(times_s.max()) - first_s) / SLOT_S) + 1
        motion = SweepMotion(
            first_s, np.tile(self._twist[:3], (slots, 1)), np.tile(self._twist[3:], (slots, 1))
        )
        return planar_patches(scan.points_lidar, self._noise, times_s, motion)

    def _insert(self, pose: gtsam.Pose3, patches: ScanPatches) -> None:
        R, t = _sweep(patches.time_s, self._twist)
        moments = moved_moments(patches.moments, R, t)
        normals = np.einsum("nij,nj->ni", R, patches.normal_lidar)
        if len(moments):
            self._map.add(moments, normals, pose.rotation().matrix(), pose.translation())
        self._key = pose

    def _registered(
        self, predicted: gtsam.Pose3, patches: ScanPatches, seconds: float
    ) -> tuple[gtsam.Pose3, _Fit]:
        """The pose of a scan, `seconds` after the last one, and how well it is known.

        The sweep is put together with the velocity since the last scan, anew in every step. With
        that of the step before, errors of poses would feed back with a factor of minus one.
        """
        patches = _thinned(patches)
        own = patches.moments[:, :3, 3] / patches.moments[:, 3:, 3]
        unit = np.array([ACCELERATION_RAD_S2] * 3 + [ACCELERATION_M_S2] * 3)
        prior = 0.5 * unit * seconds**2
        ahead = 1.0 + patches.time_s / seconds
        pose, twist, facing, share = predicted, self._twist, np.zeros((6, 6)), 0.0
        for k in range(STEPS):
            R, t = _sweep(patches.time_s, twist)
            centres = np.einsum("nij,nj->ni", R, own) + t
            normals = np.einsum("nij,nj->ni", R, patches.normal_lidar)
            gate = FIRST_GATE_M * (LAST_GATE_M / FIRST_GATE_M) ** min(k / (STEPS // 2), 1.0)
            R_map, t_map = pose.rotation().matrix(), pose.translation()
            in_map = centres @ R_map.T + t_map
            which, surface, normal, around = self._map.nearest(in_map, normals @ R_map.T)
            r = np.einsum("ni,ni->n", normal, in_map[which] - surface)
            sigma = max(gate / 3.0, PATCH_SIGMA_M)
            w = np.where(np.abs(r) < gate, 1.0 / (1.0 + (r / sigma) ** 2) ** 2, 0.0)
            J = point_to_plane(R_map, centres[which], normal)
            facing = J.T @ (w[:, None] * J)
            share = float((np.abs(r) < gate).sum()) / max(around, 1)
            # The velocity follows the pose, and a patch at the end of the sweep moves twice as far.
            J = J * ahead[which, None]
            away = gtsam.Pose3.Logmap(predicted.between(pose))
            H = J.T @ (w[:, None] * J) / PATCH_SIGMA_M**2 + np.diag(prior**-2.0)
            b = -J.T @ (w * r) / PATCH_SIGMA_M**2 - away / prior**2
            d = np.linalg.solve(H, b)
            pose = pose.retract(d)
            twist = gtsam.Pose3.Logmap(self.poses[-1].between(pose)) / seconds
            if k > STEPS // 2 and np.abs(d).max() < SMALL_STEP:
                break
        # About the LiDAR rotation and translation hardly mix; what both leave open shows here, too.
        scale = np.array([1.0 / LEVER_M] * 3 + [1.0] * 3)
        least = float(np.linalg.eigvalsh(facing * np.outer(scale, scale))[0])
        away = gtsam.Pose3.Logmap(predicted.between(pose))
        return pose, _Fit(least < FEWEST_FACING, share, float(np.abs(away / prior).max()))


@dataclass(frozen=True)
class _Fit:
    """How well a scan lies on the map.

    Attributes:
        weak: whether the surfaces leave a direction open.
        share: of the patches with a surface near, those that lie on it.
        sigmas: of what velocities change between two scans.
    """

    weak: bool
    share: float
    sigmas: float


def _thinned(patches: ScanPatches) -> ScanPatches:
    """At most `MOST_PATCHES`, an even part."""
    step = max(len(patches.time_s) / MOST_PATCHES, 1.0)
    return patches.part(np.arange(0.0, len(patches.time_s), step).astype(np.int64))


def _sweep(times_s: Array, twist: Array) -> tuple[Array, Array]:
    """R (n, 3, 3) and t (n, 3) of a LiDAR in its frame at the stamp, after times, second order."""
    R = exp_so3(times_s[:, None] * twist[:3])
    turned = cross(twist[:3], twist[3:])
    return R, times_s[:, None] * twist[3:] + 0.5 * times_s[:, None] ** 2 * turned
