"""The rough alignment: from guesses that are off, and with nothing to align."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.config.guesses import with_guess
from caliv_graph.config.lidars import LidarConfig
from caliv_graph.config.model import Config
from caliv_graph.geometry.se3 import retract_vehicle_axes, stack, unstack, vehicle_axes_difference
from caliv_graph.products import Array, IntArray, Trajectory
from caliv_graph.structure import pairs
from caliv_graph.structure.align import PatchAlignment, _jacobians, align_patches
from caliv_graph.structure.pairs import Pairs, gathered
from caliv_graph.structure.patches import DrivePatches, RangeNoise
from caliv_graph.structure.prior import PosePrior
from caliv_graph.structure.read import _together, level, lidars_above_ground, scan_patches
from caliv_graph.structure.solve import solve_structure
from caliv_graph.structure.term import problem_of, term_of, usable
from caliv_graph.trajectory.select import GivenTrajectory
from tests.samples import pose
from tests.structure.worlds import Spinner, World, driven, ground, world_of, yard
from tests.trajectory.motions import eight_drive

NOISE = RangeNoise.constant(0.01)

TRAJECTORY = driven(eight_drive())
SPINNERS = {
    "front": Spinner(
        pose((2.0, 0.0, 2.0), (0.0, 10.0, 0.0)),
        np.linspace(-12.5, 12.5, 60),
        np.linspace(-60.0, 60.0, 220),
    ),
    "rear": Spinner(
        pose((-0.4, 0.0, 2.0), (1.0, 10.0, 178.0)),
        np.linspace(-20.0, 12.5, 60),
        np.linspace(-60.0, 60.0, 220),
        sweep_s=0.1,
    ),
}
TRUTH = {name: spinner.T_vehicle_lidar for name, spinner in SPINNERS.items()}


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of the patches is enough for forty scans."""
    monkeypatch.setattr(pairs, "SOURCES", 1000)


def patches_of(world: World, stamps_s: Array, seed: int = 1) -> DrivePatches:
    """Patches of scans at these times, motion compensated with the true extrinsics."""
    rng = np.random.default_rng(seed)
    scans = []
    for k, (name, spinner) in enumerate(SPINNERS.items()):
        for stamp in np.round(1e9 * stamps_s).astype(np.int64).tolist():
            scan = spinner.scan(name, world, TRAJECTORY, stamp + 30_000_000 * k, rng)
            found = scan_patches(scan, TRUTH[name], TRAJECTORY, NOISE, keep_level=True)
            scans.append((k, scan.stamp_ns, found))
    return _together(0, tuple(SPINNERS), scans, tuple(TRUTH.values()), {})


@functools.cache
def in_yard() -> DrivePatches:
    return patches_of(yard(), np.arange(1.0, 59.0, 2.9))


def off_by(
    turn_deg: float, shift_m: float, seed: int
) -> tuple[dict[str, gtsam.Pose3], dict[str, Array]]:
    """Guesses with uniform errors, and their sigmas."""
    rng = np.random.default_rng(seed)
    bound = np.repeat([np.radians(turn_deg), shift_m], 3)
    guesses = {
        name: retract_vehicle_axes(T, rng.uniform(-bound, bound)) for name, T in TRUTH.items()
    }
    return guesses, dict.fromkeys(TRUTH, bound / np.sqrt(3.0))


def errors(result: PatchAlignment | Mapping[str, gtsam.Pose3]) -> Array:
    """(2, 6) of the LiDARs, vehicle axes."""
    poses = result.T_vehicle_lidar if isinstance(result, PatchAlignment) else result
    return np.array([vehicle_axes_difference(poses[name], T) for name, T in TRUTH.items()])


@pytest.mark.parametrize(
    ("turn_deg", "shift_m", "seed"), [(3.0, 0.1, 0), (3.0, 0.1, 1), (10.0, 0.5, 2)]
)
def test_extrinsics_that_are_off_are_found(turn_deg: float, shift_m: float, seed: int) -> None:
    guesses, sigmas = off_by(turn_deg, shift_m, seed)
    result = align_patches([in_yard()], [TRAJECTORY], guesses, sigmas)
    assert result.converged
    assert result.agreement > 0.95 > 2.0 * result.before
    assert min(result.matches.values()) > 300
    off = errors(result)
    assert np.abs(off[:, :3]).max() < 2e-3
    assert np.abs(off[:, 3:5]).max() < 8e-3
    # Nothing tells the height of all: it stays at the guesses, the difference does not.
    assert abs(off[0, 5] - off[1, 5]) < 8e-3
    assert off[:, 5].mean() == pytest.approx(errors(guesses)[:, 5].mean(), abs=0.02)


