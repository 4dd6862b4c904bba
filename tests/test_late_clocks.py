"""A drive whose GNSS and IMU are not in the clock of the LiDARs, against known truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.pipeline import calibrate
from caliv_graph.products import MotionData
from caliv_graph.readers.forwarding import ForwardingRecording
from caliv_graph.scenario.model import Scenario, load_scenario
from caliv_graph.simulation.writer import config_of
from caliv_graph.uncertainty.evaluation import evaluate
from tests.drives_with_chair import without_structure
from tests.kept import KeptDrive

SCENARIOS = Path(__file__).resolve().parents[1] / "configs" / "scenarios"

GNSS_LATE_S, IMU_LATE_S = 0.025, 0.008


@dataclass(frozen=True)
class Late(ForwardingRecording):
    """A recording whose fixes and IMU samples are stamped too late, in seconds."""

    gnss_s: float = 0.0
    imu_s: float = 0.0

    def motion(self) -> MotionData:
        motion = super().motion()
        assert motion.gnss is not None
        assert motion.imu is not None
        gnss, imu = motion.gnss, motion.imu
        return replace(
            motion,
            gnss=replace(gnss, stamps_ns=gnss.stamps_ns + round(1e9 * self.gnss_s)),
            imu=replace(imu, stamps_ns=imu.stamps_ns + round(1e9 * self.imu_s)),
        )


def few_clouds() -> Scenario:
    """The figure-eight with every third of its clouds."""
    scenario = load_scenario(SCENARIOS / "figure_eight.yaml")
    lidars = {
        name: lidar.model_copy(update={"rate_hz": 10 / 3})
        for name, lidar in scenario.lidars.items()
    }
    assert scenario.crop is not None
    crop = scenario.crop.model_copy(update={"elsewhere_stride": 16})
    return scenario.model_copy(update={"lidars": lidars, "crop": crop})


def test_clocks_are_found_and_the_extrinsics_with_them() -> None:
    drive = KeptDrive(few_clouds(), 2)
    raw = config_of(drive, has_bag=True)
    raw["registration"] = {"components": 250, "max_points": 200}
    raw["extraction"] = {"max_scans": 30}
    config = without_structure(parse_config(raw, "config.yaml", Path("/nowhere")))
    late = Late(drive, GNSS_LATE_S, IMU_LATE_S)

    found = calibrate([late], config, SilentProgress()).calibration

    for name, true_s in (("gnss_time_offset", GNSS_LATE_S), ("imu_time_offset", IMU_LATE_S)):
        (value,), (sigma,) = found.vehicle[name].value, found.vehicle[name].sigma
        assert abs(value - true_s) < 4.0 * sigma
        assert sigma < 4e-3
        assert found.vehicle[name].determined == (True,)
    for of in evaluate(found, drive.truth.T_vehicle_lidar)["lidars"].values():
        # At 2 m/s, 25 ms are 50 mm.
        assert abs(of["s2v"]["translation_m"][0]) < 0.012
        assert of["s2v"]["nees"] < 25.0
    assert found.status == "ok"
