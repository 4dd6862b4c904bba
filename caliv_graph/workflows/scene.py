"""What `inspect --html` draws of a drive: a few clouds of every LiDAR, the path, the target's box.

Clouds are cut into pieces of a few milliseconds, each with the vehicle's pose at its own time. So
they stay compensated for the vehicle's motion under any mounting that a user tries.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
import yaml

from caliv_graph.common.progress import Progress
from caliv_graph.config.lidars import FoundLidarConfig
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config, TargetRegion
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import CalivError
from caliv_graph.geometry.se3 import stack, unstack
from caliv_graph.pipeline import Look
from caliv_graph.products import Array, IntArray, LidarScan, Recording, TargetObservation
from caliv_graph.readers import open_recording
from caliv_graph.readers.sampled import thinned
from caliv_graph.targets.search.find import REGION_MARGIN_M, scans_to_read
from caliv_graph.trajectory.deskew import checked_times
from caliv_graph.trajectory.gnss import positions_in_map
from caliv_graph.trajectory.select import (
    GivenTrajectory,
    VehicleTrajectory,
    smooth_trajectories,
    twists_at,
)
from caliv_graph.wording.inspection import no_trajectory_sentence, unseen_lidar_sentence
from caliv_graph.workflows.draft import draft_config

ALONG_SCANS = 12
"""Of one LiDAR, along the drive: enough to see whether a wall appears once or twice."""

MOST_POINTS = 800_000
"""Of all LiDARs: 6.4 MB of a page that is to stay below 10 MB."""

LIDAR_POINTS = 15_000
"""Of one LiDAR at most, in one scan, and as many along the drive."""

NEAR_CELL_M = 0.08
FAR_CELL_M = 0.25
"""Cells of which one point is kept: of the single scan, and of those along the drive."""

RANGE_M = 60.0
"""Farther points show nothing of a mounting that nearer ones do not."""

PIECE_NS = 5_000_000
"""Duration of a piece: at 10 m/s its points are within 25 mm of where they were measured."""

STANDS_M_S = 0.05
"""A vehicle that is slower stands: scans that are 20 ms apart then agree to a millimetre."""

ARM_M = 10.0
"""Distance at which a rotation counts as speed: where the clouds are."""

PATH_POINTS = 1500
FIXES = 1500
"""Drawn at most."""

BOX_PERCENT = 2.0
"""Points of a found target that its box may leave out on each side: strays."""


@dataclass(frozen=True)
class Piece:
    """Points of one scan, taken within a few milliseconds.

    Attributes:
        points_lidar: (N, 3) metres.
        T_view_vehicle: the vehicle at their time, in the frame in which they are shown.
    """

    points_lidar: Array
    T_view_vehicle: gtsam.Pose3


@dataclass(frozen=True)
class SceneLidar:
    """One LiDAR of the scene.

    Attributes:
        name: the user's.
        topic: or folder of its clouds.
        initial: its mounting; None: unknown.
        origin: where the mounting is from, or that it is unknown.
        once: pieces of one scan, in the vehicle frame at `Scene.T_map_view`.
        along: pieces of several scans along the drive, in the map; empty without a trajectory.
    """

    name: str
    topic: str
    initial: PoseConfig | None
    origin: str
    once: tuple[Piece, ...]
    along: tuple[Piece, ...]


@dataclass(frozen=True)
class Box:
    """A region of a target, of the config or about an object that was found."""

    name: str
    region: TargetRegion
    found: bool


@dataclass(frozen=True)
class Scene:
    """What a page shows of a drive in space.

    Attributes:
        lidars: in the config's order.
        T_map_view: the vehicle when the single scans were taken; None without a trajectory.
        T_map_start: the vehicle's first pose; None likewise.
        path_map: (n, 3) metres, the vehicle's way; empty without a trajectory.
        fixes_map: (m, 3) metres, the GNSS antenna.
        boxes: of targets.
        height_m: of the vehicle frame above ground; None: unknown.
        problems: what could not be shown, and why, a sentence each.
    """

    lidars: tuple[SceneLidar, ...]
    T_map_view: gtsam.Pose3 | None
    T_map_start: gtsam.Pose3 | None
    path_map: Array
    fixes_map: Array
    boxes: tuple[Box, ...]
    height_m: float | None
    problems: tuple[str, ...]


NO_POINTS = np.zeros((0, 3))


def drafted(data: Path) -> tuple[Recording, Config]:
    """A drive with the config that `init` would write for it.

    Raises:
        CalivError: it has no clouds, or is damaged.
    """
    here = Path("config.yaml")
    raw = yaml.safe_load(draft_config(data, here).text)
    config = parse_config(raw, f"the config that 'init' drafts for {data}", Path.cwd())
    return open_recording(config, data), config


def scene_of(
    recording: Recording,
    config: Config,
    seen: Look | None,
    progress: Progress,
    origin: str = "initial guess",
) -> Scene:
    """Collects a scene; what cannot be read is named in it.

    Args:
        recording: the drive.
        config: its topics and mountings.
        seen: what a search for the target has found already; None: none was made.
        progress: reports every stage.
        origin: what the mountings of the config are.
    """
    problems: list[str] = []
    given = config
    trajectory = None
    if seen is not None:
        config, trajectory = seen.config or config, seen.trajectory
    if trajectory is None:
        try:
            with progress.stage("smoothing the trajectory", None):
                (trajectory,) = smooth_trajectories([recording], config, [[]])
        except CalivError as error:
            problems.append(no_trajectory_sentence(str(error)))
    view_ns = _view_stamp(recording, trajectory)
    points = min(LIDAR_POINTS, MOST_POINTS // (2 * len(config.lidars)))
    lidars = []
    with progress.stage("reading clouds to draw", len(config.lidars)) as advance:
        for name in config.lidars:
            once, along = _chosen(recording, trajectory, name, view_ns)
            read: dict[int, LidarScan] = {}
            try:
                wanted = {*once, *along}
                read = {scan.stamp_ns: scan for scan in recording.scans(name, wanted)}
                parts = (
                    _pieces(read, once, trajectory, points, NEAR_CELL_M, view_ns),
                    _pieces(
                        read, along, trajectory, points // max(len(along), 1), FAR_CELL_M, None
                    ),
                )
            except CalivError as error:
                problems.append(unseen_lidar_sentence(name, str(error)))
                parts = ((), ())
            lidars.append(_lidar(name, given, config, origin, parts))
            advance()
    return Scene(
        lidars=tuple(lidars),
        T_map_view=None if trajectory is None or view_ns is None else _pose(trajectory, view_ns),
        T_map_start=None if trajectory is None else _pose(trajectory, trajectory.span_ns[0]),
        path_map=_path(trajectory),
        fixes_map=_fixes(recording, config, trajectory),
        boxes=_boxes(config, seen, trajectory),
        height_m=config.ground.vehicle_height,
        problems=tuple(problems),
    )


def without_clouds(problem: str) -> Scene:
    """A scene with nothing but the reason."""
    return Scene((), None, None, NO_POINTS, NO_POINTS, (), None, (problem,))


def _lidar(
    name: str,
    given: Config,
    config: Config,
    origin: str,
    pieces: tuple[tuple[Piece, ...], tuple[Piece, ...]],
) -> SceneLidar:
    lidar = config.lidars[name]
    if isinstance(lidar, FoundLidarConfig):
        origin = "found from the drive"
    elif lidar.initial is None:
        origin = "mounting unknown"
    initial = given.lidars[name].initial
    if initial is None and lidar.initial is not None:
        # Good to 0.2 m and 2 degrees: more digits would only look exact.
        initial = PoseConfig(
            xyz=_rounded(lidar.initial.xyz, 3), rpy_deg=_rounded(lidar.initial.rpy_deg, 2)
        )
    return SceneLidar(name, lidar.topic, initial, origin, *pieces)


def _pose(trajectory: VehicleTrajectory, stamp_ns: int) -> gtsam.Pose3:
    (T,) = unstack(*trajectory.poses_at([stamp_ns]))
    return T


def _in_span(recording: Recording, trajectory: VehicleTrajectory | None, name: str) -> IntArray:
    """Stamps of the clouds of a LiDAR at which there is a pose; without a trajectory all."""
    stamps = np.asarray(recording.scan_stamps_ns(name), np.int64)
    if trajectory is None:
        return stamps
    begin, end = trajectory.span_ns
    return stamps[(stamps >= begin) & (stamps <= end)]


def _evenly(count: int, most: int) -> IntArray:
    """Indices of at most so many of `count`, the first and the last among them."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)


