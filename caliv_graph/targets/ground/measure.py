"""The ground in the scans of a drive, wherever a LiDAR sees a target."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from caliv_graph.common.progress import Progress
from caliv_graph.config.guesses import configured_guess
from caliv_graph.config.model import Config
from caliv_graph.config.range_errors import growth
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.geometry.se3 import cross, turned_twist
from caliv_graph.products import (
    Array,
    GroundObservation,
    IntArray,
    LidarScan,
    Recording,
    TargetObservation,
)
from caliv_graph.targets.ground.planes import (
    BENT,
    MIN_SLOPE,
    GroundPlane,
    fit_plane,
    ground_floors,
    is_passed,
    near_points,
    response,
)
from caliv_graph.trajectory.deskew import deskewed
from caliv_graph.trajectory.select import VehicleTrajectory, twists_at

EXTRINSIC_STEP_RAD = 1e-3
"""Step of the numerical derivative with respect to the extrinsic's rotation: the displacement of
points during a sweep is linear far beyond it."""

MAX_APART_NS = 60_000_000
"""Maximum time between a scan and the pose that it is used for. Every LiDAR of 10 Hz has a scan
within half its period, over which any trajectory is right to 1 mm."""


RAISED_M, GUESS_SIGMAS = 0.5, 3.0
"""A plane that is higher than the stated ground by this, and by so many sigmas of the guess, is
perhaps the vehicle's roof."""

FEWEST_JUDGED = 8
"""Scans of a LiDAR with ground that is a plane or bent, to say how often it is bent; of those with
a plane, to say how rough it is."""


