"""Smoothed trajectories of random drives whose motion data have a fault, against the truth.

    .venv/bin/python scripts/benchmark_motion_faults.py --first 260 --seeds 8
    .venv/bin/python scripts/benchmark_motion_faults.py --first 260 --seeds 8 --faults late_100ms

The drives are those of `benchmark_foreign.py --scenarios random`, with beams too few to calibrate:
it takes seconds per drive. Those without an IMU, speeds or fixes are left out. Each is smoothed as
the calibration does first (`alone`), and again with fixes that err slowly, by 25 mm over 24 s, as
where LiDARs leave that open (`slow`). A row has the mean error of roll, pitch and yaw over the
drive (mrad) with the sigma of a pose, that of x and y of the vehicle (mm, less the mean in the
map), the estimated scale of the speeds' and the gyroscope's stated noise, and what was said.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the modules beside this script from any folder

import numpy as np
from scipy.spatial.transform import Rotation

from caliv_graph._open3d import import_open3d
from caliv_graph.batch.job import open_recordings
from caliv_graph.config.load import load_config
from caliv_graph.config.model import Config
from caliv_graph.errors import CalivError
from caliv_graph.products import Array, BoolArray, IntArray, MotionData
from caliv_graph.readers.even_stamps import even_stamps
from caliv_graph.trajectory.correlated import CorrelatedError
from caliv_graph.trajectory.smooth import smooth_trajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from scripts._command import exit_code_of, positive
from scripts._foreign_bag import BEGIN_S
from scripts._foreign_draws import Draws
from scripts._foreign_drives import Scenario, make_drive, simulate
from scripts._foreign_random import random_scenario
from scripts._foreign_vehicle import Motion

SLOW = CorrelatedError(kind="gnss", sigmas=(0.025, 0.025, 0.025), time_s=24.0)

SLIP_S, JUMP_S, FILTER_S, BURST = 1.5, 4.0, 0.2, 20

Fault = Callable[[MotionData], MotionData]


def _after_half(stamps_ns: IntArray, seconds: float) -> BoolArray:
    at_s = (stamps_ns - stamps_ns[0]) * 1e-9
    half_s = at_s[-1] / 2.0
    return np.asarray((at_s >= half_s) & (at_s < half_s + seconds))


def _wheels(change: Callable[[Array], Array]) -> Fault:
    """Other forward speeds for `SLIP_S`, from the middle of the drive on."""

    def fault(motion: MotionData) -> MotionData:
        assert motion.twist is not None
        velocity = motion.twist.velocity.copy()
        slips = _after_half(motion.twist.stamps_ns, SLIP_S)
        velocity[slips, 0] = change(velocity[slips, 0])
        return replace(motion, twist=replace(motion.twist, velocity=velocity))

    return fault


def _everywhere(change: Callable[[Array, Array], Array]) -> Fault:
    """Other forward speeds all along, by their times in seconds."""

    def fault(motion: MotionData) -> MotionData:
        assert motion.twist is not None
        velocity = motion.twist.velocity.copy()
        at_s = (motion.twist.stamps_ns - motion.twist.stamps_ns[0]) * 1e-9
        velocity[:, 0] = change(at_s, velocity[:, 0])
        return replace(motion, twist=replace(motion.twist, velocity=velocity))

    return fault


def _filtered(at_s: Array, speed: Array) -> Array:
    """A low pass of `FILTER_S`."""
    out = speed.copy()
    share = 1.0 - np.exp(-np.diff(at_s) / FILTER_S)
    for k in range(1, len(out)):
        out[k] = out[k - 1] + share[k - 1] * (speed[k] - out[k - 1])
    return out


def _late(seconds: float) -> Fault:
    def fault(motion: MotionData) -> MotionData:
        assert motion.twist is not None
        stamps_ns = motion.twist.stamps_ns + round(1e9 * seconds)
        return replace(motion, twist=replace(motion.twist, stamps_ns=stamps_ns))

    return fault


def _in_bursts(mended: bool) -> Fault:
    """Samples of the IMU stamped as they arrive, `BURST` at a time; `mended` as a bag is read."""

    def fault(motion: MotionData) -> MotionData:
        assert motion.imu is not None
        taken_ns = motion.imu.stamps_ns
        n = len(taken_ns)
        last = np.minimum((np.arange(n) // BURST + 1) * BURST, n) - 1
        arrived_ns = taken_ns[last] + 20_000 * (np.arange(n) % BURST)
        even = even_stamps(arrived_ns) if mended else None
        stamps_ns = arrived_ns if even is None else even.stamps_ns
        return replace(motion, imu=replace(motion.imu, stamps_ns=stamps_ns))

    return fault


def _jump(motion: MotionData) -> MotionData:
    assert motion.gnss is not None
    latitude = np.array(motion.gnss.latitude_deg, float)
    latitude[_after_half(motion.gnss.stamps_ns, JUMP_S)] += 0.3 / 111e3
    return replace(motion, gnss=replace(motion.gnss, latitude_deg=latitude))


FAULTS: Mapping[str, Fault] = {
    "none": lambda motion: motion,
    "spin": _wheels(lambda speed: speed + 0.5),
    "lock": _wheels(lambda speed: 0.5 * speed),
    "late_30ms": _late(0.03),
    "late_100ms": _late(0.1),
    "late_300ms": _late(0.3),
    "dead_zone": _everywhere(lambda _, speed: np.where(np.abs(speed) < 0.4, 0.0, speed)),
    "coarse": _everywhere(lambda _, speed: 0.1 * np.round(10.0 * speed)),
    "filtered": _everywhere(_filtered),
    "fixes_jump": _jump,
    "bursts": _in_bursts(mended=True),
    "bursts_raw": _in_bursts(mended=False),
}
"""Name -> what is made of the motion data: wheels that spin by 0.5 m/s or half lock for 1.5 s;
speeds that are stamped late, read zero below 0.4 m/s, have steps of 0.1 m/s, or went through a low
pass of 0.2 s; fixes that are 0.3 m beside for 4 s; an IMU whose messages are stamped as they
arrive, 20 at once, with stamps as a bag is read and as they came."""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").splitlines()[0],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--seeds", type=positive, default=8, help="how many (default: 8)")
    parser.add_argument("--first", type=positive, default=260, help="first seed (default: 260)")
    parser.add_argument(
        "--faults", nargs="+", choices=list(FAULTS), default=list(FAULTS), metavar="FAULT"
    )
    asked = parser.parse_args(arguments)
    import_open3d()  # with its shared libraries, for the simulator as well
    worst: dict[str, list[float]] = {fault: [] for fault in asked.faults}
    for seed in range(asked.first, asked.first + asked.seeds):
        for fault, sigmas in _of_drive(seed, asked.faults):
            worst[fault].append(sigmas)
    for fault, found in worst.items():
        if found:
            beyond = sum(s > 3.0 for s in found)
            print(f"{fault}: worst {max(found):.1f} sigmas, {beyond} of {len(found)} beyond 3")
    return 0


def _of_drive(seed: int, faults: Sequence[str]) -> list[tuple[str, float]]:
    """Prints the rows of a drive; the worst error over its sigma of each."""
    scenario = _without_clouds(random_scenario(seed))
    if scenario.imu is None or scenario.gnss is None or not scenario.wheels:
        return []
    draws, out = Draws("random", seed, frozenset()), []
    with TemporaryDirectory() as made:
        folder = Path(made) / "random"
        simulate(scenario, draws, folder)
        config = load_config(folder / "config.yaml")
        motion = open_recordings(config, ())[0].motion()
        shutil.rmtree(folder / "drive")
    truth = make_drive(draws, scenario).motion
    oriented = "orientation" if scenario.imu.orientation else "no orientation"
    print(f"random, seed {seed} ({oriented})", flush=True)
    for fault in faults:
        try:
            rows = _rows(FAULTS[fault](motion), config, truth, np.array(scenario.base_m))
        except CalivError as error:
            print(f"  {fault:12} refused: {error.what}", flush=True)
            continue
        for how, (text, sigmas) in rows.items():
            print(f"  {fault:12} {how:6} {text}", flush=True)
            out.append((fault, sigmas))
    return out


def _without_clouds(scenario: Scenario) -> Scenario:
    few = {
        name: replace(lidar, kind="spinning", channels=16, columns=4, fov_deg=(-15.0, 15.0))
        for name, lidar in scenario.lidars.items()
    }
    return replace(scenario, lidars=few)


def _rows(
    motion: MotionData, config: Config, truth: Motion, base_m: Array
) -> dict[str, tuple[str, float]]:
    """How it was smoothed -> text, and the worst error over its sigma."""
    begin, end = (round(1e9 * (BEGIN_S + t)) for t in (truth.t[0] + 1.0, truth.t[-1] - 1.0))
    stamps = np.arange(begin, end, 100_000_000, dtype=np.int64)
    alone = smooth_trajectory(motion, config, stamps)
    slow = smooth_trajectory(motion, config, stamps, [SLOW], None, alone)
    return {"alone": _row(alone, truth, base_m), "slow": _row(slow, truth, base_m)}


def _row(found: SmoothedTrajectory, truth: Motion, base_m: Array) -> tuple[str, float]:
    stamps = found.trajectory.stamps_ns
    R, t = found.poses_at(stamps)
    R_true, t_true = truth.pose(np.asarray(1e-9 * stamps - BEGIN_S, np.float64))
    turned = Rotation.from_matrix(np.swapaxes(R_true, 1, 2) @ R).as_rotvec().mean(axis=0)
    off = t - t_true - R_true @ base_m
    aside = np.einsum("nji,nj->ni", R_true, off - off.mean(axis=0)).mean(axis=0)
    sigmas = found.pose_sigmas[:3]
    angles = " ".join(
        f"{axis} {1e3 * value:.1f} ± {1e3 * sigma:.1f}"
        for axis, value, sigma in zip(("roll", "pitch", "yaw"), turned, sigmas, strict=True)
    )
    scales = found.data.scales
    said = "; ".join(
        w.partition(": ")[2] for w in found.warnings if "velocit" in w or "speeds" in w
    )
    text = (
        f"{angles}, x {1e3 * aside[0]:.0f} y {1e3 * aside[1]:.0f} mm, "
        f"speeds {scales.get('speed', 1.0):.2f}, gyroscope {scales.get('gyroscope', 1.0):.1f}"
    )
    return f"{text}. {said}" if said else text, float(np.max(np.abs(turned) / sigmas))


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
