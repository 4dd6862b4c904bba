"""Targets cut out of ray-cast scenes in which it is known what every return hit."""

from __future__ import annotations

import math
import re
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.model import Config, ExtractionConfig, TargetRegion
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import TargetError
from caliv_graph.products import (
    Array,
    IntArray,
    LidarScan,
    MotionData,
    Side,
    TargetCloud,
    TargetObservation,
    Trajectory,
)
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.scenario.world import GROUND, World, make_world
from caliv_graph.scenario.world_models import BoxModel, ChairModel, ObjectModel, WorldModel
from caliv_graph.simulation.lidar import SimulatedLidar
from caliv_graph.simulation.rays import RayCaster
from caliv_graph.targets.cloud.extract import extract_targets
from caliv_graph.targets.cloud.region import RegionExtractor, widened_margin_m
from caliv_graph.targets.cloud.tally import Tally
from caliv_graph.trajectory.select import GivenTrajectory

FRONT = LidarModel(
    mounting=PoseConfig(xyz=(2.0, 0.0, 2.0), rpy_deg=(0.0, 10.0, 0.0)),
    horizontal_fov_deg=(-25.0, 25.0),
)
"""The paper's LiDAR with a narrower view, so that it is quick."""

CHAIR_AT_20 = ChairModel(xy_m=(21.0, -6.0), yaw_deg=150.0)
"""19.9 m from the LiDAR of a vehicle at the origin."""

CHAIR_AT_10 = ChairModel(xy_m=(11.6, 2.0), yaw_deg=200.0)

T_MAP_VEHICLE = gtsam.Pose3()


@dataclass(frozen=True)
class Scene:
    """One scan of a world: the cloud, and the name of what every return hit."""

    world: World
    points_lidar: Array
    hit: tuple[str, ...]

    def of(self, name: str) -> set[tuple[float, ...]]:
        """The returns of one object."""
        return set(map(tuple, self.points_lidar[self._hit == name].tolist()))

    @cached_property
    def _hit(self) -> npt.NDArray[np.str_]:
        return np.array(self.hit, np.str_)


def scene(
    objects: Mapping[str, ObjectModel],
    model: LidarModel = FRONT,
    T_map_vehicle: gtsam.Pose3 = T_MAP_VEHICLE,
    seed: int = 0,
) -> Scene:
    world = make_world(WorldModel(objects=dict(objects), targets=(next(iter(objects)),)))
    lidar = SimulatedLidar(model, world, RayCaster(world), None, np.random.default_rng(seed))
    returns = lidar.scan(T_map_vehicle)
    names = world.names
    return Scene(world, returns.points_lidar, tuple(names[i] for i in returns.objects.tolist()))


@cache
def chair_at_20() -> Scene:
    return scene({"chair": CHAIR_AT_20})


@cache
def chair_at_10() -> Scene:
    return scene({"chair": CHAIR_AT_10})


def tight_region(world: World, name: str = "chair", margin_m: float = 0.1) -> TargetRegion:
    """The box of an object, and no more than 0.1 m around it."""
    low, high = world.bounds(name)
    return TargetRegion(min=(low - margin_m).tolist(), max=(high + margin_m).tolist())


def config_of(
    *regions: TargetRegion,
    lidars: Mapping[str, LidarConfig] | None = None,
    **extraction: Any,
) -> Config:
    return Config(
        lidars=dict(lidars or {"front": LidarConfig(topic="sensor_1", initial=FRONT.mounting)}),
        target=regions or None,
        extraction=ExtractionConfig(**extraction),
    )


def standing(T_map_vehicle: gtsam.Pose3 = T_MAP_VEHICLE, scans: int = 2) -> GivenTrajectory:
    return GivenTrajectory(Trajectory(np.arange(scans, dtype=np.int64), (T_map_vehicle,) * scans))


def cloud_in(extractor: RegionExtractor, scan: LidarScan) -> TargetCloud | None:
    """The target in a single scan, or None."""
    clouds = extractor.choose([extractor.candidates(scan, 0)], scan.lidar)
    return clouds[0] if clouds else None


def extracted(
    points_lidar: Array, config: Config, T_map_vehicle: gtsam.Pose3 = T_MAP_VEHICLE
) -> tuple[TargetCloud | None, Mapping[str, int]]:
    """The target in one scan, and what scans were rejected for."""
    assert config.target
    extractor = RegionExtractor(config.target[0], config, standing(T_map_vehicle))
    cloud = cloud_in(extractor, LidarScan("front", 0, points_lidar, "0.pcd"))
    return cloud, extractor.tallies["front"].rejected


def recall_and_strangers(cloud: TargetCloud | None, scene: Scene, name: str) -> tuple[float, int]:
    """Part of an object's returns that were found, and how many others were taken for it."""
    assert cloud is not None
    taken = {tuple(p) for p in cloud.points_lidar.tolist()}
    true = scene.of(name)
    return len(taken & true) / len(true), len(taken - true)


