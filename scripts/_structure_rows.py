"""The rows of benchmark_structure: a yard driven in several ways, a street, a car park, a field.

A row is a shipped scenario with another drive, other LiDARs or a target. Every run draws the noise,
the range biases, and the bumps of walls and ground anew: a fixed bump would be the same error in
all runs.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from caliv_graph.common.exits import USAGE, exit_code
from caliv_graph.common.progress import SilentProgress
from caliv_graph.errors import CalivError
from caliv_graph.pipeline import calibrate
from caliv_graph.products import IntArray
from caliv_graph.scenario.drive_models import ArcDrive, SCurveDrive, StandstillDrive
from caliv_graph.scenario.drives import cloud_stamps, make_drive
from caliv_graph.scenario.model import Scenario, load_scenario
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.scenario.world_models import ObjectModel, WallModel
from caliv_graph.simulation.lidar import beam_directions
from caliv_graph.simulation.recording import SimulatedScan
from scripts._tables_rows import compared, config_for
from scripts._thinned import BeamSelection, ThinnedRecording, scenario_digest

SCENARIOS = Path(__file__).resolve().parents[1] / "configs" / "scenarios"

CHAIR = "chair"

SEEDS_PER_RUN = 1000
"""Seeds of bumps that belong to one run; no scenario has as many walls."""

SIX = tuple[float, float, float, float, float, float]
FREE = math.nan
"""No limit: the axis is not determined, or its sigma is what it is."""


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        text: the drive and its evidence.
        scenario: name of the shipped scenario.
        drive: kind of another drive in it; empty: its own.
        lidars: `two`, `three` with stamps of their own, or `shared`, which see the same walls.
        chair: whether the chair is a target.
        runs: default number of runs.
        limits: of the RMSE per kind of quantity (S2S, S2V): x y z in mm, roll pitch yaw in mrad.
        channels: whether each channel has a range and a direction of its own.
        fixes: whether there are GNSS and orientation; else an IMU with biases, and speeds.
        must_fail: whether there must be no result: exit code 2 or 3.
    """

    text: str
    scenario: str
    drive: str = ""
    lidars: str = "two"
    chair: bool = False
    runs: int = 20
    limits: Mapping[str, SIX] = field(default_factory=dict)
    channels: bool = False
    fixes: bool = True
    must_fail: bool = False


_S2V_ALONE: SIX = (1.2, 1.2, 6.0, 0.1, 0.1, 0.15)
_S2V_S: SIX = (8.0, 6.0, 6.0, 0.3, 0.3, 0.4)

ROWS: Mapping[str, Row] = {
    "yard": Row(
        "yard, figure-eight, walls and ground",
        "yard",
        runs=100,
        limits={"S2S": (0.5, 0.4, 0.4, 0.04, 0.04, 0.02), "S2V": _S2V_ALONE},
    ),
    "yard_chair": Row(
        "yard, figure-eight, walls, ground and chair",
        "yard",
        chair=True,
        limits={"S2S": (0.4, 0.3, 0.4, 0.04, 0.04, 0.02), "S2V": _S2V_ALONE},
    ),
    "yard_s": Row(
        "yard, S-curve, walls and ground",
        "yard",
        drive="s_curve",
        limits={"S2S": (4.5, 2.5, 0.5, 0.08, 0.08, 0.06), "S2V": _S2V_S},
    ),
    "yard_s_chair": Row(
        "yard, S-curve, walls, ground and chair",
        "yard",
        drive="s_curve",
        chair=True,
        limits={"S2S": (1.0, 1.0, 0.5, 0.08, 0.08, 0.06), "S2V": _S2V_S},
    ),
    "yard_arc_chair": Row(
        "yard, the paper's arc, walls, ground and chair",
        "yard",
        drive="arc",
        chair=True,
        limits={
            "S2S": (0.8, 0.6, 0.4, 0.05, 0.05, 0.03),
            "S2V": (FREE, 10.0, 6.0, 0.2, 0.2, FREE),
        },
    ),
    "yard_three": Row(
        "yard, three LiDARs at different stamps, walls and ground",
        "yard",
        lidars="three",
        limits={
            "S2S": (0.8, 0.8, 0.5, 0.06, 0.06, 0.04),
            "S2V": (1.5, 1.5, 6.0, 0.1, 0.1, 0.15),
        },
    ),
    "yard_stand": Row(
        "yard, standing still, LiDARs that share a view of two walls",
        "yard",
        drive="standstill",
        lidars="shared",
        limits={"S2S": (3.0, 3.0, 1.0, 0.3, 0.3, 0.3)},
    ),
    "yard_channels": Row(
        "yard, figure-eight, walls and ground, channels off by 4 mm and 0.2 mrad each",
        "yard",
        channels=True,
    ),
    "yard_speed": Row(
        "yard, figure-eight, walls and ground, IMU and speeds alone",
        "yard",
        fixes=False,
    ),
    "yard_speed_chair": Row(
        "yard, figure-eight, walls, ground and chair, IMU and speeds alone",
        "yard",
        chair=True,
        fixes=False,
    ),
    "street": Row("street, parallel fronts and one crossing", "street"),
    "car_park": Row("car park, rows of cars and few walls", "car_park"),
    "field": Row("field, hedges only: no result", "field", must_fail=True),
}


