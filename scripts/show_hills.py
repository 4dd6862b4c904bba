"""How often a hill beside the path passes for a vehicle whose axes roll.

    .venv/bin/python scripts/show_hills.py

Round hills of 1 and 2 m, past which a vehicle that stands level on them drives in bends to both
sides. Of each the roll of its axes by `vehicle_tilt`, over the sigma: the truth is zero.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from collections.abc import Sequence
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY))  # imports the modules beside this script from any folder

import gtsam
import numpy as np

from caliv_graph.config.load import parse_config
from caliv_graph.products import Trajectory
from caliv_graph.trajectory.select import GivenTrajectory
from caliv_graph.trajectory.tilt import vehicle_tilt
from scripts._command import exit_code_of

ASIDE_M, WIDTH_M, HIGH_M = (5.0, 10.0, 15.0), (10.0, 15.0, 20.0), (1.0, 2.0)
BEND_S, PHASE_RAD, TURN_RAD = (15.0, 25.0, 40.0, 60.0), (0.0, math.pi / 2.0), (0.35, 0.6)

SECONDS, STEP_S, SPEED_M_S = 60.0, 0.1, 1.5


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.parse_args(arguments)
    raw = {
        "data": {"format": "caliv", "path": "."},
        "lidars": {"front": {"topic": "sensor_1"}},
        "reference": "front",
    }
    config = parse_config(raw, "config.yaml", REPOSITORY)
    told = []
    for hill in itertools.product(ASIDE_M, WIDTH_M, HIGH_M, BEND_S, PHASE_RAD, TURN_RAD):
        found = vehicle_tilt(beside_a_hill(*hill), "hill", config)
        told.append((found.roll_pitch_rad[0], found.sigma_rad[0]))
    roll, sigma = np.degrees(np.array(told)).T
    off = np.abs(roll / sigma)
    print(
        f"{len(off)} hills: roll {np.sqrt(np.mean(roll**2)):.2f} degrees (root mean square) at "
        f"{np.median(sigma):.2f} (median sigma); {(off > 3).sum()} at more than 3 sigma, "
        f"{(off > 5).sum()} at more than 5, the most {off.max():.1f}"
    )
    return 0


def beside_a_hill(
    aside_m: float,
    width_m: float,
    high_m: float,
    bend_s: float,
    phase_rad: float = 0.0,
    turn_rad: float = 0.35,
) -> GivenTrajectory:
    """Poses of a vehicle on a round hill (Gaussian, 1 sigma `width_m`), past its top."""
    t = np.arange(0.0, SECONDS, STEP_S)
    yaw = turn_rad * np.sin(2.0 * math.pi * t / bend_s + phase_rad)
    x, y = (np.cumsum(SPEED_M_S * STEP_S * of) for of in (np.cos(yaw), np.sin(yaw)))
    x, y = x - x.mean(), y - y.mean() - aside_m
    z = high_m * np.exp(-0.5 * (x**2 + y**2) / width_m**2)
    poses = []
    for psi, place in zip(yaw, np.stack([x, y, z], 1), strict=True):
        up = np.append(place[:2] * place[2] / width_m**2, 1.0)
        up /= np.linalg.norm(up)
        ahead = np.array([math.cos(psi), math.sin(psi), 0.0])
        ahead -= up * (up @ ahead)
        ahead /= np.linalg.norm(ahead)
        R = gtsam.Rot3(np.column_stack([ahead, np.cross(up, ahead), up]))
        poses.append(gtsam.Pose3(R, place))
    return GivenTrajectory(Trajectory(np.round(1e9 * t).astype(np.int64), tuple(poses)))


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