@dataclass(frozen=True)
class Scans:
    """A recording of clouds that are at hand, one per nanosecond."""

    name: str
    clouds: Mapping[str, Sequence[Array]]

    @property
    def lidars(self) -> tuple[str, ...]:
        return tuple(self.clouds)

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        return range(len(self.clouds[lidar]))

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        for stamp, points in enumerate(self.clouds[lidar]):
            if wanted is None or stamp in wanted:
                yield LidarScan(lidar, stamp, points, f"{lidar}/{stamp}.pcd")

    def motion(self) -> MotionData:
        raise AssertionError("poses come with the trajectory")

    def warnings(self) -> Sequence[str]:
        return ()


FRONT_CONFIG = LidarConfig(topic="sensor_1", initial=FRONT.mounting)
REAR_CONFIG = LidarConfig(
    topic="sensor_2", initial=PoseConfig(xyz=(-0.4, 0.0, 2.0), rpy_deg=(0.0, 10.0, 180.0))
)
BOTH = {"front": FRONT_CONFIG, "rear": REAR_CONFIG}


def extracted_from(
    clouds: Mapping[str, Sequence[Array]], config: Config
) -> tuple[TargetObservation, ...]:
    scans = max(len(c) for c in clouds.values())
    return extract_targets(
        [Scans("drive/", clouds)], [standing(scans=scans)], config, SilentProgress()
    )


# ------------------------------------------------------------------ the initial guess is wrong


def wrong_by(rpy_deg: tuple[float, float, float], shift_m: float) -> LidarConfig:
    """A guess that is off by R_true Rxyz and a shift of every axis, as the simulation draws it."""
    true = FRONT.mounting.pose()
    R = true.rotation().compose(gtsam.Rot3.RzRyRx(*np.radians(rpy_deg)))
    x, y, z = true.translation() + shift_m
    roll, pitch, yaw = np.degrees(R.rpy())
    return LidarConfig(
        topic="sensor_1", initial=PoseConfig(xyz=(x, y, z), rpy_deg=(roll, pitch, yaw))
    )


@pytest.mark.parametrize(
    ("rpy_deg", "shift_m"),
    [
        ((0.0, 0.0, 3.0), 0.1),
        ((0.0, 0.0, -3.0), -0.1),
        ((0.0, 3.0, 0.0), -0.1),
        ((0.0, -3.0, 0.0), 0.1),
        ((3.0, 3.0, -3.0), -0.1),
        ((-3.0, -3.0, -3.0), 0.1),
    ],
)
def test_target_is_found_with_the_worst_guess_at_20_metres(
    rpy_deg: tuple[float, float, float], shift_m: float
) -> None:
    scene = chair_at_20()
    wrong = wrong_by(rpy_deg, shift_m)
    middle = np.array([*CHAIR_AT_20.xy_m, 0.6])
    T_wrong_true = wrong.guess().compose(FRONT.mounting.pose().inverse())
    # The guess puts all of the chair outside the box that it stands in.
    assert np.linalg.norm(T_wrong_true.transformFrom(middle) - middle) > 1.0

    config = config_of(tight_region(scene.world), lidars={"front": wrong})
    cloud, _ = extracted(scene.points_lidar, config)

    recall, strangers = recall_and_strangers(cloud, scene, "chair")
    assert recall > 0.85
    assert strangers == 0


def test_margin_by_hand() -> None:
    # Two sigmas of the worst axes: 0.058 m, and 1.73 degrees are 0.604 m at 20 m.
    config = config_of(TargetRegion(min=(0, 0, 0), max=(1, 1, 1)))
    assert widened_margin_m(config, "front", 20.0) == pytest.approx(2 * (0.058 + 0.6039), abs=1e-3)
    trusted = {"front": FRONT_CONFIG.model_copy(update={"fixed": True})}
    config = config_of(TargetRegion(min=(0, 0, 0), max=(1, 1, 1)), lidars=trusted)
    assert widened_margin_m(config, "front", 20.0) == pytest.approx(0.1)


def test_a_trusted_lidar_does_not_look_beyond_the_region() -> None:
    scene = chair_at_10()
    low, high = scene.world.bounds("chair")
    # The same box, 0.8 m to the side of the chair: within the margin of a guess, not of a trust.
    aside = np.array([0.0, 1.5, 0.0])
    beside = TargetRegion(min=(low + aside).tolist(), max=(high + aside).tolist())
    assert extracted(scene.points_lidar, config_of(beside))[0] is not None
    trusted = {"front": FRONT_CONFIG.model_copy(update={"fixed": True})}
    cloud, rejected = extracted(scene.points_lidar, config_of(beside, lidars=trusted))
    assert cloud is None
    assert sum(rejected.values()) == 1


