"""The rows of benchmark_tables: how a simulated drive is calibrated in each."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.config.model import Config
from caliv_graph.conventions import AXES
from caliv_graph.pipeline import calibrate
from caliv_graph.products import (
    Array,
    Calibration,
    GivenPoses,
    GroundObservation,
    LidarResult,
    LidarScan,
    MotionData,
    Recording,
)
from caliv_graph.readers.forwarding import ForwardingRecording
from caliv_graph.results.run import CalibrationRun
from caliv_graph.simulation import SimulatedRecording, SimulatedTruth
from caliv_graph.simulation.recording import HEAVE_PERIOD_NS
from caliv_graph.simulation.writer import config_of
from caliv_graph.targets.ground.measure import GroundMeter
from caliv_graph.trajectory.select import smooth_trajectories
from caliv_graph.uncertainty.evaluation import evaluate
from caliv_graph.uncertainty.pairs import pair_determined, sensor_pairs, sigmas_s2s, sigmas_s2v

PERCENTILE = 10.0
"""Percentile k of the paper's filter."""

PARALLEL_SIGMA_DEG = 0.001
"""Sigma of the vehicle's tilt against the ground. The simulated vehicle is parallel to it."""

TRUE_POSES_NOISE = {
    "pose_position_m": 1e-4,
    "pose_rotation_deg": 1e-3,
    "pose_drift_position_m": 1e-4,
    "pose_drift_rotation_deg": 1e-3,
}
"""A negligible sigma, because a sigma cannot be zero."""

_NOWHERE = Path()
"""The folder of a config whose paths are not used."""

GROUND_AXES = ("roll", "pitch", "z")
"""Axes that the ground alone determines."""


@dataclass(frozen=True)
class Errors:
    """Errors of one extrinsic or pair; vehicle axes, in the order of `conventions.AXES`, rad and m.

    Attributes:
        error: (6,).
        sigma: (6,) stated sigmas; None: none stated.
        determined: per axis.
        nees: NEES of all six axes, priors included; None without a covariance.
    """

    error: tuple[float, ...]
    sigma: tuple[float, ...] | None
    determined: tuple[bool, ...]
    nees: float | None


@dataclass(frozen=True)
class Outcome:
    """Result of a row on one drive.

    Attributes:
        quantities: 'S2V front', 'S2S front to rear', ...
        status: of the calibration; empty if there is none.
        undetermined: directions, as they are named.
        seconds: CPU time per part, and in total ('total', with the simulation of the clouds).
    """

    quantities: Mapping[str, Errors]
    status: str
    undetermined: tuple[str, ...]
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class View(ForwardingRecording):
    """A recording with hidden parts, or with the true poses (products.Recording).

    Attributes:
        left: LiDARs that are visible.
        hidden: (lidar, stamp) of hidden clouds.
        poses: replace all other motion data; None: the motion data of the recording.
    """

    left: tuple[str, ...]
    hidden: frozenset[tuple[str, int]] = frozenset()
    poses: GivenPoses | None = None

    @property
    def lidars(self) -> tuple[str, ...]:
        return self.left

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        stamps = self.recording.scan_stamps_ns(lidar)
        return [stamp for stamp in stamps if (lidar, stamp) not in self.hidden]

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        left = self.scan_stamps_ns(lidar)
        return self.recording.scans(
            lidar, frozenset(s for s in left if wanted is None or s in wanted)
        )

    def motion(self) -> MotionData:
        if self.poses is None:
            return self.recording.motion()
        return MotionData(name=self.name, poses=self.poses)


