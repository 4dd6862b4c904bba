"""Two drives, one vehicle: solved together, merged, and one after the other with `--prior`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.noise import NoiseConfig
from caliv_graph.errors import ConfigError
from caliv_graph.fusion.merge import merge
from caliv_graph.geometry.se3 import retract_vehicle_axes, vehicle_axes_difference
from caliv_graph.pipeline import calibrate
from caliv_graph.products import Array, Calibration
from caliv_graph.results.run import CalibrationRun
from caliv_graph.uncertainty.pairs import sigmas_s2v
from tests.drives_with_chair import (
    ARC,
    ARC_LEFT,
    CHAIR_XYZ_M,
    QUICK,
    ChairDrive,
    paper_scenario,
    simulated,
)

NAMES = ("front", "rear")


@dataclass(frozen=True)
class TwoArcs:
    right: ChairDrive
    left: ChairDrive
    of_right: Calibration
    of_left: Calibration
    of_both: Calibration


def calibrated(*drives: ChairDrive, prior: Calibration | None = None) -> CalibrationRun:
    recordings = [drive.recording for drive in drives]
    return calibrate(recordings, drives[0].config, SilentProgress(), prior)


@pytest.fixture(scope="module")
def arcs(tmp_path_factory: pytest.TempPathFactory) -> TwoArcs:
    """A right and a left arc, seen at 1.7 Hz, given poses with white errors of 5 mm and 1 mrad."""
    drives = []
    for model, side in ((ARC, 1.0), (ARC_LEFT, -1.0)):
        scenario = paper_scenario(
            model,
            rate_hz=10 / 6,
            position_sigma_m=5e-3,
            rotation_sigma_rad=1e-3,
            chair_xy_m=(CHAIR_XYZ_M[0], side * CHAIR_XYZ_M[1]),
        )
        folder = tmp_path_factory.mktemp("arc") / "drive"
        drives.append(simulated(scenario, 31 + int(side), folder))
    right, left = drives
    # One vehicle has one initial guess; and each drive its own target, found at either side.
    both_sides = (*(right.config.target or ()), *(left.config.target or ()))
    # Errors of the poses are stated: what a drive would find out about them differs from drive to
    # drive, and with it the weights that the drives have.
    noise = NoiseConfig(
        pose_position_m=5e-3,
        pose_rotation_deg=math.degrees(1e-3),
        pose_drift_position_m=1e-3,
        pose_drift_rotation_deg=math.degrees(1e-4),
    )
    right = right.asked(target=both_sides, noise=noise, registration=QUICK)
    left = replace(left, config=right.config)
    return TwoArcs(
        right,
        left,
        calibrated(right).calibration,
        calibrated(left).calibration,
        calibrated(right, left).calibration,
    )


def apart(one: Calibration, other: Calibration) -> Array:
    """(12,) of one against the other in sigmas of the other, vehicle axes."""
    return np.concatenate(
        [
            vehicle_axes_difference(
                one.lidars[name].T_vehicle_lidar, other.lidars[name].T_vehicle_lidar
            )
            / sigmas_s2v(other, name)
            for name in NAMES
        ]
    )


def sigmas(calibration: Calibration) -> Array:
    return np.concatenate([sigmas_s2v(calibration, name) for name in NAMES])


def test_merging_is_solving_together(arcs: TwoArcs) -> None:
    """Up to what shape and noise levels of one drive tell about the other's."""
    merged = merge({"right": arcs.of_right, "left": arcs.of_left})

    assert merged.calibration.status == "partial"  # the height: there is no ground in it
    for calibration in (merged.calibration, arcs.of_both):
        for name in NAMES:
            assert calibration.lidars[name].determined["yaw"]
            assert calibration.lidars[name].determined["x"]
    assert not arcs.of_right.lidars["front"].determined["yaw"]
    assert np.abs(apart(merged.calibration, arcs.of_both)).max() < 1.0
    ratio = sigmas(merged.calibration) / sigmas(arcs.of_both)
    assert ratio.min() > 0.6
    assert ratio.max() < 1.6
    assert not merged.agreement["left"].moved


def test_a_prior_is_merging(arcs: TwoArcs) -> None:
    """The second drive starts from the first one's extrinsics, and ends where merging does."""
    result = calibrated(arcs.left, prior=arcs.of_right)
    merged = merge({"left": arcs.of_left, "right": arcs.of_right}).calibration

    assert result.calibration.status == merged.status
    assert np.abs(apart(result.calibration, merged)).max() < 0.7
    assert sigmas(result.calibration) == pytest.approx(sigmas(merged), rel=0.15)
    front = result.calibration.lidars["front"].guess
    assert front is not None
    # What the guess is, is not what the solve began with.
    configured = arcs.of_left.lidars["front"].guess
    assert configured is not None
    assert front.T_vehicle_lidar.equals(configured.T_vehicle_lidar, 1e-12)
    (earlier,) = result.calibration.earlier
    assert list(earlier.sources) == arcs.of_right.provenance["drive_sha256"]


def test_a_drive_is_no_prior_of_itself(arcs: TwoArcs) -> None:
    with pytest.raises(ConfigError, match="--prior: is a result of the drive that is to be"):
        calibrated(arcs.right, prior=arcs.of_right)


def test_a_mount_that_was_knocked_since_is_found(arcs: TwoArcs) -> None:
    """Half a degree of the rear LiDAR's pitch between the two drives."""
    lidars = dict(arcs.of_right.lidars)
    knocked = retract_vehicle_axes(
        lidars["rear"].T_vehicle_lidar, np.radians([0.0, 2.0, 0.0, 0.0, 0.0, 0.0])
    )
    lidars["rear"] = replace(lidars["rear"], T_vehicle_lidar=knocked)
    before = replace(arcs.of_right, lidars=lidars)

    result = calibrated(arcs.left, prior=before)

    assert result.calibration.status == "inconsistent"
    assert any("LiDAR 'rear' has moved" in warning for warning in result.calibration.warnings)


def test_a_trusted_mounting_is_not_data(arcs: TwoArcs) -> None:
    """What `fixed: true` puts in is taken out again: the data say what they say without it."""
    lidars = dict(arcs.right.config.lidars)
    true = arcs.right.truth["rear"]
    x, y, z = true.translation()
    trusted = lidars["rear"].model_copy(
        update={
            "fixed": True,
            "initial": lidars["rear"].given.model_copy(
                update={"xyz": (x, y, z), "rpy_deg": (0.0, 10.0, 180.0)}
            ),
        }
    )
    trusting = arcs.right.asked(lidars={**lidars, "rear": trusted})

    found = calibrated(trusting).calibration

    free = np.diag(arcs.of_right.information_data)
    assert np.diag(found.information_data) == pytest.approx(free, rel=0.3)
    assert found.lidars["rear"].guess is not None
    assert found.lidars["rear"].guess.fixed