@pytest.mark.parametrize(("axis", "part"), [(0, 0.3), (0, 0.6), (1, 0.4), (1, 0.7)])
def test_a_target_over_the_rim_of_its_region_is_taken_whole(axis: int, part: float) -> None:
    # The rim of the widened region runs through the chair.
    scene = chair_at_10()
    low, high = scene.world.bounds("chair")
    config = config_of(TargetRegion(min=(0, 0, 0), max=(1, 1, 1)))
    margin = widened_margin_m(config, "front", float(np.linalg.norm(high)))
    least, most = low - 1.0, high + 1.0
    most[axis] = low[axis] + part * (high - low)[axis] - margin
    least[axis] = most[axis] - 1.0

    region = TargetRegion(min=least.tolist(), max=most.tolist())
    cloud, _ = extracted(scene.points_lidar, config_of(region))

    inside, _ = extracted(scene.points_lidar, config_of(tight_region(scene.world, margin_m=1.0)))
    whole, _ = recall_and_strangers(inside, scene, "chair")
    recall, strangers = recall_and_strangers(cloud, scene, "chair")
    assert recall > whole - 0.03  # feet: what is ground depends on the points around
    assert strangers == 0


def test_a_wall_over_the_rim_stays_cut_off() -> None:
    # 1.5 m of a wall of 6 m are in the widened region: as wide as a target.
    wall = BoxModel(xy_m=(16.0, 6.0), size_m=(0.2, 6.0, 2.0))
    scene = scene_with_chair(wall=wall)
    region = TargetRegion(min=(9, -2, -1), max=(18, 3.5, 3))
    config = config_of(region)
    extractor = RegionExtractor(region, config, standing())

    found = extractor.candidates(LidarScan("front", 0, scene.points_lidar, "0.pcd"), 0)

    of_wall, of_chair = scene.of("wall"), scene.of("chair")
    told = {}
    for candidate in found:
        points = {tuple(p) for p in candidate.cloud.points_lidar.tolist()}
        told["wall" if len(points & of_wall) > len(points & of_chair) else "chair"] = candidate
    assert told["wall"].is_cut_off
    assert not told["chair"].is_cut_off
    width = np.ptp(told["wall"].points_region[:, 1])
    assert 0.5 < width < 2.0


# ------------------------------------------------------------------ what stands around the target


def with_box_beside(gap_m: float, size_m: tuple[float, float, float]) -> tuple[Scene, TargetRegion]:
    """The chair at 20 m and a box whose face is `gap_m` to the left of the chair's region."""
    region = tight_region(chair_at_20().world)
    y = region.max[1] + gap_m + 0.5 * size_m[1]
    box = BoxModel(xy_m=(21.0, y), size_m=size_m)
    return scene({"chair": CHAIR_AT_20, "box": box}), region


@pytest.mark.parametrize("gap_m", [0.6, 1.0, 1.5])
@pytest.mark.parametrize("size_m", [(0.5, 0.5, 1.0), (1.0, 1.0, 1.4), (0.3, 1.5, 1.8)])
def test_a_neighbour_just_outside_the_region_is_left_alone(
    gap_m: float, size_m: tuple[float, float, float]
) -> None:
    scene, region = with_box_beside(gap_m, size_m)
    # The boxes have more returns than the chair; 1.3 m around the region are searched.
    assert len(scene.of("box")) > len(scene.of("chair"))

    cloud, _ = extracted(scene.points_lidar, config_of(region))

    recall, strangers = recall_and_strangers(cloud, scene, "chair")
    assert recall > 0.9
    assert strangers == 0


@pytest.mark.parametrize("size_m", [(1.0, 1.0, 1.4), (0.3, 1.5, 1.8)])
def test_a_large_neighbour_half_a_metre_outside_the_region_is_left_alone(
    size_m: tuple[float, float, float],
) -> None:
    scene, region = with_box_beside(0.4, size_m)

    cloud, _ = extracted(scene.points_lidar, config_of(region))

    recall, strangers = recall_and_strangers(cloud, scene, "chair")
    assert recall > 0.9
    assert strangers == 0


def test_walls_and_poles_are_not_the_target() -> None:
    # Both stand in the region; the wall is too wide, the pole too thin.
    wall = BoxModel(xy_m=(14.5, 2.0), size_m=(0.2, 6.0, 2.0))
    pole = BoxModel(xy_m=(11.0, 3.5), size_m=(0.1, 0.1, 2.0))
    scene = scene_with_chair(wall=wall, pole=pole)
    assert len(scene.of("wall")) > len(scene.of("chair"))
    assert len(scene.of("pole")) > 50
    config = config_of(TargetRegion(min=(9, -2, -1), max=(16, 6, 3)))

    cloud, _ = extracted(scene.points_lidar, config)

    recall, strangers = recall_and_strangers(cloud, scene, "chair")
    assert recall > 0.9
    assert strangers == 0