def test_the_result_does_not_depend_on_where_the_map_is() -> None:
    guesses, sigmas = off_by(3.0, 0.1, 3)
    here = align_patches([in_yard()], [TRAJECTORY], guesses, sigmas)
    T = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 2.0), np.array([300.0, -200.0, 50.0]))
    of = TRAJECTORY.trajectory
    moved = GivenTrajectory(Trajectory(of.stamps_ns, tuple(T.compose(X) for X in of.T_map_vehicle)))
    there = align_patches([in_yard()], [moved], guesses, sigmas)
    np.testing.assert_allclose(errors(there), errors(here), atol=1e-6)


def test_what_is_held_stays_and_the_other_is_aligned_to_it() -> None:
    guesses, sigmas = off_by(3.0, 0.1, 4)
    guesses["rear"] = TRUTH["rear"]
    sigmas["rear"] = np.zeros(6)
    off = errors(align_patches([in_yard()], [TRAJECTORY], guesses, sigmas))
    np.testing.assert_allclose(off[1], 0.0, atol=1e-9)
    assert np.abs(off[0, :3]).max() < 2e-3
    assert np.abs(off[0, 3:]).max() < 8e-3


def test_on_ground_alone_only_tilt_and_height_are_aligned() -> None:
    guesses, sigmas = off_by(3.0, 0.1, 5)
    flat = patches_of(world_of(ground()), np.arange(1.0, 59.0, 7.3))
    result = align_patches([flat], [TRAJECTORY], guesses, sigmas)
    off, before = errors(result), errors(guesses)
    assert np.abs(off[:, :2]).max() < 2e-3
    assert abs(off[0, 5] - off[1, 5]) < 8e-3
    np.testing.assert_allclose(off[:, 2], before[:, 2], atol=5e-3)
    np.testing.assert_allclose(off[:, 3:5], before[:, 3:5], atol=0.01)


@pytest.mark.parametrize("few", [0, 3])
def test_without_structure_the_guesses_come_back(few: int) -> None:
    guesses, sigmas = off_by(3.0, 0.1, 6)
    patches = in_yard().part(np.arange(len(in_yard().scan)) < few)
    result = align_patches([patches], [TRAJECTORY], guesses, sigmas)
    assert not result.converged
    assert result.matches == {"front": 0, "rear": 0}
    np.testing.assert_allclose(errors(result), errors(guesses))
    assert not align_patches([], [], guesses, sigmas).converged


def test_clutter_is_no_structure() -> None:
    guesses, sigmas = off_by(3.0, 0.1, 7)
    rng = np.random.default_rng(0)
    patches = in_yard()
    turned = rng.normal(size=(len(patches.scan), 3))
    turned /= np.linalg.norm(turned, axis=1)[:, None]
    mixed = replace(patches, normal_lidar=turned, moments=rng.permutation(patches.moments))
    result = align_patches([mixed], [TRAJECTORY], guesses, sigmas)
    assert not result.converged
    np.testing.assert_allclose(errors(result), errors(guesses))


def test_a_lidar_that_sees_nothing_stays_at_its_guess() -> None:
    guesses, sigmas = off_by(3.0, 0.1, 8)
    only_rear = in_yard().part(in_yard().scan_lidar[in_yard().scan] == 1)
    result = align_patches([only_rear], [TRAJECTORY], guesses, sigmas)
    assert result.converged
    assert result.matches["front"] == 0
    off = errors(result)
    np.testing.assert_allclose(off[0], errors(guesses)[0], atol=1e-9)
    assert np.abs(off[1, :3]).max() < 2e-3
    assert np.abs(off[1, 3:5]).max() < 0.015


def test_two_drives_in_two_maps_are_aligned_together() -> None:
    guesses, sigmas = off_by(3.0, 0.1, 9)
    whole = in_yard()
    early = whole.stamps_ns[whole.scan] < 30_000_000_000
    T = gtsam.Pose3(gtsam.Rot3.Yaw(1.0), np.array([50.0, 0.0, 0.0]))
    R, t = stack(TRAJECTORY.trajectory.T_map_vehicle)
    moved = unstack(T.rotation().matrix() @ R, t @ T.rotation().matrix().T + T.translation())
    other = GivenTrajectory(Trajectory(TRAJECTORY.trajectory.stamps_ns, moved))
    result = align_patches(
        [whole.part(early), whole.part(~early)], [TRAJECTORY, other], guesses, sigmas
    )
    assert result.converged
    assert np.abs(errors(result)[:, :3]).max() < 3e-3


