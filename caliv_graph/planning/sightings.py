"""The clouds in which each LiDAR of a planned drive sees each target: geometry only, no rays.

Occluders (other objects, the vehicle's own body) are ignored.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from caliv_graph.config.model import ExtractionConfig
from caliv_graph.config.range_errors import growth
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.scenario.beams import channel_elevations_deg, unit_vectors
from caliv_graph.scenario.drives import Route, cloud_stamps
from caliv_graph.scenario.model import Scenario
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.scenario.shapes import object_mesh
from caliv_graph.scenario.terrain import Terrain, make_terrain
from caliv_graph.scenario.world_models import ObjectModel
from caliv_graph.targets.cloud.views import chosen, clouds_per_lidar, preference
from caliv_graph.targets.ground.planes import CELL_M, CELL_POINTS, UNEVENNESS_M

SEEN_PART = 0.87
"""Fraction of the surface facing a LiDAR that returns points; the target occludes the rest itself.
It gives 480 points of a chair at 10 m with the paper's LiDAR."""

INDEPENDENT_PART = 0.58
"""Fraction of that surface that counts as independent points: 300 of a chair at 10 m."""

LEVER_PART = 0.59
"""Effective fraction of the lever of a target's surface. A point observes a rotation only by the
component of its lever across the normal: 0.2 m of a chair's 0.34 m about each axis."""

ROTATION_FLOOR_RAD = 1e-3
POSITION_FLOOR_M = 5e-4
"""Smallest sigmas of the registration of one cloud."""

FACING_STEPS = 12
"""Number of directions over which the facing area of a target is averaged."""

GROUND_REACH_M = 15.0
GROUND_LEAST_POINTS = 60
"""Largest range of ground points and their smallest number, as in `targets.ground.planes`."""

GROUND_COLUMNS = 24

ROUND_SHAPES = ("pole", "cylinder")
"""Shapes that are symmetric about the vertical."""


@dataclass(frozen=True)
class Placement:
    """A target at one place, while it stands there.

    Attributes:
        name: name of the object, with a number from the second place on.
        centre_map: (3,) metres, centre of its bounding box.
        half_size_m: (3,) half sides of its bounding box, map axes.
        area_m2: projected area of the surface that faces a LiDAR, mean over directions.
        levers_m: (3,) root mean square distance of its surface from the axes through its centre.
        is_round: whether it is symmetric about the vertical.
        begin_s: time at which it is put there, since the start of the drive.
        end_s: time at which it is taken away.
    """

    name: str
    centre_map: Array
    half_size_m: Array
    area_m2: float
    levers_m: Array
    is_round: bool
    begin_s: float = 0.0
    end_s: float = math.inf

    def information(self, points: Array, range_sigma_m: float) -> Array:
        """(m, 6, 6) information of the registration of clouds on their poses.

        It is about the target's centre: left perturbations in the target frame (map axes), rotation
        then translation. Sigmas fall with the root of the number of points, down to a floor.

        Args:
            points: (m,) number of independent points of each cloud.
            range_sigma_m: noise along the beam.
        """
        with np.errstate(divide="ignore"):
            sigma = range_sigma_m / np.sqrt(points)
        rotation = np.hypot(sigma[:, None] / (LEVER_PART * self.levers_m), ROTATION_FLOOR_RAD)
        diagonal = np.empty((len(points), 6))
        diagonal[:, :3] = rotation**-2.0
        diagonal[:, 3:] = (np.hypot(sigma, POSITION_FLOOR_M) ** -2.0)[:, None]
        if self.is_round:
            diagonal[:, 2] = 0.0
        return np.asarray(diagonal[:, :, None] * np.eye(6))


@dataclass(frozen=True)
class Sighting:
    """One LiDAR and one placement of a target.

    Attributes:
        lidar: its name.
        placement: name of the placement.
        scans: number of all clouds of the LiDAR.
        stamps_ns: (m,) times of the clouds in which it sees the target.
        range_m: (m,) range to the target's centre.
        points: (m,) expected number of points on the target.
        towards_deg: (m,) azimuth in the map from the target to the LiDAR: the side it sees.
        centres_lidar: (m, 3) metres, the target's centre in the lidar frame.
        used: (u,) indices of the clouds that `calibrate` would use.
    """

    lidar: str
    placement: str
    scans: int
    stamps_ns: IntArray
    range_m: Array
    points: Array
    towards_deg: Array
    centres_lidar: Array
    used: IntArray


def placements(scenario: Scenario) -> tuple[Placement, ...]:
    """The targets of a scenario, one for each place of each target."""
    terrain = make_terrain(scenario.world.ground)
    out = []
    for name in scenario.world.targets:
        out += _placements_of(name, scenario.world.objects[name], scenario, terrain)
    return tuple(out)