def test_a_pole_alone_is_no_target() -> None:
    pole = BoxModel(xy_m=(11.0, 0.0), size_m=(0.12, 0.12, 2.0))
    alone = scene({"pole": pole})
    assert len(alone.of("pole")) > 100
    cloud, rejected = extracted(alone.points_lidar, config_of(tight_region(alone.world, "pole")))
    assert cloud is None
    assert rejected == {"nothing above the ground that is 0.2 to 2 m wide": 1}


def scene_with_chair(**others: ObjectModel) -> Scene:
    return scene({"chair": CHAIR_AT_10, **others})


def test_ground_is_left_out_however_the_guess_tilts_it() -> None:
    scene = chair_at_10()
    for pitch_deg in (-3.0, 3.0):
        lidars = {"front": wrong_by((0.0, pitch_deg, 0.0), 0.0)}
        config = config_of(tight_region(scene.world, margin_m=1.5), lidars=lidars)
        cloud, _ = extracted(scene.points_lidar, config)
        assert cloud is not None
        ground = scene.of(GROUND)
        assert not any(tuple(p) in ground for p in cloud.points_lidar.tolist())


def test_a_target_without_ground_around_it_is_found() -> None:
    # It hangs in a region that the ground does not reach.
    scene = chair_at_10()
    low, high = scene.world.bounds("chair")
    low[2] = 0.5
    lidars = {"front": FRONT_CONFIG.model_copy(update={"fixed": True})}
    config = config_of(TargetRegion(min=low.tolist(), max=high.tolist()), lidars=lidars)

    cloud, _ = extracted(scene.points_lidar, config)

    assert cloud is not None
    above = FRONT.mounting.pose().transformFrom(cloud.points_lidar.T)[2]
    assert above.min() > 0.5 - 0.1 - 1e-9
    assert len(above) > 300


# ------------------------------------------------------------------ the edge of the field of view


def chair_at_azimuth(azimuth_deg: float, model: LidarModel) -> Scene:
    """A chair 10 m from a LiDAR that is mounted level, at this azimuth of the LiDAR."""
    T = model.mounting.pose()
    a = math.radians(azimuth_deg)
    x, y, _ = T.transformFrom(np.array([10.0 * math.cos(a), 10.0 * math.sin(a), 0.0]))
    return scene({"chair": ChairModel(xy_m=(x, y), yaw_deg=30.0)}, model)


def level(low_deg: float, high_deg: float, yaw_deg: float = 0.0) -> LidarModel:
    return LidarModel(
        mounting=PoseConfig(xyz=(0.0, 0.0, 2.0), rpy_deg=(0.0, 0.0, yaw_deg)),
        horizontal_fov_deg=(low_deg, high_deg),
        vertical_fov_deg=(-20.0, 0.0),
        channels=60,
    )


CUT = "cut off by the edge of the field of view"


@pytest.mark.parametrize(
    ("azimuth_deg", "model", "cut"),
    [
        (0.0, level(-25.0, 25.0), None),
        (21.0, level(-25.0, 25.0), None),
        (-21.0, level(-25.0, 25.0), None),
        (24.0, level(-25.0, 25.0), "left"),
        (-24.0, level(-25.0, 25.0), "right"),
        # The view spans the azimuth at which atan2 jumps.
        (180.0, level(155.0, 205.0), None),
        (-159.0, level(155.0, 205.0), None),
        (159.0, level(155.0, 205.0), None),
        (-156.0, level(155.0, 205.0), "left"),
        (156.0, level(155.0, 205.0), "right"),
        # No edge anywhere.
        (180.0, level(-180.0, 180.0), None),
        (90.0, level(-180.0, 180.0), None),
    ],
)
def test_a_target_that_the_side_may_cut_is_marked(
    azimuth_deg: float, model: LidarModel, cut: Side | None
) -> None:
    scene = chair_at_azimuth(azimuth_deg, model)

    cloud, tally = marked(scene, model)

    assert cloud.cut == ({cut} if cut else set())
    assert tally.cut == (cut is not None)
    assert tally.reasons() == (f"1 {CUT}" if cut else "")


def test_a_target_that_the_highest_channel_cuts_is_marked() -> None:
    # Level, 1 m high, no beam above the horizon: of 1.25 m of chair 1 m is seen.
    model = LidarModel(
        mounting=PoseConfig(xyz=(2.0, 0.0, 1.0)),
        horizontal_fov_deg=(-25.0, 25.0),
        vertical_fov_deg=(-12.5, 0.0),
    )
    cut = scene({"chair": ChairModel(xy_m=(7.0, 0.0), yaw_deg=180.0)}, model)

    assert marked(cut, model)[0].cut == {"top"}