def test_level_patches_are_those_of_the_ground() -> None:
    patches = in_yard()
    R, _ = stack([TRUTH[name] for name in patches.lidars])
    up = np.einsum("ni,ni->n", R[patches.scan_lidar[patches.scan], 2], patches.normal_lidar)
    np.testing.assert_array_equal(level(patches, TRAJECTORY, TRUTH), up > 0.9)


def test_a_term_of_level_ground_is_linearised_at_the_yaw_that_a_target_tells() -> None:
    # Ground does not show the yaw. At guesses that are off in yaw, a tilt of the vehicle that is
    # found later turns the LiDARs by half of yaw times tilt: 0.15 * 5e-3 / 2, 0.4 mrad.
    yaw = np.array([0.0, 0.0, 0.15, 0.0, 0.0, 0.0])
    off = {"front": yaw, "rear": -yaw}
    config = Config(lidars={name: LidarConfig(topic=name) for name in TRUTH})
    for name, T in TRUTH.items():
        config = with_guess(config, name, retract_vehicle_axes(T, off[name]))
    placed = {name: retract_vehicle_axes(T, 0.02 * off[name]) for name, T in TRUTH.items()}
    flat = patches_of(world_of(ground()), np.arange(1.0, 59.0, 2.9))
    stamps = np.unique(flat.stamps_ns)
    true_poses = unstack(*TRAJECTORY.poses_at(stamps))
    # The IMU is mounted 0.3 degrees off, and may be.
    tilted = [T.retract(np.array([4e-3, -3e-3, 0.0, 0.0, 0.0, 0.0])) for T in true_poses]
    prior = PosePrior(
        stamps_ns=stamps,
        T_map_vehicle=tuple(tilted),
        parameters={},
        information=np.asarray(np.linalg.inv(tilted_cov(len(stamps))), np.float64),
        gradient=np.zeros(6 * len(stamps)),
        parameter_information=np.zeros((0, 0)),
        parameter_offset=np.zeros(0),
    )

    problem = problem_of(flat, prior, TRAJECTORY, config, 0.005, placed)
    found = solve_structure(problem, placed)

    assert found is not None
    term = term_of(found, np.arange(len(stamps)))
    assert np.abs(errors(term.T_vehicle_lidar)[:, 2]).max() < 5e-3
    pairs = zip(term.T_map_vehicle, true_poses, strict=True)
    lidars = ((T, TRUTH[name]) for name, T in term.T_vehicle_lidar.items())
    d = np.concatenate([gtsam.Pose3.Logmap(a.between(b)) for a, b in (*pairs, *lidars)])
    values, vectors = np.linalg.eigh(term.information)
    told = values > 1e-6 * values[-1]
    away = vectors[:, told].T @ d - (vectors[:, told].T @ term.gradient) / values[told]
    # The truth is as likely as it should be. At the guesses it is 73 for 51 directions.
    assert away**2 @ values[told] < 0.7 * told.sum()


def tilted_cov(m: int) -> Array:
    """Of m poses whose tilts have an error of 5 mrad in common: (6 m, 6 m)."""
    common = np.kron(np.ones((m, m)), np.diag([25e-6, 25e-6, 0.0, 0.0, 0.0, 0.0]))
    return np.asarray(common + np.diag(np.tile(np.repeat([1e-4, 1e-3], 3), m) ** 2))


def without_near_ground(patches: DrivePatches, lidar: int) -> DrivePatches:
    """The patches without the ground that a LiDAR sees under less than 75 degrees of incidence."""
    R, _ = stack([TRUTH[name] for name in patches.lidars])
    of = patches.scan_lidar[patches.scan]
    centres, up = patches.centres_lidar, R[of, 2]  # this vehicle drives on a plane
    cosine = np.abs(np.sum(centres * up, axis=1)) / np.linalg.norm(centres, axis=1)
    near = (of == lidar) & (np.abs(np.sum(patches.normal_lidar * up, axis=1)) > 0.9)
    return patches.part(~(near & (cosine > np.cos(np.radians(75.0)))))


def test_strips_stand_for_the_ground_only_of_lidars_that_see_it_at_no_grazing_angle() -> None:
    patches = in_yard()
    np.testing.assert_array_equal(lidars_above_ground(patches, TRAJECTORY, TRUTH), [True, True])
    far = without_near_ground(patches, 1)
    np.testing.assert_array_equal(lidars_above_ground(far, TRAJECTORY, TRUTH), [True, False])
    nothing = patches.part(np.zeros(len(patches.scan), dtype=bool))
    np.testing.assert_array_equal(lidars_above_ground(nothing, TRAJECTORY, TRUTH), [True, True])


