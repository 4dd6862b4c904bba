"""Calibrations of one simulated drive that is written as different drivers write it.

    .venv/bin/python scripts/benchmark_dialects.py --seeds 2 --out out/dialects

The drive is `distorted`, a figure-eight with sweeps of 0.1 s.
NEES is 6 on average if the covariance is right, and beyond 20 in 0.3 percent (3 sigma). The rows:

    plain        stamps at the start of the sweep
    end          stamps at its end, times that count from its start (`stamp: auto`)
    as start     the same bag with `stamp: start`: what a wrong stamp costs
    turning      as plain, with LiDARs that turn once in a sweep
    packets      the same, stamps at the end, times that start anew with every packet
    inspvax      poses as novatel_oem7_msgs/INSPVAX instead of IMU, GNSS and velocity
    tum          poses as a TUM file beside the bag
    navpvt       fixes as ublox_msgs/NavPVT
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
import datetime
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import yaml
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # imports the module beside this one from any folder

from caliv_graph.common.progress import SilentProgress
from caliv_graph.config.load import parse_config
from caliv_graph.errors import CalivError
from caliv_graph.geometry.se3 import rpy
from caliv_graph.pipeline import calibrate
from caliv_graph.readers import open_recording
from caliv_graph.readers.definitions import DEFINITIONS
from caliv_graph.readers.pose_file import read_poses
from caliv_graph.scenario.model import load_scenario, parse_scenario
from caliv_graph.simulation import write_drive
from caliv_graph.uncertainty.evaluation import evaluate
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

SCENARIO = ROOT / "configs" / "scenarios" / "distorted.yaml"
PACKET_S = 24 * 55.296e-6
SWEEPS: dict[str, dict[str, Any]] = {
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
WRITTEN = {
    "as start": "end",
    **dict.fromkeys(("inspvax", "tum", "navpvt", *MORE), "plain"),
}
ROWS = (
    *("plain", "end", "as start", "inspvax", "tum", "navpvt", "turning", "packets"),
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
    try:
        config = parse_config(raw, "config.yaml", folder)
        recording = open_recording(config)
        calibration = calibrate([recording], config, SilentProgress()).calibration
    except CalivError as e:
        return str(e)
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
    elif row in ("inspvax", "navpvt"):
        path = folder / row
        if not path.exists():
            rewritten(folder / "drive", path, inspvax(folder, seed) if row == "inspvax" else None)
        raw["data"]["path"] = row
        if row == "inspvax":
            raw["topics"] = {"pose": "/inspvax"}
        else:
            raw["topics"]["gnss"] = "/navpvt"
    elif row in MORE:
        path = folder / row.replace(" ", "_")
        if not path.exists():
            with_messages(folder / "drive", path, more_messages(row, folder, seed), row in NO_IMU)
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


def inspvax(folder: Path, seed: int) -> Iterator[tuple[int, str, dict[str, Any]]]:
    """The noisy poses as messages: stamp, topic and fields."""
    gnss = load_scenario(SCENARIO).gnss
    stamps, R, t = noisy_poses(folder, seed)
    east, north, up = t.T
    places = pymap3d.enu2geodetic(
        east, north, up, gnss.latitude_deg, gnss.longitude_deg, gnss.altitude_m
    )
    for i, stamp in enumerate(stamps):
        roll, pitch, yaw = (math.degrees(v) for v in rpy(R[i].matrix()))
        sigmas = {f"{n}_stdev": POSITION_M for n in ("latitude", "longitude", "height")}
        deg = math.degrees(ROTATION_RAD)
        sigmas |= {f"{n}_stdev": deg for n in ("roll", "pitch", "azimuth")}
        yield (
            stamp,
            "/inspvax",
            {
                "latitude": float(places[0][i]),
                "longitude": float(places[1][i]),
                "height": float(places[2][i]) - 45.0,
                "undulation": 45.0,
                **{"roll": roll, "pitch": -pitch, "azimuth": (90.0 - yaw) % 360.0},
                **sigmas,
            },
        )


def rewritten(source: Path, target: Path, more: Any) -> None:
    """Copies a bag; adds INSPVAX messages, or replaces its NavSatFix messages by NavPVT."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    with (
        Reader(source) as reader,
        Writer(target, version=9, storage_plugin=StoragePlugin.MCAP) as w,
    ):
        to = {
            c.id: w.add_connection(c.topic, c.msgtype, typestore=store) for c in reader.connections
        }
        kind = "novatel_oem7_msgs/msg/INSPVAX" if more else "ublox_msgs/msg/NavPVT"
        own = w.add_connection("/inspvax" if more else "/navpvt", kind, typestore=store)
        for stamp, _, fields in more or ():
            w.write(own, stamp, serialised(store, kind, stamp, fields))
        for connection, stamp, data in reader.messages():
            if connection.msgtype.endswith("NavSatFix") and not more:
                fix = store.deserialize_cdr(data, connection.msgtype)
                w.write(own, stamp, serialised(store, kind, stamp, navpvt(fix, stamp)))
            else:
                w.write(to[connection.id], stamp, data)