class GroundMeter:
    """Measures the ground in the scans of one drive, one at a time."""

    def __init__(
        self,
        config: Config,
        trajectory: VehicleTrajectory,
        drive: int,
        stamps_ns: Collection[int] = (),
    ) -> None:
        """Binds the initial guesses to the trajectory of a drive.

        It is asked for all poses at `stamps_ns` at once: a call for one takes as long.
        """
        self._config = config
        self._sigma_range_m = config.noise.lidar_range_m
        self._floors = ground_floors(config.noise)
        self._trajectory = trajectory
        self._drive = drive
        self._guess: Mapping[str, gtsam.Pose3] = {
            name: lidar.guess() for name, lidar in config.lidars.items()
        }
        self._scans: Counter[str] = Counter()
        self._without: dict[str, Counter[str]] = {name: Counter() for name in config.lidars}
        self._moving = self._moving_at(sorted(stamps_ns))

    def _moving_at(self, stamps_ns: Sequence[int]) -> dict[int, tuple[Array, Array]]:
        """R_map_vehicle (3, 3) and twist (6,) of the vehicle, by stamp."""
        if not stamps_ns:
            return {}
        R_map_vehicle, _ = self._trajectory.poses_at(stamps_ns)
        twists = twists_at(self._trajectory, stamps_ns)
        return dict(zip(stamps_ns, zip(R_map_vehicle, twists, strict=True), strict=True))

    def measure(self, scan: LidarScan, at_ns: int | None = None) -> GroundObservation | None:
        """The ground's plane in a scan as it was read; None if there is none.

        The scan is not motion compensated. The plane is relative to the LiDAR's pose at `at_ns` by
        the trajectory, a stamp near the scan's; None: the scan's own.

        Raises:
            TrajectoryError: the stamp is outside the trajectory's span, or point times are invalid.
        """
        self._scans[scan.lidar] += 1
        at_ns = scan.stamp_ns if at_ns is None else at_ns
        moving = self._moving if at_ns in self._moving else self._moving_at([at_ns])
        R_map_vehicle, twist = moving[at_ns]
        guess = self._guess[scan.lidar]
        up_lidar = (R_map_vehicle @ guess.rotation().matrix())[2]
        # Before the motion compensation, which takes most of the time.
        near = near_points(scan.points_lidar, up_lidar)
        times_s = np.full(len(near), (scan.stamp_ns - at_ns) / NANOSECONDS_PER_SECOND)
        if scan.point_times_s is not None:
            times_s += scan.point_times_s[near]
        part = replace(
            scan, stamp_ns=at_ns, points_lidar=scan.points_lidar[near], point_times_s=times_s
        )
        rotated = [guess.retract(d) for d in EXTRINSIC_STEP_RAD * np.eye(3, 6)]
        by_guess = deskewed(part, [guess, *rotated], self._trajectory)
        points = next(by_guess)
        plane, reason = fit_plane(points, up_lidar, self._sigma_range_m)
        if plane is not None and self._is_roof(scan, plane):
            plane, reason = None, "beams pass through the plane, to what is lower"
        if plane is None:
            self._without[scan.lidar][reason] += 1
            return None
        # From where the LiDAR was at their times: half a metre on, the incidence is another. By the
        # velocity at the stamp that is right to centimetres, and costs nothing.
        velocity = (guess.inverse().AdjointMap() @ twist)[3:]
        from_lidar = points - times_s[:, None] * velocity
        beams = from_lidar / np.maximum(np.linalg.norm(from_lidar, axis=1), 1e-9)[:, None]
        # As on the plane: what stands on it, nearly upright to the beams, has no part in the fit.
        across = np.maximum(-beams @ plane.normal_lidar, MIN_SLOPE)
        moved = [beams, *(beams * more[:, None] for more in growth(across).T)]
        biases = len(moved)
        if times_s.any():
            moved += [(of_rotated - points) / EXTRINSIC_STEP_RAD for of_rotated in by_guess]
            moved += by_rates(points, times_s, guess)
        changes, bends = response(plane, points, np.stack(moved, axis=2), self._sigma_range_m)
        turns = slice(biases, biases + 3)
        by_extrinsic = changes[:, turns] if times_s.any() else None
        return GroundObservation(
            lidar=scan.lidar,
            drive=self._drive,
            stamp_ns=at_ns,
            normal_lidar=plane.normal_lidar,
            distance_m=plane.distance_m,
            axes_lidar=plane.axes_lidar,
            cov=plane.cov_with(self._floors),
            centre_lidar=plane.centre_lidar,
            points=plane.points,
            R_vehicle_lidar=None if by_extrinsic is None else guess.rotation().matrix(),
            by_extrinsic=by_extrinsic,
            beyond=plane.beyond,
            beyond_variances=plane.beyond_variances,
            beyond_by_extrinsic=bends[:, turns] if times_s.any() else None,
            by_bend=np.outer(plane.beyond, plane.beyond),
            apart_ns=scan.stamp_ns - at_ns,
            by_range_bias=changes[:, :biases],
            by_rates=changes[:, biases + 3 :] if times_s.any() else None,
            taken_s=(float(times_s.min()), float(times_s.max())),
            twist_map=turned_twist(R_map_vehicle, twist),
            R_map_vehicle=R_map_vehicle,
            roughness_m=plane.roughness_m,
        )

    def _is_roof(self, scan: LidarScan, plane: GroundPlane) -> bool:
        """Whether a plane is far above the stated ground, and beams pass its edges.

        Of a road on a bank or a quay, which beams pass as well, the first does not hold.
        """
        height_m = self._config.ground.vehicle_height
        if height_m is None:
            return False
        guess = configured_guess(self._config, scan.lidar)
        above_m = guess.T_vehicle_lidar.z() + height_m - plane.distance_m
        doubt_m = GUESS_SIGMAS * float(guess.sigmas[5])
        return above_m > RAISED_M + doubt_m and is_passed(plane, scan.points_lidar)

    def bent(self) -> float:
        """Part of the scans in which the ground is bent, of the LiDAR that finds it so most often.

        Counted are scans with a plane and bent ones.
        """
        parts = [0.0]
        for name, reasons in self._without.items():
            bent = reasons[BENT]
            judged = self._scans[name] - sum(reasons.values()) + bent
            if judged >= FEWEST_JUDGED:
                parts.append(bent / judged)
        return max(parts)

    def warnings(self) -> tuple[str, ...]:
        """LiDARs that have no ground in most of their scans, and the reasons, a line each."""
        lines = []
        for name, reasons in self._without.items():
            lost, scans = sum(reasons.values()), self._scans[name]
            if 2 * lost > scans:
                why = ", ".join(f"{n} {text}" for text, n in reasons.most_common(3))
                lines.append(
                    f"ground: lidar '{name}' has it in {scans - lost} of {scans} scans of drive "
                    f"{self._drive + 1}: {why}"
                )
        return tuple(lines)


def by_rates(points_lidar: Array, times_s: Array, T_vehicle_lidar: gtsam.Pose3) -> list[Array]:
    """How points (N, 3) move with each of the six rates that moved them over their times (N,).

    The derivative is that of `tau (w x p + v)`, p in the vehicle frame at the pose: the rotation
    within a sweep, a hundredth of a radian or two, is neglected.
    """
    R_vehicle_lidar = T_vehicle_lidar.rotation().matrix()
    # In lidar axes: arms from the vehicle's origin, and the vehicle's axes.
    arms = points_lidar - T_vehicle_lidar.inverse().translation()
    by_turn = [times_s[:, None] * cross(axis, arms) for axis in R_vehicle_lidar]
    return by_turn + [times_s[:, None] * axis for axis in R_vehicle_lidar]