def test_where_planes_stand_strips_do_only_for_a_lidar_that_sees_several_pieces() -> None:
    """Of three in a scan the middles have a plane; of fewer only the tilts are known."""
    patches = in_yard()
    of, scans = patches.scan_lidar[patches.scan], int(np.sum(patches.scan_lidar == 1))
    own = np.flatnonzero(level(patches, TRAJECTORY, TRUTH) & (of == 1))
    first, second = patches.lidars
    for each, standing in ((4, True), (2, False)):
        kept = np.ones(len(of), dtype=bool)
        kept[own] = False
        kept[own[np.linspace(0, len(own) - 1, each * scans).astype(int)]] = True
        few = patches.part(kept)
        found = lidars_above_ground(few, TRAJECTORY, TRUTH, (second,))
        np.testing.assert_array_equal(found, [True, standing])
        # Without planes the pieces are all that is known.
        found = lidars_above_ground(few, TRAJECTORY, TRUTH, (first,))
        np.testing.assert_array_equal(found, [True, True])


def test_level_patches_at_the_limit_of_incidence_are_left_to_the_ground_planes() -> None:
    patches, config = in_yard(), Config(lidars={n: LidarConfig(topic=n) for n in SPINNERS})
    assert usable(patches, TRAJECTORY, TRUTH, config) is patches
    far = without_near_ground(patches, 1)
    used = usable(far, TRAJECTORY, TRUTH, config)
    is_level, lidar = level(used, TRAJECTORY, TRUTH), used.scan_lidar[used.scan]
    walls = ~level(far, TRAJECTORY, TRUTH)
    assert not is_level[lidar == 1].any()
    assert (lidar[~is_level] == 1).sum() == (far.scan_lidar[far.scan[walls]] == 1).sum() > 0
    of_front = far.scan_lidar[far.scan] == 0
    assert (lidar == 0).sum() == of_front.sum()


def test_jacobians_are_those_of_numerical_derivatives() -> None:
    guesses, _ = off_by(3.0, 0.1, 10)
    names = list(guesses)
    cloud = gathered([in_yard()], [TRAJECTORY], names, np.random.default_rng(0))
    matcher = Pairs(cloud, np.random.default_rng(0))
    poses = [guesses[name] for name in names]
    matches = matcher.matched(poses, np.array([1.5, 0.3]))
    by_i, by_j = _jacobians(cloud, matches)
    step = 1e-6

    def residuals(moved: Sequence[gtsam.Pose3]) -> Array:
        R, t = stack(moved)
        a, b = cloud.lidar[matches.i], cloud.lidar[matches.j]

        def in_map(k: IntArray, x: Array, lidar: IntArray, place: bool) -> Array:
            x = np.einsum("nij,nj->ni", R[lidar], x[k]) + place * t[lidar]
            return np.asarray(np.einsum("nij,nj->ni", cloud.R[k], x) + place * cloud.t[k])

        def back(x: Array) -> Array:
            return np.asarray(np.einsum("nji,nkj,nk->ni", R[b], cloud.R[matches.j], x))

        n = in_map(matches.j, cloud.normal, b, False)
        apart = in_map(matches.i, cloud.centre, a, True) - in_map(matches.j, cloud.centre, b, True)
        turned = back(in_map(matches.i, cloud.normal, a, False)) - cloud.normal[matches.j]
        return np.column_stack([np.einsum("ni,ni->n", n, apart), turned])

    np.testing.assert_allclose(residuals(poses)[:, 0], matches.residual, atol=1e-9)
    np.testing.assert_allclose(residuals(poses)[:, 1:], matches.turned, atol=1e-9)
    for lidar in (0, 1):
        expected = by_i * (cloud.lidar[matches.i] == lidar)[:, None, None]
        expected = expected + by_j * (cloud.lidar[matches.j] == lidar)[:, None, None]
        for axis in range(6):
            d = step * np.eye(6)[axis]
            plus, minus = (
                [T.retract(s * d) if k == lidar else T for k, T in enumerate(poses)]
                for s in (1.0, -1.0)
            )
            numerical = (residuals(plus) - residuals(minus)) / (2.0 * step)
            np.testing.assert_allclose(expected[:, :, axis], numerical, atol=1e-6)
