"""LiDARs of four kinds that look at meshes while they move.

Nothing here is imported from caliv_graph: see `_foreign_drives.py`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from scripts._foreign_draws import Draws
from scripts._foreign_vehicle import Motion
from scripts._foreign_world import Array, Grass, IntArray, Mesh, Mover

if TYPE_CHECKING:
    import open3d as o3d

Kind = Literal["spinning", "solid", "rosette", "dome"]
TimeField = Literal["t", "time", "timestamp", "offset_time"]

UNEVEN_CHANNELS_DEG = np.concatenate(
    [np.linspace(-25, -8, 9), np.linspace(-6.5, 4, 18), np.linspace(5.5, 15, 5)]
)
"""Elevations of a spinning LiDAR of 32 channels, denser about the horizon."""

SCAN_GROUPS = 6
"""Channels of a LiDAR without rows, for the errors of channels."""

MOST_POSES = 2000
"""More instants of a sweep than these share the poses of `FEWER_POSES`."""

FEWER_POSES = 1001

NEAREST_M = 0.3

BODIES_SEEN_M = 50.0
"""Moving bodies beyond are not cast."""


@dataclass(frozen=True)
class Lidar:
    """A LiDAR and its true mounting.

    Attributes:
        xyz_m: position in the axle frame.
        rpy_deg: rotation to the axle frame.
        kind: pattern of the beams.
        channels: rows; of a rosette or dome, a factor of the number of beams.
        fov_deg: elevations (spinning, dome); the second is the width of a rosette.
        columns: beams per channel.
        rate_hz: sweeps per second.
        phase_s: start of the first sweep.
        noise_m: of ranges of 10 m at normal incidence.
        quantum_m: step of ranges.
        divergence_rad: half width of a beam.
        max_range_m: of a return.
        time_field: name of the field of the point's time, which gives its type.
        deskewed: points are moved to the start of the sweep, and keep their times.
    """

    xyz_m: tuple[float, float, float]
    rpy_deg: tuple[float, float, float]
    kind: Kind = "spinning"
    channels: int = 32
    fov_deg: tuple[float, float] = (-22.5, 22.5)
    columns: int = 1024
    rate_hz: float = 10.0
    phase_s: float = 0.013
    noise_m: float = 0.008
    quantum_m: float = 0.002
    divergence_rad: float = 0.0012
    max_range_m: float = 90.0
    time_field: TimeField = "t"
    deskewed: bool = False

    @property
    def period_s(self) -> float:
        return 1.0 / self.rate_hz

    @property
    def mounting(self) -> Array:
        """(3, 3) rotation to the axle frame."""
        turn = Rotation.from_euler("ZYX", self.rpy_deg[::-1], degrees=True)
        return np.asarray(turn.as_matrix())


@dataclass(frozen=True)
class Beams:
    """Beams of a sweep, (n,) each; time from its start."""

    azimuth_rad: Array
    elevation_rad: Array
    time_s: Array
    channel: IntArray

    def directions(self, off_rad: Array | None = None) -> Array:
        """(n, 3) unit vectors; `off_rad` (2, n): errors of azimuth and elevation."""
        azimuth, elevation = self.azimuth_rad, self.elevation_rad
        if off_rad is not None:
            azimuth, elevation = azimuth + off_rad[0], elevation + off_rad[1]
        flat = np.cos(elevation)
        return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


@dataclass(frozen=True)
class Sweep:
    """Returns of a sweep, (n, ...) each; time from its start."""

    start_s: float
    points: Array
    time_s: Array
    channel: IntArray
    intensity: Array


def beams(lidar: Lidar, sweep: int) -> Beams:
    """The beams of a sweep; rosette and dome have a pattern that does not repeat."""
    if lidar.kind == "spinning":
        return _spinning(lidar)
    if lidar.kind == "solid":
        return _solid(lidar)
    count = lidar.columns * lidar.channels
    order = np.arange(count)
    time_s = order * lidar.period_s / count
    total_s = sweep * lidar.period_s + time_s
    if lidar.kind == "rosette":
        a, b = 2 * np.pi * 77.13 * total_s, -2 * np.pi * 46.71 * total_s
        half = np.radians(lidar.fov_deg[1] / 2)
        azimuth, elevation = half * (np.cos(a) + np.cos(b)), half * (np.sin(a) + np.sin(b))
        return Beams(azimuth, elevation, time_s, order % SCAN_GROUPS)
    low, high = np.radians(lidar.fov_deg)
    saw = np.abs((total_s * 171.37 + order % 4 / 4) % 2 - 1)
    azimuth = -2 * np.pi * 9.713 * total_s
    return Beams(azimuth, low + (high - low) * saw, time_s, order % 4)


def _spinning(lidar: Lidar) -> Beams:
    """Clockwise turns; neighbouring channels look aside by up to 1.2 degrees."""
    elevations = np.radians(np.linspace(*lidar.fov_deg, lidar.channels))
    if lidar.channels == 32 and lidar.fov_deg[0] < -20:
        elevations = np.radians(UNEVEN_CHANNELS_DEG)
    column = np.repeat(np.arange(lidar.columns), lidar.channels)
    channel = np.tile(np.arange(lidar.channels), lidar.columns)
    aside = np.radians(((channel * 7) % 4 - 1.5) * 0.8)
    azimuth = -2 * np.pi * column / lidar.columns + aside
    return Beams(azimuth, elevations[channel], column * lidar.period_s / lidar.columns, channel)


def _solid(lidar: Lidar) -> Beams:
    """Rows over 120 degrees, two at a time, there and back."""
    azimuths = np.radians(np.linspace(60, -60, lidar.columns))
    elevations = np.radians(np.linspace(12.5, -12.5, lidar.channels))
    row = np.repeat(np.arange(lidar.channels), lidar.columns)
    column = np.tile(np.arange(lidar.columns), lidar.channels)
    along = column / lidar.columns
    done = (row // 2 * 2 + 2 * np.where(row // 2 % 2 == 1, 1 - along, along)) / lidar.channels
    azimuth = azimuths[column]
    elevation = elevations[row] + np.radians(0.3) * np.cos(azimuth)
    return Beams(azimuth, elevation, 0.95 * lidar.period_s * done, row)


@dataclass(frozen=True)
class Rays:
    """Rays (n, 3) in the world and in the axle frame, and their times."""

    origin: Array
    direction: Array
    time_s: Array
    body_origin: Array
    body_direction: Array


class Scene:
    """Meshes that stand, meshes that move, and the vehicle's own body.

    Args:
        still: in the world.
        movers: in the world.
        body: in the axle frame.
        grass: on the ground; None: the ground is bare.
    """

    def __init__(
        self, still: Mesh, movers: list[Mover], body: Mesh | None, grass: Grass | None = None
    ) -> None:
        self._still = _ray_scene(still)
        self.grass = grass
        self._movers = [(mover, _ray_scene(mover.mesh)) for mover in movers]
        self._body = None if body is None else _ray_scene(body)

    def cast(self, rays: Rays) -> tuple[Array, Array]:
        """Ranges (inf: nothing) and cosines of incidence."""
        ranges, cosines = _cast(self._still, rays.origin, rays.direction)
        others = []
        for mover, scene in self._movers:
            yaw_rad, place = mover.pose(rays.time_s)
            if np.min(np.linalg.norm(place - rays.origin, axis=1)) > BODIES_SEEN_M:
                continue
            turn = Rotation.from_euler("z", yaw_rad).as_matrix()
            others.append(_cast(scene, (rays.origin - place) @ turn, rays.direction @ turn))
        if self._body is not None:
            others.append(_cast(self._body, rays.body_origin, rays.body_direction))
        for other, cosine in others:
            cosines, ranges = np.where(other < ranges, cosine, cosines), np.minimum(ranges, other)
        return ranges, cosines


def _ray_scene(mesh: Mesh) -> o3d.t.geometry.RaycastingScene:
    import open3d as o3d  # takes a second

    vertices, faces = mesh.arrays()
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(vertices.astype(np.float32)),
        o3d.core.Tensor.from_numpy(faces.astype(np.uint32)),
    )
    return scene


def _cast(
    scene: o3d.t.geometry.RaycastingScene, origin: Array, direction: Array
) -> tuple[Array, Array]:
    import open3d as o3d

    rays = np.column_stack([origin, direction]).astype(np.float32)
    hit = scene.cast_rays(o3d.core.Tensor.from_numpy(rays), nthreads=1)
    cosine = np.abs(np.sum(hit["primitive_normals"].numpy() * direction, axis=1))
    return hit["t_hit"].numpy().astype(np.float64), cosine


class _Moving:
    """A LiDAR on its way through one sweep: rays of directions in its own frame."""

    def __init__(self, lidar: Lidar, motion: Motion, start_s: float, time_s: Array) -> None:
        # Poses at a few hundred instants; between them the motion is straight enough.
        at, inverse = np.unique(time_s, return_inverse=True)
        shared = len(at) > MOST_POSES
        if shared:
            at = np.linspace(0, lidar.period_s, FEWER_POSES)
            steps = FEWER_POSES - 1
            inverse = np.minimum((time_s / lidar.period_s * steps).round().astype(int), steps)
        turns, places = motion.pose(start_s + at)
        self._mounting = lidar.mounting
        self._where = np.array(lidar.xyz_m)
        self._turn = (turns @ self._mounting)[inverse]
        self._origin = places[inverse] + (turns @ self._where)[inverse]
        if shared:
            velocity = motion.values(start_s + at, 1)[:, :3]
            self._origin += velocity[inverse] * (time_s - at[inverse])[:, None]
        self._time_s = start_s + time_s

    def at_start(self, points: Array) -> Array:
        """Points (n, 3) of all beams, moved to the LiDAR's frame at the first beam."""
        there = self._origin + np.einsum("nij,nj->ni", self._turn, points)
        first = int(np.argmin(self._time_s))
        return np.asarray((there - self._origin[first]) @ self._turn[first])

    def rays(self, directions: Array) -> Rays:
        return Rays(
            self._origin,
            np.einsum("nij,nj->ni", self._turn, directions),
            self._time_s,
            np.broadcast_to(self._where, directions.shape),
            directions @ self._mounting.T,
        )


