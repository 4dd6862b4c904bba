"""A simulated drive as folders of clouds: KITTI odometry, nuScenes, and a CaLiV folder."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import gtsam
import numpy as np

from caliv_graph.geometry.se3 import quaternion_xyzw
from caliv_graph.products import Array, Recording
from caliv_graph.simulation.caliv_folder import write_ego_poses, write_pcd

FRAME_NS = 100_000_000
R_VEHICLE_CAMERA = gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
"""Axes of a camera that looks ahead: x right, y down, z forward."""

Poses = Mapping[int, gtsam.Pose3]
"""The vehicle in the map by the stamp of a cloud."""


def write_kitti(root: Path, recording: Recording, poses: Poses) -> dict[str, str]:
    """Numbered clouds, `times.txt`, poses of a camera at the vehicle's origin. LiDAR -> folder."""
    stamps = sorted(poses)
    number = {stamp: k for k, stamp in enumerate(stamps)}
    T_vehicle_camera = gtsam.Pose3(R_VEHICLE_CAMERA, np.zeros(3))
    folders = {name: f"velodyne_{name}" for name in recording.lidars}
    for name, stamp, points in _clouds(recording, poses):
        path = root / folders[name] / f"{number[stamp]:06d}.bin"
        path.parent.mkdir(parents=True, exist_ok=True)
        _rows(points, 4).tofile(path)
    first = poses[stamps[0]].compose(T_vehicle_camera).inverse()
    moved = [first.compose(poses[stamp]).compose(T_vehicle_camera).matrix() for stamp in stamps]
    lines = [" ".join(f"{v:.9e}" for v in matrix[:3].ravel()) for matrix in moved]
    (root / "poses.txt").write_text("\n".join(lines))
    seconds = [f"{(stamp - stamps[0]) * 1e-9:.6e}" for stamp in stamps]
    (root / "times.txt").write_text("\n".join(seconds))
    return folders


def write_nuscenes(root: Path, recording: Recording, poses: Poses) -> dict[str, str]:
    """Clouds with the time in their names, `ego_pose.json`. LiDAR -> folder."""
    folders = {name: f"samples/LIDAR_{name.upper()}" for name in recording.lidars}
    for name, stamp, points in _clouds(recording, poses):
        folder = root / folders[name]
        folder.mkdir(parents=True, exist_ok=True)
        _rows(points, 5).tofile(folder / f"n015__{folder.name}__{stamp // 1000}.pcd.bin")
    entries = []
    for k, (stamp, T) in enumerate(sorted(poses.items())):
        x, y, z, w = (float(v) for v in quaternion_xyzw(T.rotation()))
        place = [float(v) for v in T.translation()]
        entry = {"token": str(k), "timestamp": stamp // 1000, "rotation": [w, x, y, z]}
        entries.append({**entry, "translation": place})
    (root / "ego_pose.json").write_text(json.dumps(entries))
    return folders


def write_pcds(root: Path, recording: Recording, poses: Poses) -> dict[str, str]:
    """A CaLiV folder whose files say WIDTH 0, HEIGHT 0 and POINTS n. LiDAR -> folder."""
    begin = min(poses)
    folders = {name: f"sensor_{k}" for k, name in enumerate(recording.lidars, start=1)}
    entries: dict[str, list[tuple[int, gtsam.Pose3]]] = {name: [] for name in folders.values()}
    for name, stamp, points in _clouds(recording, poses):
        frame = round((stamp - begin) / FRAME_NS)
        path = root / "input" / folders[name] / f"{frame}.pcd"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_pcd(path, points)
        whole = path.read_bytes()
        size = f"WIDTH {len(points)}\nHEIGHT 1\n".encode()
        path.write_bytes(whole.replace(size, b"WIDTH 0\nHEIGHT 0\n", 1))
        entries[folders[name]].append((frame, poses[stamp]))
    write_ego_poses(root / "input" / "ego_poses.yaml", entries)
    return folders


def poses_of_clouds(
    recording: Recording, stamps: Sequence[int], R: Sequence[gtsam.Rot3], t: Array
) -> dict[int, gtsam.Pose3]:
    """The poses that are at the stamps of clouds, to 10 ms."""
    known = np.asarray(stamps, np.int64)
    out = {}
    for name in recording.lidars:
        for stamp in recording.scan_stamps_ns(name):
            i = int(np.abs(known - stamp).argmin())
            if abs(int(known[i]) - stamp) < 1_000_000:
                out[stamp] = gtsam.Pose3(R[i], t[i])
    return out


def _clouds(recording: Recording, poses: Poses) -> Iterator[tuple[str, int, Array]]:
    """Name of the LiDAR, stamp and points of every cloud that has a pose."""
    for name in recording.lidars:
        for scan in recording.scans(name, frozenset(poses)):
            yield name, scan.stamp_ns, scan.points_lidar


def _rows(points: Array, columns: int) -> Array:
    """(n, columns) float32: x y z, and zeros."""
    out = np.zeros((len(points), columns), "<f4")
    out[:, :3] = points
    return out
