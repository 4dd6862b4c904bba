"""Drives of the localiser example: simulation, runs, measures and cached results."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from caliv_graph.common.files import atomic_write
from caliv_graph.config.mounting import PoseConfig
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.geometry.se3 import (
    retract_vehicle_axes,
    rpy,
    vehicle_axes_difference,
)
from caliv_graph.products import Array, Calibration, LidarScan, MotionData
from caliv_graph.results.calibration_file import read_calibration
from caliv_graph.scenario.drive_models import StandstillDrive
from caliv_graph.scenario.model import Scenario, dump_scenario
from caliv_graph.scenario.world import World
from caliv_graph.simulation.recording import SimulatedRecording, SimulatedTruth, simulate_drive
from scripts import _localiser
from scripts._localiser import Extrinsics, Localiser, Track, make_map

KEYFRAME_S = 0.5
"""Time between keyframes. The LiDARs alternate, because simultaneous scans share the heave."""

SEED_OF_DRIVES = 10_000
"""Added to the seeds, so that no drive shares its noise with a calibrated drive."""

VARIANTS = {
    "initial": "initial guess, constants",
    "calibrated": "calibrated, constants",
    "priors": "calibrated, priors refined on line",
}

Run = dict[str, Any]
"""Result of one localiser on one drive, plain values only."""


class KnockedRecording:
    """A drive with a mount that is knocked; everything else, noise included, is unchanged.

    Attributes:
        before: the drive with the mount as it is before the knock.
        after: the same drive with the mount as it is after the knock.
        knock_ns: stamp of the knock.
    """

    def __init__(
        self, scenario: Scenario, seed: int, lidar: str, turn_rad: Array, after_s: float
    ) -> None:
        """Simulates both halves.

        Args:
            scenario: the drive.
            seed: seed of all draws.
            lidar: LiDAR whose mount is knocked.
            turn_rad: (3,) rotation vector about the LiDAR's own origin, vehicle axes.
            after_s: seconds since the start of the drive.
        """
        self.before = simulate_drive(scenario, seed)
        self.knock_ns = self.before.truth.start_ns + round(after_s * NANOSECONDS_PER_SECOND)
        mount = self.before.truth.T_vehicle_lidar[lidar]
        moved = retract_vehicle_axes(mount, np.concatenate([turn_rad, np.zeros(3)]))
        x, y, z = (float(v) for v in moved.translation())
        roll, pitch, yaw = (float(v) for v in np.degrees(rpy(moved.rotation().matrix())))
        model = scenario.lidars[lidar].model_copy(
            update={"mounting": PoseConfig(xyz=(x, y, z), rpy_deg=(roll, pitch, yaw))}
        )
        knocked = scenario.model_copy(update={"lidars": {**scenario.lidars, lidar: model}})
        self.after = simulate_drive(knocked, seed)

    @property
    def truth(self) -> SimulatedTruth:
        """Truth before the knock. The vehicle's poses are true for the whole drive."""
        return self.before.truth

    @property
    def world(self) -> World:
        """The world around the drive."""
        return self.before.world

    def motion(self) -> MotionData:
        """IMU, GNSS and velocity."""
        return self.before.motion()

    def scan_stamps_ns(self, lidar: str) -> Sequence[int]:
        """Stamps of the clouds of one LiDAR, ascending."""
        return self.before.scan_stamps_ns(lidar)

    def scans(self, lidar: str, wanted: Container[int] | None = None) -> Iterator[LidarScan]:
        """The clouds of one LiDAR in order of their stamps."""
        stamps = [s for s in self.scan_stamps_ns(lidar) if wanted is None or s in wanted]
        before = {s for s in stamps if s < self.knock_ns}
        yield from self.before.scans(lidar, before)
        yield from self.after.scans(lidar, set(stamps) - before)


