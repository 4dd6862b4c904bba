"""Turns a log of Argoverse 2 (sensor or LiDAR dataset) into folders of clouds and a file of poses.

    .venv/bin/pip install pyarrow
    .venv/bin/python scripts/convert_argoverse2.py LOG --out out/argoverse2
    caliv-graph calibrate configs/datasets/argoverse2.yaml --data out/argoverse2 --out out/result

A sweep of Argoverse 2 holds the points of two VLP-32C in the vehicle frame, each moved to the time
of the sweep. Here they go back: each to the time when it was taken and into the frame of its LiDAR,
by the extrinsics of the log. What is calibrated is how far these extrinsics are off.

`laser_number` 0 to 31 is one LiDAR and 32 to 63 the other, but which of them is `up_lidar` is not
documented. The beams of a laser have one elevation, but only in the frame of its LiDAR: that tells.

Written from the published format; tested on simulated sweeps, not on the dataset.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from caliv_graph.products import Array, IntArray

LIDARS = ("up_lidar", "down_lidar")
LASERS = 32
LEAST_RANGE_M = 3.0
"""Nearer points are the vehicle's own body, and their elevation is coarse."""

Table = Mapping[str, Any]
"""Columns of a feather file by name."""


@dataclass(frozen=True)
class Poses:
    """`city_SE3_egovehicle.feather`: stamps (n,) ns, rotations, translations (n, 3) m."""

    stamps_ns: IntArray
    R_city_vehicle: Rotation
    t_city_vehicle: Array

    def at(self, stamps_ns: IntArray) -> tuple[Rotation, Array]:
        """Rotations and translations between the given ones."""
        own_s = (self.stamps_ns - self.stamps_ns[0]) * 1e-9
        at_s = np.clip((stamps_ns - self.stamps_ns[0]) * 1e-9, own_s[0], own_s[-1])
        t = np.stack([np.interp(at_s, own_s, axis) for axis in self.t_city_vehicle.T], axis=1)
        return Slerp(own_s, self.R_city_vehicle)(at_s), t


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("log", type=Path, metavar="LOG", help="folder with sensors/ and poses")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    try:
        from pyarrow import feather  # type: ignore[import-not-found]
    except ImportError:
        print("pyarrow reads the files of Argoverse 2: install it with pip", file=sys.stderr)
        return 2

    def read(path: Path) -> Table:
        table = feather.read_table(path)
        return {name: table[name].to_numpy() for name in table.column_names}

    log = arguments.log
    poses = read_poses(read(log / "city_SE3_egovehicle.feather"))
    extrinsics = read_extrinsics(read(log / "calibration" / "egovehicle_SE3_sensor.feather"))
    sweeps = sorted((log / "sensors" / "lidar").glob("*.feather"))
    if not sweeps:
        print(f"{log}: holds no sensors/lidar/*.feather", file=sys.stderr)
        return 2
    first = read(sweeps[0])
    lasers = lidar_of_lasers(first, int(sweeps[0].stem), poses, extrinsics)
    arguments.out.mkdir(parents=True)
    for path in sweeps:
        stamp_ns = int(path.stem)
        for name, cloud in separated(read(path), stamp_ns, poses, extrinsics, lasers).items():
            (arguments.out / name).mkdir(exist_ok=True)
            cloud.tofile(arguments.out / name / f"{stamp_ns}.bin")
    (arguments.out / "poses.txt").write_text(tum(poses))
    return 0


def read_poses(table: Table) -> Poses:
    """Poses from the columns timestamp_ns, qw, qx, qy, qz, tx_m, ty_m, tz_m."""
    order = np.argsort(table["timestamp_ns"])
    q = np.column_stack([table[k] for k in ("qx", "qy", "qz", "qw")])[order]
    t = np.column_stack([table[k] for k in ("tx_m", "ty_m", "tz_m")])[order]
    return Poses(np.asarray(table["timestamp_ns"], np.int64)[order], Rotation.from_quat(q), t)


