"""A drive whose GNSS and IMU are not in the clock of the LiDARs, against known truth."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config
from caliv_graph.pipeline import calibrate
from caliv_graph.scenario.model import Scenario, load_scenario
from caliv_graph.simulation.writer import config_of
from caliv_graph.uncertainty.evaluation import evaluate
from scripts.benchmark_clocks import Late
from tests.drives_with_chair import without_structure
from tests.kept import KeptDrive

SCENARIOS = Path(__file__).resolve().parents[1] / "configs" / "scenarios"

SPEED_M_S, RADIUS_M = 3.0, 6.0
GNSS_LATE_S, IMU_LATE_S, POSES_LATE_S = 0.025, 0.008, 0.012


@cache
def figure_eight() -> KeptDrive:
    return KeptDrive(few_clouds(), 2)


def few_clouds() -> Scenario:
    """A figure-eight in half of its time, with every fourth of its clouds."""
    scenario = load_scenario(SCENARIOS / "figure_eight.yaml")
    lidars = {
        name: lidar.model_copy(update={"rate_hz": 10 / 4})
        for name, lidar in scenario.lidars.items()
    }
    assert scenario.crop is not None
    crop = scenario.crop.model_copy(update={"elsewhere_stride": 32})
    drive = scenario.drive.model_copy(update={"speed_m_s": SPEED_M_S, "radius_m": RADIUS_M})
    imu = scenario.imu.model_copy(update={"rate_hz": 50.0})
    changes = {"drive": drive, "lidars": lidars, "crop": crop, "imu": imu}
    return scenario.model_copy(update=changes)


def quick_config(drive: KeptDrive, has_bag: bool) -> Config:
    """Few components and scans, no structure."""
    raw = config_of(drive, has_bag)
    raw["registration"] = {"components": 100, "max_points": 100}
    raw["extraction"] = {"max_scans": 16}
    return without_structure(parse_config(raw, "config.yaml", Path("/nowhere")))


def test_clocks_are_found_and_the_extrinsics_with_them() -> None:
    drive = figure_eight()
    config = quick_config(drive, has_bag=True)
    late = Late(drive, {"gnss": GNSS_LATE_S, "imu": IMU_LATE_S})

    found = calibrate([late], config, SilentProgress()).calibration

    for name, true_s in (("gnss_time_offset", GNSS_LATE_S), ("imu_time_offset", IMU_LATE_S)):
        (value,), (sigma,) = found.vehicle[name].value, found.vehicle[name].sigma
        assert abs(value - true_s) < 4.0 * sigma
        assert sigma < 4e-3
        assert found.vehicle[name].determined == (True,)
    for of in evaluate(found, drive.truth.T_vehicle_lidar)["lidars"].values():
        # At 3 m/s, 25 ms are 75 mm.
        assert abs(of["s2v"]["translation_m"][0]) < 0.012
        assert of["s2v"]["nees"] < 25.0
    assert found.status == "ok"


def test_the_clock_of_given_poses_is_found_and_the_extrinsics_with_it() -> None:
    drive = figure_eight()
    config = quick_config(drive, has_bag=False)
    late = Late(drive, {"poses": POSES_LATE_S})

    found = calibrate([late], config, SilentProgress()).calibration

    (value,), (sigma,) = (
        getattr(found.vehicle["pose_time_offset"], part) for part in ("value", "sigma")
    )
    assert abs(value - POSES_LATE_S) < 4.0 * sigma
    assert sigma < 1.5e-3
    for of in evaluate(found, drive.truth.T_vehicle_lidar)["lidars"].values():
        # At 3 m/s, 12 ms are 36 mm.
        assert abs(of["s2v"]["translation_m"][0]) < 0.010
        assert of["s2v"]["nees"] < 25.0
    assert found.status == "ok"
