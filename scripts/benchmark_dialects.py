"""Calibrations of one simulated drive that is written as different drivers write it.

    .venv/bin/python scripts/benchmark_dialects.py --seeds 2 --out out/dialects

The drive is `distorted`, a figure-eight with sweeps of 0.1 s. The installed command calibrates.
NEES is 6 on average if the covariance is right, and beyond 20 in 0.3 percent (3 sigma). The rows:

    plain        stamps at the start of the sweep
    end          stamps at its end, times that count from its start (`stamp: auto`)
    as start     the same bag with `stamp: start`: what a wrong stamp costs
    turning      as plain, with LiDARs that turn once in a sweep
    packets      the same, stamps at the end, times that start anew with every packet
    velodyne     VLP-16 LiDARs in place of the drive's, as velodyne_msgs/VelodyneScan
    inspvax      poses as novatel_oem7_msgs/INSPVAX instead of IMU, GNSS and velocity
    novatel      the same as novatel_msgs/INSPVAX, which is stamped by the recording
    tum          poses as a TUM file beside the bag
    csv          poses as a CSV file with nanoseconds beside the bag
    navpvt       fixes as ublox_msgs/NavPVT
    pvt          fixes as septentrio_gnss_driver/PVTGeodetic
    station      positions of a total station, in its own axes, as geometry_msgs/PoseStamped
    kitti        folders of .bin files, times.txt and poses of a camera, as of KITTI odometry
    nuscenes     folders of .pcd.bin files with the time in their names, and ego_pose.json
    pcd          a CaLiV folder whose files say WIDTH 0, HEIGHT 0, POINTS n
    odometry     no IMU: fixes, and wheel odometry (speed and yaw rate) as nav_msgs/Odometry
    speed        no IMU: fixes, and speeds as geometry_msgs/TwistStamped
    heading      IMU without orientation, fixes, heading of two antennas as QuaternionStamped
    imu heading  the same as an Imu
    two fixes    the same as the fixes of a second antenna
    wheels       no IMU: as speed, with that heading
    scale        IMU without orientation, fixes, speeds whose scale is estimated
"""

from __future__ import annotations

import argparse
import math
import shutil
import sys
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import yaml
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # imports the module beside this one from any folder

from caliv_graph.config.load import parse_config
from caliv_graph.errors import CalivError
from caliv_graph.geometry.se3 import rpy
from caliv_graph.readers import open_recording
from caliv_graph.readers.definitions import DEFINITIONS
from caliv_graph.readers.pose_file import read_poses
from caliv_graph.results.calibration_file import read_calibration
from caliv_graph.scenario.model import load_scenario, parse_scenario
from caliv_graph.simulation import write_drive
from caliv_graph.uncertainty.evaluation import evaluate
from scripts._bags import copied
from scripts._command import calibrate_measured
from scripts._dialects_folders import poses_of_clouds, write_kitti, write_nuscenes, write_pcds
from scripts._dialects_messages import FIXES, POSES, RECEIVERS, serialised
from scripts._dialects_motion import (
    ARM_M,
    BASELINE_DEG,
    SCALE,
    SECOND_ARM,
    Message,
    drawn,
    headings,
    odometry,
    second_fixes,
    turned,
)
from scripts._dialects_packets import velodyne_scans

SCENARIO = ROOT / "configs" / "scenarios" / "distorted.yaml"
PACKET_S = 24 * 55.296e-6
SWEEPS: dict[str, dict[str, Any]] = {
    "still": {},
    "plain": {"time_field": "t"},
    "turning": {"time_field": "t"},
    "end": {"time_field": "t", "stamp_at": "end", "times_from": "start"},
    "packets": {
        "time_field": "time",
        "stamp_at": "end",
        "times_from": "start",
        "packet_s": PACKET_S,
    },
}
MORE = ("odometry", "speed", "heading", "imu heading", "two fixes", "wheels", "scale")
FOLDERS = {"kitti": write_kitti, "nuscenes": write_nuscenes, "pcd": write_pcds}
"""Clouds of these are taken at one instant: the formats have no times of points."""

