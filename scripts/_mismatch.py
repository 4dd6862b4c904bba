"""The rows of benchmark_mismatch: in what the drive differs from what the program is told."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from caliv_graph.common.progress import SilentProgress
from caliv_graph.pipeline import calibrate
from caliv_graph.scenario.model import Scenario, load_scenario
from scripts._tables_rows import config_for
from scripts._targets import Result, judged
from scripts._thinned import GroundWaves, ThinnedRecording, cached_selection

REPOSITORY = Path(__file__).resolve().parents[1]

NOMINAL_RANGE_M = 0.01
"""Noise along the beams that every config states."""

LEVER_ARM_M = (1.2, 0.3, 0.85)
"""True antenna of all rows, in the vehicle frame."""

LEVER_ARM_SIGMA_M = 0.01
"""1 sigma of the error with which the row `lever_arm` states it, the default of the config."""

CORRELATED_M = 0.02
"""1 sigma of the Gauss-Markov error of the fixes, per axis."""

GOOD = 0.1
"""Noise of a gyroscope over the nominal one, in the row whose gyroscope has a wrong scale: the
nominal noise would hide it."""

CORRELATED_RAD = 2e-3
"""1 sigma of the Gauss-Markov error of the orientation, per axis: the slow error of a good AHRS."""


@dataclass(frozen=True)
class Row:
    """One kind of mismatch.

    Attributes:
        text: its description.
        heave, waves, range, gnss, imu: factors on the nominal figure of the simulation.
        correlation_s: of GNSS errors of `CORRELATED_M`; 0: they are white.
        turning_s: correlation time of orientation errors of `CORRELATED_RAD`; 0: they are white.
        lever_arm: whether the config states a lever arm that is off by its sigma.
        gyroscope: 1 sigma of the errors of the gyroscope's scale and axes.
    """

    text: str
    heave: float = 1.0
    waves: float = 1.0
    range: float = 1.0
    gnss: float = 1.0
    imu: float = 1.0
    correlation_s: float = 0.0
    turning_s: float = 0.0
    lever_arm: bool = False
    gyroscope: float = 0.0


ROWS: Mapping[str, Row] = {
    "nominal": Row("all as told"),
    "heave_half": Row("heave halved", heave=0.5),
    "heave_double": Row("heave doubled", heave=2.0),
    "waves_half": Row("waves of the ground halved", waves=0.5),
    "waves_double": Row("waves of the ground doubled", waves=2.0),
    "range_half": Row("range noise halved", range=0.5),
    "range_double": Row("range noise doubled", range=2.0),
    "gnss_half": Row("GNSS noise halved", gnss=0.5),
    "gnss_double": Row("GNSS noise doubled", gnss=2.0),
    "imu_half": Row("IMU noise halved", imu=0.5),
    "imu_double": Row("IMU noise doubled", imu=2.0),
    "gnss_10s": Row("GNSS error of 20 mm correlated over 10 s", correlation_s=10.0),
    "gnss_60s": Row("GNSS error of 20 mm correlated over 60 s", correlation_s=60.0),
    "lever_arm": Row("lever arm off by 10 mm per axis, 1 sigma", lever_arm=True),
    "gyroscope": Row("gyroscope of a tenth of the noise, its scale off by 4e-3", gyroscope=4e-3),
    "orientation_30s": Row("orientation error of 2 mrad correlated over 30 s", turning_s=30.0),
}
"""By name."""


@dataclass(frozen=True)
class Task:
    """One run of a row on a scenario, with the seed of all its draws."""

    row: str
    seed: int
    scenario: str = "figure_eight"


def scenario_of(task: Task) -> Scenario:
    """The drive of a task: true noise, and messages that state the nominal figures."""
    row, nominal = ROWS[task.row], _scenario(task.scenario)
    gnss, imu = nominal.gnss, nominal.imu
    suspension = nominal.suspension
    return nominal.model_copy(
        update={
            "lidars": {
                name: lidar.model_copy(update={"range_sigma_m": row.range * NOMINAL_RANGE_M})
                for name, lidar in nominal.lidars.items()
            },
            "suspension": suspension.model_copy(
                update={"heave_sigma_m": row.heave * suspension.heave_sigma_m}
            ),
            "gnss": gnss.model_copy(
                update={
                    "lever_arm": LEVER_ARM_M,
                    "horizontal_sigma_m": row.gnss * gnss.horizontal_sigma_m,
                    "vertical_sigma_m": row.gnss * gnss.vertical_sigma_m,
                    "stated_over_true": 1.0 / row.gnss,
                    **(_correlated(row) if row.correlation_s else {}),
                }
            ),
            "imu": imu.model_copy(
                update={
                    "accelerometer_sigma_m_s2": row.imu * imu.accelerometer_sigma_m_s2,
                    "gyroscope_sigma_rad_s": (GOOD if row.gyroscope else row.imu)
                    * imu.gyroscope_sigma_rad_s,
                    "gyroscope_scale_sigma": row.gyroscope,
                    "stated_over_true": 1.0 / row.imu,
                    "orientation": imu.orientation.model_copy(
                        update={
                            "correlated_sigma_rad": CORRELATED_RAD if row.turning_s else 0.0,
                            "correlation_s": row.turning_s or imu.orientation.correlation_s,
                        }
                    ),
                }
            ),
        }
    )


def _correlated(row: Row) -> dict[str, float]:
    return {
        "correlated_horizontal_sigma_m": CORRELATED_M,
        "correlated_vertical_sigma_m": CORRELATED_M,
        "correlation_s": row.correlation_s,
    }


@functools.cache
def _scenario(name: str) -> Scenario:
    return load_scenario(REPOSITORY / "configs" / "scenarios" / f"{name}.yaml")


def recording_of(task: Task, beams: Path) -> ThinnedRecording:
    """The drive of a task; `beams` is the folder of the beams that matter."""
    scenario, nominal = scenario_of(task), GroundWaves()
    waves = replace(nominal, sigma_m=ROWS[task.row].waves * nominal.sigma_m)
    return ThinnedRecording(scenario, cached_selection(scenario, beams), task.seed, waves=waves)


def run(task: Task, beams: Path) -> Result:
    """Simulates, calibrates and compares once. A failure of any kind is a result too."""
    recording = recording_of(task, beams)
    arm = np.array(LEVER_ARM_M)
    if ROWS[task.row].lever_arm:
        arm += LEVER_ARM_SIGMA_M * np.random.default_rng(task.seed).standard_normal(3)
    changes: dict[str, dict[str, Any]] = {
        "noise": {"lidar_range_m": NOMINAL_RANGE_M},
        # The config that `simulate` writes states an exact arm: here it has the default sigma.
        "gnss": {"lever_arm": arm.tolist(), "lever_arm_sigma": None},
    }
    config = config_for(recording, changes)
    return judged(
        lambda: calibrate([recording], config, SilentProgress()),
        lambda _: recording.truth.T_vehicle_lidar,
    )