@dataclass(frozen=True)
class Task:
    """The runs of a seed.

    Attributes:
        scenario: the drive.
        calibration: file of a calibration of the vehicle, from any drives.
        knock_deg: rotation of the knocked mount; 0: no drive with a knock.
        draw: whether the errors of the calibration are drawn from its covariance, or stay its own.
    """

    scenario: Scenario
    calibration: Path
    knock_deg: float
    draw: bool

    def digest(self) -> str:
        """Digest of everything that the result depends on, except this project's estimator."""
        text = hashlib.sha256(dump_scenario(self.scenario).encode())
        text.update(self.calibration.read_bytes())
        text.update(repr((self.knock_deg, self.draw)).encode())
        monitor = Path(_localiser.__file__).parents[1] / "caliv_graph" / "fusion" / "monitor.py"
        for source in (Path(__file__), Path(_localiser.__file__), monitor):
            text.update(source.read_bytes())
        return text.hexdigest()[:16]


def cached_runs(task: Task, seed: int, folder: Path) -> dict[str, Run]:
    """The runs of a seed: cached in `folder`, or made now."""
    path = folder / f"seed-{seed}-{task.digest()}.json"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, json.dumps(runs(task, seed)))
    found: dict[str, Run] = json.loads(path.read_text(encoding="utf-8"))
    return found


def runs(task: Task, seed: int) -> dict[str, Run]:
    """All localisers on the drive of a seed, and the last one with a knocked mount."""
    recording = simulate_drive(task.scenario, SEED_OF_DRIVES + seed)
    calibration = read_calibration(task.calibration)
    if task.draw:
        calibration = drawn(calibration, recording.truth.T_vehicle_lidar, seed)
    extrinsics: dict[str, Extrinsics] = {
        "initial": {n: guess.pose() for n, guess in recording.guesses.items()},
        "calibrated": {n: r.T_vehicle_lidar for n, r in calibration.lidars.items()},
        "priors": calibration,
    }
    out = {name: one_run(recording, task.scenario, m) for name, m in extrinsics.items()}
    if task.knock_deg > 0.0:
        out["knocked"] = knocked_run(task, seed, calibration)
    return out


def knocked_run(task: Task, seed: int, calibration: Calibration) -> Run:
    """The localiser with priors on a drive with one mount rotated about a random axis."""
    names = list(task.scenario.lidars)
    lidar = names[seed % len(names)]
    axis = np.random.default_rng([seed, 1]).normal(size=3)
    turn = np.radians(task.knock_deg) * axis / np.linalg.norm(axis)
    truth = simulate_drive(task.scenario, SEED_OF_DRIVES + seed).truth
    half_s = 0.5 * (truth.end_ns - truth.start_ns) / NANOSECONDS_PER_SECOND
    recording = KnockedRecording(task.scenario, SEED_OF_DRIVES + seed, lidar, turn, half_s)
    run = one_run(recording, task.scenario, calibration)
    return {**run, "knocked": lidar, "turn": turn.tolist(), "knock_s": half_s}


def drawn(calibration: Calibration, truth: Mapping[str, gtsam.Pose3], seed: int) -> Calibration:
    """A calibration with errors drawn from this one's covariance about the truth."""
    values, vectors = np.linalg.eigh(calibration.cov_joint)
    normal = np.random.default_rng([seed, 0]).normal(size=len(values))
    error = vectors @ (np.sqrt(np.maximum(values, 0.0)) * normal)
    return replace(
        calibration,
        lidars={
            name: replace(result, T_vehicle_lidar=truth[name].retract(error[6 * i : 6 * i + 6]))
            for i, (name, result) in enumerate(calibration.lidars.items())
        },
    )