def test_a_target_that_the_lowest_channel_cuts_is_marked() -> None:
    # 15 degrees below the horizon the beams meet the ground 7.5 m away: at 5 m, 0.7 m above it.
    model = level(-25.0, 25.0).model_copy(
        update={"vertical_fov_deg": (-15.0, 15.0), "channels": 16}
    )
    objects: dict[str, ObjectModel] = {
        "chair": ChairModel(xy_m=(5.0, 0.0), yaw_deg=180.0),
        "wall": BoxModel(xy_m=(20.0, 0.0), size_m=(0.2, 10.0, 6.0)),
    }

    assert marked(scene(objects, model), model)[0].cut == {"bottom"}
    objects["chair"] = ChairModel(xy_m=(9.0, 0.0), yaw_deg=180.0)
    assert not marked(scene(objects, model), model)[0].cut


def marked(scene: Scene, model: LidarModel) -> tuple[TargetCloud, Tally]:
    """The chair in a single scan, and the tally of that."""
    lidars = {"front": LidarConfig(topic="sensor_1", initial=model.mounting)}
    region = tight_region(scene.world)
    extractor = RegionExtractor(region, config_of(region, lidars=lidars), standing())
    cloud = cloud_in(extractor, LidarScan("front", 0, scene.points_lidar, "0.pcd"))
    assert cloud is not None
    return cloud, extractor.tallies["front"]


# ------------------------------------------------------------------ few points


@pytest.mark.parametrize(
    ("channels", "resolution_deg", "chair"),
    [(24, 0.5, CHAIR_AT_10), (32, 0.2, CHAIR_AT_20)],
)
def test_sparse_clouds_are_one_object(
    channels: int, resolution_deg: float, chair: ChairModel
) -> None:
    # Channels 1 and 0.8 degrees apart: 0.18 m at 10 m, 0.28 m and more at 20 m.
    model = FRONT.model_copy(
        update={"channels": channels, "horizontal_resolution_deg": resolution_deg}
    )
    sparse = scene({"chair": chair}, model)
    assert 20 <= len(sparse.of("chair")) <= 60
    config = config_of(tight_region(sparse.world), outlier_neighbours=0)

    cloud, _ = extracted(sparse.points_lidar, config)

    recall, strangers = recall_and_strangers(cloud, sparse, "chair")
    assert recall > 0.9
    assert strangers == 0


@pytest.mark.parametrize("range_m", [6.0, 9.0, 13.0, 17.0, 20.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 4.0])
@pytest.mark.parametrize(("fov_deg", "channels"), [((-15.0, 15.0), 16), ((-25.0, 15.0), 32)])
def test_sixteen_and_thirty_two_channels_see_a_chair_as_one_object(
    fov_deg: tuple[float, float], channels: int, tilt_deg: float, range_m: float
) -> None:
    # On the roof, with a wall 1.5 m behind the chair and a box 1 m beside it.
    model = LidarModel(
        mounting=PoseConfig(xyz=(0.0, 0.0, 2.0), rpy_deg=(0.0, tilt_deg, 0.0)),
        horizontal_fov_deg=(-60.0, 60.0),
        horizontal_resolution_deg=0.2,
        vertical_fov_deg=fov_deg,
        channels=channels,
        max_range_m=100.0,
    )
    lidars = {"front": LidarConfig(topic="sensor_1", initial=model.mounting)}
    for yaw_deg in (0.0, 50.0, 100.0, 200.0, 290.0):
        chair = ChairModel(xy_m=(range_m, 0.0), yaw_deg=yaw_deg)
        wall = BoxModel(xy_m=(range_m + 2.0, 0.0), size_m=(0.2, 12.0, 2.5))
        box = BoxModel(xy_m=(range_m, 1.6), size_m=(0.4, 0.4, 0.9))
        sparse = scene({"chair": chair, "wall": wall, "box": box}, model)
        if len(sparse.of("chair")) < 12:
            # Less than 8 points may be above the ground and no outliers.
            continue

        cloud, _ = extracted(
            sparse.points_lidar, config_of(tight_region(sparse.world), lidars=lidars)
        )

        recall, strangers = recall_and_strangers(cloud, sparse, "chair")
        # A row of feet may be taken for ground.
        assert recall > 0.8, yaw_deg
        assert strangers == 0, yaw_deg


def test_a_scan_with_too_few_target_points_does_not_see_it() -> None:
    scene = chair_at_20()
    # 142 returns, of which the outlier filter and the ground take a few.
    config = config_of(tight_region(scene.world), min_points=140)
    cloud, rejected = extracted(scene.points_lidar, config)
    assert cloud is None
    assert rejected == {"under 140 points": 1}


# ------------------------------------------------------------------ filters


