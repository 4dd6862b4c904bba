"""Files beside a simulated recording: truth, true trajectory, config and scenario."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import yaml

from caliv_graph.config.load import parse_config
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import ConfigError
from caliv_graph.geometry.se3 import quaternion_xyzw
from caliv_graph.products import Array, IntArray
from caliv_graph.scenario.model import UNIFORM_TO_SIGMA, Scenario, dump_scenario
from caliv_graph.simulation.caliv_folder import (
    CALIV_FOLDER,
    frame_poses,
    pose_values,
    sensor_folders,
)
from caliv_graph.simulation.motion import antenna_positions
from caliv_graph.simulation.recording import SimulatedRecording

BAG_FOLDER = "drive"
"""Name of the bag in the folder of a simulated drive."""

TRAJECTORY_PERIOD_NS = NANOSECONDS_PER_SECOND // 100
"""Period of the true poses written beside a bag, in addition to those at cloud stamps."""

EXACT_M, EXACT_DEG = 1e-4, 1e-3
"""Sigmas of lever arm and IMU rotation in the written config: the values are those that were
simulated, and no error of theirs is drawn."""

TOPIC_IMU = "/imu/data"
TOPIC_GNSS = "/gnss/fix"
TOPIC_TWIST = "/vehicle/twist"


def topic_of_lidar(name: str) -> str:
    """Topic of a LiDAR's clouds.

    Raises:
        ConfigError: the name cannot be part of a topic.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ConfigError(
            f"lidars.{name}: a bag's topics have letters, digits and underscores, and begin with a "
            "letter. Rename the LiDAR, or write a CaLiV folder (--format caliv)"
        )
    return f"/lidar/{name}/points"


def truth_of(
    T_vehicle_lidar: Mapping[str, gtsam.Pose3], time_offset_s: Mapping[str, float]
) -> dict[str, Any]:
    """The content of `truth.yaml`; a time offset is stamp minus true acquisition time."""
    return {
        "lidars": {
            name: {
                "T_vehicle_lidar": {
                    "translation": [float(v) for v in pose.translation()],
                    "quaternion_xyzw": list(quaternion_xyzw(pose.rotation())),
                },
                "time_offset": time_offset_s[name],
            }
            for name, pose in T_vehicle_lidar.items()
        }
    }


def _target_regions(recording: SimulatedRecording, has_bag: bool) -> list[dict[str, Any]]:
    world = recording.world
    margin_m = recording.scenario.world.region_margin_m
    # With a bag, the origin of the map is the antenna at the first fix.
    origin_map = _first_antenna_position(recording) if has_bag else np.zeros(3)
    regions = []
    for name in world.targets:
        low, high = world.bounds(name)
        regions.append(
            {
                "min": [round(float(v), 3) for v in low - margin_m - origin_map],
                "max": [round(float(v), 3) for v in high + margin_m - origin_map],
                "frame": "map",
            }
        )
    return regions


def _target_section(recording: SimulatedRecording, has_bag: bool) -> dict[str, Any]:
    """The config's `target`: false where there is none; without it the program searches for one."""
    if recording.scenario.config_target == "search":
        return {}
    return {"target": _target_regions(recording, has_bag) or False}


def _first_antenna_position(recording: SimulatedRecording) -> Array:
    """(3,) true position of the antenna in the map at the first fix; zero without a fix."""
    gnss = recording.motion().gnss
    if gnss is None or not len(gnss.stamps_ns):
        return np.zeros(3)
    states = recording.truth.states(gnss.stamps_ns[:1])
    first: Array = antenna_positions(states, recording.scenario.gnss)[0]
    return first


def _positive(noise: Mapping[str, float]) -> dict[str, float]:
    """The entries above zero, because a sigma in a config cannot be zero."""
    return {key: value for key, value in noise.items() if value > 0.0}


def _range_sigma_m(scenario: Scenario) -> float:
    return max(lidar.range_sigma_m for lidar in scenario.lidars.values())


