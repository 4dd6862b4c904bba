"""Weights on the scenario `noisy`: outlying fixes, and points that are not on the chair.

Needs the environment that scripts/demo makes:

    .venv/bin/python scripts/benchmark_outliers.py --seeds 5

A fix is an outlier if it is more than six of its sigmas from the true antenna, in a jump or alone.
The simulation gives the object of each point of a cloud. A point has its cloud's robust weight.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy

import numpy as np
import pymap3d

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the modules beside this script from any folder

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.model import Config
from caliv_graph.pipeline import calibrate
from caliv_graph.products import Array, BoolArray, IntArray
from caliv_graph.scenario.model import load_scenario
from caliv_graph.trajectory.select import smooth_trajectories
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from scripts._command import add_beams, exit_code_of, positive
from scripts._tables_rows import config_for
from scripts._thinned import GroundWaves, ThinnedRecording, cached_selection

SCENARIO = REPOSITORY / "configs" / "scenarios" / "noisy.yaml"

OFF_SIGMAS = 6.0
"""Error in sigmas above which a fix is an outlier: probability 1e-8 of a sound fix."""

WALKED = 0.05
"""Fraction of a cloud's points on the walker from which on it counts as a cloud of the walker."""


@dataclass(frozen=True)
class Fixes:
    """Number of fixes of a kind, and the number of dropped ones."""

    jump: tuple[int, int]
    outlier: tuple[int, int]
    sound: tuple[int, int]


@dataclass(frozen=True)
class Clouds:
    """Weights of the clouds that were used.

    Attributes:
        count: all.
        walked: those with the walker in them.
        walked_weight: mean weight of these; NaN if there are none.
        walker_share: fraction of the total weight on the walker's points.
        chair_share: fraction of the total weight on the chair's points.
    """

    count: int
    walked: int
    walked_weight: float
    walker_share: float
    chair_share: float


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=positive, default=5, help="1 to N (default: 5)")
    add_beams(parser)
    asked = parser.parse_args(arguments)
    scenario = load_scenario(SCENARIO)
    selection = cached_selection(scenario, asked.beams)
    print("seed | fixes dropped: in the jump, outliers, sound | clouds, with the walker (weight)")
    print("     | part of all weight on the walker, on the chair")
    for seed in range(1, asked.seeds + 1):
        drive = ThinnedRecording(scenario, selection, seed, waves=GroundWaves())
        config = config_for(drive, {"solve": {"time_offset": True}})
        f, c = fixes_of(drive, config), clouds_of(drive, config)
        dropped = ", ".join(f"{lost} of {n}" for n, lost in (f.jump, f.outlier, f.sound))
        weight = f" ({c.walked_weight:.3f})" if c.walked else ""
        print(f"{seed:4d} | {dropped} | {c.count}, {c.walked}{weight}")
        print(f"     | {c.walker_share:.5f}, {c.chair_share:.5f}", flush=True)
    return 0


def fixes_of(drive: ThinnedRecording, config: Config) -> Fixes:
    """The fixes that the smoother drops."""
    model = drive.scenario.gnss
    fixes = drive.motion().gnss
    assert fixes is not None
    trajectory = smooth_trajectories([drive], config, [[]])[0]
    assert isinstance(trajectory, SmoothedTrajectory)
    dropped = np.isin(fixes.stamps_ns, trajectory.gnss_rejected)
    origin = (model.latitude_deg, model.longitude_deg, model.altitude_m)
    enu = pymap3d.geodetic2enu(fixes.latitude_deg, fixes.longitude_deg, fixes.altitude_m, *origin)
    arm = np.array(model.lever_arm)
    antenna = np.array([T.transformFrom(arm) for T in drive.truth.T_map_vehicle(fixes.stamps_ns)])
    sigmas = np.array([model.horizontal_sigma_m] * 2 + [model.vertical_sigma_m])
    off = np.linalg.norm((np.column_stack(enu) - antenna) / sigmas, axis=1) > OFF_SIGMAS
    seconds = 1e-9 * (fixes.stamps_ns - drive.truth.start_ns)
    jump = np.zeros(len(seconds), np.bool_)
    for j in model.jumps:
        jump |= (seconds >= j.start_s) & (seconds < j.start_s + j.duration_s)

    def counted(which: BoolArray) -> tuple[int, int]:
        return int(which.sum()), int((which & dropped).sum())

    return Fixes(counted(jump), counted(off & ~jump), counted(~off & ~jump))


def clouds_of(drive: ThinnedRecording, config: Config) -> Clouds:
    """Weights by the object of the points."""
    run = calibrate([drive], config, SilentProgress())
    names = drive.world.names
    walkers = np.array([names.index(name) for name in drive.scenario.world.walkers])
    chairs = np.array([names.index(name) for name in drive.scenario.world.targets])
    parts, weights = [], []
    for registration, robust in zip(
        run.solution.registrations, run.solution.cloud_weights, strict=True
    ):
        for cloud, weight in zip(registration.observation.clouds, robust, strict=True):
            objects = _objects(drive, cloud.lidar, cloud.stamp_ns, cloud.points_lidar)
            parts.append([np.isin(objects, walkers).mean(), np.isin(objects, chairs).mean()])
            weights.append(float(weight) * len(objects))
    part, carried = np.array(parts), np.array(weights)
    robust = np.concatenate(run.solution.cloud_weights)
    walked = part[:, 0] > WALKED
    shares: Array = carried @ part / carried.sum()
    return Clouds(
        count=len(part),
        walked=int(walked.sum()),
        walked_weight=float(robust[walked].mean()) if walked.any() else float("nan"),
        walker_share=float(shares[0]),
        chair_share=float(shares[1]),
    )


def _objects(drive: ThinnedRecording, lidar: str, stamp_ns: int, points_lidar: Array) -> IntArray:
    """(n,) object of each point of an extracted cloud."""
    (taken,) = drive.scans_with_truth(lidar, {stamp_ns})
    of = {p.tobytes(): k for p, k in zip(taken.scan.points_lidar, taken.objects, strict=True)}
    return np.array([of[p.tobytes()] for p in points_lidar], np.int64)


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
