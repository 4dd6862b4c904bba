"""From IMU, GNSS, velocity and bags' clouds to extrinsics, on a simulated drive with known truth.

The drive has everything that goes wrong at once: somebody walks past the chair, the GNSS jumps, one
LiDAR's stamps are 20 ms late, and every cloud is a sweep of 0.1 s.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from caliv_graph.calibration.check import check
from caliv_graph.calibration.problem import HEAVE_SIGMA_M, pose_problem
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config
from caliv_graph.pipeline import calibrate
from caliv_graph.products import Array, LidarScan, TargetObservation
from caliv_graph.readers.forwarding import ForwardingRecording
from caliv_graph.results.run import CalibrationRun
from caliv_graph.scenario.model import Scenario, load_scenario
from caliv_graph.simulation.recording import SimulatedRecording
from caliv_graph.simulation.writer import config_of
from caliv_graph.targets import extract_targets
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.uncertainty.evaluation import evaluate
from tests.drives_with_chair import without_structure
from tests.kept import KeptDrive

SCENARIOS = Path(__file__).resolve().parents[1] / "configs" / "scenarios"
MM, MRAD = 1e-3, 1e-3


@dataclass(frozen=True)
class Drive:
    """A simulated drive and the config that calibrates it quickly: few scans, few components."""

    recording: SimulatedRecording
    config: Config


def swept_and_noisy() -> Scenario:
    """`noisy` in two thirds of its time, swept as `distorted`, with half of clouds and fixes."""
    noisy = load_scenario(SCENARIOS / "noisy.yaml")
    distorted = load_scenario(SCENARIOS / "distorted.yaml")
    lidars = {}
    for name, lidar in noisy.lidars.items():
        sweep = distorted.lidars[name].sweep
        assert sweep is not None
        sweep = sweep.model_copy(update={"duration_s": 0.1})
        lidars[name] = lidar.model_copy(update={"sweep": sweep, "rate_hz": 20 / 3})
    assert noisy.crop is not None
    crop = noisy.crop.model_copy(update={"elsewhere_stride": 16})
    course = noisy.drive.model_copy(update={"speed_m_s": 3.0, "radius_m": 6.0})
    imu = noisy.imu.model_copy(update={"rate_hz": 50.0})
    gnss = noisy.gnss.model_copy(update={"rate_hz": 5.0})
    velocity = noisy.velocity.model_copy(update={"rate_hz": 5.0})
    changes: dict[str, object] = {"drive": course, "lidars": lidars, "crop": crop}
    changes |= {"imu": imu, "gnss": gnss, "velocity": velocity}
    return noisy.model_copy(update=changes)


@cache
def drive() -> Drive:
    recording = KeptDrive(swept_and_noisy(), 3)
    raw = config_of(recording, has_bag=True)
    raw |= {"solve": {"time_offset": True}, "registration": {"components": 150, "max_points": 120}}
    raw["extraction"] = {"max_scans": 30}
    # Its LiDARs have no bias, and the config says so: else z is known to a millimetre only.
    raw.setdefault("noise", {})["lidar_range_bias_m"] = 0.0005
    return Drive(recording, without_structure(parse_config(raw, "config.yaml", Path("/nowhere"))))


@cache
def run_and_tested() -> tuple[CalibrationRun, Sequence[VehicleTrajectory]]:
    """A calibration, and the trajectories that its inputs were tested on."""
    seen: list[Sequence[VehicleTrajectory]] = []

    def watched(*args: Any, **more: Any) -> Any:
        seen.append(args[3])
        return check(*args, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("caliv_graph.pipeline.run.check", watched)
        found = calibrate([drive().recording], drive().config, SilentProgress())
    (tested,) = seen
    return found, tested


def run() -> CalibrationRun:
    return run_and_tested()[0]


def test_extrinsics_are_found() -> None:
    errors = evaluate(run().calibration, drive().recording.truth.T_vehicle_lidar)
    (pair,) = errors["pairs"]
    assert np.abs(pair["rotation_rad"]).max() < 1.5 * MRAD
    # z to within what roll and pitch of LiDARs that never meet leave; x and y are determined.
    assert np.abs(pair["translation_m"][:2]).max() < 10 * MM
    for lidar in errors["lidars"].values():
        assert np.abs(lidar["s2v"]["rotation_rad"]).max() < 1.5 * MRAD
        assert np.abs(lidar["s2v"]["translation_m"][:2]).max() < 10 * MM
        # Six degrees of freedom, of which the height is the guess's: 99.9 percent are below 22.
        assert lidar["s2v"]["nees"] < 22.0


def test_the_ground_gives_the_height_and_ties_the_lidars_together() -> None:
    calibration = run().calibration
    assert calibration.status == "ok"
    (pair,) = evaluate(calibration, drive().recording.truth.T_vehicle_lidar)["pairs"]
    assert np.abs(pair["rotation_rad"][:2]).max() < 0.15 * MRAD
    assert abs(pair["translation_m"][2]) < 1.0 * MM
    for name, lidar in calibration.lidars.items():
        assert all(lidar.determined.values())
        height_m = drive().recording.truth.T_vehicle_lidar[name].translation()[2]
        # The vehicle's own height was drawn with 5 mm.
        assert lidar.T_vehicle_lidar.translation()[2] == pytest.approx(height_m, abs=15 * MM)


def test_a_late_clock_is_found() -> None:
    for name, true_s in drive().recording.truth.time_offset_s.items():
        found = run().calibration.lidars[name].time_offset
        assert found is not None
        value, sigma = found
        # With a quarter of the scans and of the components; all of them find it to 0.7 ms.
        assert value == pytest.approx(true_s, abs=3e-3)
        assert abs(value - true_s) < 4.0 * sigma
        assert 1e-4 < sigma < 2e-3


def test_inputs_are_tested_on_the_motion_that_the_result_has() -> None:
    """With the slow errors of the fixes in it: without, 20 mm of them look like a wrong height."""
    found, tested = run_and_tested()
    assert found.record is not None
    for one, used in zip(tested, found.record.trajectories, strict=True):
        assert isinstance(used, SmoothedTrajectory)
        assert used.correlated
        assert one is used


def test_no_pose_noise_is_reported_where_no_poses_were_given() -> None:
    assert run().solution.pose_noise is None
    assert "pose_noise" not in run().calibration.provenance


@dataclass(frozen=True)
class Counting(ForwardingRecording):
    """A recording that counts the scans that it hands out, per LiDAR."""

    decoded: Counter[str] = field(default_factory=Counter)

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        for scan in super().scans(lidar, wanted):
            self.decoded[lidar] += 1
            yield scan


def trajectories() -> Sequence[VehicleTrajectory]:
    record = run().record
    assert record is not None
    return record.trajectories


@cache
def extracted() -> tuple[TargetObservation, Mapping[str, int]]:
    """The clouds of the target, and how many scans of each LiDAR were decoded for them."""
    recording, config = Counting(drive().recording), drive().config
    (observation,) = extract_targets([recording], trajectories(), config, SilentProgress())
    return observation, recording.decoded


def centres_map() -> Array:
    """Middle of every extracted cloud in the map, through the true poses and extrinsics."""
    truth = drive().recording.truth
    out = []
    for cloud in extracted()[0].clouds:
        late_ns = round(1e9 * truth.time_offset_s[cloud.lidar])
        (T_map_vehicle,) = truth.T_map_vehicle(np.array([cloud.stamp_ns - late_ns]))
        T = T_map_vehicle.compose(truth.T_vehicle_lidar[cloud.lidar])
        points = T.transformFrom(cloud.points_lidar.T).T
        out.append(0.5 * (points.min(axis=0) + points.max(axis=0)))
    return np.array(out)


def test_the_walker_is_not_taken_for_the_chair() -> None:
    centres = centres_map()
    assert len(centres) == 60
    off = np.linalg.norm(centres[:, :2] - np.median(centres[:, :2], axis=0), axis=1)
    # In a dozen of these scans the walker is the largest thing in the region, up to 3 m away.
    assert (off < 0.25).mean() > 0.95
    assert off.max() < 0.6


def test_scans_that_cannot_see_the_target_are_not_decoded() -> None:
    for name, decoded in extracted()[1].items():
        assert 100 < decoded < 0.8 * len(drive().recording.scan_stamps_ns(name))
    assert set(extracted()[1]) == set(drive().config.lidars)


def test_beams_begin_where_the_lidars_were() -> None:
    """As the clouds were found, and as they were put together again with what was found."""
    again = [registration.observation for registration in run().solution.registrations]
    clouds = [cloud for of in (*run().observations, *again) for cloud in of.clouds]
    farthest_m = 0.0
    for cloud in clouds:
        assert cloud.swept is not None
        assert cloud.origins_lidar is not None
        ranges = np.linalg.norm(cloud.swept.points_lidar, axis=1)
        seen = np.linalg.norm(cloud.points_lidar - cloud.origins_lidar, axis=1)
        assert seen == pytest.approx(ranges, abs=1e-6)
        farthest_m = max(farthest_m, float(np.linalg.norm(cloud.seen_from_lidar)))
    assert farthest_m > 0.1


def test_poses_are_as_uncertain_as_the_motion_data_and_heave_say() -> None:
    clouds = run().observations
    stamps = sorted({c.stamp_ns for o in clouds for c in o.clouds})[:5]
    some = [c for c in clouds[0].clouds if c.stamp_ns in stamps]
    observation = clouds[0].__class__(0, "target", np.zeros(3), tuple(some))
    problem = pose_problem([observation], trajectories(), drive().config)
    cov = np.linalg.inv(problem.motion[0])
    smoothed = trajectories()[0]
    assert isinstance(smoothed, SmoothedTrajectory)
    without, poses = smoothed.joint_information(stamps)
    expected = np.linalg.inv(without)
    z = np.arange(5, len(cov), 6)
    expected[z, z] += HEAVE_SIGMA_M**2
    np.testing.assert_allclose(cov, expected, rtol=1e-5, atol=1e-12)
    assert not problem.given().any()
    assert problem.pose_error_keys() == ()
    shift = problem.origins_map[0]
    for T, pose in zip(problem.T_map_vehicle, poses, strict=True):
        assert T.equals(gtsam.Pose3(pose.rotation(), pose.translation() - shift), 1e-9)
