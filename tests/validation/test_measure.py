from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.geometry.se3 import retract_vehicle_axes, stack
from caliv_graph.products import Array
from caliv_graph.trajectory.select import smooth_trajectories
from caliv_graph.validation import measure
from caliv_graph.validation.clouds import Clouds, Extrinsics, Placed, read_clouds
from caliv_graph.validation.measure import (
    Errors,
    SurfaceMeter,
    cloud_distances,
    offset_covariance,
    thing_distance,
)
from caliv_graph.validation.refine import (
    extrinsic_jacobian,
    pose_jacobian,
)
from caliv_graph.validation.surfaces import Structure, Wall, find_structure
from tests.samples import pose
from tests.validation.scenes import MOUNTINGS, make_config, make_recording

STEP = 1e-6


@pytest.fixture(scope="module")
def clouds() -> Clouds:
    recording = make_recording()
    (trajectory,) = smooth_trajectories([recording], make_config())
    truth = Extrinsics({n: pose(*m) for n, m in MOUNTINGS.items()}, {})
    chosen = {n: np.array(recording.scan_stamps_ns(n)[::4]) for n in MOUNTINGS}
    return read_clouds(recording, trajectory, chosen, {"after": truth}, (), False, SilentProgress())


@pytest.fixture(scope="module")
def structure(clouds: Clouds) -> Structure:
    placed = clouds.placed["after"]
    points, beams = clouds.points_map(placed), clouds.beams_map(placed)
    return find_structure(points, beams, clouds.scan, 0.06, with_ground=False)


def poses_of(clouds: Clouds) -> list[gtsam.Pose3]:
    return list(clouds.placed["after"].extrinsics.T_vehicle_lidar.values())


def moved(placed: Placed, errors: Array) -> Placed:
    """The scans' poses with errors (S, 6), right perturbations."""
    R, t = [], []
    for Ri, ti, e in zip(placed.R_map_vehicle, placed.t_map_vehicle, errors, strict=True):
        T = gtsam.Pose3(gtsam.Rot3(Ri), ti).retract(e)
        R.append(T.rotation().matrix())
        t.append(T.translation())
    return replace(placed, R_map_vehicle=np.array(R), t_map_vehicle=np.array(t))


def remounted(poses: Sequence[gtsam.Pose3], errors: Array) -> list[gtsam.Pose3]:
    return [retract_vehicle_axes(T, e) for T, e in zip(poses, errors.reshape(-1, 6), strict=True)]


def test_points_move_with_mountings_and_poses_as_the_jacobians_say(clouds: Clouds) -> None:
    placed, poses = clouds.placed["after"], poses_of(clouds)
    members = np.arange(0, len(clouds.lidar), 97)
    rng = np.random.default_rng(2)
    normal = rng.normal(size=(len(members), 3))
    there = clouds.points_map(placed)[members]
    by_extrinsic = extrinsic_jacobian(clouds, placed, poses, members, normal)
    vehicle = clouds.points_vehicle(placed)[members]
    by_pose = pose_jacobian(clouds, placed, vehicle, members, normal)

    for axis in range(6):
        d = STEP * np.eye(6)[axis]
        shifted = clouds.points_map(placed, remounted(poses, np.concatenate([d, d])))[members]
        expected = np.einsum("ni,ni->n", shifted - there, normal) / STEP
        assert by_extrinsic[:, axis] == pytest.approx(expected, abs=1e-4)
        other = moved(placed, np.tile(d, (len(placed.taken_ns), 1)))
        expected = np.einsum("ni,ni->n", clouds.points_map(other)[members] - there, normal) / STEP
        assert by_pose[:, axis] == pytest.approx(expected, abs=1e-4)


