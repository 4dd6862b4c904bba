"""The matrix of benchmark_targets: objects, LiDARs, drives, a run of a cell, recorded drives."""

from __future__ import annotations

import functools
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from caliv_graph.common.exits import DEFECT, USAGE, exit_code
from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import load_config
from caliv_graph.config.model import Config
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.errors import CalivError
from caliv_graph.pipeline import calibrate
from caliv_graph.products import Calibration
from caliv_graph.readers import open_recording
from caliv_graph.results.run import CalibrationRun
from caliv_graph.scenario.model import Scenario, load_scenario
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.scenario.world_models import (
    BicycleModel,
    BinModel,
    BoxesModel,
    BoxModel,
    ChairModel,
    ConesModel,
    ObjectModel,
    StrollerModel,
    ThinChairModel,
)
from caliv_graph.simulation import SimulatedRecording
from caliv_graph.simulation.recording import simulate_drive
from scripts._tables_rows import compared, config_for
from scripts._thinned import (
    BeamSelection,
    GroundWaves,
    ThinnedRecording,
    cached_selection,
    scenario_digest,
)

REPOSITORY = Path(__file__).resolve().parents[1]
SCENARIOS = REPOSITORY / "configs" / "scenarios"
DATA = REPOSITORY.parent / "shared" / "data"

OBJECTS: Mapping[str, type] = {
    "chair": ChairModel,
    "thin_chair": ThinChairModel,
    "boxes": BoxesModel,
    "cones": ConesModel,
    "bicycle": BicycleModel,
    "stroller": StrollerModel,
    "bin": BinModel,
}
"""Models of the targets by the name of their shape."""

ENVELOPE_M = (1.8, 1.4, 1.3)
"""Box about the origin that holds each of the objects. The beams of a cell are those into it."""

TILT_DEG = 5.0
"""Pitch of the spinning LiDARs, nose down. That of the drives, 10 degrees, belongs to a LiDAR that
looks to one side: a spinning one would see the sky at its back."""

DRIVES = ("figure_eight", "s_curve")

TARGET = "target"
"""Name of the object in the scenario."""


@dataclass(frozen=True)
class SpinningLidar:
    """A LiDAR that sees all around.

    Attributes:
        channels: beams above one another.
        vertical_fov_deg: elevation of the lowest and the highest.
        horizontal_resolution_deg: between two columns.
    """

    channels: int
    vertical_fov_deg: tuple[float, float]
    horizontal_resolution_deg: float

    def in_place_of(self, model: LidarModel) -> LidarModel:
        """The same position and heading with the beams of this LiDAR."""
        yaw_deg = model.mounting.rpy_deg[2]
        return model.model_copy(
            update={
                "mounting": PoseConfig(xyz=model.mounting.xyz, rpy_deg=(0.0, TILT_DEG, yaw_deg)),
                "horizontal_fov_deg": (-180.0, 180.0),
                "vertical_fov_deg": self.vertical_fov_deg,
                "channels": self.channels,
                "horizontal_resolution_deg": self.horizontal_resolution_deg,
            }
        )


LIDARS: Mapping[str, SpinningLidar | None] = {
    "spin16": SpinningLidar(16, (-15.0, 15.0), 0.2),
    "spin32": SpinningLidar(32, (-25.0, 15.0), 0.2),
    "spin64": SpinningLidar(64, (-22.5, 22.5), 0.2),
    "spin128": SpinningLidar(128, (-22.5, 22.5), 360.0 / 1024.0),
    "wide": None,
}
"""LiDARs by name; None: that of the drives, 120 x 25 degrees and 152 channels."""


@dataclass(frozen=True)
class Task:
    """One run of a cell.

    Attributes:
        object: name of the target's shape.
        lidar: name of both LiDARs' model.
        drive: name of the scenario that the drive is taken from.
        seed: seed of all draws.
        range_sigma_m: noise along the beams.
        whole: whether whole clouds are cast.
    """

    object: str
    lidar: str
    drive: str
    seed: int
    range_sigma_m: float = 0.01
    whole: bool = False


def scenario_of(task: Task) -> Scenario:
    """The scenario of a cell."""
    model: ObjectModel = OBJECTS[task.object](**_place(task.drive))
    return _scenario(task.drive, task.lidar, model, task.range_sigma_m)


def _place(drive: str) -> dict[str, Any]:
    """Position and heading of the drive's own target."""
    world = _drive(drive).world
    own = world.objects[world.targets[0]]
    return {"xy_m": own.xy_m, "yaw_deg": own.yaw_deg}


@functools.cache
def _drive(name: str) -> Scenario:
    return load_scenario(SCENARIOS / f"{name}.yaml")


def _scenario(drive: str, lidar: str, target: ObjectModel, range_sigma_m: float) -> Scenario:
    own = _drive(drive)
    beams = LIDARS[lidar]
    lidars = {
        name: (beams.in_place_of(model) if beams else model).model_copy(
            update={"range_sigma_m": range_sigma_m}
        )
        for name, model in own.lidars.items()
    }
    left = {name: o for name, o in own.world.objects.items() if name not in own.world.targets}
    world = own.world.model_copy(update={"objects": {TARGET: target, **left}, "targets": (TARGET,)})
    return own.model_copy(
        update={"name": f"{drive}_{lidar}", "lidars": lidars, "world": world, "crop": None}
    )


def selection_of(drive: str, lidar: str, folder: Path) -> BeamSelection:
    """The beams of a drive and a LiDAR into `ENVELOPE_M` and its surroundings, for all objects."""
    envelope = BoxModel(size_m=ENVELOPE_M, **_place(drive))
    return cached_selection(_scenario(drive, lidar, envelope, 0.0), folder)


