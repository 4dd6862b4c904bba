"""Reads the scans of a drive, a few along its way, and reduces each to flat patches."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial

import gtsam
import numpy as np

from caliv_graph.common.cores import worked_together
from caliv_graph.common.progress import Progress
from caliv_graph.config.model import Config
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, BoolArray, IntArray, LidarScan, Recording
from caliv_graph.structure.channels import ChannelSums, found_rows
from caliv_graph.structure.noise import roughness_m
from caliv_graph.structure.patches import DrivePatches, RangeNoise, Swept
from caliv_graph.structure.planar import SLOT_S, ScanPatches, SweepMotion, planar_patches
from caliv_graph.structure.range_noise import OPEN_M, measured_noise
from caliv_graph.targets.cloud.beams import elevations
from caliv_graph.targets.cloud.views import evenly_spread
from caliv_graph.trajectory.deskew import checked_times
from caliv_graph.trajectory.imu import log_so3
from caliv_graph.trajectory.measurements import nearest_node
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smoothed import within_span

MAX_SCANS = 150
"""Scans of a LiDAR that are read of a drive. More scans of one place share the errors of its
surface (an offset of its own per strip and scan, not per point), and the poses between are tied by
the IMU; time and memory do not grow with the drive."""

MAX_POSES = 400
"""Stamps at most at which scans of a drive are read, all LiDARs together: each is a pose of the
solve, whose time grows with the cube of their number. Scans of one stamp share theirs. What LiDARs
know of the vehicle hardly changes (1.03 times the sigmas with 100 scans in place of 150 of each of
four); what they know of each other is as their number of scans (1.24)."""

MIN_SCANS = 20
"""Scans that are read however little the vehicle moves, if there are as many: their noise averages
out."""

MIN_STEP_M = 0.1
"""Least motion between two scans that are read: nearer ones hit the same spots of a wall, 0.2
degrees of beams at 30 m being 0.1 m apart."""

LEVER_M = 10.0
"""A rotation counts as the motion that it gives a point at this range, typical of walls."""

REST_M_S = 0.1
"""Time counts as motion at this speed: a vehicle that stands gives a scan a second at most."""

INSTANTS = 2000
"""Instants at most among which those of the scans are chosen."""

INSTANT_NS = 100_000_000
"""Time between these at least: the period of common LiDARs."""

LEAST_SHARE = 0.02
"""Share of the ground that a LiDAR sees at no grazing angle, at least, for strips to stand for it.
One at 3 m whose channels end at 15 degrees below the horizon has none, and its strips are all at
the limit: they claimed a tilt to 0.06 mrad that was 0.33 off. With a share of 0.09 strips are
better than planes (errors of 0.05 and 0.25 mrad), and others have 0.15 to 0.9."""

FEWEST_OF_GROUND = 3.0
"""Patches of the ground in a scan at least, on average, for strips to stand for it: three have a
plane by their middles. Of fewer all that is known of the tilt is how each small piece lies, which
its bumps and the noise of its points turn alike in every scan. A rosette at the bumper has 1.7,
with a tenth of what it sees of the ground (`slalom` of the second simulator: S2S pitch 0.7 and 0.9
mrad off at a claimed 0.2); other LiDARs have 18 to 140."""

OF_SCANS, LEAST_NOISE_SCANS = 20, 5
"""Every so many scans one is read first, to measure the noise along the beam, and as many at least.
They are spread over the drive: beside a hedge nothing is smooth."""

STEEP_COS = float(np.cos(np.radians(74.0)))
"""Cosine of the incidence that counts as no grazing angle: a degree, by which guesses and ground
may be off, above that of sightings (`config.range_errors.GRAZING_COS`)."""

LEVEL_COS = float(np.cos(np.radians(25.0)))
"""Cosine between a patch's normal and up above which it is level: 10 degrees of error of the guess,
7 of the ground, and 2 of the patch's own normal."""