def nearest_scans(
    poses_ns: Sequence[int] | IntArray, scans_ns: Sequence[int] | IntArray
) -> dict[int, int]:
    """Stamp of the pose by stamp of the nearest scan, for poses with a scan near enough.

    `scans_ns` are those of one LiDAR, ascending. No scan is used twice.
    """
    scans = np.asarray(scans_ns, dtype=np.int64)
    out: dict[int, int] = {}
    if not len(scans):
        return out
    for pose_ns in map(int, poses_ns):
        after = int(np.searchsorted(scans, pose_ns))
        near = scans[max(after - 1, 0) : after + 1]
        scan_ns = int(near[np.abs(near - pose_ns).argmin()])
        apart = abs(scan_ns - pose_ns)
        if apart <= MAX_APART_NS and (scan_ns not in out or apart < abs(scan_ns - out[scan_ns])):
            out[scan_ns] = pose_ns
    return out


def roughness_m(observations: Sequence[GroundObservation], drive: int) -> float | None:
    """Scatter of the ground of a drive from point to point, 1 sigma, beside the noise of LiDARs.

    That of the LiDAR that sees the least of it: an error of its own is none of the ground. None: no
    LiDAR sees it in enough scans.
    """
    seen: dict[str, list[float]] = {}
    for o in observations:
        if o.drive == drive and not math.isnan(o.roughness_m):
            seen.setdefault(o.lidar, []).append(o.roughness_m)
    found = [float(np.median(of)) for of in seen.values() if len(of) >= FEWEST_JUDGED]
    return min(found, default=None)


def measure_grounds(
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    targets: Sequence[TargetObservation],
    config: Config,
    progress: Progress,
    others: Collection[str] = (),
    kept_ns: Mapping[int, Sequence[int]] | None = None,
) -> tuple[tuple[GroundObservation, ...], tuple[str, ...]]:
    """The ground in the scans of all LiDARs, whenever one of them sees a target; and warnings.

    All LiDARs at the same poses: heave of the body and error of the trajectory are then common to
    them, and the ground determines S2S to the 2 mm of a plane. Observations are by drive, LiDAR and
    stamp, each at the stamp of a pose: those of the clouds of `targets`.

    Args:
        recordings: the drives.
        trajectories: one per drive.
        targets: clouds of each target placement.
        config: guesses, noise, ground.
        progress: reports every scan.
        others: names of LiDARs whose ground is measured although they saw no target.
        kept_ns: drive -> stamps of further poses.

    Raises:
        RecordingError: a cloud could not be read.
    """
    if not config.ground.use:
        return (), ()
    further = {(d, stamp) for d, stamps in (kept_ns or {}).items() for stamp in stamps}
    poses = sorted({(c.drive, c.stamp_ns) for o in targets for c in o.clouds} | further)
    seeing = {c.lidar for o in targets for c in o.clouds} | set(others)
    names = [n for n, lidar in config.lidars.items() if n in seeing or lidar.fixed]
    wanted: list[tuple[int, str, dict[int, int]]] = []
    for drive, recording in enumerate(recordings):
        begin, end = trajectories[drive].span_ns
        of_drive = [stamp for d, stamp in poses if d == drive]
        for name in names:
            scans = [t for t in recording.scan_stamps_ns(name) if begin <= t <= end]
            wanted.append((drive, name, nearest_scans(of_drive, scans)))
    found: list[GroundObservation] = []
    meters = []
    for drive, trajectory in enumerate(trajectories):
        stamps = {at for d, _, pairs in wanted if d == drive for at in pairs.values()}
        meters.append(GroundMeter(config, trajectory, drive, stamps))
    total = sum(len(pairs) for _, _, pairs in wanted)
    with progress.stage("reading the ground", total) as advance:
        for drive, name, pairs in wanted:
            for scan in recordings[drive].scans(name, pairs) if pairs else ():
                observation = meters[drive].measure(scan, pairs[scan.stamp_ns])
                if observation is not None:
                    found.append(observation)
                advance()
    bent = [meter.bent() for meter in meters]
    observations = tuple(replace(o, bent=bent[o.drive]) for o in found)
    return observations, tuple(line for meter in meters for line in meter.warnings())