WRITTEN = {
    "as start": "end",
    "velodyne": "plain",
    **dict.fromkeys((*POSES, *FIXES, "tum", "csv", *MORE), "plain"),
    **dict.fromkeys(FOLDERS, "still"),
}
ROWS = (
    *("plain", "end", "as start", *POSES, "tum", "csv", *FIXES, "turning", "packets", "velodyne"),
    *FOLDERS,
    *MORE,
)
NO_IMU = ("odometry", "speed", "wheels")
POSITION_M, ROTATION_RAD = 0.01, 1e-3
"""White noise of the poses of INSPVAX and TUM."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=1, help="seeds 1 to N (default: 1)")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--out", type=Path, default=Path("out/dialects"))
    arguments = parser.parse_args()
    print(f"{'':10}{'seed':>5}  {'status':13}{'NEES S2V':>20}{'S2S':>8}   largest errors, mm mrad")
    for seed in range(1, arguments.seeds + 1):
        for row in arguments.rows:
            print(f"{row:10}{seed:5}  {result(row, seed, arguments.out)}", flush=True)
    return 0


def result(row: str, seed: int, out: Path) -> str:
    """Simulates, if the drive is not there, calibrates and compares."""
    kind = WRITTEN.get(row, row)
    folder = out / f"{kind}_{seed}"
    scenario = parse_scenario(described(kind), f"{kind}.yaml")
    if not (folder / "truth.yaml").is_file():
        write_drive(scenario, folder, seed, threads=1)
    raw = yaml.safe_load((folder / "config.yaml").read_text())
    changed(row, raw, folder, seed)
    config = folder / f"config_{row.replace(' ', '_')}.yaml"
    config.write_text(yaml.safe_dump(raw), encoding="utf-8")
    try:
        calibrate_measured(config, config.with_suffix(""))
    except CalivError as e:
        return str(e)
    calibration = read_calibration(config.with_suffix("") / "calibration.yaml")
    truth = {name: model.mounting.pose() for name, model in scenario.lidars.items()}
    if row in NO_IMU:
        truth = {name: turned(T, seed) for name, T in truth.items()}
    found = evaluate(calibration, truth)
    rows = [item["s2v"] for item in found["lidars"].values()]
    nees = " ".join(f"{item['nees']:9.1f}" for item in rows)
    pair = found["pairs"][0]
    mm = 1e3 * max(np.abs(item["translation_m"]).max() for item in (*rows, pair))
    mrad = 1e3 * max(np.abs(item["rotation_rad"]).max() for item in (*rows, pair))
    line = f"{calibration.status:13}{nees:>20}{pair['nees']:8.1f}   {mm:8.1f} {mrad:8.2f}"
    scale = calibration.vehicle.get("speed_scale")
    if scale is not None:
        off = float(scale.value[0]) - drawn(seed).scale
        line += f"   scale {1e4 * off:+.1f}e-4, sigma {1e4 * float(scale.sigma[0]):.1f}e-4"
    return line


def described(kind: str) -> dict[str, Any]:
    """The scenario with the sweeps of a row."""
    raw: dict[str, Any] = load_scenario(SCENARIO).model_dump(mode="json", exclude_none=True)
    for lidar in raw["lidars"].values():
        lidar["sweep"] = dict(SWEEPS[kind])
        if kind == "still":
            del lidar["sweep"]
        if kind in ("turning", "packets"):
            lidar["horizontal_fov_deg"] = [-180.0, 180.0]
    raw["bag"]["transport_s"] = 0.004
    return raw


def changed(row: str, raw: dict[str, Any], folder: Path, seed: int) -> None:
    """The config of the drive for a row, and files that it needs."""
    if row == "as start":
        for lidar in raw["lidars"].values():
            lidar["stamp"] = "start"
    elif row == "tum":
        stamps, R, t = noisy_poses(folder, seed)
        q = [r.toQuaternion() for r in R]
        lines = [
            f"{s // 10**9}.{s % 10**9:09d} {p[0]:.6f} {p[1]:.6f} {p[2]:.6f} "
            f"{v.x():.9f} {v.y():.9f} {v.z():.9f} {v.w():.9f}"
            for s, p, v in zip(stamps, t, q, strict=True)
        ]
        (folder / "noisy.tum").write_text("\n".join(lines))
        raw["data"]["poses"] = "noisy.tum"
        raw["topics"] = {}
    elif row == "csv":
        stamps, R, t = noisy_poses(folder, seed)
        q = [r.toQuaternion() for r in R]
        lines = ["timestamp_nsec,x,y,z,qx,qy,qz,qw"] + [
            f"{s},{p[0]:.6f},{p[1]:.6f},{p[2]:.6f},{v.x():.9f},{v.y():.9f},{v.z():.9f},{v.w():.9f}"
            for s, p, v in zip(stamps, t, q, strict=True)
        ]
        (folder / "noisy.csv").write_text("\n".join(lines))
        raw["data"]["poses"] = "noisy.csv"
        raw["topics"] = {}
    elif row in POSES or row in FIXES:
        path = folder / row
        if not path.exists():
            rewritten(folder / "drive", path, row, seed)
        raw["data"]["path"] = row
        if row in POSES:
            raw["topics"] = {"pose": f"/{row}"}
        else:
            raw["topics"]["gnss"] = f"/{row}"
    elif row == "velodyne":
        topics = {name: f"/{name}/velodyne_packets" for name in raw["lidars"]}
        if not (folder / row).exists():
            clouds = [lidar["topic"] for lidar in raw["lidars"].values()]
            scans = velodyne_scans(parse_scenario(described("plain"), "plain.yaml"), seed, topics)
            with_messages(folder / "drive", folder / row, scans, clouds, oriented=True)
        raw["data"]["path"] = row
        for name, topic in topics.items():
            raw["lidars"][name]["topic"] = topic
    elif row in FOLDERS:
        in_folders(row, raw, folder, seed)
    elif row in MORE:
        path = folder / row.replace(" ", "_")
        if not path.exists():
            without = ("/vehicle/twist", *(("/imu/data",) if row in NO_IMU else ()))
            more = more_messages(row, folder, seed)
            with_messages(folder / "drive", path, more, without, oriented=False)
        raw["data"]["path"] = path.name
        raw["topics"] = {"gnss": "/gnss/fix"} | TOPICS[row]
        if row in ("heading", "wheels"):
            raw["heading"] = {"yaw_deg": BASELINE_DEG, "axes": "ned"}
        elif row == "imu heading":
            raw["heading"] = {"yaw_deg": BASELINE_DEG}
        elif row == "scale":
            raw["wheels"] = {"speed_scale_sigma": SCALE}
        elif row == "two fixes":
            raw["heading"] = {"lever_arm": list(SECOND_ARM), "lever_arm_sigma": ARM_M}


TOPICS = {
    "odometry": {"twist": "/odom"},
    "speed": {"twist": "/vehicle/speed"},
    "heading": {"imu": "/imu/data", "heading": "/heading"},
    "imu heading": {"imu": "/imu/data", "heading": "/navheading"},
    "two fixes": {"imu": "/imu/data", "heading": "/gnss/second/fix"},
    "scale": {"imu": "/imu/data", "twist": "/vehicle/speed"},
    "wheels": {"twist": "/vehicle/speed", "heading": "/heading"},
}


def more_messages(row: str, folder: Path, seed: int) -> Iterator[Message]:
    """What the bag of a row has beside the drive's."""
    gnss = load_scenario(SCENARIO).gnss
    origin = (gnss.latitude_deg, gnss.longitude_deg, gnss.altitude_m)
    if row in (*NO_IMU, "scale"):
        yield from odometry(folder, seed, yaw_rate=row == "odometry")
    if row in ("heading", "imu heading", "wheels"):
        yield from headings(folder, seed, as_imu=row == "imu heading")
    if row == "two fixes":
        yield from second_fixes(folder, seed, origin)