def _placements_of(
    name: str, model: ObjectModel, scenario: Scenario, terrain: Terrain | None
) -> list[Placement]:
    low, high, area_m2, levers_m = _shape_of(model.model_copy(update=_AT_ORIGIN))
    places = [(model.xy_m, model.yaw_deg)]
    begins, ends = [0.0], []
    for move in getattr(model, "moves", ()):
        places.append((move.xy_m, move.yaw_deg))
        ends.append(move.begin_s)
        begins.append(move.end_s)
    ends.append(math.inf)
    out = []
    for number, ((xy_m, yaw_deg), begin_s, end_s) in enumerate(
        zip(places, begins, ends, strict=True), start=1
    ):
        yaw = math.radians(yaw_deg)
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        ground_m = scenario.world.ground.height_m
        if terrain is not None:
            ground_m += terrain.height_at(xy_m)
        half = 0.5 * (high - low)
        middle = 0.5 * (low + high)
        out.append(
            Placement(
                name=name if number == 1 else f"{name} {number}",
                centre_map=np.array([*(np.array(xy_m) + turn @ middle[:2]), ground_m + middle[2]]),
                half_size_m=np.array([*(np.abs(turn) @ half[:2]), half[2]]),
                area_m2=area_m2,
                levers_m=np.sqrt([*(turn**2 @ levers_m[:2] ** 2), levers_m[2] ** 2]),
                is_round=model.shape in ROUND_SHAPES,
                begin_s=begin_s,
                end_s=end_s,
            )
        )
    return out


_AT_ORIGIN = {"xy_m": (0.0, 0.0), "yaw_deg": 0.0, "moves": ()}


@lru_cache(maxsize=64)
def _shape_of(model: ObjectModel) -> tuple[Array, Array, float, Array]:
    """Lower and upper corner, facing area and levers of an object at the origin."""
    mesh = object_mesh(model)
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    normals = 0.5 * np.cross(b - a, c - a)
    azimuth = np.linspace(0.0, 2.0 * math.pi, FACING_STEPS, endpoint=False)
    directions = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(FACING_STEPS)])
    area_m2 = float(np.maximum(normals @ directions.T, 0.0).sum() / FACING_STEPS)
    weight = np.linalg.norm(normals, axis=1)
    weight /= weight.sum()
    middle = (a + b + c) / 3.0
    square = weight @ (middle - weight @ middle) ** 2
    levers_m = np.sqrt(square.sum() - square)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return low, high, area_m2, levers_m


def scan_stamps(scenario: Scenario, lidar: str, duration_s: float) -> IntArray:
    """(n,) true times of the clouds of a LiDAR since the start of the drive.

    They are the stamps minus the time offset.
    """
    model = scenario.lidars[lidar]
    stamps = cloud_stamps(lidar, model, duration_s)
    taken = stamps - round(model.time_offset_s * NANOSECONDS_PER_SECOND)
    return np.asarray(taken[taken >= 0])


def sight(
    drive: Route,
    scenario: Scenario,
    lidar: str,
    placement: Placement,
    extraction: ExtractionConfig,
) -> Sighting:
    """The clouds of a LiDAR in which it sees a target; `used` is left empty.

    Args:
        drive: the drive.
        scenario: the LiDARs.
        lidar: its name.
        placement: the target.
        extraction: how many points are needed.
    """
    model = scenario.lidars[lidar]
    stamps = scan_stamps(scenario, lidar, drive.duration_s)
    states = drive.states(stamps, scenario.world.ground.height_m)
    # The part of a grid over the target's box that is within the field of view. Clouds that a side
    # of the field of view cuts are left out: they have less information, and the plan is to hold.
    offsets = np.stack(
        np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], [-0.9, -0.45, 0.0, 0.45, 0.9]), axis=-1
    ).reshape(-1, 3)
    # The corners of the box are outside the object.
    grid = placement.centre_map + offsets * placement.half_size_m * [0.7, 0.7, 1.0]
    T = model.mounting.pose()
    back = np.swapaxes(states.R_map_vehicle, 1, 2)
    in_vehicle = np.einsum("nij,nkj->nki", back, grid[None] - states.position_map[:, None])
    in_lidar = (in_vehicle - T.translation()) @ T.rotation().matrix()
    whole, inside = within(model, in_lidar)
    towards = states.position_map + states.R_map_vehicle @ T.translation() - placement.centre_map
    range_m = np.linalg.norm(towards, axis=1)
    level = np.einsum("nij,nj->ni", back, -towards) @ T.rotation().matrix()
    elevation = np.arcsin(np.clip(level[:, 2] / range_m, -1.0, 1.0))
    facing = placement.area_m2 * inside / (range_m**2 * solid_angle(model, elevation))
    time_s = stamps / NANOSECONDS_PER_SECOND
    seen = whole & (SEEN_PART * facing >= extraction.min_points)
    seen &= (time_s >= placement.begin_s) & (time_s <= placement.end_s)
    return Sighting(
        lidar=lidar,
        placement=placement.name,
        scans=len(stamps),
        stamps_ns=stamps[seen],
        range_m=range_m[seen],
        points=SEEN_PART * facing[seen],
        towards_deg=np.degrees(np.arctan2(towards[seen, 1], towards[seen, 0])),
        centres_lidar=level[seen],
        used=np.zeros(0, dtype=np.int64),
    )


