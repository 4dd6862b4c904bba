"""Clouds of a chair and of plates with known poses, and how far a registration is from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import gtsam
import numpy as np

from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.model import Config, RegistrationConfig
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.config.noise import NoiseConfig
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, Side, TargetCloud, TargetObservation
from caliv_graph.registration.centring import middles_of
from caliv_graph.registration.clouds import CloudStack
from caliv_graph.scenario.model import CropModel
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.scenario.world import World, make_world
from caliv_graph.scenario.world_models import ChairModel, WorldModel
from caliv_graph.simulation.lidar import SimulatedLidar
from caliv_graph.simulation.rays import RayCaster

CENTRE_M = 0.62
"""Height of the chair's middle above the ground: the origin of the target frame."""

STRAIGHT = PoseConfig(xyz=(0.0, 0.0, 0.0), rpy_deg=(0.0, 0.0, 0.0))

IDENTITY = (np.eye(3)[None], np.zeros((1, 3)))
"""Pose of one cloud, as `expect` takes it."""


@dataclass(frozen=True)
class Scene:
    """Clouds and the true pose of the LiDAR that took each."""

    observation: TargetObservation
    T_target_lidar: tuple[gtsam.Pose3, ...]


def config_of(
    *, components: int = 300, lidar_range_m: float = 0.01, max_points: int = 1500
) -> Config:
    return Config(
        lidars={"front": LidarConfig(topic="sensor_1", initial=STRAIGHT)},
        noise=NoiseConfig(lidar_range_m=lidar_range_m),
        registration=RegistrationConfig(components=components, max_points=max_points),
    )


def observe(clouds: Sequence[Array]) -> TargetObservation:
    """Points (lidar frame) as the clouds of one placement."""
    return TargetObservation(
        0,
        "target",
        np.zeros(3),
        tuple(TargetCloud("front", 0, j, p, f"{j}.pcd") for j, p in enumerate(clouds)),
    )


def looking_at_target(azimuth_deg: float, range_m: float, height_m: float = 1.4) -> gtsam.Pose3:
    """T_target_lidar of a LiDAR above and beside the target that looks at it."""
    azimuth = math.radians(azimuth_deg)
    R = gtsam.Rot3.RzRyRx(0.02, math.atan2(height_m, range_m), azimuth + math.pi)
    place = [range_m * math.cos(azimuth), range_m * math.sin(azimuth), height_m]
    return gtsam.Pose3(R, np.array(place))


@cache
def _chair() -> tuple[World, RayCaster]:
    chair = ChairModel(xy_m=(0.0, 0.0))
    world = make_world(WorldModel(objects={"chair": chair}, targets=("chair",)))
    return world, RayCaster(world)


def chair_scene(
    azimuths_deg: Sequence[float], ranges_m: Sequence[float], sigma_m: float, seed: int
) -> Scene:
    """The paper's LiDAR from places around the chair; its noise is `sigma_m` along the beam."""
    world, caster = _chair()
    model = LidarModel(mounting=STRAIGHT, range_sigma_m=sigma_m)
    crop = CropModel(margin_m=0.0, elsewhere_stride=0)
    lidar = SimulatedLidar(model, world, caster, crop, np.random.default_rng(seed))
    T_map_target = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, CENTRE_M]))
    clouds, poses = [], []
    for azimuth, range_m in zip(azimuths_deg, ranges_m, strict=True):
        T = looking_at_target(azimuth, range_m)
        returns = lidar.scan(T_map_target.compose(T))
        clouds.append(returns.points_lidar[returns.objects == world.names.index("chair")])
        poses.append(T)
    return Scene(observe(clouds), tuple(poses))


def rectangle_points(
    rng: np.random.Generator, count: int, corner: Array, side_u: Array, side_v: Array
) -> Array:
    """(count, 3) points anywhere on a rectangle."""
    u, v = rng.random((2, count, 1))
    return np.asarray(corner + u * side_u + v * side_v)


def seen_from(
    T_target_lidar: gtsam.Pose3, points_target: Array, sigma_m: float, rng: np.random.Generator
) -> Array:
    """The points as the LiDAR reports them, with noise along the beam."""
    points = np.asarray(T_target_lidar.transformTo(points_target.T).T)
    beams = points / np.linalg.norm(points, axis=1, keepdims=True)
    noisy: Array = points + sigma_m * rng.normal(size=(len(points), 1)) * beams
    return noisy