def test_outlier_filter_drops_what_is_lonely() -> None:
    scene = chair_at_10()
    config = config_of(tight_region(scene.world), outlier_neighbours=0)
    everything, _ = extracted(scene.points_lidar, config)
    assert everything is not None
    # Three returns of dust: 0.25 m above the highest point, and to both sides of the outermost.
    T = FRONT.mounting.pose()
    points_map = T.transformFrom(everything.points_lidar.T).T
    left, right, top = (
        points_map[:, 1].argmax(),
        points_map[:, 1].argmin(),
        points_map[:, 2].argmax(),
    )
    dust_map = points_map[[left, right, top]] + 0.25 * np.array([[0, 1, 0], [0, -1, 0], [0, 0, 1]])
    dust = T.transformTo(dust_map.T).T
    dusty = np.vstack([dust, scene.points_lidar])

    kept, _ = extracted(dusty, config)
    filtered, _ = extracted(dusty, config_of(tight_region(scene.world)))

    def dust_in(cloud: TargetCloud | None) -> int:
        assert cloud is not None
        found = {tuple(p) for p in cloud.points_lidar.tolist()}
        return sum(tuple(p) in found for p in dust.tolist())

    assert dust_in(kept) == 3
    assert dust_in(filtered) == 0
    assert filtered is not None
    assert len(filtered.points_lidar) > 0.9 * len(everything.points_lidar)


def test_voxel_filter_keeps_one_of_the_points_of_a_voxel() -> None:
    scene = chair_at_10()
    region = tight_region(scene.world)
    everything, _ = extracted(scene.points_lidar, config_of(region, outlier_neighbours=0))
    thinned, _ = extracted(scene.points_lidar, config_of(region, outlier_neighbours=0, voxel=0.1))
    assert everything is not None
    assert thinned is not None
    # The points are returns, not middles of voxels, and in their own order.
    order = {tuple(p): i for i, p in enumerate(everything.points_lidar.tolist())}
    indices = [order[tuple(p)] for p in thinned.points_lidar.tolist()]
    assert indices == sorted(indices)
    T = FRONT.mounting.pose()

    def voxels(points_lidar: Array) -> IntArray:
        return np.floor(T.transformFrom(points_lidar.T).T / 0.1).astype(np.int64)

    cells = voxels(thinned.points_lidar)
    assert len(np.unique(cells, axis=0)) == len(cells)
    assert len(cells) == len(np.unique(voxels(everything.points_lidar), axis=0))
    assert len(cells) < 0.5 * len(everything.points_lidar)


def test_points_are_given_in_the_lidar_frame_with_their_scan() -> None:
    scene = chair_at_10()
    (observation,) = extracted_from(
        {"front": [scene.points_lidar] * 8}, config_of(tight_region(scene.world))
    )
    cloud = observation.clouds[3]
    assert (cloud.lidar, cloud.drive, cloud.stamp_ns) == ("front", 0, 3)
    assert cloud.source == "front/3.pcd"
    assert not cloud.cut
    T = FRONT.mounting.pose()
    low, high = scene.world.bounds("chair")
    points_map = T.transformFrom(cloud.points_lidar.T).T
    assert (points_map > low - 0.05).all()
    assert (points_map < high + 0.05).all()


# ------------------------------------------------------------------ regions


def test_region_in_the_frame_of_the_first_pose() -> None:
    # The vehicle starts at (100, 50) and heads north; 3 m on it sees a chair that stands 12 m
    # ahead of the start and 1 m to the left: at (99, 62) in the map.
    start = gtsam.Pose3(gtsam.Rot3.Yaw(math.pi / 2), np.array([100.0, 50.0, 0.3]))
    later = start.compose(gtsam.Pose3(gtsam.Rot3.Yaw(0.05), np.array([3.0, 0.0, 0.0])))
    objects = {"chair": ChairModel(xy_m=(99.0, 62.0), yaw_deg=200.0)}
    seen = scene(objects, T_map_vehicle=later)
    region = TargetRegion(min=(11, 0, -0.4), max=(13, 2, 1.1), frame="start")
    config = config_of(region)
    trajectory = GivenTrajectory(Trajectory(np.array([0, 7], dtype=np.int64), (start, later)))
    extractor = RegionExtractor(region, config, trajectory)

    cloud = cloud_in(extractor, LidarScan("front", 7, seen.points_lidar, "7.pcd"))

    recall, strangers = recall_and_strangers(cloud, seen, "chair")
    assert recall > 0.9
    assert strangers == 0
    assert extractor.centre_map == pytest.approx([99.0, 62.0, 0.65])
    # The same numbers in the map are somewhere else.
    in_map = RegionExtractor(region.model_copy(update={"frame": "map"}), config, trajectory)
    assert cloud_in(in_map, LidarScan("front", 7, seen.points_lidar, "7.pcd")) is None


def test_moving_the_whole_world_changes_nothing() -> None:
    T_map_other = gtsam.Pose3(gtsam.Rot3.Yaw(math.pi / 2), np.array([500.0, -300.0, 20.0]))
    scene = chair_at_10()
    low, high = scene.world.bounds("chair")
    corners = T_map_other.transformFrom(np.array([low, high]).T).T
    region = TargetRegion(min=corners.min(axis=0).tolist(), max=corners.max(axis=0).tolist())

    here, _ = extracted(scene.points_lidar, config_of(tight_region(scene.world, margin_m=0.0)))
    there, _ = extracted(scene.points_lidar, config_of(region), T_map_other)

    assert here is not None
    assert there is not None
    np.testing.assert_array_equal(here.points_lidar, there.points_lidar)


