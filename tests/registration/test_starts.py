"""Clouds that show less of a chair than the others: which they are, and where they are put."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from caliv_graph.products import Array, Side
from caliv_graph.registration.clouds import CloudStack, stack_clouds
from caliv_graph.registration.register import (
    JointRegistration,
    centre_clouds,
    register_jointly,
)
from caliv_graph.registration.starts import suspicious
from tests.registration.scenes import (
    Scene,
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
    return stack_clouds(observe(clouds), 400, SIGMA_M, normals=False)


def clouds_without(part: str, which: tuple[int, ...]) -> list[Array]:
    """The chair's clouds; some of them without its upper or lower part, or one side."""
    out = []
    for j, cloud in enumerate(chair().observation.clouds):
        points = cloud.points_lidar
        z = chair().T_target_lidar[j].transformFrom(points.T)[2]
        left = points[:, 1] > 0.5 * (points[:, 1].min() + points[:, 1].max())
        keep = {"top": z < 0.2, "bottom": z > -0.2, "left": ~left, "right": left}[part]
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
        monkeypatch.setattr(
            "caliv_graph.registration.register._from_other_starts", lambda _, run, __: run
        )
    for a, b in zip(results[0].T_target_lidar, results[1].T_target_lidar, strict=True):
        assert np.array_equal(a.matrix(), b.matrix())


@pytest.mark.parametrize("part", ["top", "bottom", "left", "right"])
def test_cut_clouds_are_centred_by_the_sides_that_are_whole(part: Side) -> None:
    R, t = matrices(chair().T_target_lidar)
    whole = centre_clouds(stacked(clouds_without("top", ())), R, t)
    some = (1, 6)
    clouds = stacked(clouds_without(part, some))
    blind = centre_clouds(clouds, R, t)
    cut = [frozenset({part}) if j in some else frozenset[Side]() for j in range(8)]
    informed = centre_clouds(clouds, R, t, cut)
    others = [j for j in range(8) if j not in some]
    np.testing.assert_array_equal(informed[others], blind[others])
    for j in some:
        # Of the direction in which it is cut: half of a chair is less deep, too.
        axis = [0.0, 0.0, 1.0] if part in ("top", "bottom") else [0.0, 1.0, 0.0]
        along = np.array(axis) if part in ("top", "bottom") else R[j] @ axis
        off = abs(float((blind[j] - whole[j]) @ along))
        assert off > 0.05
        # The width of a chair depends on the side that is seen.
        assert abs(float((informed[j] - whole[j]) @ along)) < 0.6 * off
