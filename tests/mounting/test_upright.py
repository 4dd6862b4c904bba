"""Which way is up, from flat patches of scans whose mounting is unknown."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caliv_graph.mounting.upright import Ground, ground_below
from caliv_graph.products import Array
from caliv_graph.structure.planar import ScanPatches

UP = np.array([0.0, 0.0, 1.0])


def patches(planes: list[tuple[Array, float]], R_lidar_level: Array) -> ScanPatches:
    """Patches on planes (normal towards the LiDAR, distance) in level axes about the LiDAR."""
    normals = np.array([n for n, _ in planes])
    centres = np.array([-d * n + [0.0, 0.0, 0.0] for n, d in planes])
    moments = np.zeros((len(planes), 4, 4))
    moments[:, :3, 3] = 20.0 * centres @ R_lidar_level.T
    moments[:, 3, 3] = 20.0
    count = len(planes)
    return ScanPatches(np.zeros(count), moments, normals @ R_lidar_level.T, np.full(count, 0.01))


def drive(R_lidar_level: Array, scans: int = 8) -> list[ScanPatches]:
    """Ground 1.8 m below, and a wall with more patches that the LiDAR passes while it turns."""
    out = []
    for i in range(scans):
        angle = 0.3 * i
        wall = np.array([np.cos(angle), np.sin(angle), 0.0])
        out.append(patches([(UP, 1.8)] * 5 + [(wall, 6.0 + i)] * 20, R_lidar_level))
    return out


@pytest.mark.parametrize("seed", range(4))
def test_the_ground_is_what_stays(seed: int) -> None:
    R = Rotation.random(random_state=seed).as_matrix()
    found = ground_below(drive(R))
    assert found is not None
    assert found.up_lidar == pytest.approx(R @ UP, abs=1e-9)
    assert found.height_m == pytest.approx(1.8)
    assert found.scans == 8
    assert found.R_level_lidar @ found.up_lidar == pytest.approx(UP, abs=1e-12)
    assert np.linalg.det(found.R_level_lidar) == pytest.approx(1.0)


@pytest.mark.parametrize("up", [UP, -UP, np.array([1e-9, 0.0, -1.0])])
def test_upright_and_upside_down(up: Array) -> None:
    R = Ground(up, 1.0, 5).R_level_lidar
    assert R @ up == pytest.approx(UP, abs=1e-6)
    assert pytest.approx(np.eye(3), abs=1e-9) == R @ R.T


def test_nothing_is_found_where_no_plane_stays() -> None:
    walls = [
        patches([(np.array([np.cos(0.3 * i), np.sin(0.3 * i), 0.0]), 5.0)] * 9, np.eye(3))
        for i in range(9)
    ]
    assert ground_below(walls) is None
    assert ground_below([]) is None
