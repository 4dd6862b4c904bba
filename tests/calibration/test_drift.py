"""A heading that drifts is linearised where walls put the vehicle, or refused without any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration import estimate, structure_evidence
from caliv_graph.calibration.drift import about_walls
from caliv_graph.calibration.sensor_noise import usual_noise, with_noise
from caliv_graph.calibration.structure_evidence import NO_STRUCTURE, StructureEvidence
from caliv_graph.calibration.vehicle_parameters import motion_term
from caliv_graph.common.progress import SilentProgress
from caliv_graph.errors import SolveError, TrajectoryError
from caliv_graph.products import Array
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.trajectory.about_poses import about_poses
from caliv_graph.trajectory.correlated import CorrelatedError
from caliv_graph.trajectory.imu import log_so3
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from tests.trajectory.motions import record, seconds
from tests.trajectory.test_about_poses import (
    BIAS_RAD_S,
    COURSE,
    SENSORS,
    WANTED,
    smoothed_by_speeds,
    speeds_alone,
)

FOUND = {"front": gtsam.Pose3(gtsam.Rot3(), np.array([1.0, 0.0, 2.0]))}
START = {"front": gtsam.Pose3()}


@dataclass
class Walls:
    """`SlowErrors` that know where the vehicle is; and how often they were asked.

    `sigma_rad` is what they know of the heading, `least` the number of poses that they need.
    """

    sigma_rad: float = 1e-4
    least: int = 0
    asked: list[Sequence[VehicleTrajectory]] = field(default_factory=list)

    def __call__(self, *given: Any) -> tuple[tuple[tuple[Array, Array] | None, ...], Any]:
        _, priors, _, trajectories, *_ = given
        self.asked.append(trajectories)
        out: list[tuple[Array, Array] | None] = []
        for prior in priors:
            if len(prior.stamps_ns) < self.least:
                out.append(None)
                continue
            true = COURSE.at(seconds(prior.stamps_ns))
            T = np.tile(np.eye(4), (len(prior.stamps_ns), 1, 1))
            T[:, :3, :3], T[:, :3, 3] = true.R_map_vehicle, true.p_map_vehicle
            out.append((T, np.full(len(T), self.sigma_rad)))
        return tuple(out), FOUND


def patches_of(*drives: int) -> tuple[DrivePatches, ...]:
    n = len(WANTED) - 2
    ahead = np.eye(4)
    ahead[0, 3] = ahead[3, 0] = 5.0
    return tuple(
        DrivePatches(
            drive=drive,
            lidars=("front",),
            stamps_ns=WANTED[1:-1],
            scan_lidar=np.zeros(n, np.int64),
            scan=np.arange(n),
            time_s=np.zeros(n),
            moments=np.tile(ahead, (n, 1, 1)),
            normal_lidar=np.tile([1.0, 0.0, 0.0], (n, 1)),
            scatter_m=np.full(n, 0.01),
        )
        for drive in drives
    )


@cache
def with_fixes() -> SmoothedTrajectory:
    """The same drive, its fixes and orientations too."""
    _, config = speeds_alone()
    return smooth_trajectory(record(COURSE, SENSORS, 3), config, WANTED)


@pytest.fixture
def drifting() -> SmoothedTrajectory:
    return smoothed_by_speeds()


def test_walls_tell_the_bias_of_a_drive_whose_heading_drifts(drifting: SmoothedTrajectory) -> None:
    _, config = speeds_alone()
    fixed = with_fixes()
    walls = Walls()
    evidence = StructureEvidence(patches_of(0, 1), errors=walls)

    (same, without), told = about_walls([fixed, drifting], evidence, START, {}, config)

    assert same is fixed
    assert isinstance(without, SmoothedTrajectory)
    assert np.median(without.states.gyro_bias[:, 2]) == pytest.approx(BIAS_RAD_S, abs=5e-4)
    # The second time nothing turns any more.
    assert [len(trajectories) for trajectories in walls.asked] == [1, 1]
    assert walls.asked[0][0] is drifting
    assert told.T_vehicle_lidar is FOUND
    assert not told.of_drives


def test_where_some_scans_tell_nothing_all_are_asked(
    drifting: SmoothedTrajectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thin chair and few walls: without, S2V yaw was 20 mrad off at 1.6, with exit code 0."""
    _, config = speeds_alone()
    (patches,) = patches_of(0)
    few = replace(patches, stamps_ns=patches.stamps_ns[:5]).part(patches.scan < 5)
    monkeypatch.setattr(structure_evidence, "scans_for_errors", lambda *_: few)
    walls = Walls(least=20)

    (found,), _ = about_walls(
        [drifting], StructureEvidence((patches,), errors=walls), START, {}, config
    )

    assert isinstance(found, SmoothedTrajectory)
    assert np.median(found.states.gyro_bias[:, 2]) == pytest.approx(BIAS_RAD_S, abs=5e-4)
    assert len(walls.asked) == 4  # some, all; and again


