"""Writing a simulated drive: a CaLiV folder, the truth, and a config that is ready to run."""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import yaml

from caliv_graph.config import Mounting, parse_config
from caliv_graph.conventions import NANOSECONDS_PER_SECOND
from caliv_graph.errors import OutputError
from caliv_graph.geometry.se3 import pose_from_mounting
from caliv_graph.products import Array, IntArray
from caliv_graph.simulation.scenario import Scenario, dump_scenario
from caliv_graph.simulation.worlds import World

UNIFORM_TO_SIGMA = 1.0 / math.sqrt(3.0)
"""Standard deviation of a uniform draw from -1 to 1."""


@contextmanager
def new_folder(path: Path, content: Collection[str], force: bool = False) -> Iterator[Path]:
    """A folder that is there with all its content, or not at all.

    Args:
        path: the folder.
        content: names of what will be in it. A folder that holds anything else is not replaced,
            whatever `force` says: it is not one of ours.
        force: replace an older one.

    Yields:
        An empty folder beside `path` to write to. It takes the place of `path` at the end, and is
        removed if anything goes wrong.

    Raises:
        OutputError: `path` exists and is not to be replaced, or cannot be written.
    """
    path = path.absolute()
    replace = path.exists()
    if replace:
        _check_replaceable(path, content, force)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
    except OSError as e:
        raise OutputError(f"{path}: cannot be written: {e.strerror}") from None
    fresh, old = scratch / "new", scratch / "old"
    try:
        fresh.mkdir()
        yield fresh
        # A folder cannot be renamed onto one that has content.
        if replace:
            path.rename(old)
        fresh.rename(path)
    except OSError as e:
        raise OutputError(f"{e.filename or path}: cannot be written: {e.strerror}") from None
    finally:
        if old.exists() and not path.exists():
            old.rename(path)
        shutil.rmtree(scratch, ignore_errors=True)


def _check_replaceable(path: Path, content: Collection[str], force: bool) -> None:
    if not path.is_dir():
        raise OutputError(f"{path}: is a file. Choose another folder with --out")
    if not force:
        raise OutputError(f"{path}: exists already. Choose another --out, or replace with --force")
    strangers = sorted(entry.name for entry in path.iterdir() if entry.name not in content)
    if strangers:
        raise OutputError(
            f"{path}: is not replaced, for it holds '{strangers[0]}', which no simulated drive "
            "does. Move it away, or choose another --out"
        )


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


def truth_of(scenario: Scenario) -> dict[str, Any]:
    """The content of `truth.yaml`."""
    lidars = {}
    for name, model in scenario.lidars.items():
        T_vehicle_lidar = pose_from_mounting(model.mounting)
        lidars[name] = {
            "T_vehicle_lidar": {
                "translation": [float(v) for v in T_vehicle_lidar.translation()],
                "quaternion_xyzw": list(_quaternion_xyzw(T_vehicle_lidar.rotation())),
            },
            "time_offset": model.time_offset_s,
        }
    return {"lidars": lidars}


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
        "data": {"format": "caliv", "path": "."},
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
        f"# Written by 'caliv-graph simulate' for scenario '{scenario.name}', seed {seed}.\n"
        "# The initial guesses are off on purpose: truth.yaml has the true mountings.\n"
    )
    path.write_text(text + _dump_yaml(content), encoding="utf-8")


def write_truth(path: Path, scenario: Scenario) -> None:
    """Writes `truth.yaml`."""
    path.write_text(_dump_yaml(truth_of(scenario)), encoding="utf-8")


def write_scenario(path: Path, scenario: Scenario, seed: int) -> None:
    """Writes the effective scenario, and the seed as a comment."""
    path.write_text(f"# seed {seed}\n{dump_scenario(scenario)}", encoding="utf-8")


def _dump_yaml(content: dict[str, Any]) -> str:
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=100)
