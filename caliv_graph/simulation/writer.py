"""Writing a simulated drive: a CaLiV folder, the truth, and a config that is ready to run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import yaml

from caliv_graph.config import Mounting, parse_config
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.products import Array, IntArray
from caliv_graph.simulation.scenario import Scenario, dump_scenario
from caliv_graph.simulation.worlds import World

CALIV_FOLDER = "caliv"
"""Name of the CaLiV folder in the folder of a simulated drive."""

UNIFORM_TO_SIGMA = 1.0 / math.sqrt(3.0)
"""Standard deviation of a uniform draw from -1 to 1."""


def write_pcd(path: Path, points: Array) -> None:
    """Writes a cloud as binary PCD v0.7 with fields x y z, float32.

    Args:
        path: the file.
        points: (n, 3) metres, every value finite.
    """
    n = len(points)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\n"
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    )
    path.write_bytes(header.encode() + np.ascontiguousarray(points, dtype="<f4").tobytes())


def _quaternion_xyzw(rotation: gtsam.Rot3) -> tuple[float, float, float, float]:
    q: Any = rotation.toQuaternion()
    return (q.x(), q.y(), q.z(), q.w())


def _pose_values(pose: gtsam.Pose3) -> list[str]:
    """The numbers x y z qx qy qz qw, to a picometre and a picoradian.

    Never in Python's own form: 1e-05 is a string to YAML 1.1.
    """
    return [f"{v:.12f}" for v in (*pose.translation(), *_quaternion_xyzw(pose.rotation()))]


def write_ego_poses(path: Path, poses: Mapping[str, Sequence[tuple[int, gtsam.Pose3]]]) -> None:
    """Writes `ego_poses.yaml` of a CaLiV folder.

    Args:
        path: the file.
        poses: per sensor (`sensor_1`, ...) its frame numbers with T_map_vehicle.
    """
    lines = []
    for sensor, entries in poses.items():
        lines.append(f"{sensor}:" if entries else f"{sensor}: []")
        for frame, pose in entries:
            lines.append(f"- [{frame}.pcd, [{', '.join(_pose_values(pose))}]]")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_tum(path: Path, stamps_ns: IntArray, T_map_vehicle: Sequence[gtsam.Pose3]) -> None:
    """Writes a trajectory in the TUM format: stamp in seconds, x y z qx qy qz qw."""
    lines = []
    for stamp_ns, pose in zip(stamps_ns.tolist(), T_map_vehicle, strict=True):
        seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS_PER_SECOND)
        lines.append(f"{seconds}.{nanoseconds:09d} {' '.join(_pose_values(pose))}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def sensor_folders(scenario: Scenario) -> tuple[str, ...]:
    """Folder of each LiDAR in a CaLiV folder, in the scenario's order: sensor_1, sensor_2, ..."""
    return tuple(f"sensor_{number}" for number in range(1, len(scenario.lidars) + 1))


def truth_of(
    T_vehicle_lidar: Mapping[str, gtsam.Pose3], time_offset_s: Mapping[str, float]
) -> dict[str, Any]:
    """The content of `truth.yaml`.

    Args:
        T_vehicle_lidar: true mounting per LiDAR.
        time_offset_s: per LiDAR, stamp minus true acquisition time.
    """
    return {
        "lidars": {
            name: {
                "T_vehicle_lidar": {
                    "translation": [float(v) for v in pose.translation()],
                    "quaternion_xyzw": list(_quaternion_xyzw(pose.rotation())),
                },
                "time_offset": time_offset_s[name],
            }
            for name, pose in T_vehicle_lidar.items()
        }
    }


def _target_regions(scenario: Scenario, world: World) -> list[dict[str, Any]]:
    regions = []
    for name in world.targets:
        low, high = world.bounds(name)
        margin_m = scenario.world.region_margin_m
        regions.append(
            {
                "min": [round(float(v), 3) for v in low - margin_m],
                "max": [round(float(v), 3) for v in high + margin_m],
                "frame": "map",
            }
        )
    return regions


def _noise_section(scenario: Scenario, duration_s: float) -> dict[str, float]:
    """What the config says of the noise: only what there is, for a sigma cannot be zero."""
    poses = scenario.poses
    root_s = math.sqrt(duration_s)
    noise = {
        "lidar_range_m": max(lidar.range_sigma_m for lidar in scenario.lidars.values()),
        "pose_position_m": poses.position_sigma_m,
        "pose_rotation_deg": math.degrees(poses.rotation_sigma_rad),
        # What the walk has come to by the end of the drive.
        "pose_drift_position_m": poses.position_walk_m_sqrts * root_s,
        "pose_drift_rotation_deg": math.degrees(poses.rotation_walk_rad_sqrts) * root_s,
    }
    return {key: value for key, value in noise.items() if value > 0.0}


def config_of(
    scenario: Scenario, world: World, guesses: Mapping[str, Mounting], duration_s: float
) -> dict[str, Any]:
    """The content of a `config.yaml` that calibrates the drive as it is written.

    Args:
        scenario: the drive.
        world: its world, for the targets' regions.
        guesses: initial guess per LiDAR.
        duration_s: duration of the drive.
    """
    guess = scenario.initial_guess
    sigma = {
        "xyz": guess.translation_m * UNIFORM_TO_SIGMA,
        "rpy_deg": guess.rotation_deg * UNIFORM_TO_SIGMA,
    }
    lidars = {
        name: {
            "topic": sensor,
            "initial": {"xyz": list(guesses[name].xyz), "rpy_deg": list(guesses[name].rpy_deg)},
            "sigma": {key: value for key, value in sigma.items() if value > 0.0},
            "min_range": model.min_range_m,
            "max_range": model.max_range_m,
        }
        for sensor, (name, model) in zip(
            sensor_folders(scenario), scenario.lidars.items(), strict=True
        )
    }
    ground: dict[str, Any] = {"use": True, "vehicle_height": 0.0}
    if scenario.suspension.height_sigma_m > 0.0:
        ground["sigma"] = scenario.suspension.height_sigma_m
    return {
        "data": {"format": "caliv", "path": CALIV_FOLDER},
        "lidars": lidars,
        "reference": scenario.reference,
        "target": _target_regions(scenario, world),
        "ground": ground,
        "noise": _noise_section(scenario, duration_s),
    }


def write_config(
    path: Path,
    scenario: Scenario,
    world: World,
    guesses: Mapping[str, Mounting],
    duration_s: float,
    seed: int,
) -> None:
    """Writes `config.yaml`; see `config_of`."""
    content = config_of(scenario, world, guesses, duration_s)
    # What is called ready to run shall at least be a config.
    parse_config(content, str(path), path.parent)
    text = (
        f"# A simulated drive: scenario '{scenario.name}', seed {seed}.\n"
        "# The initial guesses are off on purpose: truth.yaml has the true mountings.\n"
    )
    path.write_text(text + _dump_yaml(content), encoding="utf-8")


def write_truth(
    path: Path, T_vehicle_lidar: Mapping[str, gtsam.Pose3], time_offset_s: Mapping[str, float]
) -> None:
    """Writes `truth.yaml`; see `truth_of`."""
    path.write_text(_dump_yaml(truth_of(T_vehicle_lidar, time_offset_s)), encoding="utf-8")


def write_scenario(path: Path, scenario: Scenario, seed: int) -> None:
    """Writes the effective scenario, and the seed as a comment."""
    path.write_text(f"# seed {seed}\n{dump_scenario(scenario)}", encoding="utf-8")


def _dump_yaml(content: dict[str, Any]) -> str:
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=100)