def two_chairs() -> tuple[Scene, tuple[TargetRegion, TargetRegion]]:
    other = ChairModel(xy_m=(13.0, -3.0), yaw_deg=100.0)
    both = scene({"chair": CHAIR_AT_10, "other": other})
    return both, (tight_region(both.world), tight_region(both.world, "other"))


def test_every_region_of_every_drive_is_a_placement() -> None:
    both, regions = two_chairs()
    drives = [Scans(name, {"front": [both.points_lidar] * 8}) for name in ("first/", "second/")]

    observations = extract_targets(
        drives, [standing(scans=8)] * 2, config_of(*regions), SilentProgress()
    )

    assert [o.placement for o in observations] == [0, 1, 2, 3]
    assert [o.name for o in observations] == [
        "target 1 of first/",
        "target 2 of first/",
        "target 1 of second/",
        "target 2 of second/",
    ]
    assert [o.clouds[0].drive for o in observations] == [0, 0, 1, 1]
    for observation, name in zip(observations, ["chair", "other"] * 2, strict=True):
        assert len(observation.clouds) == 8
        recall, strangers = recall_and_strangers(observation.clouds[0], both, name)
        assert recall > 0.9
        assert strangers == 0
        low, high = both.world.bounds(name)
        assert observation.centre_map == pytest.approx(0.5 * (low + high))


def test_a_drive_that_misses_one_of_its_targets_keeps_the_other() -> None:
    scene = chair_at_10()
    nowhere = TargetRegion(min=(9, -5, 4), max=(12, -2, 6))
    first, second = extracted_from(
        {"front": [scene.points_lidar] * 8}, config_of(tight_region(scene.world), nowhere)
    )
    assert (len(first.clouds), len(second.clouds)) == (8, 0)
    assert first.warnings == ()
    (warning,) = second.warnings
    assert warning.startswith("target 2: no LiDAR sees the target: lidar 'front' in 0 of 8 scans")


# ------------------------------------------------------------------ what is said of failures


def test_without_a_region_the_target_is_searched_for() -> None:
    # A region does not help where scans have no point.
    empty = [np.zeros((0, 3))] * 8
    with pytest.raises(TargetError, match=r"none found.*no ground.*its topic, min_range and max"):
        extracted_from({"front": empty}, config_of())


def test_of_many_scans_some_are_kept_and_all_are_told() -> None:
    scene = chair_at_10()
    config = config_of(tight_region(scene.world))
    few = config.extraction.model_copy(update={"max_scans": 8})

    (observation,) = extracted_from(
        {"front": [scene.points_lidar] * 20}, config.model_copy(update={"extraction": few})
    )

    assert len(observation.clouds) <= 10
    assert observation.seen_ns == {"front": tuple(range(20))}


def test_a_lidar_that_never_looks_there_is_not_without_scans() -> None:
    """Of more than a few scans, those that cannot have the region in view are not decoded."""
    scene = chair_at_10()
    config = config_of(tight_region(scene.world), lidars=BOTH)
    ahead = np.abs(np.arctan2(scene.points_lidar[:, 1], scene.points_lidar[:, 0])) < 0.3
    scans = {"front": [scene.points_lidar] * 8, "rear": [scene.points_lidar[ahead]] * 200}

    (observation,) = extracted_from(scans, config)

    (warning,) = observation.warnings
    assert warning.startswith("target: lidar 'rear' has it in view in none of its 200 scans")

    above = config_of(TargetRegion(min=(9, -5, 4), max=(12, -2, 6)), lidars=BOTH)
    with pytest.raises(TargetError, match="'rear' has it in view in none of its 200 scans"):
        extracted_from(scans, above)


def test_a_region_that_nothing_enters_says_how_near_it_came() -> None:
    # 4 m above the flat ground that is all there is below it.
    scene = chair_at_10()
    config = config_of(TargetRegion(min=(9, -5, 4), max=(12, -2, 6)), lidars=BOTH)

    with pytest.raises(TargetError) as caught:
        extracted_from({"front": [scene.points_lidar] * 8, "rear": [scene.points_lidar]}, config)

    message = str(caught.value)
    assert message.startswith("target: no LiDAR sees the target: lidar 'front' in 0 of 8 scans")
    assert "needs 8 (nearest return 4.0" in message
    # The rear LiDAR looks back: what it sees is behind it. The region's near face is at x = 9.
    nearest = re.search(r"lidar 'rear' in 0 of 1 scans.*?nearest return ([0-9.]+) m", message)
    assert nearest is not None
    assert float(nearest[1]) > 9.4 + 4.0
    assert "8 outside the region" in message
    assert "\n" not in message