def guesses(
    poses: Sequence[gtsam.Pose3], seed: int, rotation_deg: float = 3.0, shift_m: float = 0.5
) -> list[gtsam.Pose3]:
    """Poses that are off by uniform errors; the rotation is about the LiDAR."""
    rng = np.random.default_rng(seed)
    return [
        gtsam.Pose3(
            gtsam.Rot3.Expmap(np.radians(rotation_deg) * rng.uniform(-1, 1, 3)).compose(
                T.rotation()
            ),
            T.translation() + shift_m * rng.uniform(-1, 1, 3),
        )
        for T in poses
    ]


def errors(est: Sequence[gtsam.Pose3], true: Sequence[gtsam.Pose3]) -> Array:
    """(J, 6) left perturbations (target frame) of each pose, the common motion taken out."""
    gauge = est[0].compose(true[0].inverse())
    for _ in range(10):
        e = np.array(
            [
                gtsam.Pose3.Logmap(gauge.inverse().compose(a).compose(b.inverse()))
                for a, b in zip(est, true, strict=True)
            ]
        )
        gauge = gauge.compose(gtsam.Pose3.Expmap(e.mean(axis=0)))
    return e


def rms(e: Array) -> tuple[float, float]:
    """Root mean square of rotations (rad) and translations (m), over clouds and axes."""
    return float(np.sqrt(np.mean(e[:, :3] ** 2))), float(np.sqrt(np.mean(e[:, 3:] ** 2)))


def plates(points: int, sigma_m: float, seed: int, thickness_m: float = 0.025) -> Scene:
    """A plate that is seen from the front by every other LiDAR, from behind by those between them.

    Its skins, at x = +-half the thickness, have most of the points. What all see is two posts, each
    with a facet to either side, and a shelf: they tell where front and back are to each other.
    """
    rng = np.random.default_rng(seed)
    right, left = np.array([0.13, -0.075, 0.0]), np.array([-0.13, -0.075, 0.0])
    up, along = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    clouds, poses = [], []
    for j in range(12):
        front = j % 2 == 0
        T = looking_at_target((50.0 if front else 130.0) + 4.0 * (j // 2 - 2.5), 7.0)
        x = 0.5 * thickness_m * (1.0 if front else -1.0)
        parts = [rectangle_points(rng, points, np.array([x, -0.4, -0.5]), 0.6 * along, up)]
        for ridge in (np.array([-0.4, 0.6, -0.5]), np.array([0.4, 0.6, -0.5])):
            parts += [rectangle_points(rng, points // 4, ridge, s, up) for s in (right, left)]
        shelf = np.array([-0.5, 0.3, 0.6])
        parts.append(rectangle_points(rng, points // 4, shelf, np.array([1.0, 0, 0]), 0.3 * along))
        clouds.append(seen_from(T, np.vstack(parts), sigma_m, rng))
        poses.append(T)
    return Scene(observe(clouds), tuple(poses))


def matrices(poses: Sequence[gtsam.Pose3]) -> tuple[Array, Array]:
    return stack(list(poses))


def stack_of(
    points: Array,
    normals: Array,
    *,
    beams: Array | None = None,
    flatness: Array | None = None,
    starts: tuple[int, ...] = (0,),
    sigma_range_m: float = 0.01,
) -> CloudStack:
    """Points with normals as they are given; beams against the normals unless given."""
    count = len(points)
    cloud = np.searchsorted(np.array(starts), np.arange(count), side="right") - 1
    return CloudStack(
        points=points,
        cloud=cloud.astype(np.int64),
        starts=np.array(starts, dtype=np.int64),
        lidar=np.zeros(len(starts), dtype=np.int64),
        beams=-normals if beams is None else beams,
        normals=normals,
        flatness=np.ones(count) if flatness is None else flatness,
        whole=(points,),
        sigma_range_m=np.full(1, sigma_range_m),
        seen_from=np.zeros((len(starts), 3)),
    )


def centre_clouds(
    clouds: CloudStack, R: Array, t: Array, cut: Sequence[frozenset[Side]] = ()
) -> Array:
    """(J, 3) translations that put the middle of every cloud's extent at the origin."""
    return -np.asarray(np.einsum("jab,jb->ja", R, middles_of(clouds, R, t, cut).points))
