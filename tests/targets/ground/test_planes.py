"""Planes of known truth in scans of a LiDAR that looks down on them, and what is no plane."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import gtsam
import numpy as np
import pytest

from caliv_graph.config.noise import NoiseConfig
from caliv_graph.geometry.se3 import tangent_axes
from caliv_graph.pipeline.preparation import ROUGH_M
from caliv_graph.products import Array, LidarScan
from caliv_graph.simulation import load_scenario, simulate_drive
from caliv_graph.targets.ground.planes import (
    CELL_POINTS,
    DISTANCE_FLOOR_M,
    NORMAL_FLOOR_RAD,
    GroundPlane,
    ground_floors,
    near_points,
)
from tests.samples import pose
from tests.scan_rates import scanned_every
from tests.targets.ground.scans import (
    HEIGHT_M,
    NOSE_DOWN,
    RING,
    UP_LIDAR,
    Depth,
    beams,
    level,
    plane_in,
    plateau,
    scan_of,
    terrain,
    wall,
)

ROOT = Path(__file__).parents[3]


def measured(scan: LidarScan, up_lidar: Array = UP_LIDAR, sigma_m: float = 0.01) -> GroundPlane:
    plane = plane_in(scan, up_lidar, sigma_m)
    assert plane is not None
    return plane


def errors(plane: GroundPlane, normal: Array = UP_LIDAR, distance_m: float = HEIGHT_M) -> Array:
    """(3,) off along the plane's axes and in distance."""
    return np.append(
        plane.axes_lidar @ (plane.normal_lidar - normal), plane.distance_m - distance_m
    )


# ------------------------------------------------------------------ the plane


def test_level_ground_by_hand() -> None:
    plane = measured(scan_of(level))

    assert plane.normal_lidar == pytest.approx(UP_LIDAR, abs=1e-9)
    assert plane.distance_m == pytest.approx(HEIGHT_M, abs=1e-9)
    assert plane.axes_lidar @ plane.axes_lidar.T == pytest.approx(np.eye(2), abs=1e-12)
    assert plane.axes_lidar @ UP_LIDAR == pytest.approx([0.0, 0.0], abs=1e-9)
    # The centre is on the plane, ahead and in the middle.
    assert plane.centre_lidar @ UP_LIDAR == pytest.approx(-HEIGHT_M, abs=1e-9)
    assert plane.centre_lidar[1] == pytest.approx(0.0, abs=0.2)
    assert 5.0 < plane.centre_lidar[0] < 12.0
    assert plane.scatter_m < 1e-9
    assert plane.radius_m == 15.0


@pytest.mark.parametrize("sigma_m", [0.01, 0.03])
def test_noise_along_the_beam_biases_nothing_and_is_what_the_covariance_says(
    sigma_m: float,
) -> None:
    off, squares, bends = [], [], []
    for seed in range(150):
        plane = measured(scan_of(level, sigma_m=sigma_m, seed=seed), sigma_m=sigma_m)
        off.append(errors(plane))
        bends.append(plane.beyond**2 / plane.beyond_variances)
        squares.append(off[-1] @ np.linalg.solve(plane.cov, off[-1]))
    bias, spread = np.mean(off, axis=0), np.std(off, axis=0)
    assert np.abs(bias[:2]).max() < 2e-5 * sigma_m / 0.01
    assert abs(bias[2]) < 1.5e-4 * sigma_m / 0.01
    assert spread == pytest.approx(np.sqrt(np.diag(plane.cov)), rel=0.35)
    # 450 degrees of freedom: 392 to 511 in 95 of 100 cases.
    assert 370.0 < sum(squares) < 540.0
    # What the noise makes of the bend of level ground: 150 squares are known to 12 percent.
    assert np.mean(bends, axis=0) == pytest.approx(np.ones(3), abs=0.36)


@pytest.mark.parametrize("half_deg", [180.0, 60.0])
def test_one_ring_tells_no_bend_across_it(half_deg: float) -> None:
    """It is a conic: one of the three bends is the same as a tilt, to the last digit."""
    azimuth = np.radians(np.linspace(-half_deg, half_deg, 1200))
    down = math.radians(15.0)
    along = np.column_stack([np.cos(azimuth), np.sin(azimuth)]) * math.cos(down)
    ring = np.column_stack([along, np.full(len(azimuth), -math.sin(down))])
    plane = measured(scan_of(level, sigma_m=0.01, directions=ring @ NOSE_DOWN.matrix()))
    assert np.abs(plane.beyond).max() < 0.2
    assert (plane.beyond_variances < 0.2**2).all()
    assert np.linalg.eigvalsh(plane.cov_with(ground_floors(NoiseConfig())))[0] > 0.0