def _view_stamp(recording: Recording, trajectory: VehicleTrajectory | None) -> int | None:
    """A time at which all LiDARs scan and the vehicle stands or is slowest; None without clouds."""
    spans = [_in_span(recording, trajectory, name) for name in recording.lidars]
    spans = [stamps for stamps in spans if len(stamps)]
    if not spans:
        return None
    begin, end = max(int(s[0]) for s in spans), min(int(s[-1]) for s in spans)
    common = spans[0][(spans[0] >= begin) & (spans[0] <= end)]
    stamps = common if len(common) else spans[0]
    stamps = stamps[_evenly(len(stamps), 200)]
    if trajectory is None:
        return int(stamps[0])
    twists = twists_at(trajectory, stamps.tolist())
    speed = np.linalg.norm(twists[:, 3:], axis=1) + ARM_M * np.linalg.norm(twists[:, :3], axis=1)
    stands = np.flatnonzero(speed < STANDS_M_S)
    return int(stamps[stands[0] if len(stands) else speed.argmin()])


def _chosen(
    recording: Recording, trajectory: VehicleTrajectory | None, name: str, view_ns: int | None
) -> tuple[list[int], list[int]]:
    """Stamps of the single scan of a LiDAR, and of those along the drive."""
    stamps = _in_span(recording, trajectory, name)
    if view_ns is None or not len(stamps):
        return [], []
    once = [int(stamps[np.abs(stamps - view_ns).argmin()])]
    if trajectory is None:
        return once, []
    readable = scans_to_read(stamps.tolist(), trajectory)
    return once, readable[_evenly(len(readable), ALONG_SCANS)].tolist()