def _noise_of_poses(scenario: Scenario, duration_s: float) -> dict[str, float]:
    """The config's noise section for a CaLiV folder."""
    poses = scenario.poses
    root_s = math.sqrt(duration_s)
    return _positive(
        {
            "lidar_range_m": _range_sigma_m(scenario),
            "pose_position_m": poses.position_sigma_m,
            "pose_rotation_deg": math.degrees(poses.rotation_sigma_rad),
            # The sigma of the walk at the end of the drive.
            "pose_drift_position_m": poses.position_walk_m_sqrts * root_s,
            "pose_drift_rotation_deg": math.degrees(poses.rotation_walk_rad_sqrts) * root_s,
        }
    )


def _noise_of_sensors(scenario: Scenario) -> dict[str, float]:
    """The config's noise section for a bag: the noise that its messages do not state."""
    imu, gnss = scenario.imu, scenario.gnss
    noise = {"lidar_range_m": _range_sigma_m(scenario)}
    if imu.enabled:
        noise |= {
            "accelerometer_bias_walk_m_s3_sqrthz": imu.accelerometer_bias_walk_m_s3_sqrthz,
            "gyroscope_bias_walk_rad_s2_sqrthz": imu.gyroscope_bias_walk_rad_s2_sqrthz,
        }
    if scenario.bag.covariances == "unknown":
        # Density of white noise: sigma of a sample times the root of the sampling period.
        stated = imu.stated_over_true / math.sqrt(imu.rate_hz)
        if imu.enabled:
            noise |= {
                "accelerometer_density_m_s2_sqrthz": stated * imu.accelerometer_sigma_m_s2,
                "gyroscope_density_rad_s_sqrthz": stated * imu.gyroscope_sigma_rad_s,
            }
        if imu.enabled and imu.orientation.enabled:
            noise["orientation_deg"] = math.degrees(imu.orientation.sigma_rad)
        if gnss.enabled:
            noise["gnss_horizontal_m"] = gnss.stated_over_true * gnss.horizontal_sigma_m
            noise["gnss_vertical_m"] = gnss.stated_over_true * gnss.vertical_sigma_m
        if scenario.velocity.enabled:
            noise["velocity_m_s"] = scenario.velocity.sigma_m_s
    return _positive(noise)


def _motion_sections(scenario: Scenario) -> dict[str, Any]:
    """Topics and mountings of IMU, GNSS and odometry, those that the vehicle has."""
    topics: dict[str, str] = {}
    sections: dict[str, Any] = {}
    if scenario.imu.enabled:
        mounting = scenario.imu.mounting
        topics["imu"] = TOPIC_IMU
        sections["imu"] = {
            "T_vehicle_imu": {"xyz": list(mounting.xyz), "rpy_deg": list(mounting.rpy_deg)}
        }
        if any(mounting.rpy_deg) or any(mounting.xyz):
            sections["imu"]["rotation_sigma_deg"] = EXACT_DEG
        if any(mounting.xyz):
            sections["imu"]["xyz_sigma"] = EXACT_M
    if scenario.gnss.enabled:
        topics["gnss"] = TOPIC_GNSS
        sections["gnss"] = {"lever_arm": list(scenario.gnss.lever_arm)}
        if any(scenario.gnss.lever_arm):
            sections["gnss"]["lever_arm_sigma"] = EXACT_M
    if scenario.velocity.enabled:
        topics["twist"] = TOPIC_TWIST
    return {"topics": topics, **sections}


