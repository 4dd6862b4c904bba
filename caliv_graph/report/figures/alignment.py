"""Figures of the alignment: target and scene, with the initial extrinsics and the solved ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gtsam
import numpy as np

from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, Calibration, LidarResult, LidarScan, Solution
from caliv_graph.report.figures.drawing import (
    BLACK,
    SYMBOLS,
    Figure,
    colours,
    evenly,
    finish,
    labels,
    small,
    stamps_along,
)
from caliv_graph.report.figures.plot import Plot
from caliv_graph.trajectory.deskew import deskew
from caliv_graph.trajectory.select import VehicleTrajectory

MOST_POINTS = 12000
"""Points of a 3-D view, so that ten views are smaller than plotly itself."""


def target_figures(
    placement: int, solution: Solution, calibration: Calibration
) -> tuple[Figure, Figure]:
    """A target with the initial and with the solved extrinsics, in 3-D and in two flat views."""
    registration = solution.registrations[placement]
    lidars = list(calibration.lidars)
    before = _target_points(placement, solution, calibration, guess=True)
    after = _target_points(placement, solution, calibration, guess=False)
    name = registration.observation.name
    note = (
        f"Clouds of '{name}' from all scans of each LiDAR, merged with the initial extrinsics "
        "(left) and with the solved ones (right). Metres from the target's centre, map axes."
    )
    solid = _pair_of_scenes(before, after, lidars, 2, found=_all_found(calibration))
    flat = Plot(("before, from above", "after", "before, from the side", "after"), spacing=0.05)
    colour, shown = colours(lidars), labels(lidars)
    reach = min(_reach(before.values()), 1.6 * _reach(after.values()))
    for panel, (points, pick) in enumerate(
        ((before, (0, 1)), (after, (0, 1)), (before, (0, 2)), (after, (0, 2))), start=1
    ):
        for i, lidar in enumerate(lidars):
            if lidar not in points:
                continue
            p = points[lidar][evenly(len(points[lidar]), 900)]
            flat.add(
                "scatter",
                x=small(p[:, pick[0]]),
                y=small(p[:, pick[1]]),
                mode="markers",
                marker={
                    "color": colour[lidar],
                    "size": 3,
                    "opacity": 0.6,
                    "symbol": SYMBOLS[i % len(SYMBOLS)],
                },
                name=shown[lidar],
                legendgroup=shown[lidar],
                showlegend=panel == 1,
                hoverinfo="skip",
                panel=panel,
            )
        flat.x_axes(range=[-reach, reach], constrain="domain", panel=panel)
        anchor = f"x{panel if panel > 1 else ''}"
        flat.y_axes(range=[-reach, reach], scaleanchor=anchor, panel=panel)
    finish(flat, 340)
    return (
        Figure(f"target_{placement}", note, solid, solid=True),
        Figure(f"target_flat_{placement}", f"{note} Views from above and from the side.", flat),
    )


def scene_figure(
    drive: int,
    trajectory: VehicleTrajectory,
    scans: Sequence[LidarScan],
    calibration: Calibration,
    name: str,
) -> Figure | None:
    """Scans in the map with the initial and with the solved extrinsics; None if none was kept."""
    share = max(MOST_POINTS // max(len(scans), 1), 20)
    before = _scene_points(trajectory, scans, calibration, share, guess=True)
    after = _scene_points(trajectory, scans, calibration, share, guess=False)
    if not after:
        return None
    _, t = trajectory.poses_at(stamps_along(trajectory, 200))
    return Figure(
        f"scene_{drive}",
        f"Recording '{name}': some scans of every LiDAR in the map, with the initial extrinsics "
        "(left) and with the solved ones (right), on the same vehicle poses. Objects that appear "
        "twice on the left and once on the right show the effect of the calibration. Metres from "
        "the first pose; black: the vehicle.",
        _pair_of_scenes(
            before, after, list(calibration.lidars), 1.5, t - t[0], _all_found(calibration)
        ),
        solid=True,
    )


def _target_points(
    placement: int, solution: Solution, calibration: Calibration, guess: bool
) -> dict[str, Array]:
    """Per LiDAR the points (N, 3) of its clouds, metres from the target's centre, map axes."""
    registration = solution.registrations[placement]
    # Map axes: the target's own axes are rotated by the error of the initial guess.
    centre_map = solution.T_target_map[placement].inverse().translation()
    out: dict[str, list[Array]] = {}
    budget = max(MOST_POINTS // max(len(registration.observation.clouds), 1), 20)
    for cloud in registration.observation.clouds:
        extrinsic = _extrinsic(calibration.lidars[cloud.lidar], guess)
        T_map_vehicle = solution.T_map_vehicle[cloud.drive, cloud.stamp_ns]
        R, t = stack([T_map_vehicle.compose(extrinsic)])
        points = cloud.points_lidar[evenly(len(cloud.points_lidar), budget)]
        out.setdefault(cloud.lidar, []).append(points @ R[0].T + t[0] - centre_map)
    return {name: np.concatenate(points) for name, points in out.items()}


def _all_found(calibration: Calibration) -> bool:
    return all(lidar.without_guess for lidar in calibration.lidars.values())


def _extrinsic(lidar: LidarResult, guess: bool) -> gtsam.Pose3:
    return lidar.guess.T_vehicle_lidar if guess and lidar.guess else lidar.T_vehicle_lidar


def _scene_points(
    trajectory: VehicleTrajectory,
    scans: Sequence[LidarScan],
    calibration: Calibration,
    budget: int,
    guess: bool,
) -> dict[str, Array]:
    """Per LiDAR the points (N, 3) of its scans in the map, metres from the first pose."""
    begin, end = trajectory.span_ns
    _, origin = trajectory.poses_at([begin])
    out: dict[str, list[Array]] = {}
    for scan in scans:
        extrinsic = _extrinsic(calibration.lidars[scan.lidar], guess)
        if not begin <= scan.stamp_ns <= end:
            continue
        try:
            points = deskew(scan, extrinsic, trajectory).points_lidar
        except TrajectoryError:  # invalid point times: the solve has raised or warned already
            continue
        R, t = trajectory.poses_at([scan.stamp_ns])
        R_extrinsic, t_extrinsic = stack([extrinsic])
        points = points[evenly(len(points), budget)] @ R_extrinsic[0].T + t_extrinsic[0]
        out.setdefault(scan.lidar, []).append(points @ R[0].T + t[0] - origin[0])
    return {name: np.concatenate(points) for name, points in out.items()}


def _pair_of_scenes(
    before: Mapping[str, Array],
    after: Mapping[str, Array],
    lidars: Sequence[str],
    size: float,
    path: Array | None = None,
    found: bool = False,
) -> Plot:
    """Both in 3-D; `found`: the guesses were not given but found in the drive."""
    first = "found in the drive" if found else "initial guess"
    figure = Plot((f"before: {first}", "after"), solid=True, spacing=0.01)
    colour, shown = colours(lidars), labels(lidars)
    for panel, points in enumerate((before, after), start=1):
        for name in lidars:
            if name not in points:
                continue
            x, y, z = small(points[name]).T
            figure.add(
                "scatter3d",
                x=x,
                y=y,
                z=z,
                mode="markers",
                # Of all symbols the one with the fewest triangles: half the time without a GPU.
                marker={"color": colour[name], "size": size, "symbol": "square"},
                name=shown[name],
                legendgroup=shown[name],
                showlegend=panel == 1,
                hoverinfo="skip",
                panel=panel,
            )
        if path is not None:
            x, y, z = small(path).T
            figure.add(
                "scatter3d",
                x=x,
                y=y,
                z=z,
                mode="lines",
                line={"color": BLACK, "width": 5},
                name="vehicle",
                legendgroup="vehicle",
                showlegend=panel == 1,
                hoverinfo="skip",
                panel=panel,
            )
    axis = {"title": {"text": ""}, "backgroundcolor": "#F7F7F7", "gridcolor": "#DDDDDD"}
    # A drive is flat and wide: the camera is higher, and the view larger.
    longest, eye = (1.25, (-1.1, -1.1, 0.9)) if path is None else (1.7, (-0.8, -0.8, 1.1))
    camera = {"eye": dict(zip("xyz", eye, strict=True))}
    spans = {}
    everything = np.concatenate([*before.values(), *after.values()])
    low, high = np.percentile(everything, [0.2, 99.8], axis=0)
    for key, a, b in zip(("xaxis", "yaxis", "zaxis"), low, high, strict=True):
        margin = 0.03 * max(float(b - a), 0.1)
        spans[key] = {**axis, "range": [round(float(a) - margin, 3), round(float(b) + margin, 3)]}
    # The same box on both sides, to scale, but at least 0.1 m high: a flat box is hard to read.
    extent: Array = np.maximum(high - low, 0.1)
    aspect = dict(zip("xyz", (longest * extent / extent.max()).round(3).tolist(), strict=True))
    figure.scenes(aspectmode="manual", aspectratio=aspect, camera=camera, **spans)
    finish(figure, 480)
    figure.layout["legend"]["itemsizing"] = "constant"
    return figure


def _reach(parts: Any) -> float:
    points = np.abs(np.concatenate(list(parts)))
    return 1.15 * float(np.percentile(points, 99.5))