def thinned(weights: Array, seeing: int, extraction: ExtractionConfig) -> IntArray:
    """Indices of the clouds of a target that are used, as `targets.cloud.extract` selects them.

    Args:
        weights: (n,) weight of each cloud of one LiDAR that sees it (`targets.cloud.views`).
        seeing: number of LiDARs that see it often enough.
        extraction: how many are used.
    """
    if len(weights) < extraction.min_scans:
        return np.zeros(0, dtype=np.int64)
    preferences = preference(np.arange(len(weights)), len(weights))
    return chosen(preferences, weights, clouds_per_lidar(extraction.max_scans, seeing))


def sees_ground(model: LidarModel) -> bool:
    """Whether a LiDAR on level ground has enough points on the ground around it."""
    low, high = np.radians(model.horizontal_fov_deg)
    columns = (high - low) / math.radians(model.horizontal_resolution_deg)
    return bool(len(_ground_points(model)) * columns / GROUND_COLUMNS >= GROUND_LEAST_POINTS)


def ground_by_range_bias(model: LidarModel) -> Array:
    """(3, 3) change of the plane that a LiDAR sees, if its ranges are off.

    Slopes along the vehicle's x and y, and height in metres below the LiDAR, by a metre of all
    ranges, and by those of `config.range_errors.growth`. As in `targets.ground`, square metres
    count alike from `CELL_POINTS` points on.
    """
    points = _ground_points(model)
    low, high = np.radians(model.horizontal_fov_deg)
    of_each = (high - low) / math.radians(model.horizontal_resolution_deg) / GROUND_COLUMNS
    cells = np.floor(points[:, :2] / CELL_M).astype(np.int64)
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    down = -points[:, 2] / np.linalg.norm(points, axis=1)
    variance = (model.range_sigma_m * down) ** 2 + UNEVENNESS_M**2
    weight = np.minimum(1.0, CELL_POINTS / (of_each * count[cell.ravel()])) / variance
    J = np.column_stack([points[:, :2], np.ones(len(points))])
    lower = -down[:, None] * np.column_stack([np.ones(len(down)), growth(down)])
    return np.asarray(np.linalg.solve(J.T @ (weight[:, None] * J), J.T @ (weight[:, None] * lower)))


def _ground_points(model: LidarModel) -> Array:
    """(m, 3) points on level ground near a LiDAR, from it, vehicle axes; of `GROUND_COLUMNS`."""
    T = model.mounting.pose()
    elevation = np.radians(channel_elevations_deg(model))[:, None]
    low, high = np.radians(model.horizontal_fov_deg)
    azimuth = low + (high - low) * (np.arange(GROUND_COLUMNS) + 0.5) / GROUND_COLUMNS
    beams = unit_vectors(elevation, azimuth) @ T.rotation().matrix().T
    down = -beams[..., 2]
    height_m = float(T.translation()[2])
    if height_m <= 0.0:
        return np.zeros((0, 3))
    with np.errstate(divide="ignore"):
        distance_m = np.where(down > 0.0, height_m / np.maximum(down, 1e-9), np.inf)
    hit = (distance_m * np.sqrt(1.0 - np.minimum(down, 1.0) ** 2) < GROUND_REACH_M) & (
        distance_m > model.min_range_m
    )
    return np.asarray(beams[hit] * distance_m[hit][:, None])


def within(model: LidarModel, points_lidar: Array) -> tuple[BoolArray, Array]:
    """Visibility of m groups of k points (m, k, 3) for a LiDAR.

    Returns:
        (m,) whether all k points are between the sides of the field of view, and (m,) the fraction
        of points inside the field of view and the range.
    """
    range_m = np.linalg.norm(points_lidar, axis=-1)
    azimuth = np.degrees(np.arctan2(points_lidar[..., 1], points_lidar[..., 0]))
    elevation = np.degrees(np.arcsin(np.clip(points_lidar[..., 2] / range_m, -1.0, 1.0)))
    low, high = model.horizontal_fov_deg
    elevations = channel_elevations_deg(model)
    between = (azimuth - low) % 360.0 <= high - low
    inside = (
        between
        & (elevation >= elevations[0])
        & (elevation <= elevations[-1])
        & (range_m >= model.min_range_m)
        & (range_m <= model.max_range_m)
    )
    return np.asarray(between.all(axis=-1)), np.asarray(inside.mean(axis=-1))


def solid_angle(model: LidarModel, elevation: Array) -> Array:
    """(n,) solid angle of a beam in steradians, at elevations (n,) in radians."""
    elevations = np.radians(channel_elevations_deg(model))
    spacing = np.interp(elevation, 0.5 * (elevations[1:] + elevations[:-1]), np.diff(elevations))
    return np.asarray(spacing * math.radians(model.horizontal_resolution_deg) * np.cos(elevation))
