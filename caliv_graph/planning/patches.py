"""The patches of surface that each scan of a planned drive will give, without noise."""

from __future__ import annotations

import math

import numpy as np

from caliv_graph.geometry.se3 import unstack
from caliv_graph.planning.faces import Faces, Places, face_places, ground_places
from caliv_graph.planning.sightings import scan_stamps, solid_angle, within
from caliv_graph.products import Array, BoolArray, IntArray, Trajectory
from caliv_graph.scenario.beams import channel_elevations_deg
from caliv_graph.scenario.drives import Route
from caliv_graph.scenario.model import CropModel, Scenario
from caliv_graph.scenario.sensor_models import LidarModel
from caliv_graph.structure.patches import DrivePatches
from caliv_graph.structure.planar import (
    MAX_PATCH_M,
    MAX_POINTS,
    MIN_POINTS,
)
from caliv_graph.structure.read import chosen_scans
from caliv_graph.structure.sightings import MIN_COS
from caliv_graph.trajectory.select import GivenTrajectory

PATH_NS = 50_000_000
"""Step of the poses between which the planned path is interpolated."""


def planned_patches(
    scenario: Scenario, drive: Route, faces: Faces, ground: bool
) -> tuple[DrivePatches, IntArray]:
    """The patches of the scans that `calibrate` would read, and the face of each; -1: ground.

    Points of a piece of surface are spread evenly over it; how many there are follows from the
    angles between the beams. No point is drawn and nothing has noise.

    Args:
        scenario: LiDARs and ground.
        drive: the drive.
        faces: what stands around.
        ground: whether the ground is used.
    """
    names = tuple(scenario.lidars)
    path = _path(scenario, drive)
    stamps = chosen_scans([scan_stamps(scenario, n, drive.duration_s) for n in names], path)
    walls = face_places(faces)
    used = [walls]
    reach_m = max(
        m.mounting.pose().translation()[2] * math.tan(math.acos(MIN_COS))
        + float(np.linalg.norm(m.mounting.pose().translation()[:2]))
        for m in scenario.lidars.values()
    )
    if ground and reach_m > 0.0:
        every = np.concatenate([path.poses_at(s)[1] for s in stamps])
        used.append(ground_places(scenario, every, reach_m))
    all_stamps: list[IntArray] = []
    of_lidar: list[IntArray] = []
    parts: list[tuple[Array, Array, IntArray, IntArray]] = []
    scan = 0
    for k, (name, own) in enumerate(zip(names, stamps, strict=True)):
        R, t = path.poses_at(own)
        model = scenario.lidars[name]
        T, part = model.mounting.pose(), _used_part(model, scenario.crop)
        eyes, turns = t + R @ T.translation(), R @ T.rotation().matrix()
        for eye, turn in zip(eyes, turns, strict=True):
            for places in used:
                own_moments, own_normals, which = _seen(model, part, faces, places, eye, turn)
                of_scan = np.full(len(which), scan, dtype=np.int64)
                parts.append((own_moments, own_normals, places.face[which], of_scan))
            scan += 1
        all_stamps.append(own)
        of_lidar.append(np.full(len(own), k))
    moments, normals, faces_seen, scans = zip(*parts, strict=True)
    of_patch = np.concatenate(scans)
    patches = DrivePatches(
        drive=0,
        lidars=names,
        stamps_ns=np.concatenate(all_stamps),
        scan_lidar=np.concatenate(of_lidar),
        scan=of_patch,
        time_s=np.zeros(len(of_patch)),
        moments=np.concatenate(moments),
        normal_lidar=np.concatenate(normals),
        scatter_m=np.zeros(len(of_patch)),
    )
    return patches, np.concatenate(faces_seen)


def _path(scenario: Scenario, drive: Route) -> GivenTrajectory:
    end = round(1e9 * drive.duration_s)
    stamps = np.unique(np.append(np.arange(0, end, PATH_NS, dtype=np.int64), end))
    states = drive.states(stamps, scenario.world.ground.height_m)
    poses = unstack(states.R_map_vehicle, states.position_map)
    return GivenTrajectory(Trajectory(stamps, poses))


def _seen(
    model: LidarModel,
    used_part: float,
    faces: Faces,
    places: Places,
    eye_map: Array,
    R_map_lidar: Array,
) -> tuple[Array, Array, IntArray]:
    """Moments (n, 4, 4) and normals (n, 3), lidar frame, of the places that are seen; which."""
    away = places.centres_map - eye_map
    distance = np.linalg.norm(away, axis=1)
    cos = -np.einsum("ki,ki->k", places.normals_map, away) / distance
    kept = np.flatnonzero(cos > MIN_COS)
    local = away[kept] @ R_map_lidar
    _, inside = within(model, local[:, None])
    elevation = np.arcsin(local[:, 2] / distance[kept])
    density = used_part * cos[kept]
    density /= distance[kept] ** 2 * solid_angle(model, elevation)
    good: BoolArray = (inside > 0.0) & (density * MAX_PATCH_M**2 >= MIN_POINTS)
    kept, local, density = kept[good], local[good], density[good]
    clear = ~faces.hide(eye_map, places.centres_map[kept])
    kept, local, density = kept[clear], local[clear], density[clear]
    half = places.half_m[kept]
    axes = places.axes_map[kept] @ R_map_lidar
    # Points spread evenly over a rectangle: their variance along a side is half^2 / 3.
    spread = np.einsum("na,nai,naj->nij", half**2 / 3.0, axes, axes)
    count = density * 4.0 * half[:, 0] * half[:, 1]
    h = np.column_stack([local, np.ones(len(kept))])
    moments = h[:, :, None] * h[:, None, :]
    moments[:, :3, :3] += spread
    return count[:, None, None] * moments, places.normals_map[kept] @ R_map_lidar, kept


def _used_part(model: LidarModel, crop: CropModel | None) -> float:
    """Part of the beams that are used: of dense clouds an even part; those that are cropped not."""
    low, high = model.horizontal_fov_deg
    beams = len(channel_elevations_deg(model)) * (high - low) / model.horizontal_resolution_deg
    kept = 1.0
    if crop is not None:
        kept = crop.elsewhere_stride**-2.0 if crop.elsewhere_stride else 0.0
    return min(kept, MAX_POINTS / beams)