def test_the_covariance_is_that_of_the_distance_at_the_lidar() -> None:
    plane = measured(scan_of(level, sigma_m=0.01, seed=3))
    # About the centre of the patch, height and tilt hardly correlate; seen from the LiDAR they do.
    place = plane.axes_lidar @ plane.centre_lidar
    shift = np.eye(3)
    shift[2, :2] = place
    there = shift @ plane.cov @ shift.T
    correlation = plane.cov[2, :2] @ np.linalg.solve(plane.cov[:2, :2], plane.cov[2, :2])
    assert correlation / plane.cov[2, 2] > 0.8
    left = there[2, :2] @ np.linalg.solve(there[:2, :2], there[2, :2])
    assert left / there[2, 2] < 0.3
    floors = ground_floors(NoiseConfig())
    added = np.diag(floors**2) + np.outer(plane.beyond, plane.beyond)
    assert plane.cov_with(floors) - plane.cov == pytest.approx(added)
    # The ground is level: what it seems to be bent by is noise, and less than the floors.
    assert np.all(np.abs(plane.beyond) < 2.0 * floors)


@pytest.mark.parametrize("tilt_deg", [3.0, 10.0])
def test_guess_may_be_off(tilt_deg: float) -> None:
    scan = scan_of(level, wall(18.0, 3.0), sigma_m=0.01, seed=4)
    right = measured(scan)
    for azimuth in np.radians(np.arange(0.0, 360.0, 45.0)):
        axis = math.radians(tilt_deg) * np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        plane = measured(scan, gtsam.Rot3.Expmap(axis).matrix() @ UP_LIDAR)
        # Not the same points in every cell, but the same plane.
        assert errors(plane)[:2] == pytest.approx([0.0, 0.0], abs=2e-4)
        assert plane.distance_m == pytest.approx(right.distance_m, abs=1e-3)


def test_turning_the_lidar_turns_the_plane() -> None:
    scan = scan_of(level, wall(14.0, 3.0), sigma_m=0.01, seed=5)
    plane = measured(scan)
    R = gtsam.Rot3.RzRyRx(2.0, -0.7, 1.3).matrix()
    turned = measured(replace(scan, points_lidar=scan.points_lidar @ R.T), R @ UP_LIDAR)
    assert turned.normal_lidar == pytest.approx(R @ plane.normal_lidar, abs=1e-4)
    assert turned.distance_m == pytest.approx(plane.distance_m, abs=1e-3)


def test_a_slope_is_a_plane_too() -> None:
    slope = math.tan(math.radians(6.0))
    plane = measured(scan_of(terrain(lambda x: slope * x)))
    # Nose down by 10 degrees on ground that rises by 6: 4 degrees to it, and 2 cos 6 m above it.
    four = math.radians(16.0)
    assert plane.normal_lidar == pytest.approx([-math.sin(four), 0.0, math.cos(four)], abs=1e-6)
    assert plane.distance_m == pytest.approx(HEIGHT_M * math.cos(math.radians(6.0)), abs=1e-6)


# ------------------------------------------------------------------ what stands on it


@pytest.mark.parametrize(
    "surface",
    [
        wall(8.0, 3.0),
        wall(7.0, 1.0, 0.4),
        wall(7.0, 0.06, 3.0),
        plateau(8.0, 12.0, 2.0, 0.7),
        plateau(6.0, 30.0, 1.2, 0.15),
    ],
    ids=["wall", "target", "kerb", "table", "pavement"],
)
def test_things_that_stand_on_it_do_not_move_it(surface: Depth) -> None:
    off = np.mean(
        [errors(measured(scan_of(level, surface, sigma_m=0.01, seed=seed))) for seed in range(10)],
        axis=0,
    )
    assert np.abs(off[:2]).max() < NORMAL_FLOOR_RAD / 5.0
    assert abs(off[2]) < DISTANCE_FLOOR_M / 2.0


