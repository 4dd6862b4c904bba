"""Clouds that show less of a chair than the others: which they are, and where they are put."""

from __future__ import annotations

from functools import cache

import gtsam
import numpy as np
import pytest

from caliv_graph.products import Array, Side
from caliv_graph.registration import register
from caliv_graph.registration.clouds import CloudStack, stack_clouds
from caliv_graph.registration.register import (
    JointRegistration,
    register_jointly,
)
from caliv_graph.registration.starts import Suspicion, _shifts, suspicious
from tests.registration.scenes import (
    Scene,
    centre_clouds,
    chair_scene,
    config_of,
    guesses,
    matrices,
    observe,
)

SIGMA_M = 0.003


@cache
def chair() -> Scene:
    return chair_scene(np.linspace(20.0, 110.0, 8).tolist(), [6.0, 8.0] * 4, SIGMA_M, 1)


def stacked(clouds: list[Array]) -> CloudStack:
    return stack_clouds(observe(clouds), 4000, SIGMA_M, normals=False)


def clouds_without(part: str, which: tuple[int, ...]) -> list[Array]:
    """The chair's clouds; some of them without its upper or lower part."""
    out = []
    for j, cloud in enumerate(chair().observation.clouds):
        points = cloud.points_lidar
        z = chair().T_target_lidar[j].transformFrom(points.T)[2]
        keep = {"top": z < 0.2, "bottom": z > -0.2}[part]
        out.append(points[keep] if j in which else points)
    return out


def test_whole_clouds_are_not_suspicious() -> None:
    clouds = stacked([c.points_lidar for c in chair().observation.clouds])
    assert not len(suspicious(clouds, *matrices(chair().T_target_lidar)).clouds)


@pytest.mark.parametrize("part", ["top", "bottom"])
def test_low_clouds_are_suspicious(part: str) -> None:
    clouds = stacked(clouds_without(part, (1, 6)))
    found = suspicious(clouds, *matrices(chair().T_target_lidar))
    assert found.clouds.tolist() == [1, 6]
    assert found.up_m == pytest.approx([0.4, 0.4], abs=0.1)


def test_a_majority_is_not_suspicious() -> None:
    # Too few are left to make a shape of.
    clouds = stacked(clouds_without("top", (0, 1, 2)))
    assert suspicious(clouds, *matrices(chair().T_target_lidar)).clouds.tolist() == [0, 1, 2]
    clouds = stacked(clouds_without("top", (0, 2, 3, 4, 6)))
    assert not len(suspicious(clouds, *matrices(chair().T_target_lidar)).clouds)


def test_where_no_cloud_is_suspicious_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, config = chair(), config_of(lidar_range_m=SIGMA_M)
    results = []
    for _ in range(2):
        state = JointRegistration(scene.observation, config, rough=True)
        results.append(register_jointly(state, guesses(scene.T_target_lidar, 1), 40))
        monkeypatch.setattr(register, "_from_other_starts", register._alternated)
    assert results[0].iterations == results[1].iterations
    for a, b in zip(results[0].T_target_lidar, results[1].T_target_lidar, strict=True):
        assert np.array_equal(a.matrix(), b.matrix())


def test_a_cloud_is_tried_over_what_it_lacks_itself() -> None:
    # 0.35 m of height: every 8.75 cm from end to end. 0.15 m of width, across the view: three.
    view = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.6, 0.8, 0.0]])
    found = Suspicion(
        np.array([2, 5, 7]), np.array([0.35, 0.0, 0.1]), np.array([0, 0.15, 0.1]), view
    )
    tried, shifts = _shifts(found)
    assert np.bincount(tried).tolist() == [5, 3, 9]
    first = shifts[tried == 0]
    assert sorted(first[:, 2]) == pytest.approx([-0.175, -0.0875, 0.0, 0.0875, 0.175])
    assert np.abs(first[:, :2]).max() == 0.0
    np.testing.assert_allclose(np.sort(shifts[tried == 1][:, 0]), [-0.075, 0.0, 0.075])
    # The first is where the cloud is: of two places that are as good it stays.
    assert [np.abs(shifts[tried == s][0]).max() for s in range(3)] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("part", ["top", "bottom", "left", "right"])
def test_cut_clouds_are_centred_by_the_sides_that_are_whole(part: Side) -> None:
    # Boards of 1 x 1.2 m that face each LiDAR at 10 m; of two of them 0.4 m are cut off.
    y, z = np.meshgrid(np.linspace(-0.5, 0.5, 41), np.linspace(-0.6, 0.6, 49))
    board = np.column_stack([np.full(y.size, 10.0), y.ravel(), z.ravel()])
    keep = {
        "top": board[:, 2] <= 0.2,
        "bottom": board[:, 2] >= -0.2,
        "left": board[:, 1] <= 0.1,
        "right": board[:, 1] >= -0.1,
    }[part]
    turns = [gtsam.Rot3.Yaw(0.8 * j) for j in range(5)]
    R, t = matrices([gtsam.Pose3(turn, np.array([3.0, 2.0, 1.0])) for turn in turns])
    clouds = stacked([board[keep] if j in (1, 4) else board for j in range(5)])

    cut = [frozenset({part}) if j in (1, 4) else frozenset[Side]() for j in range(5)]
    blind, informed = centre_clouds(clouds, R, t), centre_clouds(clouds, R, t, cut)

    expected = np.array([turn.rotate(np.array([-10.0, 0.0, 0.0])) for turn in turns])
    assert np.linalg.norm(blind - expected, axis=1)[[1, 4]] == pytest.approx(0.2, abs=0.03)
    np.testing.assert_allclose(informed, expected, atol=0.03)