def true_poses(truth: SimulatedTruth, stamps_ns: Sequence[int]) -> GivenPoses:
    """True poses of the vehicle at the clouds, heave included.

    The heave is constant within each of its periods. There is a pose at each stamp.
    """
    stamps = np.unique(np.asarray(stamps_ns, np.int64))
    heave_m = truth.heave_m[(stamps - truth.start_ns) // HEAVE_PERIOD_NS]
    poses = tuple(
        gtsam.Pose3(T.rotation(), T.translation() + np.array([0.0, 0.0, heave]))
        for T, heave in zip(truth.T_map_vehicle(stamps), heave_m, strict=True)
    )
    return GivenPoses(stamps, poses)


def config_for(
    recording: SimulatedRecording, changes: Mapping[str, Mapping[str, Any]], *, poses: bool = False
) -> Config:
    """The config that `simulate` writes, with changes.

    Args:
        recording: the drive.
        changes: keys to add to a section, or to replace.
        poses: whether the true poses replace IMU, GNSS and velocity.
    """
    raw = config_of(recording, has_bag=not poses)
    del raw["data"]
    if poses:
        raw["noise"] = {"lidar_range_m": raw["noise"]["lidar_range_m"], **TRUE_POSES_NOISE}
    for section, keys in changes.items():
        raw[section] = {**raw.get(section, {}), **keys}
    return parse_config(raw, recording.name, _NOWHERE)


def run_row(row: str, recording: SimulatedRecording, seed: int) -> Outcome:
    """Calibrates one drive as a row says, and compares with the truth.

    Raises:
        CalivError: there is no result.
    """
    begun = time.process_time()
    outcome = ROWS[row].run(recording, seed)
    return replace(outcome, seconds={**outcome.seconds, "total": time.process_time() - begun})


# ------------------------------------------------------------------ rows


@dataclass(frozen=True)
class Row:
    """A row of the tables.

    Attributes:
        text: its description.
        runs: default number of runs.
        run: function of the drive and its seed that makes one run.
        changes: changes of the config, on which a result depends.
    """

    text: str
    runs: int
    run: Callable[[SimulatedRecording, int], Outcome]
    changes: Mapping[str, Mapping[str, Any]]


def _calibrated(
    changes: Mapping[str, Mapping[str, Any]], text: str, runs: int = 20, *, poses: bool = False
) -> Row:
    def run(recording: SimulatedRecording, seed: int) -> Outcome:
        config = config_for(recording, _for_scenario(recording, changes), poses=poses)
        return _outcome(recording, calibrate([_seen(recording, poses)], config, SilentProgress()))

    return Row(text, runs, run, changes)


def _seen(recording: SimulatedRecording, poses: bool) -> Recording:
    if not poses:
        return recording
    stamps = [stamp for name in recording.lidars for stamp in recording.scan_stamps_ns(name)]
    return View(recording, recording.lidars, poses=true_poses(recording.truth, stamps))


def _for_scenario(
    recording: SimulatedRecording, changes: Mapping[str, Mapping[str, Any]]
) -> dict[str, Mapping[str, Any]]:
    """Estimates time offsets if the scenario has some, as a user of such a vehicle would."""
    out: dict[str, Mapping[str, Any]] = dict(changes)
    if any(recording.truth.time_offset_s.values()):
        out["solve"] = {"time_offset": True, **out.get("solve", {})}
    return out


def _outcome(recording: SimulatedRecording, run: CalibrationRun) -> Outcome:
    return compared(
        run.calibration,
        recording.truth.T_vehicle_lidar,
        run.solution.stage_times_s,
    )


def compared(
    calibration: Calibration, truth: Mapping[str, gtsam.Pose3], seconds: Mapping[str, float]
) -> Outcome:
    """Errors, sigmas and verdicts of a calibration."""
    found = evaluate(calibration, truth)
    quantities = {
        f"S2V {name}": Errors(
            _six(errors["s2v"]),
            tuple(sigmas_s2v(calibration, name).tolist()),
            tuple(calibration.lidars[name].determined[axis] for axis in AXES),
            errors["s2v"]["nees"],
        )
        for name, errors in found["lidars"].items()
    }
    for errors in found["pairs"]:
        a, b = errors["from"], errors["to"]
        determined = pair_determined(calibration, a, b)
        quantities[f"S2S {a} to {b}"] = Errors(
            _six(errors),
            tuple(sigmas_s2s(calibration, a, b).tolist()),
            tuple(determined[axis] for axis in AXES),
            errors["nees"],
        )
    texts = tuple(direction.text for direction in calibration.undetermined)
    return Outcome(quantities, calibration.status, texts, seconds)


def _six(errors: Mapping[str, Any]) -> tuple[float, ...]:
    return tuple(float(v) for v in (*errors["rotation_rad"], *errors["translation_m"]))


def _one_by_one(recording: SimulatedRecording, seed: int) -> Outcome:
    """The paper's S2V stage for each LiDAR by itself; S2S follows from the two results."""
    config = config_for(recording, _for_scenario(recording, _STAGED))
    lidars: dict[str, LidarResult] = {}
    for name in recording.lidars:
        alone = config.model_copy(update={"lidars": {name: config.lidars[name]}, "reference": name})
        run = calibrate([View(recording, (name,))], alone, SilentProgress())
        lidars[name] = run.calibration.lidars[name]
    size = 6 * len(lidars)
    cov = np.zeros((size, size))
    for i, result in enumerate(lidars.values()):
        cov[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = result.cov
    outcome = compared(
        _calibration(lidars, cov, config.reference), recording.truth.T_vehicle_lidar, {}
    )
    # An axis of the difference is determined only if both LiDARs determine it.
    for name in outcome.quantities:
        if name.startswith("S2S"):
            a, b = name.removeprefix("S2S ").split(" to ")
            determined = tuple(lidars[a].determined[x] and lidars[b].determined[x] for x in AXES)
            errors = replace(outcome.quantities[name], determined=determined)
            outcome = replace(outcome, quantities={**outcome.quantities, name: errors})
    return outcome


def _calibration(lidars: Mapping[str, LidarResult], cov: Array, reference: str) -> Calibration:
    return Calibration(
        status="",
        reference=reference,
        lidars=lidars,
        cov_joint=cov,
        information_data=np.zeros_like(cov),
        undetermined=(),
        weak=(),
        unmet=(),
        provenance={},
    )


def _ground_alone(recording: SimulatedRecording, seed: int) -> Outcome:
    """Roll, pitch and z from the ground under a vehicle that stands parallel to it.

    SensorX2Car and Multi-LiCa do the same. All scans of the drive are used. Yaw, x and y stay at
    the guess.
    """
    config = config_for(recording, _PARALLEL)
    # The poses are only needed for the vertical direction, to 10 degrees.
    trajectory = smooth_trajectories([recording], config, [[]])[0]
    begin, end = trajectory.span_ns
    poses: dict[str, gtsam.Pose3] = {}
    own: dict[str, Array] = {}
    for name in recording.lidars:
        meter = GroundMeter(config, trajectory, 0)
        planes = [
            plane
            for scan in recording.scans(name)
            if begin <= scan.stamp_ns <= end and (plane := meter.measure(scan)) is not None
        ]
        guess = config.lidars[name].guess()
        poses[name], own[name] = stood_on(planes, guess, config.ground.vehicle_height or 0.0)
    lidars = {
        name: LidarResult(T, np.full((6, 6), math.nan), dict.fromkeys(AXES, False), 0, False)
        for name, T in poses.items()
    }
    size = 6 * len(lidars)
    nowhere = np.full((size, size), math.nan)
    calibration = _calibration(lidars, nowhere, config.reference)
    found = compared(calibration, recording.truth.T_vehicle_lidar, {})
    determined = tuple(axis in GROUND_AXES for axis in AXES)
    common = np.array([math.radians(PARALLEL_SIGMA_DEG)] * 2 + [config.ground.sigma])
    quantities = {}
    for name in poses:
        sigma = np.hypot(common, own[name])
        quantities[f"S2V {name}"] = (sigma, found.quantities[f"S2V {name}"])
    for a, b in sensor_pairs(poses, config.reference):
        sigma = np.hypot(own[a], own[b])
        quantities[f"S2S {a} to {b}"] = (sigma, found.quantities[f"S2S {a} to {b}"])
    stated = {
        name: replace(errors, sigma=_on_ground_axes(sigma), determined=determined, nees=None)
        for name, (sigma, errors) in quantities.items()
    }
    return Outcome(stated, "", ("x, y and yaw: the ground does not tell them",), {})


def _on_ground_axes(sigma: Array) -> tuple[float, ...]:
    out = dict.fromkeys(AXES, math.inf) | dict(zip(GROUND_AXES, sigma.tolist(), strict=True))
    return tuple(out[axis] for axis in AXES)


def stood_on(
    planes: Sequence[GroundObservation], guess: gtsam.Pose3, vehicle_height_m: float
) -> tuple[gtsam.Pose3, Array]:
    """An extrinsic with the roll, pitch and z at which the vehicle stands on the ground.

    Args:
        planes: ground planes of one LiDAR.
        guess: T_vehicle_lidar, whose x, y and yaw are kept.
        vehicle_height_m: of the vehicle frame above the ground.

    Returns:
        T_vehicle_lidar, and (3,) the standard errors of roll, pitch and z, of the mean over the
        scans.
    """
    normals = np.array([plane.normal_lidar for plane in planes])
    distances = np.array([plane.distance_m for plane in planes])
    up_lidar = normals.mean(axis=0)
    up_lidar /= np.linalg.norm(up_lidar)
    # The smallest rotation that makes the mean normal vertical does not change the heading.
    up = guess.rotation().rotate(up_lidar)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    length = float(np.linalg.norm(axis))
    turn = gtsam.Rot3.Expmap(axis / max(length, 1e-12) * math.atan2(length, up[2]))
    rotation = turn.compose(guess.rotation())
    x, y, _ = guess.translation()
    z = float(distances.mean()) - vehicle_height_m
    turned = normals @ rotation.matrix().T
    scatter = np.array([turned[:, 1].std(), turned[:, 0].std(), distances.std()])
    T_vehicle_lidar = gtsam.Pose3(rotation, np.array([x, y, z]))
    return T_vehicle_lidar, scatter / math.sqrt(len(planes))


def _percentile(recording: SimulatedRecording, seed: int) -> Outcome:
    """Without a robust kernel, then again without the clouds that the paper's filter drops.

    It drops the errors below the k-th and above the (100 - k)-th percentile. Here these are the
    errors of the clouds, because the graph has no pairwise errors.
    """
    config = config_for(recording, _for_scenario(recording, _NO_KERNEL))
    first = calibrate([recording], config, SilentProgress())
    hidden: set[tuple[str, int]] = set()
    errors = [np.linalg.norm(r, axis=1) for r in first.solution.residuals]
    low, high = np.percentile(np.concatenate(errors), [PERCENTILE, 100.0 - PERCENTILE])
    for registration, error in zip(first.solution.registrations, errors, strict=True):
        for cloud, size in zip(registration.observation.clouds, error.tolist(), strict=True):
            if not low <= size <= high:
                hidden.add((cloud.lidar, cloud.stamp_ns))
    # Only these clouds again; otherwise other clouds would replace the dropped ones.
    used = {
        (cloud.lidar, cloud.stamp_ns)
        for registration in first.solution.registrations
        for cloud in registration.observation.clouds
    }
    left = _OnlyTargets(recording, recording.lidars, frozenset(hidden), used=frozenset(used))
    return _outcome(recording, calibrate([left], config, SilentProgress()))


@dataclass(frozen=True)
class _OnlyTargets(View):
    """A view in which only some clouds keep all points; the others keep only the ground.

    Attributes:
        used: (lidar, stamp) of the clouds that are used.
    """

    used: frozenset[tuple[str, int]] = frozenset()

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        return self.recording.scan_stamps_ns(lidar)

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        assert isinstance(self.recording, SimulatedRecording)
        ground = self.recording.world.names.index("ground")
        for taken in self.recording.scans_with_truth(lidar, wanted):
            scan = taken.scan
            key = (lidar, scan.stamp_ns)
            if key in self.hidden or key not in self.used:
                below = taken.objects == ground
                times = scan.point_times_s
                scan = replace(
                    scan,
                    points_lidar=scan.points_lidar[below],
                    point_times_s=None if times is None else times[below],
                )
            yield scan


def _paper(recording: SimulatedRecording, seed: int) -> Outcome:
    """The paper's own estimator, reimplemented. It states no sigma and fixes every translation."""
    from scripts._paper import paper_from_recording

    config = config_for(recording, {})
    result = paper_from_recording(recording, config, seed)
    lidars = {
        name: LidarResult(T, np.full((6, 6), math.nan), dict.fromkeys(AXES, True), 0, True)
        for name, T in result.T_vehicle_lidar.items()
    }
    size = 6 * len(lidars)
    calibration = _calibration(lidars, np.full((size, size), math.nan), config.reference)
    outcome = compared(calibration, recording.truth.T_vehicle_lidar, result.seconds)
    quantities = {
        name: replace(
            errors,
            sigma=None,
            determined=tuple(not (name.startswith("S2V") and axis in "xyz") for axis in AXES),
        )
        for name, errors in outcome.quantities.items()
    }
    return replace(outcome, quantities=quantities)


_STAGED = {"solve": {"mode": "staged"}}
_PARALLEL = {"ground": {"parallel_sigma_deg": PARALLEL_SIGMA_DEG}}
_NO_KERNEL = {"robust": {"kernel": "none"}}

ROWS: Mapping[str, Row] = {
    "auto": _calibrated({}, "auto", 100),
    "auto_true": _calibrated({}, "auto, true poses", poses=True),
    "staged": _calibrated(_STAGED, "staged, as the paper"),
    "staged_true": _calibrated(_STAGED, "staged, true poses (Table III)", poses=True),
    "staged_no_s2s": Row("staged, without the S2S stage first", 20, _one_by_one, _STAGED),
    "auto_parallel": _calibrated(_PARALLEL, "auto, ground in role (c) as well"),
    "ground": Row("ground alone, in role (c)", 20, _ground_alone, _PARALLEL),
    "paper": Row("the paper's estimator, written anew", 3, _paper, {}),
    "tls": _calibrated({"robust": {"kernel": "tls"}}, "auto, kernel tls"),
    "trimmed": _calibrated({"robust": {"kernel": "trimmed"}}, "auto, kernel trimmed"),
    "none": _calibrated(_NO_KERNEL, "auto, no kernel"),
    "percentile": Row("auto, the paper's percentile filter", 20, _percentile, _NO_KERNEL),
}
"""Rows by name, in the order in which they run and are printed."""

_TABLES = ("auto", "auto_true", "staged", "staged_true", "staged_no_s2s", "auto_parallel", "ground")

ROWS_OF: Mapping[str, tuple[str, ...]] = {
    "paper_arc": (*_TABLES, "paper"),
    "s_curve": _TABLES,
    "figure_eight": _TABLES,
    "tri_lidar": _TABLES,
    "noisy": ("auto", "tls", "trimmed", "none", "percentile"),
}
"""Default rows of each scenario."""

RUNS_OF: Mapping[tuple[str, str], int] = {("noisy", "auto"): 20}
"""Numbers of runs of a scenario that differ from those of the row."""