def test_the_vehicle_s_own_bonnet_is_not_the_ground() -> None:
    # A dense LiDAR that looks steeply down: two thirds of its returns are of a bonnet 1 m below.
    directions = np.concatenate([beams(240, 40), beams(60, 20)])
    directions[: 240 * 40] = directions[: 240 * 40] @ gtsam.Rot3.Pitch(0.45).matrix().T
    scan = scan_of(level, plateau(0.8, 2.4, 0.9, 1.0), sigma_m=0.01, seed=2, directions=directions)
    on_bonnet = np.abs(scan.points_lidar @ UP_LIDAR + 1.0) < 0.05
    on_ground = np.abs(scan.points_lidar @ UP_LIDAR + HEIGHT_M) < 0.05
    assert on_bonnet.sum() > on_ground.sum() / 2
    plane = measured(scan)
    assert np.abs(errors(plane)[:2]).max() < 3e-4
    assert plane.distance_m == pytest.approx(HEIGHT_M, abs=1.5e-3)


def test_grass_is_not_the_ground() -> None:
    # On a third of the ground beams end anywhere in the last 0.3 m above it, more often below.
    off = []
    for seed in range(20):
        scan = scan_of(level, sigma_m=0.01, seed=seed)
        rng = np.random.default_rng(seed)
        height = 0.3 * rng.uniform(0.0, 1.0, len(scan.points_lidar)) ** 2
        grass = scan.points_lidar[:, 1] > 0.25 * scan.points_lidar[:, 0]
        points = np.where(
            grass[:, None],
            scan.points_lidar * (1.0 - height / HEIGHT_M)[:, None],
            scan.points_lidar,
        )
        plane = plane_in(replace(scan, points_lidar=points), UP_LIDAR, 0.01)
        if plane is not None:
            off.append(errors(plane))
    assert len(off) > 10
    assert np.abs(np.mean(off, axis=0)[:2]).max() < NORMAL_FLOOR_RAD / 5.0
    assert abs(np.mean(off, axis=0)[2]) < DISTANCE_FLOOR_M / 2.0


@pytest.mark.parametrize(
    ("sigma_m", "sigma_rad"), [(0.03, 0.0), (0.01, 1e-3), (0.02, 7e-4)], ids=str
)
def test_a_road_is_smooth_by_a_noisier_lidar_than_is_stated(
    sigma_m: float, sigma_rad: float
) -> None:
    """The range noise of 20 to 30 mm shows near the LiDAR, that of 1 mrad of the beams far away."""
    scan = scan_of(level, sigma_m=sigma_m, seed=3)
    aside = np.random.default_rng(4).normal(0.0, sigma_rad, scan.points_lidar.shape)
    turned = scan.points_lidar + np.cross(aside, scan.points_lidar)
    assert measured(replace(scan, points_lidar=turned)).roughness_m < 0.9 * ROUGH_M


@pytest.mark.parametrize("sigma_m", [0.003, 0.01])
@pytest.mark.parametrize("mean_m", [0.0, 0.02, 0.035])
def test_roughness_is_that_of_the_ground_not_of_the_ranges(mean_m: float, sigma_m: float) -> None:
    """Blades of all lengths return flat beams far before the soil; heights scatter by 0.5 to 0.7
    of the mean, in some part of the ground by 0.4."""
    scan = scan_of(level, wall(10.0, 2.0), sigma_m=sigma_m, seed=3)
    low = scan.points_lidar @ UP_LIDAR < -HEIGHT_M + 0.2
    lift = low * mean_m * np.random.default_rng(3).gamma(2.0, 0.5, len(low))
    points = scan.points_lidar * (1.0 - lift / HEIGHT_M)[:, None]
    plane = measured(replace(scan, points_lidar=points), sigma_m=0.01)
    assert 0.4 * mean_m - 0.002 < plane.roughness_m < 0.75 * mean_m + 0.002


def test_few_square_metres_do_not_tell_the_roughness() -> None:
    scan = scan_of(level, sigma_m=0.01, directions=beams(30, 13))
    assert math.isnan(measured(scan).roughness_m)


def test_scattered_returns_do_not_matter() -> None:
    scan = scan_of(level, sigma_m=0.01, seed=7)
    rng = np.random.default_rng(0)
    stray = scan.points_lidar * rng.uniform(0.3, 1.0, (len(scan.points_lidar), 1))
    mixed = np.where(rng.random((len(stray), 1)) < 0.15, stray, scan.points_lidar)
    plane = measured(replace(scan, points_lidar=mixed))
    assert np.abs(errors(plane)[:2]).max() < 3e-4
    assert plane.distance_m == pytest.approx(HEIGHT_M, abs=2e-3)


def test_sparse_clouds_will_do() -> None:
    scan = scan_of(level, wall(10.0, 2.0), sigma_m=0.01, directions=beams(30, 13))
    assert len(scan.points_lidar) < 400
    plane = measured(scan)
    assert plane.points < 200
    assert np.abs(errors(plane)[:2]).max() < NORMAL_FLOOR_RAD
    assert abs(errors(plane)[2]) < 2.0 * DISTANCE_FLOOR_M


