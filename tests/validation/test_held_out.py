"""Held-out structure of a drive whose heading drifts; and what `inspect` says of such a drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caliv_graph.pipeline import inspection
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.validation import held_out
from caliv_graph.validation.clouds import Extrinsics
from tests.calibration.test_drift import START, Walls, patches_of
from tests.trajectory.test_about_poses import smoothed_by_speeds, speeds_alone


@pytest.fixture
def drifting() -> SmoothedTrajectory:
    return smoothed_by_speeds()


def test_a_drifting_drive_is_validated_where_walls_put_it(
    drifting: SmoothedTrajectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """About its own estimate it contradicted a right calibration (S2S x by 10 mm, exit code 4)."""
    _, config = speeds_alone()
    monkeypatch.setattr(held_out, "slow_errors", Walls())

    found = held_out._about_walls(drifting, patches_of(0)[0], Extrinsics(START, {}), config)

    assert isinstance(found, SmoothedTrajectory)
    assert found.elsewhere


def test_a_wide_heading_is_said_to_hang_on_walls(drifting: SmoothedTrajectory) -> None:
    assert inspection._on_heading("drive", drifting) == ()
    (said,) = inspection._on_heading("drive", replace(drifting, pose_sigmas=np.full(6, 0.3)))
    assert "leave the heading to 17.2 degrees" in said