def _pieces(
    read: dict[int, LidarScan],
    chosen: Iterable[int],
    trajectory: VehicleTrajectory | None,
    most: int,
    cell_m: float,
    view_ns: int | None,
) -> tuple[Piece, ...]:
    """Pieces of chosen scans, in the map, or in the vehicle frame at `view_ns`."""
    out: list[Piece] = []
    for stamp in chosen:
        if stamp not in read:
            continue  # a damaged cloud, which the recording has left out
        scan = thinned(read[stamp], most, cell_m, RANGE_M)
        if trajectory is None:
            out.append(Piece(scan.points_lidar, gtsam.Pose3()))
            continue
        times_s = checked_times(scan)
        late: IntArray = np.zeros(len(scan.points_lidar), np.int64)
        if times_s is not None:
            late = np.round(1e9 * times_s).astype(np.int64)
        parts = late // PIECE_NS
        which, of_point = np.unique(parts, return_inverse=True)
        begin, end = trajectory.span_ns
        middle = PIECE_NS // 2 if times_s is not None else 0
        at = np.clip(stamp + which * PIECE_NS + middle, begin, end)
        poses = unstack(*trajectory.poses_at(at)) if len(at) else ()
        if view_ns is not None:
            back = _pose(trajectory, view_ns).inverse()
            poses = tuple(back.compose(T) for T in poses)
        out += [Piece(scan.points_lidar[of_point == k], T) for k, T in enumerate(poses)]
    return tuple(out)


def _path(trajectory: VehicleTrajectory | None) -> Array:
    if trajectory is None:
        return NO_POINTS
    begin, end = trajectory.span_ns
    stamps = begin + (end - begin) * np.arange(PATH_POINTS) // (PATH_POINTS - 1)
    _, path = trajectory.poses_at(stamps)
    return path


def _fixes(recording: Recording, config: Config, trajectory: VehicleTrajectory | None) -> Array:
    """GNSS fixes in the map; of given poses the map is another."""
    if isinstance(trajectory, GivenTrajectory):
        return NO_POINTS
    try:
        gnss = recording.motion().gnss
        if gnss is None:
            return NO_POINTS
        positions, _ = positions_in_map(gnss, config, recording.name)
    except CalivError:
        return NO_POINTS  # the inspection says what is wrong with them
    at = positions.position_map
    return at[_evenly(len(at), FIXES)]


def _boxes(
    config: Config, seen: Look | None, trajectory: VehicleTrajectory | None
) -> tuple[Box, ...]:
    """The config's boxes; without any, one about each target that was found."""
    if config.target:
        regions = config.target
        return tuple(
            Box(name, region, False)
            for name, region in zip(_names(len(regions)), regions, strict=True)
            # Where the first pose is, only a trajectory tells.
            if region.frame == "map" or trajectory is not None
        )
    if seen is None or trajectory is None:
        return ()
    targets = seen.observations or ()
    return tuple(
        Box(name, _region(found, seen.config or config, trajectory), True)
        for name, found in zip(_names(len(targets)), targets, strict=True)
    )


def _names(count: int) -> list[str]:
    """Of boxes; short, for the picture."""
    return ["target"] if count == 1 else [f"target {i + 1}" for i in range(count)]


def _region(
    found: TargetObservation, config: Config, trajectory: VehicleTrajectory
) -> TargetRegion:
    """A box in the map about the clouds of a target that was found."""
    R, t = trajectory.poses_at([cloud.stamp_ns for cloud in found.clouds])
    mounts = stack([config.lidars[cloud.lidar].guess() for cloud in found.clouds])
    points = np.concatenate(
        [
            (cloud.points_lidar @ R_l.T + t_l) @ R_v.T + t_v
            for cloud, R_v, t_v, R_l, t_l in zip(found.clouds, R, t, *mounts, strict=True)
        ]
    )
    low, high = np.percentile(points, [BOX_PERCENT, 100.0 - BOX_PERCENT], axis=0)
    return TargetRegion(
        min=_rounded(low - REGION_MARGIN_M), max=_rounded(high + REGION_MARGIN_M), frame="map"
    )


def _rounded(values: Sequence[float] | Array, digits: int = 3) -> tuple[float, float, float]:
    x, y, z = (round(float(v), digits) for v in values)
    return x, y, z