# ------------------------------------------------------------------ what is no plane


def rise(foot_m: float, x_m: Array) -> Array:
    return 0.15 * np.maximum(x_m - foot_m, 0.0)


def test_ramp_ahead_leaves_the_near_part_or_nothing() -> None:
    for foot_m in (6.0, 7.0, 8.0, 9.0, 11.0, 13.0):
        rises = terrain(partial(rise, foot_m))
        plane = plane_in(scan_of(rises, sigma_m=0.01), UP_LIDAR, 0.01)
        if plane is not None:
            # Level, or the ramp: never the mean of both. 0.15 is 8.5 degrees.
            tilt = math.asin(float(np.cross(UP_LIDAR, plane.normal_lidar)[1]))
            assert min(abs(tilt), abs(abs(tilt) - math.atan(0.15))) < 1.5e-3, foot_m
        if foot_m > 10.0:
            assert plane is not None
            assert abs(errors(plane)[2]) < 2.0 * DISTANCE_FLOOR_M


def test_stairs_are_refused() -> None:
    stairs = terrain(lambda x: 0.1 * np.floor(np.maximum(x - 5.0, 0.0) / 1.5))
    assert plane_in(scan_of(stairs, sigma_m=0.01), UP_LIDAR, 0.01) is None


def test_a_step_leaves_the_level_that_the_vehicle_is_on() -> None:
    # Of what is seen within 15 m half is up the step; within 10 m little.
    step = terrain(lambda x: np.where(x > 9.0, 0.1, 0.0))
    plane = measured(scan_of(step, sigma_m=0.01))
    assert plane.radius_m == 10.0
    assert abs(errors(plane)[2]) < 2.0 * DISTANCE_FLOOR_M
    # With the step so near, both levels could be the vehicle's.
    near = terrain(lambda x: np.where(x > 6.5, -0.2, 0.0))
    assert plane_in(scan_of(near, sigma_m=0.01), UP_LIDAR, 0.01) is None


def test_a_roof_larger_than_the_ground_is_refused() -> None:
    roof = plateau(1.0, 30.0, 100.0, 1.2)
    beside = plateau(1.0, 12.0, 2.6, 1.2)
    # A lorry's: of the ground less is seen than of the roof; alone it could be the ground.
    assert plane_in(scan_of(level, beside, sigma_m=0.01), UP_LIDAR, 0.01) is None
    assert plane_in(scan_of(roof, sigma_m=0.01), UP_LIDAR, 0.01) is not None


def test_what_is_bent_over_15_m_may_be_a_plane_over_10() -> None:
    plane = measured(scan_of(terrain(lambda x: -(x**2) / 1000.0), sigma_m=0.01))
    assert plane.radius_m == 10.0


@pytest.mark.parametrize("radius_m", [2000.0, -3000.0])
def test_a_crest_or_a_dip_is_owned_up_to(radius_m: float) -> None:
    # The patch, 4.5 to 15 m ahead, lies x^2 / 2R above the ground at the wheels: 20 mm of 2 km.
    scans = [
        scan_of(terrain(lambda x: x**2 / (2.0 * radius_m)), sigma_m=0.005, seed=seed)
        for seed in range(8)
    ]
    planes = [measured(scan, sigma_m=0.005) for scan in scans]
    off = np.mean([errors(plane) for plane in planes], axis=0)
    assert abs(off[2]) > 5.0 * DISTANCE_FLOOR_M
    # It is no plane, and the bend says by how much and in which direction it is wrong.
    beyond = np.mean([plane.beyond for plane in planes], axis=0)
    assert off + beyond == pytest.approx(np.zeros(3), abs=0.25 * abs(off[2]))
    for plane in planes:
        wrong = errors(plane)
        assert wrong @ np.linalg.solve(plane.cov_with(ground_floors(NoiseConfig())), wrong) < 6.0


@pytest.mark.parametrize("radius_m", [100.0, -100.0, 300.0])
def test_bent_ground_is_refused(radius_m: float) -> None:
    bent = terrain(lambda x: x**2 / (2.0 * radius_m))
    assert plane_in(scan_of(bent, sigma_m=0.01), UP_LIDAR, 0.01) is None


def test_hardly_bent_ground_is_not() -> None:
    # 5 mm over the half of 15 m.
    bent = terrain(lambda x: x**2 / (2.0 * 10_000.0))
    assert plane_in(scan_of(bent, sigma_m=0.01), UP_LIDAR, 0.01) is not None


