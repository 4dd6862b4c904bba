"""Noise levels of structure, from patches whose noise is known."""

from __future__ import annotations

import numpy as np
import pytest

from caliv_graph.structure.noise import range_sigmas
from caliv_graph.structure.patches import DrivePatches

POINTS = 20


def patches_of(range_m: float, beam_rad: float, count: int = 3000) -> DrivePatches:
    """Half on ground 3 to 9 m away, half on walls at 20 to 40 m, none seen straight on."""
    rng = np.random.default_rng(4)
    near = np.arange(count) < count // 2
    distance = np.where(near, rng.uniform(3.0, 9.0, count), rng.uniform(20.0, 40.0, count))
    cos = np.where(near, 1.5 / distance, rng.uniform(0.35, 0.65, count))
    variance = (range_m * cos) ** 2 + (beam_rad * distance) ** 2 * (1.0 - cos**2)
    moments = np.zeros((count, 4, 4))
    moments[:, 0, 3] = moments[:, 3, 0] = POINTS * distance
    moments[:, 3, 3] = POINTS
    return DrivePatches(
        drive=0,
        lidars=("lidar",),
        stamps_ns=np.zeros(1, np.int64),
        scan_lidar=np.zeros(1, np.int64),
        scan=np.zeros(count, np.int64),
        time_s=np.zeros(count),
        moments=moments,
        normal_lidar=np.column_stack([-cos, np.sqrt(1.0 - cos**2), np.zeros(count)]),
        scatter_m=np.sqrt(variance * rng.chisquare(POINTS - 3, count) / (POINTS - 3)),
    )


@pytest.mark.parametrize("beam_rad", [0.0, 1e-4, 2e-4])
@pytest.mark.parametrize("range_m", [0.005, 0.01, 0.025])
def test_noise_along_beams_is_found_whatever_that_of_their_directions(
    range_m: float, beam_rad: float
) -> None:
    """With an assumed noise of 0.3 mrad 10 mm came out as 1 mm where beams have none."""
    found = range_sigmas(patches_of(range_m, beam_rad), 0.1)
    assert found == pytest.approx([range_m], rel=0.05)


def test_what_is_stated_counts_where_there_are_few_patches() -> None:
    assert range_sigmas(patches_of(0.01, 0.0, 200), 0.03).tolist() == [0.03]