def with_messages(
    source: Path, target: Path, messages: Iterator[Message], without_imu: bool
) -> None:
    """Copies a bag without its velocities and orientations, or IMU, and with more messages."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    without = ("/vehicle/twist", *(("/imu/data",) if without_imu else ()))
    with (
        Reader(source) as reader,
        Writer(target, version=9, storage_plugin=StoragePlugin.MCAP) as w,
    ):
        kept = [c for c in reader.connections if c.topic not in without]
        to = {c.id: w.add_connection(c.topic, c.msgtype, typestore=store) for c in kept}
        own: dict[str, Any] = {}
        for stamp, topic, kind, fields in messages:
            if topic not in own:
                own[topic] = w.add_connection(topic, kind, typestore=store)
            w.write(own[topic], stamp, serialised(store, kind, stamp, fields))
        for connection, stamp, data in reader.messages(connections=kept):
            if connection.topic == "/imu/data":
                message: Any = store.deserialize_cdr(data, connection.msgtype)
                message.orientation_covariance = np.array([-1.0] + [0.0] * 8)
                w.write(to[connection.id], stamp, store.serialize_cdr(message, connection.msgtype))
            else:
                w.write(to[connection.id], stamp, data)


def navpvt(fix: Any, stamp: int) -> dict[str, Any]:
    """A NavSatFix as the receiver would report it."""
    t = datetime.datetime.fromtimestamp(stamp // 10**9, tz=datetime.UTC)
    horizontal, vertical = math.sqrt(2 * fix.position_covariance[0]), fix.position_covariance[8]
    return {
        **{"year": t.year, "month": t.month, "day": t.day, "hour": t.hour, "min": t.minute},
        **{"sec": t.second, "nano": stamp % 10**9, "valid": 7, "fix_type": 3, "flags": 1},
        "lat": round(fix.latitude * 1e7),
        "lon": round(fix.longitude * 1e7),
        "height": round(fix.altitude * 1e3),
        "h_acc": round(1e3 * horizontal),
        "v_acc": round(1e3 * math.sqrt(vertical)),
    }


def serialised(store: Any, kind: str, stamp: int, fields: dict[str, Any]) -> bytes:
    """A message whose other fields are zero; the status of an INS is good."""

    def built(name: str, given: dict[str, Any]) -> Any:
        values = {}
        for field, (node, detail) in store.fielddefs[name][1]:
            if int(node) == 2:
                values[field] = built(detail, given.get(field, {}))
            elif int(node) == 1:
                values[field] = given.get(field, "" if detail[0] == "string" else 0)
            else:
                values[field] = given.get(field, np.zeros(detail[1], detail[0][1][0]))
        return store.types[name](**values)

    if kind.endswith("INSPVAX"):
        header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}}
        fields = {**fields, "header": header, "ins_status": {"status": 3}}
    return bytes(store.serialize_cdr(built(kind, fields), kind))


if __name__ == "__main__":
    sys.exit(main())