@pytest.mark.parametrize(
    "scan",
    [
        LidarScan("front", 0, np.zeros((0, 3)), "empty"),
        LidarScan("front", 0, np.array([[5.0, 0.0, -1.0]] * 3), "three points"),
        scan_of(wall(6.0, 50.0)),
        scan_of(level, directions=RING[np.abs(RING[:, 1]) < 0.35]),
    ],
    ids=["empty", "few", "wall", "one ring"],
)
def test_no_ground_is_no_plane(scan: LidarScan) -> None:
    assert plane_in(scan, UP_LIDAR, 0.01) is None


def test_ceiling_is_not_the_ground() -> None:
    scan = scan_of(level, sigma_m=0.01)
    assert plane_in(replace(scan, points_lidar=-scan.points_lidar), UP_LIDAR, 0.01) is None


def test_no_place_has_more_than_its_share() -> None:
    rng = np.random.default_rng(0)
    heap = np.array([4.5, 0.5, -2.0]) + rng.uniform(-0.4, 0.4, (5000, 3)) * [1.0, 1.0, 0.0]
    wide = np.column_stack([rng.uniform(-14.0, 14.0, (300, 2)), np.full(300, -2.0)])
    near = near_points(np.concatenate([heap, wide]), np.array([0.0, 0.0, 1.0]))
    # The heap lies across four cells at most.
    assert np.sum(near < 5000) <= 4 * CELL_POINTS
    assert np.sum(near >= 5000) > 280
    assert np.all(np.diff(near) > 0)


def test_axes_are_at_right_angles() -> None:
    for normal in np.random.default_rng(0).normal(size=(20, 3)):
        unit = normal / np.linalg.norm(normal)
        axes = np.vstack([tangent_axes(unit), unit])
        assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1.0)


# ------------------------------------------------------------------ simulated drives


def simulated(
    name: str, every: int, seed: int = 11
) -> dict[str, list[tuple[GroundPlane | None, Array, float]]]:
    """Planes of a scenario with as many times fewer scans; true normal and distance of the ground.

    Scans that nobody asks for cost too: their noise is drawn.
    """
    scenario = load_scenario(ROOT / "configs" / "scenarios" / f"{name}.yaml")
    recording = simulate_drive(scanned_every(scenario, every), seed)
    truth = recording.truth
    out: dict[str, list[tuple[GroundPlane | None, Array, float]]] = {}
    for lidar in recording.lidars:
        guess = recording.guesses[lidar]
        R_guess = pose((0.0, 0.0, 0.0), guess.rpy_deg).rotation().matrix()
        for scan in recording.scans(lidar):
            since_ns = scan.stamp_ns - truth.start_ns
            heave_m = truth.heave_m[since_ns // 100_000_000]
            (X,) = truth.drive.poses(np.array([since_ns]), truth.level_z_map + heave_m)
            T = X.compose(truth.T_vehicle_lidar[lidar])
            up = (X.rotation().matrix() @ R_guess)[2]
            normal = T.rotation().matrix()[2]
            height = float(T.translation()[2] - recording.world.ground_z_map)
            out.setdefault(lidar, []).append((plane_in(scan, up, 0.01), normal, height))
    return out


def test_simulated_drive_unbiased_and_as_good_as_said() -> None:
    for rows in simulated("figure_eight", 12).values():
        assert len(rows) > 45
        off, squares = [], []
        for plane, normal, height in rows:
            assert plane is not None
            off.append(errors(plane, normal, height))
            squares.append(off[-1] @ np.linalg.solve(plane.cov, off[-1]))
        bias = np.mean(off, axis=0)
        assert np.abs(bias[:2]).max() < 2e-5
        assert abs(bias[2]) < 1.5e-4
        assert 0.7 < np.mean(squares) / 3.0 < 1.4


def test_simulated_ramp_is_the_level_ground_or_nothing() -> None:
    for rows in simulated("ramp", 8).values():
        off = np.array(
            [errors(plane, normal, height) for plane, normal, height in rows if plane is not None]
        )
        # Planes of the ramps would be off by 150 mrad and decimetres.
        assert len(off) > 0.8 * len(rows)
        assert np.abs(off[:, :2]).max() < 2.0 * NORMAL_FLOOR_RAD
        assert np.abs(off[:, 2]).max() < 3.0 * DISTANCE_FLOOR_M
        assert np.abs(off[:, :2].mean(axis=0)).max() < 1e-4
        assert abs(off[:, 2].mean()) < 5e-4