def read_extrinsics(table: Table) -> dict[str, tuple[Rotation, Array]]:
    """T_vehicle_lidar of both LiDARs."""
    names = [str(name) for name in table["sensor_name"]]
    found = {}
    for name in LIDARS:
        i = names.index(name)
        q = [table[k][i] for k in ("qx", "qy", "qz", "qw")]
        found[name] = (
            Rotation.from_quat(q),
            np.array([table[k][i] for k in ("tx_m", "ty_m", "tz_m")], np.float64),
        )
    return found


def lidar_of_lasers(
    sweep: Table, stamp_ns: int, poses: Poses, extrinsics: Mapping[str, tuple[Rotation, Array]]
) -> dict[str, Sequence[int]]:
    """Which `laser_number`s are of which LiDAR: each laser then has one elevation."""
    low, high = range(LASERS), range(LASERS, 2 * LASERS)
    ways: list[dict[str, Sequence[int]]] = [
        dict(zip(LIDARS, pair, strict=True)) for pair in ((low, high), (high, low))
    ]
    return min(ways, key=lambda way: _scatter(sweep, stamp_ns, poses, extrinsics, way))


def _scatter(
    sweep: Table,
    stamp_ns: int,
    poses: Poses,
    extrinsics: Mapping[str, tuple[Rotation, Array]],
    lasers: Mapping[str, Sequence[int]],
) -> float:
    """Radians: mean over the lasers of how much the elevation of their points scatters."""
    scatter = []
    numbers = np.asarray(sweep["laser_number"])
    for name, cloud in separated(sweep, stamp_ns, poses, extrinsics, lasers).items():
        own = numbers[np.isin(numbers, lasers[name])]
        xyz = np.column_stack([cloud[axis] for axis in "xyz"]).astype(np.float64)
        far = np.linalg.norm(xyz, axis=1) > LEAST_RANGE_M
        elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
        scatter += [float(elevation[far & (own == k)].std()) for k in np.unique(own[far])]
    return float(np.mean(scatter))


def separated(
    sweep: Table,
    stamp_ns: int,
    poses: Poses,
    extrinsics: Mapping[str, tuple[Rotation, Array]],
    lasers: Mapping[str, Sequence[int]],
) -> dict[str, Any]:
    """The points of a sweep by LiDAR, in its frame when each was taken.

    Of a point p at the sweep's time s, taken at t: T_vehicle_lidar^-1 T_city_vehicle(t)^-1
    T_city_vehicle(s) p.
    """
    numbers = np.asarray(sweep["laser_number"])
    offsets_ns = np.asarray(sweep["offset_ns"], np.int64)
    points = np.column_stack([sweep[axis] for axis in "xyz"]).astype(np.float64)
    R_sweep, t_sweep = poses.at(np.array([stamp_ns]))
    R, t = poses.at(stamp_ns + offsets_ns)
    vehicle = R.inv().apply(R_sweep.apply(points) + t_sweep - t)
    out = {}
    for name, own in lasers.items():
        kept = np.isin(numbers, own)
        R_vehicle_lidar, t_vehicle_lidar = extrinsics[name]
        kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<i4")]
        cloud = np.zeros(int(kept.sum()), np.dtype(kinds))
        lidar = R_vehicle_lidar.inv().apply(vehicle[kept] - t_vehicle_lidar)
        for axis, column in zip("xyz", lidar.T, strict=True):
            cloud[axis] = column
        cloud["intensity"] = np.asarray(sweep["intensity"])[kept]
        cloud["t"] = offsets_ns[kept]
        out[name] = cloud
    return out


def tum(poses: Poses) -> str:
    """Poses as TUM writes them, with the origin at the first: cities are kilometres wide."""
    t = poses.t_city_vehicle - poses.t_city_vehicle[0]
    return "".join(
        f"{stamp // 10**9}.{stamp % 10**9:09d} {p[0]:.6f} {p[1]:.6f} {p[2]:.6f} "
        f"{q[0]:.9f} {q[1]:.9f} {q[2]:.9f} {q[3]:.9f}\n"
        for stamp, p, q in zip(
            poses.stamps_ns.tolist(), t, poses.R_city_vehicle.as_quat(), strict=True
        )
    )


if __name__ == "__main__":
    sys.exit(main())