def noisy_poses(folder: Path, seed: int) -> tuple[list[int], list[Any], Any]:
    """True poses at 20 Hz with white noise: stamps, rotations, positions."""
    import gtsam

    truth = read_poses(folder / "trajectory.tum")
    rng = np.random.default_rng(seed)
    stamps, R, t = [], [], []
    for stamp, pose in zip(truth.stamps_ns.tolist()[::5], truth.T_map_vehicle[::5], strict=True):
        stamps.append(stamp)
        R.append(pose.rotation().compose(gtsam.Rot3.Expmap(ROTATION_RAD * rng.normal(size=3))))
        t.append(pose.translation() + POSITION_M * rng.normal(size=3))
    return stamps, R, np.array(t)


def in_folders(row: str, raw: dict[str, Any], folder: Path, seed: int) -> None:
    """The clouds in folders, with poses for each, and the config for them."""
    recording = open_recording(parse_config(raw, "config.yaml", folder))
    target = folder / row
    if target.exists():
        shutil.rmtree(target)
    target.mkdir()
    folders = FOLDERS[row](
        target, recording, poses_of_clouds(recording, *noisy_poses(folder, seed))
    )
    raw["data"] = {"format": "caliv" if row == "pcd" else "clouds", "path": row}
    raw["topics"] = {}
    for name, topic in folders.items():
        raw["lidars"][name]["topic"] = topic