@functools.cache
def shipped(name: str) -> Scenario:
    return load_scenario(SCENARIOS / f"{name}.yaml")


@functools.cache
def scenario_of(row: str) -> Scenario:
    """The scenario of a row, before anything is drawn."""
    asked = ROWS[row]
    base = shipped(asked.scenario)
    world = base.world
    changes: dict[str, Any] = {"name": row}
    if asked.drive:
        changes["drive"], chair_xy = _drive(asked.drive)
        chair = world.objects[CHAIR].model_copy(update={"xy_m": chair_xy})
        world = world.model_copy(update={"objects": {**world.objects, CHAIR: chair}})
    if asked.chair:
        world = world.model_copy(update={"targets": (CHAIR,)})
    if asked.lidars != "two":
        changes["lidars"] = _lidars(asked.lidars, base.lidars["front"])
        changes["reference"] = "front"
    if not asked.fixes:
        changes |= _without_fixes(base)
    scenario = base.model_copy(update={**changes, "world": world})
    return _with_channel_errors(scenario) if asked.channels else scenario


def _without_fixes(scenario: Scenario) -> dict[str, Any]:
    """An IMU of a mobile robot, whose bias turns the heading by 0.3 rad within the drive."""
    imu = scenario.imu.model_copy(
        update={
            "rate_hz": 200.0,
            "gyroscope_sigma_rad_s": 0.002,
            "gyroscope_bias_sigma_rad_s": 0.005,
            "accelerometer_bias_sigma_m_s2": 0.05,
            "orientation": scenario.imu.orientation.model_copy(update={"enabled": False}),
        }
    )
    return {"imu": imu, "gnss": scenario.gnss.model_copy(update={"enabled": False})}


def _with_channel_errors(scenario: Scenario) -> Scenario:
    """LiDARs whose channels are calibrated as well as those of a good one."""
    errors = {"channel_bias_sigma_m": 0.004, "channel_direction_sigma_mrad": 0.2}
    lidars = {name: lidar.model_copy(update=errors) for name, lidar in scenario.lidars.items()}
    return scenario.model_copy(update={"lidars": lidars})


def _drive(kind: str) -> tuple[Any, tuple[float, float]]:
    """Another drive in the yard, and the place of the chair: 4 to 6 m beside its path, metres."""
    if kind == "s_curve":
        return SCurveDrive(start_xy_m=(-9.0, 9.0), duration_s=17.0), (0.0, -10.0)
    if kind == "arc":
        return ArcDrive(duration_s=17.0), (12.08, 0.0)
    stand = StandstillDrive(start_xy_m=(-4.0, -4.0), start_yaw_deg=15.0, duration_s=10.0)
    return stand, (12.08, 0.0)