def read_patches(
    recordings: Sequence[Recording],
    trajectories: Sequence[VehicleTrajectory],
    config: Config,
    progress: Progress,
    keep_level: bool = False,
) -> tuple[DrivePatches, ...]:
    """The patches of every drive, those of the ground only with `keep_level`.

    Raises:
        RecordingError: a cloud could not be read.
        TrajectoryError: times of points are invalid.
    """
    names = tuple(config.lidars)
    guesses = tuple(lidar.guess() for lidar in config.lidars.values())
    wanted = [
        chosen_scans([recording.scan_stamps_ns(name) for name in names], trajectory)
        for recording, trajectory in zip(recordings, trajectories, strict=True)
    ]
    found: list[DrivePatches] = []
    total = sum(len(stamps) for of_drive in wanted for stamps in of_drive)
    with progress.stage("reading walls and other surfaces", total) as advance:
        for drive, recording in enumerate(recordings):
            scans: list[tuple[int, int, ScanPatches]] = []
            noises: dict[int, RangeNoise] = {}
            without_rows: set[int] = set()
            for k, name in enumerate(names):
                if not len(wanted[drive][k]):
                    continue
                cut = partial(
                    scan_patches, T_vehicle_lidar=guesses[k], trajectory=trajectories[drive]
                )
                clouds, noises[k], in_rows = _with_noise(
                    recording, name, wanted[drive][k], cut, config
                )
                if not in_rows:
                    without_rows.add(k)
                reduced = partial(_stamped, partial(cut, noise=noises[k], keep_level=keep_level))
                own: list[tuple[int, int, ScanPatches]] = []
                for stamp_ns, patches in worked_together(reduced, clouds):
                    own.append((k, stamp_ns, patches))
                    advance()
                scans.extend(sorted(own, key=lambda scan: scan[1]))
            found.append(_together(drive, names, scans, guesses, noises, without_rows))
    return tuple(found)


def level(
    patches: DrivePatches,
    trajectory: VehicleTrajectory,
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
) -> BoolArray:
    """(N,) whether patches are level, the ground rather than a wall, at these extrinsics.

    Raises:
        TrajectoryError: a scan is outside the trajectory's span.
    """
    if not len(patches.scan):
        return np.zeros(0, dtype=bool)
    return _is_level(patches.normal_lidar, _up(patches, trajectory, T_vehicle_lidar))


def ground_roughness_m(
    patches: DrivePatches,
    trajectory: VehicleTrajectory,
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
) -> float | None:
    """Scatter of the ground about pieces of half a metre, 1 sigma, beside the noise of the LiDARs.

    That of the LiDAR that sees the least of it: an error of its own is none of the ground. None: no
    LiDAR sees enough ground.

    Raises:
        TrajectoryError: a scan is outside the trajectory's span.
    """
    found = roughness_m(patches, level(patches, trajectory, T_vehicle_lidar))
    found = found[np.isfinite(found)]
    return float(found.min()) if len(found) else None


def lidars_above_ground(
    patches: DrivePatches,
    trajectory: VehicleTrajectory,
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
    on_planes: Collection[str] = (),
) -> BoolArray:
    """(L,) LiDARs for whose ground the strips stand.

    They do not see it at a grazing angle only, and in several pieces. Of others the fitted plane of
    a scan, which is made of all points, knows more. `on_planes` are LiDARs for which such planes
    stand where pieces are few; of others these are all that is known of the ground.

    Raises:
        TrajectoryError: a scan is outside the trajectory's span.
    """
    lidars = len(patches.lidars)
    if not len(patches.scan):
        return np.ones(lidars, dtype=bool)
    up, centres = _up(patches, trajectory, T_vehicle_lidar), patches.centres_lidar
    cosine = np.abs(np.einsum("ni,ni->n", centres, up)) / np.linalg.norm(centres, axis=1)
    of_ground, lidar = _is_level(patches.normal_lidar, up), patches.scan_lidar[patches.scan]
    seen = np.bincount(lidar[of_ground], minlength=lidars)
    steep = np.bincount(lidar[of_ground & (cosine > STEEP_COS)], minlength=lidars)
    scans = np.bincount(patches.scan_lidar, minlength=lidars)
    few = seen < FEWEST_OF_GROUND * scans
    few &= [name in on_planes for name in patches.lidars]
    return np.asarray((steep >= LEAST_SHARE * seen) & ~few)


def _up(
    patches: DrivePatches,
    trajectory: VehicleTrajectory,
    T_vehicle_lidar: Mapping[str, gtsam.Pose3],
) -> Array:
    """(N, 3) up in the lidar frame, of each patch."""
    R_map_vehicle, _ = trajectory.poses_at(patches.stamps_ns)
    R, _ = stack([T_vehicle_lidar[name] for name in patches.lidars])
    up_lidar = (R_map_vehicle @ R[patches.scan_lidar])[:, 2]
    return np.asarray(up_lidar[patches.scan])


