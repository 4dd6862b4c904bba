"""Which scans are from one place."""

import numpy as np

from caliv_graph.structure.views import views_of
from tests.structure.yards import TRUE, draw_patches, draw_prior, poses, yard


def test_scans_of_a_vehicle_that_stands_are_one_view_per_lidar() -> None:
    """It stands for three scans, drives for two, and turns by 2 mrad where it is."""
    x = np.array([0.0, 0.001, 0.002, 1.0, 2.0, 2.0])
    yaw = np.array([0.0, 0.0, 1e-4, 0.0, 0.0, 2e-3])
    path = poses(np.column_stack([x, np.zeros((6, 2))]), yaw)
    rng = np.random.default_rng(0)
    prior = draw_prior(path, rng, rotation_rad=1e-7, position_m=1e-6, heave_m=1e-6)
    patches = draw_patches(yard(2), path, rng, patch_m=2.0)
    views = views_of(patches, np.tile(np.arange(6), len(TRUE)), prior)
    assert views.of_scan.tolist() == [0, 0, 0, 1, 2, 3, 4, 4, 4, 5, 6, 7]
    assert views.count.tolist() == [3, 3, 3, 1, 1, 1] * 2