def _lidars(kind: str, front: LidarModel) -> dict[str, LidarModel]:
    """Other LiDARs on the vehicle, with the range errors of the yard's front one."""
    if kind == "shared":
        turned = front.mounting.model_copy(
            update={"xyz": (1.0, 0.8, 1.9), "rpy_deg": (0.0, 10.0, 45.0)}
        )
        return {"front": front, "left": front.model_copy(update={"mounting": turned})}
    bias = {
        "range_bias_sigma_m": front.range_bias_sigma_m,
        "incidence_bias_m": front.incidence_bias_m,
    }
    sides = {
        name: shipped("tri_lidar").lidars[name].model_copy(update=bias)
        for name in ("left", "right")
    }
    return {"front": front, **sides}


def drawn(scenario: Scenario, seed: int) -> Scenario:
    """The scenario with the bumps of one run."""
    number = 0
    objects: dict[str, ObjectModel] = {}
    for name, placed in scenario.world.objects.items():
        if isinstance(placed, WallModel):
            number += 1
            placed = placed.model_copy(update={"seed": SEEDS_PER_RUN * seed + number})
        objects[name] = placed
    ground = scenario.world.ground.model_copy(update={"bumps_seed": SEEDS_PER_RUN * seed})
    world = scenario.world.model_copy(update={"objects": objects, "ground": ground})
    return scenario.model_copy(update={"world": world})


class WholeRecording(ThinnedRecording):
    """A simulated drive with all beams, of which only those clouds are cast that are read, once.

    Attributes:
        cast_s: CPU time of the world and of casting so far, seconds.
        clouds: number of clouds cast so far.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        """Draws the errors that hold for the whole drive."""
        begun = time.process_time()
        super().__init__(scenario, _all_beams(scenario), seed)
        self.cast_s = time.process_time() - begun
        self.clouds = 0

    def _thin(self, lidar: str, index: int, frame: int, stamp_ns: int) -> SimulatedScan:
        begun = time.process_time()
        taken = super()._thin(lidar, index, frame, stamp_ns)
        self.cast_s += time.process_time() - begun
        self.clouds += 1
        return taken


def _all_beams(scenario: Scenario) -> BeamSelection:
    """A selection that leaves nothing out."""
    duration_s = make_drive(scenario.drive).duration_s
    beams, frames = {}, {}
    for name, model in scenario.lidars.items():
        beams[name] = np.arange(beam_directions(model)[..., 0].size)
        frames[name] = np.arange(len(cloud_stamps(name, model, duration_s)))
    nothing: dict[str, Mapping[int, IntArray]] = {name: {} for name in scenario.lidars}
    return BeamSelection(scenario_digest(scenario), beams, beams, nothing, frames)


def run_row(row: str, seed: int) -> dict[str, Any]:
    """Simulates, calibrates and compares once.

    Returns:
        The line to write: `failure` (the reason, or empty), `exit` as that of the command line,
        `cast_s` and `clouds` of `WholeRecording`, and the fields of `Outcome` if there is a result.
    """
    recording = WholeRecording(drawn(scenario_of(row), seed), seed)
    config = config_for(recording, {})
    begun = time.process_time()
    line: dict[str, Any] = {"failure": ""}
    try:
        run = calibrate([recording], config, SilentProgress())
    except CalivError as error:
        line |= {"failure": str(error), "exit": USAGE}
    else:
        outcome = compared(
            run.calibration, recording.truth.T_vehicle_lidar, run.solution.stage_times_s
        )
        line |= {**asdict(outcome), "exit": exit_code(run.calibration)}
    # Clouds are cast while the program reads them.
    total_s = time.process_time() - begun
    line["seconds"] = {**line.get("seconds", {}), "total": total_s}
    return {**line, "cast_s": recording.cast_s, "clouds": recording.clouds}
