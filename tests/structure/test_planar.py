"""Flat patches of a scan: what is kept, what is not, and that nothing is biased."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from caliv_graph.products import Array
from caliv_graph.structure.patches import DrivePatches, RangeNoise
from caliv_graph.structure.planar import (
    MAX_PATCHES,
    MIN_POINTS,
    ScanPatches,
    SweepMotion,
    planar_patches,
)

SIGMA_M = 0.01

NOISE = RangeNoise.constant(SIGMA_M)


def beams(elevations_deg: Array, azimuths_deg: Array) -> Array:
    elevation, azimuth = np.meshgrid(np.radians(elevations_deg), np.radians(azimuths_deg))
    flat = np.cos(elevation)
    return np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1
    ).reshape(-1, 3)


DENSE = beams(np.arange(-12.5, 12.5, 0.25), np.arange(-45.0, 45.0, 0.25))


def on_plane(rays: Array, normal: Array, distance_m: float) -> Array:
    """(N,) ranges to the plane `normal . p = distance`; infinite behind."""
    at = distance_m / (rays @ normal)
    return np.where(at > 0.0, at, np.inf)


def noisy(rays: Array, ranges: Array, seed: int = 0) -> Array:
    seen = ranges < 60.0
    ranges = ranges + np.random.default_rng(seed).normal(0.0, SIGMA_M, len(ranges))
    return np.asarray(rays[seen] * ranges[seen, None])


def points_of(patches: ScanPatches) -> Array:
    return np.asarray(patches.moments[:, 3, 3])


def centres(patches: ScanPatches) -> Array:
    return np.asarray(patches.moments[:, :3, 3] / patches.moments[:, 3, 3, None])


def of_one_scan(patches: ScanPatches, *moved_with: gtsam.Pose3) -> DrivePatches:
    return DrivePatches(
        drive=0,
        lidars=("front",),
        stamps_ns=np.zeros(1, np.int64),
        scan_lidar=np.zeros(1, np.int64),
        scan=np.zeros(len(patches.time_s), np.int64),
        time_s=patches.time_s,
        moments=patches.moments,
        normal_lidar=patches.normal_lidar,
        scatter_m=patches.scatter_m,
        swept=patches.swept,
        moved_with=moved_with,
    )


def test_the_moments_are_the_sums_over_the_points() -> None:
    # All within one cell of 3.75 degrees.
    rays = beams(np.arange(0.2, 3.4, 0.25), np.arange(0.2, 3.4, 0.25))
    points = noisy(rays, on_plane(rays, np.array([1.0, 0.0, 0.0]), 9.0))
    patches = planar_patches(points, NOISE)
    h = np.column_stack([points, np.ones(len(points))])
    np.testing.assert_allclose(patches.moments, [h.T @ h], rtol=1e-12)
    np.testing.assert_allclose(patches.normal_lidar, [[-1.0, 0.0, 0.0]], atol=0.02)
    residual = (points - points.mean(axis=0)) @ patches.normal_lidar[0]
    assert patches.scatter_m[0] ** 2 == pytest.approx(residual @ residual / (len(points) - 3))
    assert patches.time_s.tolist() == [0.0]


def test_a_wall_becomes_unbiased_patches() -> None:
    normal = np.array([0.8, 0.5, 0.1])
    normal /= np.linalg.norm(normal)
    points = noisy(DENSE, on_plane(DENSE, normal, 15.0))
    patches = planar_patches(points, NOISE)
    assert points_of(patches).sum() > 0.95 * (len(points) - patches.grazing)
    assert patches.uneven == 0
    assert points_of(patches).min() >= MIN_POINTS
    off = centres(patches) @ normal - 15.0
    expected = SIGMA_M / np.sqrt(points_of(patches))
    assert np.sqrt(np.mean((off / expected) ** 2)) < 1.1
    assert abs(np.average(off, weights=points_of(patches))) < 3.0 * SIGMA_M / len(points) ** 0.5
    np.testing.assert_allclose(patches.normal_lidar @ normal, -1.0, atol=3e-3)
    assert 300 < len(patches.time_s) < MAX_PATCHES
    assert (
        patches.undecided + patches.uneven + patches.grazing
        == len(points) - points_of(patches).sum()
    )


def test_no_patch_is_a_mean_of_the_two_walls_of_a_corner() -> None:
    normals = np.array([[0.9, 0.436, 0.0], [0.7, -0.714, 0.0]])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    ranges = np.minimum(*(on_plane(DENSE, n, 11.0) for n in normals))
    patches = planar_patches(noisy(DENSE, ranges), NOISE)
    angle = np.arccos(np.clip(np.abs(patches.normal_lidar @ normals.T), 0.0, 1.0)).min(axis=1)
    assert len(angle) > 300
    assert angle.max() < 0.12
    off = np.abs(centres(patches) @ normals.T - 11.0).min(axis=1)
    assert off.max() < 0.012


@pytest.mark.parametrize("step_m", [0.05, 0.2, 3.0])
def test_no_patch_spans_a_step(step_m: float) -> None:
    # 8.2 degrees is inside a cell. The rear part is hidden behind the front one's edge.
    left = np.arctan2(DENSE[:, 1], DENSE[:, 0]) > np.radians(8.2)
    normal = np.array([1.0, 0.0, 0.0])
    ranges = np.where(left, on_plane(DENSE, normal, 10.0), on_plane(DENSE, normal, 10.0 + step_m))
    patches = planar_patches(noisy(DENSE, ranges), NOISE)
    x = centres(patches)[:, 0]
    assert len(x) > 300
    off = np.minimum(np.abs(x - 10.0), np.abs(x - 10.0 - step_m))
    assert off.max() < 0.012
    assert np.abs(patches.normal_lidar[:, 0]).min() > 0.99


def beside_a_kerb(kerb_m: float, seed: int) -> ScanPatches:
    """Patches of road, seen from 2 m above it, and of a kerb of 12 cm across it."""
    rays = beams(np.arange(-26.0, -12.0, 0.35), np.arange(-45.0, 45.0, 0.32))
    x, z = rays[:, 0], rays[:, 2]
    ranges = on_plane(rays, np.array([0.0, 0.0, -1.0]), 2.0)
    at_face = kerb_m / x
    ranges = np.where(z * at_face > -2.0, at_face, ranges)
    ranges = np.where(z * at_face > -1.88, -1.88 / z, ranges)
    return planar_patches(noisy(rays, ranges, seed), NOISE)


@pytest.mark.parametrize("width_deg", [0.5, 1.0])
def test_a_line_of_points_that_noise_makes_wide_is_no_plane(width_deg: float) -> None:
    """An arc of a rosette on the ground, 0.6 m below: 60 to 120 mm wide, ranges good to 14 mm.

    As a patch it would be tilted by 7 and 3 degrees: its width is that of the noise.
    """
    assert not len(planar_patches(arc_on_ground(width_deg), NOISE).time_s)
    wide = planar_patches(arc_on_ground(4.0), NOISE)
    assert len(wide.time_s)
    assert (wide.normal_lidar[:, 2] > np.cos(np.radians(2.0))).all()


def arc_on_ground(width_deg: float) -> Array:
    rng = np.random.default_rng(0)
    azimuth = np.radians(np.linspace(20.0, 26.0, 300))
    elevation = np.radians(-17.5 + width_deg * rng.uniform(-0.5, 0.5, 300))
    flat = np.cos(elevation)
    rays = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    return np.asarray(rays * (-0.6 / rays[:, 2] + rng.normal(0.0, 0.014, 300))[:, None])


def test_what_stands_on_the_road_does_not_tilt_it() -> None:
    beside = []
    for seed in range(20):
        kerb_m = 4.2 + 0.08 * seed
        patches = beside_a_kerb(kerb_m, seed)
        x, _, z = centres(patches).T
        near = (patches.normal_lidar[:, 2] > 0.9) & (z < -1.94) & (np.abs(kerb_m - x) < 0.6)
        beside.append(np.stack([z[near] + 2.0, patches.normal_lidar[near, 0]]))
    height_m, slope = np.concatenate(beside, axis=1)
    assert len(slope) > 20
    # Patches that hold points of the kerb's foot are 2 mm high in the mean and slope by 10 mrad.
    assert abs(height_m.mean()) < 3e-4
    assert height_m.max() < 2e-3
    assert abs(slope.mean()) < 3e-3


def test_curved_and_rough_surfaces_are_left_out() -> None:
    rays = beams(np.arange(-3.5, 3.5, 0.1), np.arange(-3.5, 3.5, 0.1))
    b = rays @ np.array([8.0, 0.0, 0.0])
    with np.errstate(invalid="ignore"):
        ball = b - np.sqrt(b * b - 64.0 + 0.5**2)
    ball = np.where(np.isfinite(ball), ball, np.inf)
    patches = planar_patches(noisy(rays, ball), NOISE)
    assert points_of(patches).sum() < 0.1 * np.isfinite(ball).sum()
    hedge = on_plane(DENSE, np.array([1.0, 0.0, 0.0]), 9.0)
    hedge += np.random.default_rng(1).normal(0.0, 0.05, len(hedge))
    patches = planar_patches(noisy(DENSE, hedge), NOISE)
    assert points_of(patches).sum() < 0.01 * len(DENSE)
    assert patches.uneven > 0.9 * len(DENSE)


def test_beams_that_graze_a_wall_are_left_out() -> None:
    normal = np.array([np.sin(np.radians(3.0)), np.cos(np.radians(3.0)), 0.0])
    patches = planar_patches(noisy(DENSE, on_plane(DENSE, normal, 2.0)), NOISE)
    towards = centres(patches) / np.linalg.norm(centres(patches), axis=1)[:, None]
    cosine = -np.einsum("ni,ni->n", towards, patches.normal_lidar)
    assert cosine.min() > np.cos(np.radians(75.0))
    assert patches.grazing > 0


def test_two_rings_prove_no_plane_and_sixteen_do() -> None:
    azimuths = np.arange(-45.0, 45.0, 0.2)
    normal = np.array([0.9, 0.3, 0.0])
    normal /= np.linalg.norm(normal)
    two = beams(np.array([-1.0, 1.0]), azimuths)
    assert not len(planar_patches(noisy(two, on_plane(two, normal, 10.0)), NOISE).time_s)
    # A ring on a wall and one on the ground before it lie on a plane, which is neither.
    rings = beams(np.linspace(-15.0, 15.0, 16), azimuths)
    ranges = np.minimum(on_plane(rings, normal, 12.0), on_plane(rings, np.array([0, 0, -1.0]), 1.6))
    patches = planar_patches(noisy(rings, ranges), NOISE)
    assert len(patches.time_s) > 20
    upright = np.abs(patches.normal_lidar[:, 2]) < 0.3
    assert upright.sum() > 20
    np.testing.assert_allclose(-patches.normal_lidar[upright] @ normal, 1.0, atol=5e-3)
    np.testing.assert_allclose(centres(patches)[upright] @ normal, 12.0, atol=0.012)


def test_the_cells_favour_no_axis() -> None:
    normal = np.array([0.8, 0.5, 0.3])
    normal /= np.linalg.norm(normal)
    points = noisy(DENSE, on_plane(DENSE, normal, 9.0))
    here, there = planar_patches(points, NOISE), planar_patches(points[:, [1, 2, 0]], NOISE)
    assert len(here.time_s) == len(there.time_s)
    back = there.moments[:, [2, 0, 1, 3]][:, :, [2, 0, 1, 3]]
    order, other = (np.lexsort(m[:, :3, 3].T.round(6)) for m in (here.moments, back))
    np.testing.assert_allclose(back[other], here.moments[order], rtol=1e-9, atol=1e-9)


def test_the_order_of_the_points_does_not_matter() -> None:
    points = noisy(DENSE, on_plane(DENSE, np.array([1.0, 0.0, 0.0]), 9.0))
    mixed = np.random.default_rng(2).permutation(len(points))
    here, there = planar_patches(points, NOISE), planar_patches(points[mixed], NOISE)
    np.testing.assert_allclose(there.moments, here.moments, rtol=1e-9, atol=1e-9)


def test_points_of_a_sweep_are_moved_to_their_patchs_time() -> None:
    # Rows one after the other within 0.1 s, so that times differ within a patch.
    turn, velocity = np.array([0.05, -0.1, 0.6]), np.array([3.0, 0.4, -0.2])
    times = np.repeat(np.linspace(0.0, 0.1, 100), len(DENSE) // 100 + 1)[: len(DENSE)]
    normal = np.array([0.95, 0.2, 0.1])
    normal /= np.linalg.norm(normal)

    def plane_at(t: Array) -> tuple[Array, Array]:
        # Normal and distance of a fixed wall in the frame of a body with this twist, to 1e-5.
        n = normal - t[:, None] * np.cross(turn, normal)
        n += 0.5 * t[:, None] ** 2 * np.cross(turn, np.cross(turn, normal))
        return n, 9.0 - t * (n @ velocity) - 0.5 * t**2 * (np.cross(turn, velocity) @ normal)

    n, d = plane_at(times)
    points = DENSE * (d / np.einsum("ni,ni->n", DENSE, n))[:, None]
    motion = SweepMotion(0.0, np.tile(turn, (11, 1)), np.tile(velocity, (11, 1)))
    patches = planar_patches(points, NOISE, times, motion)
    n, d = plane_at(patches.time_s)
    off = np.einsum("ni,ni->n", centres(patches), n) - d
    assert len(off) > 100
    assert np.abs(off).max() < 2e-4
    assert patches.scatter_m.max() < 2e-4
    still = planar_patches(points, NOISE)
    assert still.scatter_m.max() > 5e-3 or len(still.time_s) < len(patches.time_s)


def test_a_dense_cloud_costs_no_more_than_a_bounded_one() -> None:
    rays = beams(np.arange(-45.0, 45.0, 0.1), np.arange(-45.0, 45.0, 0.22))
    assert len(rays) > 300_000
    points = noisy(rays, on_plane(rays, np.array([1.0, 0.0, 0.0]), 25.0))
    patches = planar_patches(points, NOISE)
    assert 1000 < len(patches.time_s) <= MAX_PATCHES
    assert np.ptp(centres(patches)[:, 1]) > 40.0


def test_nothing_comes_of_nothing() -> None:
    for points in (np.zeros((0, 3)), np.array([[5.0, 0.0, 0.0]])):
        patches = planar_patches(points, NOISE)
        assert len(patches.time_s) == 0
        assert patches.moments.shape == (0, 4, 4)
        assert patches.undecided == len(points)


def test_patches_of_a_sweep_follow_better_extrinsics() -> None:
    # A ground that is taken in turn, to the left, within 0.1 s.
    rays = beams(np.arange(-20.0, -10.0, 0.25), np.arange(-60.0, 60.0, 0.25))
    points = rays * on_plane(rays, np.array([0.0, 0.0, -1.0]), 1.6)[:, None]
    times = 0.1 * (np.arctan2(rays[:, 1], rays[:, 0]) / np.radians(120.0) + 0.5)
    of_vehicle = np.array([0.02, -0.03, 0.3, 3.0, 0.1, 0.0])
    right = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.05, 0.1, 0.4), np.array([1.0, 0.3, 1.6]))
    guess = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.05, 0.08, 0.42), np.array([1.1, 0.2, 1.6]))

    def taken(T_vehicle_lidar: gtsam.Pose3) -> DrivePatches:
        twist = T_vehicle_lidar.inverse().AdjointMap() @ of_vehicle
        motion = SweepMotion(0.0, np.tile(twist[:3], (11, 1)), np.tile(twist[3:], (11, 1)))
        found = planar_patches(points, NOISE, times, motion)
        return of_one_scan(found, T_vehicle_lidar)

    def tilts(patches: DrivePatches) -> Array:
        """Slope of each patch to the left of its beams, rad."""
        centre = patches.centres_lidar
        cov = patches.moments[:, :3, :3] / patches.points[:, None, None]
        cov = cov - centre[:, :, None] * centre[:, None, :]
        left = np.stack([-centre[:, 1], centre[:, 0], np.zeros(len(centre))], axis=1)
        left /= np.linalg.norm(left, axis=1)[:, None]
        along = np.einsum("ni,nij->nj", left, cov)
        return np.asarray(along[:, 2] / np.einsum("ni,ni->n", along, left))

    by_right, by_guess = taken(right), taken(guess)
    assert len(by_guess.scan) == len(by_right.scan) > 50
    wrong = tilts(by_guess) - tilts(by_right)
    assert np.abs(wrong).mean() > 3e-4
    followed = by_guess.followed({"front": right})
    left = tilts(followed) - tilts(by_right)
    assert np.abs(left).max() < 0.02 * np.abs(wrong).max()
    # And as often as the estimate moves.
    again = by_guess.followed({"front": gtsam.Pose3()}).followed({"front": right})
    np.testing.assert_allclose(again.moments, followed.moments, rtol=1e-3, atol=1e-3)
    assert again.moved_with == (right,)


def test_patches_that_were_taken_at_once_follow_nothing() -> None:
    found = planar_patches(DENSE * on_plane(DENSE, np.array([1.0, 0.0, 0.0]), 8.0)[:, None], NOISE)
    assert found.swept is None


def test_noise_along_the_beams_is_taken_out_of_the_tilt_of_ground() -> None:
    """A LiDAR 0.6 m above flat ground, whose beams scatter over its patches as a Livox's do.

    A plane that is fitted to the points leans to the LiDAR by milliradians. What they scatter along
    the beams is measured in each patch, whatever is stated, and so this can be taken out.
    """
    rng, sigma_m, height_m = np.random.default_rng(4), 0.025, 0.6
    down = np.radians(rng.uniform(12.0, 40.0, 60_000))
    azimuth = np.radians(rng.uniform(-35.0, 35.0, len(down)))
    flat = np.cos(down)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), -np.sin(down)], axis=1)
    ranges = height_m / np.sin(down) + rng.normal(0.0, sigma_m, len(down))
    found = planar_patches(rays * ranges[:, None], NOISE)
    of = of_one_scan(found)
    along = of.scatter_along_beam_m

    squares = (along**2).sum()
    assert np.sqrt(squares / of.points.sum()) == pytest.approx(sigma_m, rel=0.02)
    up, outwards = np.array([0.0, 0.0, 1.0]), of.centres_lidar * [1.0, 1.0, 0.0]
    outwards /= np.linalg.norm(outwards, axis=1)[:, None]
    means = of.points[:, None, None] * of.centres_lidar[:, :, None] * of.centres_lidar[:, None, :]
    about = of.moments[:, :3, :3] - means

    def slope_rad(moments: Array) -> float:
        """Rise of the ground away from the LiDAR, of all patches together: it is level."""
        rise = np.einsum("ni,nij,j->", outwards, moments, up)
        return float(rise / np.einsum("ni,nij,nj->", outwards, about, outwards))

    assert slope_rad(about) < -3e-3
    assert abs(slope_rad(about - along[:, :, None] * along[:, None, :])) < 1e-3