def config_of(recording: SimulatedRecording, has_bag: bool) -> dict[str, Any]:
    """The content of a `config.yaml` with which the written bag or CaLiV folder can be calibrated.

    Raises:
        ConfigError: a LiDAR whose name cannot be part of a topic.
    """
    scenario = recording.scenario
    guess = scenario.initial_guess
    sigma = {
        "xyz": guess.translation_m * UNIFORM_TO_SIGMA,
        "rpy_deg": guess.rotation_deg * UNIFORM_TO_SIGMA,
    }
    topics = map(topic_of_lidar, scenario.lidars) if has_bag else sensor_folders(scenario)
    lidars = {
        name: {
            "topic": topic,
            "initial": {
                "xyz": list(recording.guesses[name].xyz),
                "rpy_deg": list(recording.guesses[name].rpy_deg),
            },
            "sigma": {key: value for key, value in sigma.items() if value > 0.0},
            "min_range": model.min_range_m,
            "max_range": model.max_range_m,
        }
        for topic, (name, model) in zip(topics, scenario.lidars.items(), strict=True)
    }
    ground: dict[str, Any] = {"use": True, "vehicle_height": 0.0}
    if scenario.suspension.height_sigma_m > 0.0:
        ground["sigma"] = scenario.suspension.height_sigma_m
    data = {"format": "rosbag", "path": BAG_FOLDER}
    return {
        "data": data if has_bag else {"format": "caliv", "path": CALIV_FOLDER},
        **(_motion_sections(scenario) if has_bag else {}),
        "lidars": lidars,
        "reference": scenario.reference,
        **_target_section(recording, has_bag),
        "ground": ground,
        "noise": (
            _noise_of_sensors(scenario)
            if has_bag
            else _noise_of_poses(scenario, recording.truth.drive.duration_s)
        ),
    }


def write_config(path: Path, recording: SimulatedRecording, has_bag: bool) -> None:
    """Writes `config.yaml`; see `config_of`."""
    content = config_of(recording, has_bag)
    # The written config must be valid.
    parse_config(content, str(path), path.parent)
    text = (
        f"# A simulated drive: scenario '{recording.scenario.name}', seed {recording.seed}.\n"
        "# The initial guesses are off on purpose: truth.yaml has the true extrinsics.\n"
    )
    path.write_text(text + _dump_yaml(content), encoding="utf-8")


def write_truth(
    path: Path, T_vehicle_lidar: Mapping[str, gtsam.Pose3], time_offset_s: Mapping[str, float]
) -> None:
    """Writes `truth.yaml`; see `truth_of`."""
    path.write_text(_dump_yaml(truth_of(T_vehicle_lidar, time_offset_s)), encoding="utf-8")


def write_tum(
    path: Path, stamps_ns: IntArray, T_map_vehicle: Sequence[gtsam.Pose3], comment: str = ""
) -> None:
    """Writes a trajectory in the TUM format: stamp in seconds, x y z qx qy qz qw.

    The comment is the first line, after `#`.
    """
    lines = [f"# {comment}"] if comment else []
    for stamp_ns, pose in zip(stamps_ns.tolist(), T_map_vehicle, strict=True):
        seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS_PER_SECOND)
        lines.append(f"{seconds}.{nanoseconds:09d} {' '.join(pose_values(pose))}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_trajectory(path: Path, recording: SimulatedRecording, has_bag: bool) -> None:
    """Writes `trajectory.tum`, the true poses; see `simulate.write_drive`."""
    if not has_bag:
        write_tum(path, *frame_poses(recording))
        return
    truth = recording.truth
    stamps = [np.arange(truth.start_ns, truth.end_ns + 1, TRAJECTORY_PERIOD_NS, dtype=np.int64)]
    stamps += [np.array(recording.scan_stamps_ns(name), np.int64) for name in recording.lidars]
    stamps_ns = np.unique(np.concatenate(stamps))
    latitude, longitude, altitude = truth.datum
    write_tum(
        path,
        stamps_ns,
        truth.T_map_vehicle(stamps_ns),
        f"map: ENU, origin at latitude {latitude:.9f} longitude {longitude:.9f} degrees, altitude "
        f"{altitude:.4f} m (WGS84). vehicle: {recording.scenario.name}, without heave",
    )


def write_scenario(path: Path, scenario: Scenario, seed: int) -> None:
    """Writes the effective scenario, and the seed as a comment."""
    path.write_text(f"# seed {seed}\n{dump_scenario(scenario)}", encoding="utf-8")


def _dump_yaml(content: dict[str, Any]) -> str:
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=100)