def test_what_is_expected_is_what_errors_of_the_known_size_give(
    clouds: Clouds, structure: Structure, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Shapes are exact here, and ranges are drawn once.
    monkeypatch.setattr(measure, "WALL_TRUE_M", 1e-6)
    monkeypatch.setattr(measure, "POLE_TRUE_M", 1e-6)
    placed, poses = clouds.placed["after"], poses_of(clouds)
    rng = np.random.default_rng(3)
    scans = len(placed.taken_ns)
    root_m = rng.normal(size=(12, 12)) * np.tile([2e-4] * 3 + [2e-3] * 3, 2)[:, None]
    # Partly white, partly the same for all scans: such errors a surface follows.
    white = np.tile([1e-4] * 3 + [1e-3] * 3, scans)
    common = np.kron(np.ones((scans, 1)), np.diag([3e-4] * 3 + [4e-3] * 3))
    cov_poses = np.diag(white**2) + common @ common.T
    errors = Errors(root_m @ root_m.T, cov_poses, 1e-6)
    meters = [SurfaceMeter(clouds, s) for s in structure.surfaces]
    expected = [meter.expect(placed, errors) for meter in meters]
    pair = ("front", "rear")
    cov = offset_covariance([(e, pair) for e in expected], errors)
    zero = [meter.measure(placed)[1][pair].offset_m for meter in meters]

    draws, squares, alone = [], [], []
    for _ in range(150):
        pushed = moved(
            placed,
            (white * rng.normal(size=6 * scans) + common @ rng.normal(size=6)).reshape(-1, 6),
        )
        mounted = remounted(poses, root_m @ rng.normal(size=12))
        found = [meter.measure(pushed, mounted) for meter in meters]
        draws.append(
            np.concatenate([a[pair].offset_m - z for (_, a), z in zip(found, zero, strict=True)])
        )
        squares.append([a[pair].distance_m ** 2 for _, a in found])
        alone.append([t.alone["front"] ** 2 for t, _ in found])
    chi2 = [d @ np.linalg.solve(cov, d) for d in draws]
    assert len(draws[0]) == 4
    # Four degrees of freedom, 150 draws: 0.23 is one sigma of the mean.
    assert np.mean(chi2) == pytest.approx(4.0, abs=0.8)
    rms = np.sqrt(np.mean(squares, axis=0))
    assert rms == pytest.approx([e.distance_m[pair] for e in expected], rel=0.2)
    # Ranges scatter by 10 mm on top, the same in all draws.
    noise = np.array([meter.measure(placed)[0].alone["front"] ** 2 for meter in meters])
    thick = np.sqrt(np.mean(alone, axis=0) - noise)
    assert thick[:2] == pytest.approx([e.alone["front"] for e in expected[:2]], rel=0.3)


def test_relief_of_a_wall_is_found_and_widens_what_is_expected(
    clouds: Clouds, structure: Structure
) -> None:
    """Fronts of houses: reveals and pillars of 20 mm, a metre wide."""
    placed = clouds.placed["after"]
    errors = Errors(np.zeros((12, 12)), np.zeros((6 * len(placed.taken_ns),) * 2), 0.01)
    pair = ("front", "rear")
    rng = np.random.default_rng(8)
    for surface in structure.surfaces:
        meter = SurfaceMeter(clouds, surface)
        flat_m = meter.relief_m(placed, None, 0.01)
        assert flat_m < 0.003
        if not isinstance(surface, Wall):
            assert flat_m == 0.0
            continue
        members = surface.members
        place = (clouds.points_map(placed)[members] - surface.centre) @ surface.axes.T
        cell = np.unique(np.floor(place), axis=0, return_inverse=True)[1].ravel()
        bulge = 0.02 * rng.standard_normal(cell.max() + 1)[cell]
        points = placed.points_lidar.copy()
        R_vehicle, _ = stack(poses_of(clouds))
        R = placed.R_map_vehicle[clouds.scan[members]] @ R_vehicle[clouds.lidar[members]]
        points[members] += np.einsum("nji,nj->ni", R, bulge[:, None] * surface.normal)
        rough = replace(placed, points_lidar=points)

        relief_m = meter.relief_m(rough, None, 0.01)

        assert relief_m == pytest.approx(0.02, rel=0.35)
        usual, wide = meter.expect(rough, errors), meter.expect(rough, errors, relief_m)
        assert wide.distance_m[pair] > 1.5 * usual.distance_m[pair]
        thickness, apart = meter.measure(rough)
        assert apart[pair].distance_m < 2.5 * wide.distance_m[pair]
        assert thickness.alone["front"] == pytest.approx(wide.alone["front"], rel=0.35)


def test_cloud_distance_of_two_plates() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.uniform(0.0, 4.0, (2, 2000, 2))
    points = np.vstack(
        [np.column_stack([a, np.full(2000, 0.03)]), np.column_stack([b, np.zeros(2000)])]
    )
    far = np.column_stack([rng.uniform(0.0, 4.0, (1000, 2)), np.full(1000, 9.0)])
    lidar = np.repeat([0, 1, 0], [2000, 2000, 1000])

    found = cloud_distances(np.vstack([points, far]), lidar, ("a", "b"))

    # Beside each other, not point to point: those are 50 mm apart.
    assert found["a", "b"][0] == pytest.approx(0.03, abs=1e-6)
    assert found["a", "b"][1] == pytest.approx(2.0 / 3.0, abs=0.01)
    assert found["b", "a"] == pytest.approx((0.03, 1.0), abs=1e-6)


def test_distance_of_objects_is_that_of_nearest_points() -> None:
    p = np.column_stack([np.arange(20.0), np.zeros((20, 2))])
    lidar = np.repeat([0, 1], 20)

    assert thing_distance(
        np.vstack([p, p + np.array([0.0, 0.0, 0.25])]), lidar, 0, 1
    ) == pytest.approx(0.25)
    assert thing_distance(np.vstack([p, p]), np.repeat([0, 1], [30, 10]), 0, 1) is None
