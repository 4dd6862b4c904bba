"""A yard of walls, and patches of it drawn directly: for tests of the solve with known truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, IntArray
from caliv_graph.structure.channels import ChannelSums, PointChannels
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.prior import PosePrior

STEP_NS = 200_000_000


@dataclass(frozen=True)
class Wall:
    """A face: middle of its foot (2,), heading of its normal, length and height in metres."""

    middle: tuple[float, float]
    heading_rad: float
    length_m: float
    height_m: float = 3.0

    def axes(self) -> tuple[Array, Array, Array]:
        """Centre (3,), normal, and direction along the wall."""
        c, s = np.cos(self.heading_rad), np.sin(self.heading_rad)
        centre = np.array([*self.middle, 0.5 * self.height_m])
        return centre, np.array([c, s, 0.0]), np.array([-s, c, 0.0])


def yard(walls: int = 8, distance_m: float = 19.0) -> list[Wall]:
    """Walls around the origin, facing it, of 8 to 18 m."""
    out = []
    for i in range(walls):
        at = 2.0 * np.pi * i / walls + 0.1 * np.sin(3.0 * i)
        r = distance_m * (1.0 + 0.15 * np.cos(2.0 * i))
        heading = at + np.pi + 0.3 * np.sin(5.0 * i)
        length = 8.0 + 10.0 * (0.5 + 0.5 * np.sin(7.0 * i))
        out.append(Wall((r * np.cos(at), r * np.sin(at)), heading, length))
    return out


def figure_eight(m: int, radius_m: float = 9.16) -> tuple[Array, Array]:
    """Positions (m, 3) and yaws (m,) along two circles."""
    s = np.linspace(0.0, 4.0 * np.pi, m)
    first = s < 2.0 * np.pi
    yaw = np.where(first, -s, -(4.0 * np.pi - s))
    y = np.where(first, -radius_m * (1.0 - np.cos(s)), radius_m * (1.0 - np.cos(s)))
    return np.stack([radius_m * np.sin(s), y, np.zeros(m)], axis=1), yaw


def poses(positions: Array, yaws: Array) -> tuple[gtsam.Pose3, ...]:
    """T_map_vehicle."""
    return tuple(
        gtsam.Pose3(gtsam.Rot3.Yaw(yaw), p) for p, yaw in zip(positions, yaws, strict=True)
    )


TRUE = {
    "front": gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.17, 0.0), np.array([2.0, 0.0, 2.0])),
    "rear": gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.17, np.pi), np.array([-0.4, 0.0, 2.0])),
}


@dataclass(frozen=True)
class Noise:
    """Sigmas in metres; `bump_cell_m`: size of the pieces of a wall.

    `channel_m` is that of the ranges of each channel, half a degree high.
    """

    range_m: float = 0.01
    sighting_m: float = 0.002
    wall_m: float = 0.0
    bump_m: float = 0.005
    bump_cell_m: float = 1.5
    bias_m: float = 0.005
    channel_m: float = 0.0


CHANNEL_DEG = 0.5
"""Height of a channel."""


def channel_of(elevation_rad: Array) -> IntArray:
    """Index of the channel at elevations."""
    return np.asarray(np.degrees(elevation_rad) // CHANNEL_DEG + 180).astype(np.int64)


def channel_errors(noise: Noise, lidar: int) -> Array:
    """(360,) by how much the ranges of each channel of a LiDAR are too long, metres."""
    return noise.channel_m * np.random.default_rng([lidar, 7]).standard_normal(360)


@dataclass(frozen=True)
class Slip:
    """From a pose on the mounts of some LiDARs are elsewhere: `T_vehicle_lidar Exp(by)`."""

    lidars: tuple[int, ...]
    pose: int
    by: Array

    def moved(self, lidar: int, pose: int, T_vehicle_lidar: gtsam.Pose3) -> gtsam.Pose3:
        """T_vehicle_lidar of a LiDAR at a pose."""
        slipped = lidar in self.lidars and pose >= self.pose
        return T_vehicle_lidar.retract(self.by) if slipped else T_vehicle_lidar


def draw_patches(
    walls: Sequence[Wall],
    T_map_vehicle: Sequence[gtsam.Pose3],
    rng: np.random.Generator,
    noise: Noise = Noise(),
    extrinsics: dict[str, gtsam.Pose3] = TRUE,
    points: int = 60,
    patch_m: float = 0.7,
    half_fov_rad: float = np.radians(60.0),
    range_m: float = 60.0,
    slip: Slip | None = None,
) -> DrivePatches:
    """Patches of walls as seen from true poses, all LiDARs at all stamps."""
    cells = [rng.standard_normal((40, 10)) * noise.bump_m for _ in walls]
    out: dict[str, list[Any]] = {k: [] for k in ("scan", "moments", "normal", "scatter")}
    stamps, scan_lidar = [], []
    of_channels: list[ChannelSums | None] = []
    scan = 0
    for number, T in enumerate(extrinsics.values()):
        bias = rng.standard_normal() * noise.bias_m
        channels = channel_errors(noise, number)
        for i, X in enumerate(T_map_vehicle):
            stamps.append(i * STEP_NS)
            scan_lidar.append(number)
            L = X.compose(T if slip is None else slip.moved(number, i, T))
            (R,), (t,) = stack([L])
            for w, wall in enumerate(walls):
                centre, normal, along = wall.axes()
                if (t - centre) @ normal < 0.5:
                    continue
                common = rng.standard_normal() * noise.wall_m
                pieces = rng.standard_normal(40) * noise.sighting_m
                u = np.arange(-wall.length_m / 2, wall.length_m / 2, patch_m) + patch_m / 2
                v = np.arange(0.3, wall.height_m, patch_m)
                U, V = (g.ravel() for g in np.meshgrid(u, v))
                p = centre + np.outer(U, along)
                p[:, 2] = V
                local = (p - t) @ R
                d = np.linalg.norm(local, axis=1)
                az = np.arctan2(local[:, 1], local[:, 0])
                el = np.arcsin(local[:, 2] / d)
                seen = (np.abs(az) < half_fov_rad) & (np.abs(el) < np.radians(15.0))
                seen &= (d < range_m) & (d > 1.0)
                cos = ((t - p) @ normal) / d
                seen &= cos > 0.26
                which = np.flatnonzero(seen)
                if not len(which):
                    continue
                n = np.clip((points * (15.0 / d[which]) ** 2 * cos[which]).astype(int), 8, 300)
                # Drawn patch by patch, the rest for all points of the wall at once.
                drawn = [
                    (rng.uniform(-0.5, 0.5, m), rng.uniform(-0.5, 0.5, m), rng.standard_normal(m))
                    for m in n.tolist()
                ]
                beside, above, white = (np.concatenate(part) for part in zip(*drawn, strict=True))
                first, of = np.cumsum(n) - n, np.repeat(which, n)
                q = p[of] + np.outer(beside * patch_m, along)
                q[:, 2] += above * patch_m
                cu = ((q - centre) @ along / noise.bump_cell_m + 20).astype(int)
                cv = (q[:, 2] / noise.bump_cell_m).astype(int)
                own_error = common + pieces[(U[of] // 2.0 + 20).astype(int)]
                q += np.outer(cells[w][cu, cv] + own_error, normal)
                q_l = (q - t) @ R
                r = np.linalg.norm(q_l, axis=1)
                own_channel = channel_of(np.arcsin(q_l[:, 2] / r))
                long = bias + channels[own_channel]
                q_l *= (1.0 + (long + white * noise.range_m) / r)[:, None]
                h = np.column_stack([q_l, np.ones(len(q_l))])
                moments = np.add.reduceat(h[:, :, None] * h[:, None, :], first)
                if noise.channel_m:
                    of_channels += [
                        _sums(own_channel[a : a + m], q_l[a : a + m])
                        for a, m in zip(first.tolist(), n.tolist(), strict=True)
                    ]
                c = np.add.reduceat(q_l, first) / n[:, None]
                off = q_l - np.repeat(c, n, axis=0)
                spread = np.add.reduceat(off[:, :, None] * off[:, None, :], first)
                values, vectors = np.linalg.eigh(spread / n[:, None, None])
                nu = vectors[:, :, 0]
                out["scan"].append(np.full(len(n), scan))
                out["moments"].append(moments)
                out["normal"].append(np.where((nu * c).sum(axis=1)[:, None] < 0.0, nu, -nu))
                out["scatter"].append(np.sqrt(values[:, 0] * n / (n - 3.0)))
            scan += 1
    return DrivePatches(
        drive=0,
        lidars=tuple(extrinsics),
        stamps_ns=np.array(stamps, np.int64),
        scan_lidar=np.array(scan_lidar, np.int64),
        scan=np.concatenate(out["scan"]).astype(np.int64),
        time_s=np.zeros(sum(map(len, out["scan"]))),
        moments=np.concatenate(out["moments"]),
        normal_lidar=np.concatenate(out["normal"]),
        scatter_m=np.concatenate(out["scatter"]),
        channels=ChannelSums.joined(of_channels, [1] * len(of_channels))
        if noise.channel_m
        else None,
    )


def _sums(channel: IntArray, points_lidar: Array) -> ChannelSums | None:
    """Sums of the points (n, 3) of a patch, by their channels (n,)."""
    seen_by, which = np.unique(channel, return_inverse=True)
    middles = np.radians(CHANNEL_DEG * (seen_by - 179.5))
    return PointChannels(middles, which).sums(points_lidar.T, np.zeros(len(channel), np.int64))


def draw_prior(
    T_map_vehicle: Sequence[gtsam.Pose3],
    rng: np.random.Generator,
    rotation_rad: float = 1e-3,
    position_m: float = 0.02,
    time_s: float = 5.0,
    heave_m: float = 0.005,
) -> PosePrior:
    """Poses that err as a smoothed trajectory does: slowly, and by heave; their information."""
    m = len(T_map_vehicle)
    at = np.arange(m) * STEP_NS * 1e-9
    decay = np.exp(-np.abs(at[:, None] - at) / time_s) + 1e-4 * np.eye(m)
    sigmas = np.array([rotation_rad] * 3 + [position_m] * 3)
    cov = np.kron(decay, np.diag(sigmas**2))
    z = np.arange(5, 6 * m, 6)
    cov[z, z] += heave_m**2
    d = np.linalg.cholesky(cov) @ rng.standard_normal(6 * m)
    means = [X.retract(-v) for X, v in zip(T_map_vehicle, d.reshape(m, 6), strict=True)]
    return PosePrior(
        stamps_ns=np.arange(m) * STEP_NS,
        T_map_vehicle=tuple(means),
        parameters={},
        information=np.linalg.inv(cov),
        gradient=np.zeros(6 * m),
        parameter_information=np.zeros((0, 0)),
        parameter_offset=np.zeros(0),
    )