def recording_of(task: Task, beams: Path) -> SimulatedRecording:
    """The drive of a task.

    Args:
        task: what to simulate.
        beams: folder of the beams that matter, found once per drive and LiDAR.
    """
    scenario = scenario_of(task)
    if task.whole:
        return simulate_drive(GroundWaves().on(scenario, task.seed), task.seed)
    selection = replace(
        selection_of(task.drive, task.lidar, beams), digest=scenario_digest(scenario)
    )
    return ThinnedRecording(scenario, selection, task.seed, waves=GroundWaves())


# ------------------------------------------------------------------ runs


@dataclass(frozen=True)
class Result:
    """One calibration against the truth.

    Attributes:
        exit: exit code that `calibrate` would have.
        failure: reason for a missing result, or empty.
        status: of the calibration.
        contradictions: why it is inconsistent.
        undetermined: directions, as they are named.
        quantities: errors of 'S2V front', 'S2S front to rear', ... (`_tables_rows.Errors`).
        scale: `registration_scale`; None without a result.
        clouds: clouds used, per LiDAR.
        points: median number of points of a cloud; None without a result.
        seconds: 'total', CPU time with the simulation of the clouds.
    """

    exit: int
    failure: str = ""
    status: str = ""
    contradictions: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()
    quantities: Mapping[str, Any] = field(default_factory=dict)
    scale: float | None = None
    clouds: Mapping[str, int] = field(default_factory=dict)
    points: float | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)


def run(task: Task, beams: Path) -> Result:
    """Simulates, calibrates and compares once. A failure of any kind is a result too."""
    recording = recording_of(task, beams)
    config = config_for(recording, {})
    return judged(
        lambda: calibrate([recording], config, SilentProgress()),
        lambda _: recording.truth.T_vehicle_lidar,
    )


def judged(
    work: Callable[[], CalibrationRun], truth: Callable[[Calibration], Mapping[str, gtsam.Pose3]]
) -> Result:
    """What comes of a calibration.

    Args:
        work: the calibration.
        truth: T_vehicle_lidar per LiDAR, from its result.
    """
    begun = time.process_time()
    try:
        done = work()
    except CalivError as e:
        return Result(USAGE, str(e), seconds={"total": time.process_time() - begun})
    except Exception as e:  # a defect of the program in one cell must not end the others
        failure = f"{type(e).__name__}: {e}"
        return Result(DEFECT, failure, seconds={"total": time.process_time() - begun})
    seconds = time.process_time() - begun
    outcome = compared(done.calibration, truth(done.calibration), {"total": seconds})
    clouds = [cloud for o in done.observations for cloud in o.clouds]
    names = [cloud.lidar for cloud in clouds]
    return Result(
        exit=exit_code(done.calibration),
        status=outcome.status,
        contradictions=tuple(done.calibration.contradictions),
        undetermined=outcome.undetermined,
        quantities={name: asdict(errors) for name, errors in outcome.quantities.items()},
        scale=float(done.solution.registration_scale),
        clouds={name: names.count(name) for name in done.calibration.lidars},
        points=statistics.median(len(cloud.points_lidar) for cloud in clouds),
        seconds=outcome.seconds,
    )


# ------------------------------------------------------------------ recorded drives


EDGAR_REFERENCE = gtsam.Pose3(
    gtsam.Rot3.RzRyRx(700.1e-3, -6.5e-3, 22.2e-3), np.array([0.002, -1.231, -0.430])
)
"""T_sensor_1_sensor_2 of EDGAR's two LiDARs, by generalised ICP on whole clouds: three frames agree
to 0.2 mrad and 1 mm. It is not surveyed."""


def run_released() -> Result:
    """The drive that the CaLiV authors published, with our config of it as it is.

    Raises:
        CalivError: the drive is not there.
    """
    from scripts.benchmark_released import CONFIG, authors_config

    authors = authors_config(DATA / "caliv_released")
    truth = {name: lidar.guess() for name, lidar in authors.lidars.items()}
    return _calibrated(load_config(CONFIG), lambda _: truth)


def run_edgar(config_name: str) -> Result:
    """EDGAR standing still, with a config of its folder as it is; S2V has no reference.

    Raises:
        CalivError: it is not there.
    """
    config = load_config(DATA / "edgar_static" / config_name)

    def truth(calibration: Calibration) -> Mapping[str, gtsam.Pose3]:
        T_vehicle_sensor_1 = calibration.lidars["sensor_1"].T_vehicle_lidar
        return {
            "sensor_1": T_vehicle_sensor_1,
            "sensor_2": T_vehicle_sensor_1.compose(EDGAR_REFERENCE),
        }

    result = _calibrated(config, truth)
    pairs = {name: e for name, e in result.quantities.items() if name.startswith("S2S")}
    return replace(result, quantities=pairs)


def _calibrated(
    config: Config, truth: Callable[[Calibration], Mapping[str, gtsam.Pose3]]
) -> Result:
    recording = open_recording(config)
    return judged(lambda: calibrate([recording], config, SilentProgress()), truth)


RECORDED: Mapping[str, tuple[tuple[str, Callable[[], Result]], ...]] = {
    "released": (("the authors' drive", run_released),),
    "edgar": (
        ("edgar_static, one region", lambda: run_edgar("config_one_box.yaml")),
        ("edgar_static, three regions", lambda: run_edgar("config_three_boxes.yaml")),
    ),
}
"""Recorded drives by option: what to call a run, and the run."""