def one_run(
    recording: SimulatedRecording | KnockedRecording, scenario: Scenario, extrinsics: Extrinsics
) -> Run:
    """A localiser on a drive."""
    truth = recording.truth
    drive = scenario.drive
    standing_s = drive.duration_s if isinstance(drive, StandstillDrive) else drive.standstill_s
    first_ns = truth.start_ns + round(standing_s * NANOSECONDS_PER_SECOND)
    localiser = Localiser(
        recording.motion(),
        scenario,
        truth.datum,
        make_map(recording.world),
        extrinsics,
        first_ns,
        1.0 / KEYFRAME_S,
    )
    for scan in keyframes(recording, list(scenario.lidars), first_ns):
        localiser.step(scan)
    return measured(localiser.track, truth)


def keyframes(
    recording: SimulatedRecording | KnockedRecording, names: Sequence[str], first_ns: int
) -> list[LidarScan]:
    """A scan every `KEYFRAME_S`, of one LiDAR after the other."""
    step_ns = round(KEYFRAME_S * NANOSECONDS_PER_SECOND)
    out: list[LidarScan] = []
    for i, name in enumerate(names):
        wanted = {
            s
            for s in recording.scan_stamps_ns(name)
            if s > first_ns
            and (s - first_ns) % step_ns == 0
            and (s - first_ns) // step_ns % len(names) == i
        }
        out.extend(recording.scans(name, wanted))
    return sorted(out, key=lambda scan: scan.stamp_ns)


def measured(track: Track, truth: SimulatedTruth) -> Run:
    """Errors and consistency of a track against the truth."""
    true = truth.T_map_vehicle(np.array(track.stamps_ns))
    errors = np.array(
        [vehicle_axes_difference(a, b) for a, b in zip(track.T_map_vehicle, true, strict=True)]
    )
    local = np.array(
        [gtsam.Pose3.Logmap(a.between(b)) for a, b in zip(track.T_map_vehicle, true, strict=True)]
    )
    cov = np.array(track.cov)
    return {
        "time_s": [(s - truth.start_ns) / NANOSECONDS_PER_SECOND for s in track.stamps_ns],
        "position_m": np.linalg.norm(errors[:, 3:], axis=1).tolist(),
        "heading_rad": errors[:, 2].tolist(),
        "nees": _nees(local, cov, slice(None)),
        "nees_position": _nees(local, cov, slice(3, 6)),
        "nees_heading": _nees(local, cov, slice(2, 3)),
        "nees_registration": _registration_nees(track, truth),
        "innovations": track.innovations,
        "left_out": track.left_out,
        "alarms": [
            {
                "lidar": alarm.lidar,
                "time_s": (alarm.stamp_ns - truth.start_ns) / NANOSECONDS_PER_SECOND,
                "movement": alarm.movement.tolist(),
                "sigma": alarm.sigma.tolist(),
                "scans": alarm.scans,
                "chi2": alarm.chi2,
                "alone": alarm.alone,
            }
            for alarm in track.alarms
        ],
    }


def _nees(errors: Array, cov: Array, axes: slice) -> list[float]:
    """Normalised estimation error squared of some axes, not yet divided by their number."""
    e, P = errors[:, axes], cov[:, axes, axes]
    return [float(v) for v in np.einsum("ni,ni->n", e, np.linalg.solve(P, e[..., None])[..., 0])]


def _registration_nees(track: Track, truth: SimulatedTruth) -> list[float]:
    """NEES of the registrations against the true LiDAR poses, without a knocked mount."""
    out = []
    for name, stamp_ns, found in track.registered:
        (pose,) = truth.T_map_vehicle(np.array([stamp_ns]))
        heave_m = truth.heave_m[(stamp_ns - truth.start_ns) // (NANOSECONDS_PER_SECOND // 10)]
        lifted = gtsam.Pose3(pose.rotation(), pose.translation() + np.array([0.0, 0.0, heave_m]))
        d = gtsam.Pose3.Logmap(
            found.T_map_lidar.between(lifted.compose(truth.T_vehicle_lidar[name]))
        )
        out.append(float(d @ np.linalg.solve(found.cov, d)))
    return out
