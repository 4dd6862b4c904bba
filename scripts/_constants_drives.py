"""The simulated drives of benchmark_constants, and what a calibration of one leaves to compare."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import gtsam
import numpy as np

from caliv_graph.common.progress import PlainProgress, SilentProgress
from caliv_graph.config.model import Config
from caliv_graph.errors import CalivError
from caliv_graph.pipeline import Prepared, calibrate, prepare
from caliv_graph.products import GivenPoses, Recording
from caliv_graph.scenario.model import Scenario, load_scenario
from caliv_graph.simulation import SimulatedRecording
from scripts._tables_rows import TRUE_POSES_NOISE, View, compared, config_for, true_poses
from scripts._thinned import GroundWaves, ThinnedRecording, cached_selection
from scripts.benchmark_consistency import Faulty

SCENARIOS = Path(__file__).resolve().parents[1] / "configs" / "scenarios"

LOST_PART = 0.1
"""Part of the clouds of one LiDAR that lie elsewhere, where some do."""

LOST_M = (0.1, 0.05, 0.0)
"""By what (lidar frame): ten times what a registration is off, and no more than a wrong
registration of a chair."""

LATE_NS = 50_000_000
"""By what the stamps of one LiDAR are late, where they are."""

WHITE = np.array([3e-4] * 3 + [3e-3] * 3)
DRIFT = np.array([5e-4] * 3 + [8e-3] * 3)
DRIFT_TIME_S = 4.0
"""Errors of given poses, 1 sigma, rad and m: white, and Gauss-Markov with this time constant."""


@dataclass(frozen=True)
class Drive:
    """A drive and how it is calibrated.

    Attributes:
        text: what it is.
        scenario: in configs/scenarios.
        changes: of the config that `simulate` would write.
        given: poses with `WHITE` and `DRIFT` errors are given instead of IMU, GNSS and velocity.
        fault: what is wrong with the recording.
    """

    text: str
    scenario: str
    changes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    given: bool = False
    fault: Callable[[Recording], Recording] | None = None


def _lost(number: int, count: int) -> bool:
    return bool(np.random.default_rng(number).random() < LOST_PART)


def _with_lost(recording: Recording) -> Recording:
    return Faulty(recording, displaced={"front": (_lost, LOST_M)})


def _late(recording: Recording) -> Recording:
    return Faulty(recording, late_ns={"front": LATE_NS})


DRIVES: Mapping[str, Drive] = {
    "s_curve": Drive("S-curve, two LiDARs, raw sensors, `auto`", "s_curve"),
    "tri_lidar": Drive("figure-eight, three sparse and unlike LiDARs, `auto`", "tri_lidar"),
    "arc": Drive("arc, x and yaw to the vehicle undetermined, `auto`", "paper_arc"),
    "noisy": Drive(
        "figure-eight, a walker, GNSS outliers, biased IMU, a late LiDAR; clocks estimated",
        "noisy",
        {"solve": {"time_offset": True}},
    ),
    "static": Drive("the vehicle stands before the target, `auto`", "static"),
    "parallel": Drive(
        "S-curve, the vehicle stands parallel to the ground within 0.05 degrees",
        "s_curve",
        {"ground": {"parallel_sigma_deg": 0.05}},
    ),
    "given": Drive(
        "S-curve, poses of unknown noise are given, one front cloud in ten 0.11 m off",
        "s_curve",
        {"noise": dict.fromkeys(TRUE_POSES_NOISE)},
        given=True,
        fault=_with_lost,
    ),
    "staged": Drive(
        "S-curve, `staged`, one front cloud in ten 0.11 m off",
        "s_curve",
        {"solve": {"mode": "staged"}},
        fault=_with_lost,
    ),
    "late": Drive("S-curve, the stamps of the front LiDAR 50 ms late", "s_curve", fault=_late),
}
"""By name."""


@functools.cache
def scenario_of(drive: str) -> Scenario:
    """The scenario that a drive is simulated from."""
    return load_scenario(SCENARIOS / f"{DRIVES[drive].scenario}.yaml")


@functools.lru_cache(maxsize=1)
def _recording(scenario: str, seed: int, beams: Path) -> ThinnedRecording:
    """Kept for the next constant: its clouds are cast once."""
    model = load_scenario(SCENARIOS / f"{scenario}.yaml")
    selection = cached_selection(model, beams, progress=PlainProgress(print))
    return ThinnedRecording(model, selection, seed, waves=GroundWaves())


def config_of_drive(drive: str, recording: SimulatedRecording) -> Config:
    """With what a drive is calibrated."""
    return config_for(recording, DRIVES[drive].changes, poses=DRIVES[drive].given)


def performed(
    drive: str,
    seed: int,
    beams: Path,
    settings: Mapping[str, Mapping[str, Any]],
    early: bool = True,
) -> dict[str, Any]:
    """Simulates and calibrates once, with the constants as they are now.

    Args:
        drive: one of `DRIVES`.
        seed: of all that is drawn.
        beams: folder of the beams that matter.
        settings: sections of the config that have other values.
        early: False if no changed constant or setting decides trajectory, target or ground: they
            are then kept for the next run of this drive and seed.

    Returns:
        Plain values: `failure`, and unless there is one: `poses` (`T_vehicle_lidar`, 4x4 row by
        row, per LiDAR), `quantities` (`_tables_rows.Errors`), `status`, `undetermined`,
        `contradictions`, `down` (clouds of less than half their weight), `seconds` of CPU.
    """
    begun = time.process_time()
    made = DRIVES[drive]
    recording = _recording(made.scenario, seed, beams)
    config = config_of_drive(drive, recording)
    for section, keys in settings.items():
        part = getattr(config, section).model_copy(update=dict(keys))
        config = config.model_copy(update={section: part})
    seen: Recording = recording
    if made.given:
        seen = View(recording, recording.lidars, poses=_given(recording, seed))
    if made.fault is not None:
        seen = made.fault(seen)
    try:
        with nullcontext() if early else _prepared_once((drive, seed)):
            run = calibrate([seen], config, SilentProgress())
    except CalivError as e:
        return {"failure": str(e)}
    found = asdict(compared(run.calibration, recording.truth.T_vehicle_lidar, {}))
    weights = np.concatenate(run.solution.cloud_weights)
    return {
        "failure": "",
        "poses": {
            name: lidar.T_vehicle_lidar.matrix().ravel().tolist()
            for name, lidar in run.calibration.lidars.items()
        },
        "quantities": found["quantities"],
        "status": found["status"],
        "undetermined": list(found["undetermined"]),
        "contradictions": list(run.calibration.contradictions),
        "down": int((weights < 0.5).sum()),
        "seconds": time.process_time() - begun,
    }


_PREPARED: dict[tuple[str, int], Prepared] = {}
"""Trajectory, target and ground of the last drive and seed, with the constants as they are."""


@contextmanager
def _prepared_once(run: tuple[str, int]) -> Iterator[None]:
    """Lets the pipeline take its early stages from before; what estimates does not change them."""

    def prepared(*given: Any) -> Prepared:
        if run not in _PREPARED:
            _PREPARED.clear()
            _PREPARED[run] = prepare(*given)
        return _PREPARED[run]

    with mock.patch("caliv_graph.pipeline.run.prepare", prepared):
        yield


def _given(recording: ThinnedRecording, seed: int) -> GivenPoses:
    """The true poses at all stamps, with errors in vehicle (rotation) and map (position) axes."""
    stamps = [stamp for name in recording.lidars for stamp in recording.scan_stamps_ns(name)]
    true = true_poses(recording.truth, stamps)
    rng = np.random.default_rng([seed, 17])
    seconds = 1e-9 * np.diff(true.stamps_ns, prepend=true.stamps_ns[0])
    error, poses = rng.standard_normal(6) * DRIFT, []
    for step_s, T in zip(seconds.tolist(), true.T_map_vehicle, strict=True):
        kept = float(np.exp(-step_s / DRIFT_TIME_S))
        error = kept * error + np.sqrt(1.0 - kept**2) * DRIFT * rng.standard_normal(6)
        off = error + WHITE * rng.standard_normal(6)
        R = T.rotation().compose(gtsam.Rot3.Expmap(off[:3]))
        poses.append(gtsam.Pose3(R, T.translation() + off[3:]))
    return GivenPoses(true.stamps_ns, tuple(poses))