def test_a_region_with_nothing_but_ground_says_so() -> None:
    scene = chair_at_10()
    config = config_of(TargetRegion(min=(9, -6, -1), max=(12, -3, 1)))
    with pytest.raises(TargetError, match="8 nothing above the ground that is"):
        extracted_from({"front": [scene.points_lidar] * 8}, config)


def test_a_lidar_that_sees_nothing_is_left_out_and_the_others_kept() -> None:
    scene = chair_at_10()
    clouds = {"front": [scene.points_lidar] * 9, "rear": [scene.points_lidar] * 9}

    (observation,) = extracted_from(clouds, config_of(tight_region(scene.world), lidars=BOTH))

    assert [c.lidar for c in observation.clouds] == ["front"] * 9
    assert observation.warnings == (
        "target: lidar 'rear' sees it in 0 scans, needs 8 (extraction.min_scans). Of 9 scans: "
        "9 outside the region. Move or widen target.min/max, or leave target out: it is then "
        "searched for; 'caliv-graph inspect' shows who sees it when",
    )


def test_a_lidar_with_too_few_scans_is_left_out() -> None:
    scene = chair_at_10()
    blank = scene.points_lidar[:200]
    config = config_of(tight_region(scene.world), min_scans=4)
    same_place = {**BOTH, "rear": REAR_CONFIG.model_copy(update={"initial": FRONT.mounting})}
    config = config.model_copy(update={"lidars": same_place})
    clouds = {
        "front": [scene.points_lidar, blank, scene.points_lidar, scene.points_lidar, blank],
        "rear": [blank, scene.points_lidar, scene.points_lidar, scene.points_lidar] * 2,
    }

    (observation,) = extracted_from(clouds, config)

    assert [(c.lidar, c.stamp_ns) for c in observation.clouds] == [
        ("rear", stamp) for stamp in (1, 2, 3, 5, 6, 7)
    ]
    (warning,) = observation.warnings
    assert "lidar 'front' sees it in 3 scans, needs 4" in warning


def test_empty_clouds_are_counted_as_such() -> None:
    scene = chair_at_10()
    cloud, rejected = extracted(np.empty((0, 3)), config_of(tight_region(scene.world)))
    assert cloud is None
    assert rejected == {"empty within the range limits": 1}


def test_the_message_about_empty_clouds_holds_no_infinity() -> None:
    config = config_of(TargetRegion(min=(9, -5, 4), max=(12, -2, 6)))
    with pytest.raises(TargetError) as caught:
        extracted_from({"front": [np.empty((0, 3))] * 8}, config)
    assert "inf" not in str(caught.value)


def test_progress_counts_every_scan() -> None:
    scene = chair_at_10()
    progress = SilentProgress()
    drive = Scans("drive/", {"front": [scene.points_lidar] * 8, "rear": [scene.points_lidar] * 3})
    config = config_of(tight_region(scene.world), lidars=BOTH)

    extract_targets([drive], [standing(scans=8)], config, progress)

    (stage,) = progress.stages
    assert (stage.total, stage.done) == (11, 11)


def test_a_fixed_lidar_finds_the_whole_target_while_the_vehicle_drives_fast() -> None:
    """At 10 m/s the target is 0.75 m from where it is at the stamp when the sweep gets there."""
    rng = np.random.default_rng(5)
    late_s, speed_m_s = 0.075, 10.0
    box = rng.uniform([-0.3, 7.7, 0.0], [0.3, 7.75, 0.9], (300, 3))
    ground = np.column_stack([rng.uniform([-6.0, 3.0], [6.0, 14.0], (4000, 2)), np.zeros(4000)])
    height_m = 2.0
    points = np.vstack([box, ground]) - [speed_m_s * late_s, 0.0, height_m]
    times = np.append(np.full(len(points) - 1, late_s), 0.0)
    stamps = 10**12 + 100_000_000 * np.arange(-5, 6)
    poses = [gtsam.Pose3(gtsam.Rot3(), [speed_m_s * 1e-9 * (s - 10**12), 0, 0]) for s in stamps]
    trajectory = GivenTrajectory(Trajectory(stamps, tuple(poses)))
    region = TargetRegion(min=(-0.6, 7.4, -0.3), max=(0.6, 8.6, 1.2))
    lidar = LidarConfig.model_validate(
        {"topic": "front", "initial": {"xyz": [0, 0, height_m], "rpy_deg": [0, 0, 0]}}
    )
    config = Config.model_validate(
        {
            "data": {"format": "caliv", "path": "x"},
            "lidars": {"front": lidar.model_copy(update={"fixed": True})},
        }
    )
    scan = LidarScan("front", 10**12, points, "scan", times)

    (found,) = RegionExtractor(region, config, trajectory).candidates(scan, 0)

    assert np.ptp(found.cloud.points_lidar[:, 0]) > 0.5
    assert np.median(found.cloud.points_lidar[:, 0]) == pytest.approx(0.0, abs=0.05)