def inspvax(folder: Path, seed: int, row: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """The noisy poses as messages: stamp and fields."""
    above, std = ("altitude", "std") if row == "novatel" else ("height", "stdev")
    gnss = load_scenario(SCENARIO).gnss
    stamps, R, t = noisy_poses(folder, seed)
    east, north, up = t.T
    places = pymap3d.enu2geodetic(
        east, north, up, gnss.latitude_deg, gnss.longitude_deg, gnss.altitude_m
    )
    for i, stamp in enumerate(stamps):
        roll, pitch, yaw = (math.degrees(v) for v in rpy(R[i].matrix()))
        sigmas = {f"{n}_{std}": POSITION_M for n in ("latitude", "longitude", above)}
        deg = math.degrees(ROTATION_RAD)
        sigmas |= {f"{n}_{std}": deg for n in ("roll", "pitch", "azimuth")}
        yield (
            stamp,
            {
                "latitude": float(places[0][i]),
                "longitude": float(places[1][i]),
                above: float(places[2][i]) - 45.0,
                "undulation": 45.0,
                **{"roll": roll, "pitch": -pitch, "azimuth": (90.0 - yaw) % 360.0},
                **sigmas,
            },
        )


def rewritten(source: Path, target: Path, row: str, seed: int) -> None:
    """Copies a bag; adds messages of poses, or replaces its fixes by those of another receiver."""
    store, kind = _store(), {**POSES, **FIXES}[row]
    own, gnss = f"/{row}", load_scenario(SCENARIO).gnss
    with copied(source, target, store) as bag:
        bag.topic(own, kind)
        for stamp, fields in inspvax(source.parent, seed, row) if row in POSES else ():
            bag.write(own, stamp, serialised(store, kind, stamp, fields))
        for connection, stamp, data in bag.messages():
            if connection.msgtype.endswith("NavSatFix") and row in FIXES:
                fix: Any = store.deserialize_cdr(data, connection.msgtype)
                at = fix.header.stamp.sec * 10**9 + fix.header.stamp.nanosec
                bag.write(own, stamp, serialised(store, kind, at, RECEIVERS[row](fix, at, gnss)))
            else:
                bag.write(connection.topic, stamp, data)


def _store() -> Any:
    """The types of ROS 2 and those that our readers know."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def with_messages(
    source: Path,
    target: Path,
    messages: Iterator[Message],
    without: Collection[str],
    *,
    oriented: bool,
) -> None:
    """Copies a bag without some topics and with more messages; its IMU is `oriented` or not."""
    store = _store()
    with copied(source, target, store, without) as bag:
        for stamp, topic, kind, fields in messages:
            bag.topic(topic, kind)
            bag.write(topic, stamp, serialised(store, kind, stamp, fields))
        for connection, stamp, data in bag.messages():
            if connection.topic == "/imu/data" and not oriented:
                message: Any = store.deserialize_cdr(data, connection.msgtype)
                message.orientation_covariance = np.array([-1.0] + [0.0] * 8)
                data = store.serialize_cdr(message, connection.msgtype)
            bag.write(connection.topic, stamp, data)


if __name__ == "__main__":
    sys.exit(main())