def test_a_known_heading_asks_no_walls(drifting: SmoothedTrajectory) -> None:
    _, config = speeds_alone()
    known = replace(drifting, pose_sigmas=np.full(6, 0.015))
    walls = Walls()

    (same,), told = about_walls(
        [known], StructureEvidence(patches_of(0), errors=walls), START, {}, config
    )

    assert same is known
    assert not walls.asked
    assert told.T_vehicle_lidar is None


def test_a_heading_that_nothing_tells_is_refused(drifting: SmoothedTrajectory) -> None:
    _, config = speeds_alone()
    wide = replace(drifting, pose_sigmas=np.full(6, 0.3))

    with pytest.raises(TrajectoryError, match=r"heading: its sigma is 17\.2 degrees, and the wal"):
        about_walls([wide], NO_STRUCTURE, START, {}, config)

    # Of a second drive, too, where only the first has walls.
    evidence = StructureEvidence(patches_of(0), errors=Walls())
    with pytest.raises(TrajectoryError, match="walls in view of the LiDARs tell it no better"):
        about_walls([drifting, wide], evidence, START, {}, config)

    # Ground has patches, which tell no heading.
    ground = StructureEvidence(patches_of(0), errors=Walls(sigma_rad=0.25))
    with pytest.raises(TrajectoryError, match="drive where walls are in view all along"):
        about_walls([wide], ground, START, {}, config)
    (same,), told = about_walls([drifting], ground, START, {}, config)
    assert same is drifting
    assert told.T_vehicle_lidar is FOUND

    (same,), _ = about_walls([drifting], NO_STRUCTURE, START, {}, config)
    assert same is drifting


def test_other_drives_noise_leaves_it_where_walls_put_it(drifting: SmoothedTrajectory) -> None:
    """Fixes of another drive err over time: only that drive is smoothed again."""
    _, config = speeds_alone()
    fixed = with_fixes()
    true = COURSE.at(seconds(WANTED))
    there = about_poses(drifting, WANTED, true.R_map_vehicle, true.p_map_vehicle)
    error = CorrelatedError("gnss", (0.02, 0.02, 0.02), 10.0)
    noise = replace(usual_noise(config.noise), correlated=(error,))

    again, same = with_noise(noise, [fixed, there])

    assert isinstance(again, SmoothedTrajectory)
    assert again.correlated == (error,)
    assert same is there


def test_the_graph_has_the_pull_back_of_a_drive_without_uncertain_parameters() -> None:
    """A Gaussian about the trajectory would take for measured where walls put the vehicle."""
    sensors = replace(SENSORS, T_vehicle_imu=gtsam.Pose3(), lever_arm=(0.0, 0.0, 0.0))
    motion, config = speeds_alone(sensors)
    plain = smooth_trajectory(motion, config, WANTED)
    true = COURSE.at(seconds(WANTED))
    stamps = WANTED[::5].tolist()
    assert motion_term(plain, stamps, 0.01) is None

    there = about_poses(plain, WANTED, true.R_map_vehicle, true.p_map_vehicle)

    term = motion_term(there, stamps, 0.01)
    assert term is not None
    assert not term.values
    step = np.linalg.solve(term.information, term.gradient).reshape(-1, 6)
    R, _ = plain.poses_at(stamps)
    turned = log_so3(np.swapaxes(true.R_map_vehicle[::5], 1, 2) @ R)
    assert np.abs(turned[:, 2]).max() > 0.03
    assert np.abs(step[:, 2] - turned[:, 2]).max() < 0.1 * np.abs(turned[:, 2]).max()


def test_without_a_target_structure_is_solved_where_walls_put_the_vehicle(
    drifting: SmoothedTrajectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, config = speeds_alone()
    solved: list[tuple[Any, ...]] = []

    def solve(*given: Any) -> None:
        solved.append(given)
        raise SolveError("far enough")

    monkeypatch.setattr(estimate, "solve_structure_and_ground", solve)
    evidence = StructureEvidence(patches_of(0), errors=Walls())

    with pytest.raises(SolveError, match="far enough"):
        estimate.estimate_with_noise([], [drifting], config, SilentProgress(), (), evidence)

    (((trajectory,), *_, told, _),) = solved
    assert trajectory.elsewhere
    assert told.T_vehicle_lidar is FOUND