def _is_level(normals: Array, up: Array) -> BoolArray:
    """Whether unit normals (n, 3) are within 25 degrees of up, (3,) or (n, 3)."""
    return np.asarray(np.abs(np.sum(normals * up, axis=1)) > LEVEL_COS)


def chosen_scans(
    stamps_ns: Sequence[Sequence[int] | IntArray], trajectory: VehicleTrajectory
) -> list[IntArray]:
    """Stamps of the scans to read, per LiDAR, of all its stamps: evenly over the motion.

    All LiDARs are read at the same instants, each at its own stamps nearest to them: fewer instants
    where their stamps are more than `MAX_POSES`.
    """
    begin, end = trajectory.span_ns
    within = []
    for of_lidar in stamps_ns:
        all_ns = np.asarray(of_lidar, dtype=np.int64)
        within.append(all_ns[(all_ns >= begin) & (all_ns <= end)])
    ends = [t for s in within if len(s) for t in (s[0], s[-1])]
    if not ends:
        return within
    first, last = int(min(ends)), int(max(ends))
    count = min((last - first) // INSTANT_NS + 1, INSTANTS)
    instants: IntArray = first + np.arange(count, dtype=np.int64) * (last - first) // max(
        count - 1, 1
    )
    motion = _motion(instants, trajectory)
    most = int(np.clip(motion.sum() / MIN_STEP_M, MIN_SCANS, MAX_SCANS))
    while True:
        at = instants[evenly_spread(motion, most)]
        # A slow LiDAR has none within milliseconds of some, and the same one for several.
        found = [np.unique(s[nearest_node(s, at)]) if len(s) else s for s in within]
        poses = len(np.unique(np.concatenate(found)))
        if poses <= MAX_POSES or most <= MIN_SCANS:
            return found
        most = max(most * MAX_POSES // poses, MIN_SCANS)


def _motion(instants_ns: IntArray, trajectory: VehicleTrajectory) -> Array:
    """Motion about each of the instants (n,), metres: half of that to either neighbour."""
    if len(instants_ns) < 2:
        return np.ones(len(instants_ns))
    R, t = trajectory.poses_at(instants_ns)
    turned = np.linalg.norm(log_so3(R[:-1].transpose(0, 2, 1) @ R[1:]), axis=1)
    moved = np.linalg.norm(np.diff(t, axis=0), axis=1)
    seconds = np.diff(instants_ns) / NANOSECONDS_PER_SECOND
    steps = moved + LEVER_M * turned + REST_M_S * seconds
    return np.asarray(0.5 * (np.append(steps, 0.0) + np.append(0.0, steps)))


def _with_noise(
    recording: Recording,
    name: str,
    stamps_ns: IntArray,
    cut: Callable[..., ScanPatches],
    config: Config,
) -> tuple[Iterator[LidarScan], RangeNoise, bool]:
    """The scans of a LiDAR, each read once, its noise, and whether its beams are in rows.

    The noise along the beam and the rows are those in some of them, which come first and are kept
    until they are known. `cut` gives the patches of a scan.

    Raises:
        RecordingError: a cloud could not be read.
        TrajectoryError: times of points are invalid.
    """
    number = min(max(len(stamps_ns) // OF_SCANS, LEAST_NOISE_SCANS), len(stamps_ns))
    chosen = stamps_ns[np.linspace(0, len(stamps_ns) - 1, number).astype(np.int64)]
    some = frozenset(chosen.tolist())
    first = list(recording.scans(name, some))
    freely = partial(cut, noise=RangeNoise.constant(OPEN_M), keep_level=True)
    found = list(worked_together(freely, first))
    noise = measured_noise(found, config.noise.lidar_range_m)
    in_rows = any(found_rows(elevations(scan.points_lidar)) is not None for scan in first)
    rest = recording.scans(name, frozenset(stamps_ns.tolist()) - some)
    return itertools.chain(_handed_over(first), rest), noise, in_rows


def _handed_over(scans: list[LidarScan]) -> Iterator[LidarScan]:
    """Some scans, none of which is kept."""
    scans.reverse()
    while scans:
        yield scans.pop()


def _stamped(cut: Callable[[LidarScan], ScanPatches], scan: LidarScan) -> tuple[int, ScanPatches]:
    """The stamp of a scan in nanoseconds, and its patches."""
    return scan.stamp_ns, cut(scan)


def scan_patches(
    scan: LidarScan,
    T_vehicle_lidar: gtsam.Pose3,
    trajectory: VehicleTrajectory,
    noise: RangeNoise,
    keep_level: bool = False,
) -> ScanPatches:
    """The patches of one scan as it was read, which the guess is good enough for.

    Raises:
        TrajectoryError: the stamp is outside the trajectory's span, or times are invalid.
    """
    stamp = within_span([scan.stamp_ns], trajectory.span_ns, "its span")
    times_s = checked_times(scan)
    motion = None
    if times_s is not None:
        motion = _sweep_motion(scan.stamp_ns, times_s, T_vehicle_lidar, trajectory)
    patches = planar_patches(scan.points_lidar, noise, times_s, motion, by_channel=True)
    begin, end = trajectory.span_ns
    at = scan.stamp_ns + np.round(patches.time_s * NANOSECONDS_PER_SECOND).astype(np.int64)
    keep: BoolArray = (at >= begin) & (at <= end)
    if not keep_level:
        R_map_vehicle, _ = trajectory.poses_at(stamp)
        up_lidar = (R_map_vehicle[0] @ T_vehicle_lidar.rotation().matrix())[2]
        keep &= ~_is_level(patches.normal_lidar, up_lidar)
    return patches.part(keep)


def _sweep_motion(
    stamp_ns: int, times_s: Array, T_vehicle_lidar: gtsam.Pose3, trajectory: VehicleTrajectory
) -> SweepMotion:
    """Twists of a LiDAR over the times of its points; none before and after the trajectory."""
    first_s = float(times_s.min())
    count = int((times_s.max() - first_s) / SLOT_S) + 1
    knots = np.round((first_s + SLOT_S * np.arange(count + 1)) * NANOSECONDS_PER_SECOND)
    begin, end = trajectory.span_ns
    at = np.clip(stamp_ns + knots.astype(np.int64), begin, end)
    R, t = trajectory.poses_at(at)
    R_extrinsic, t_extrinsic = stack([T_vehicle_lidar])
    t = t + R @ t_extrinsic[0]
    R = R @ R_extrinsic[0]
    back = R[:-1].transpose(0, 2, 1)
    seconds = np.maximum(np.diff(at), 1)[:, None] / NANOSECONDS_PER_SECOND
    return SweepMotion(
        first_s=first_s,
        turn=log_so3(back @ R[1:]) / seconds,
        velocity=np.einsum("kij,kj->ki", back, np.diff(t, axis=0)) / seconds,
    )


def _together(
    drive: int,
    names: tuple[str, ...],
    scans: Sequence[tuple[int, int, ScanPatches]],
    moved_with: tuple[gtsam.Pose3, ...],
    noises: Mapping[int, RangeNoise],
    without_rows: Collection[int] = (),
) -> DrivePatches:
    """The patches of all scans (LiDAR, stamp, patches) of a drive, and what its LiDARs are like."""
    parts = [patches for _, _, patches in scans]
    number = [len(p.time_s) for p in parts]
    return DrivePatches(
        drive=drive,
        lidars=names,
        stamps_ns=np.array([stamp for _, stamp, _ in scans], dtype=np.int64),
        scan_lidar=np.array([k for k, _, _ in scans], dtype=np.int64),
        scan=np.repeat(np.arange(len(scans), dtype=np.int64), number),
        time_s=np.concatenate([np.zeros(0), *(p.time_s for p in parts)]),
        moments=np.concatenate([np.zeros((0, 4, 4)), *(p.moments for p in parts)]),
        normal_lidar=np.concatenate([np.zeros((0, 3)), *(p.normal_lidar for p in parts)]),
        scatter_m=np.concatenate([np.zeros(0), *(p.scatter_m for p in parts)]),
        swept=Swept.joined([p.swept for p in parts], number),
        moved_with=moved_with,
        channels=ChannelSums.joined([p.channels for p in parts], number),
        noise=noises,
        without_rows=frozenset(without_rows),
    )