def scan(draws: Draws, name: str, lidar: Lidar, motion: Motion, scene: Scene) -> Iterator[Sweep]:
    """The sweeps of a drive; points are where the LiDAR believes them, in its own frame."""
    rng = draws.stream(f"lidar {name}")
    at_edges = draws.stream(f"edges {name}")  # others draw the same without edges
    dropped = draws.stream(f"dropouts {name}")
    in_grass = draws.stream(f"grass {name}")
    channels = lidar.channels if lidar.kind in ("spinning", "solid") else SCAN_GROUPS
    range_error = draws.on("channel_range") * 0.003 * rng.normal(size=channels)
    range_error += draws.on("range_bias") * 0.004 * rng.normal()
    angle_error = draws.on("channel_angle") * 1.5e-4 * rng.normal(size=(2, channels))
    slope_m = draws.on("incidence_bias") * abs(0.001 * rng.normal())
    last_s = motion.t[-1] - lidar.phase_s - 0.05
    for k in range(int(last_s / lidar.period_s) - 1):
        start_s = lidar.phase_s + k * lidar.period_s
        sent = beams(lidar, k)
        real = sent.directions(angle_error[:, sent.channel])
        moving = _Moving(lidar, motion, start_s, sent.time_s)
        ranges, cosines = scene.cast(rays := moving.rays(real))
        if scene.grass is not None and draws.on("grass"):
            ranges = scene.grass.seen(in_grass, rays.origin, rays.direction, ranges, cosines)
        if draws.on("edges"):
            ranges = _at_edges(at_edges, lidar, scene, moving, real, ranges, cosines)
        cosines = np.maximum(cosines, 0.03)
        seen = np.isfinite(ranges) & (ranges > NEAREST_M) & (ranges < lidar.max_range_m)
        far = np.where(seen, ranges, 1.0)
        strength = cosines / (1 + (far / 35) ** 2)
        if draws.on("dropouts"):
            seen &= dropped.random(len(far)) > np.exp(-strength / 0.02) + 0.005
        sigma = lidar.noise_m * (0.7 + 0.3 * far / 10) * np.minimum(1 / np.sqrt(cosines), 2.5)
        far = far + draws.on("range_noise") * sigma * rng.normal(size=len(far))
        far += range_error[sent.channel] + slope_m * np.minimum(1 / cosines - 1, 4)
        if draws.on("quantisation"):
            far = np.round(far / lidar.quantum_m) * lidar.quantum_m
        points = sent.directions() * far[:, None]
        if lidar.deskewed:
            points = moving.at_start(points)
        yield Sweep(
            start_s, points[seen], sent.time_s[seen], sent.channel[seen], 100 * strength[seen]
        )


def _at_edges(
    rng: np.random.Generator,
    lidar: Lidar,
    scene: Scene,
    moving: _Moving,
    directions: Array,
    ranges: Array,
    cosines: Array,
) -> Array:
    """Ranges of beams with a width, part of which hits another surface: between both, or none.

    `cosines` are those of the incidence: on a slanting surface the footprint is no edge.
    """
    aside = directions + rng.normal(size=directions.shape) * lidar.divergence_rad
    aside /= np.linalg.norm(aside, axis=1)[:, None]
    others, _ = scene.cast(moving.rays(aside))
    both = np.isfinite(ranges) & np.isfinite(others)
    gap = np.abs(np.where(both, others, 0) - np.where(both, ranges, 0))
    slant = lidar.divergence_rad * np.where(both, ranges, 0) / np.maximum(np.abs(cosines), 0.03)
    edge = both & (gap > 0.04 + 4.0 * slant)
    mixed = edge & (gap < 1.2) & (rng.random(len(ranges)) < 0.6)
    share = rng.random(len(ranges))
    out = ranges.copy()
    out[mixed] += (others[mixed] - ranges[mixed]) * share[mixed]
    return np.where(edge & ~mixed & (rng.random(len(ranges)) < 0.3), np.inf, out)
