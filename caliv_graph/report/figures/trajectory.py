"""Figures of the trajectory: the drive from above, biases and GNSS residuals, corrections."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from caliv_graph.geometry.se3 import stack
from caliv_graph.products import Array, Solution
from caliv_graph.report.figures.drawing import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    PURPLE,
    SYMBOLS,
    VERMILLION,
    Figure,
    colours,
    evenly,
    finish,
    first_stamp,
    label,
    labels,
    small,
    stamps_along,
    to_seconds,
)
from caliv_graph.report.figures.plot import Plot
from caliv_graph.report.residuals import gnss_residuals
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory

MOST_SAMPLES = 3000
"""Points of a line over time."""

_AXIS_STYLES = ((BLUE, "circle"), (VERMILLION, "square"), (GREEN, "diamond"))
"""Colour and marker of x, y, z."""


def path_figure(
    drive: int,
    trajectory: VehicleTrajectory,
    solution: Solution,
    name: str,
    lidars: Sequence[str],
) -> Figure:
    """The drive from above: path, scans that see the target, the target, GNSS fixes."""
    _, t = trajectory.poses_at(stamps_along(trajectory, 1500))
    origin = t[0]
    begin_ns, end_ns = trajectory.span_ns
    figure = Plot()
    x, y, _ = small(t - origin).T
    figure.add("scatter", x=x, y=y, mode="lines", line={"color": BLACK, "width": 1}, name="vehicle")
    if isinstance(trajectory, SmoothedTrajectory):
        fixes, residuals = gnss_residuals(trajectory)
        if len(fixes):
            # The residual is the predicted position minus the fix.
            _, at = trajectory.poses_at(np.clip(fixes, begin_ns, end_ns))
            _dots(figure, at - residuals - origin, "GNSS fixes", GREY, "circle-open", 5)
        rejected = trajectory.gnss_rejected
        rejected = rejected[(rejected >= begin_ns) & (rejected <= end_ns)]
        if len(rejected):
            _, at = trajectory.poses_at(rejected)
            _dots(figure, at - origin, "dropped GNSS fixes", VERMILLION, "x", 10)
    colour, shown = colours(lidars), labels(lidars)
    clouds = [c for r in solution.registrations for c in r.observation.clouds if c.drive == drive]
    for i, lidar in enumerate(lidars):
        seen = np.unique([c.stamp_ns for c in clouds if c.lidar == lidar]).astype(np.int64)
        if len(seen):
            _, at = trajectory.poses_at(np.clip(seen, begin_ns, end_ns))
            beside = at - origin + np.array([0.0, 0.12 * i, 0.0])
            sees = f"{shown[lidar]} sees a target ({len(seen)} scans)"
            _dots(figure, beside, sees, colour[lidar], SYMBOLS[i % len(SYMBOLS)], 6)
    for r in solution.registrations:
        if any(c.drive == drive for c in r.observation.clouds):
            place = (r.observation.centre_map - origin)[None]
            _dots(figure, place, label(r.observation.name), PURPLE, "star", 15)
    figure.y_axes(scaleanchor="x", title="m")
    figure.x_axes(title="m, from the first pose, map axes", constrain="domain")
    finish(figure, 480)
    return Figure(
        f"path_{drive}",
        f"Recording '{name}' from above. Scans of further LiDARs are drawn beside the path.",
        figure,
    )


def motion_figure(drive: int, trajectory: SmoothedTrajectory, name: str) -> Figure:
    """Biases of the IMU, or motion of the axle without one, and GNSS residuals over time."""
    nodes = trajectory.nodes_ns
    begin = int(nodes[0])
    some = evenly(len(nodes), MOST_SAMPLES // 6)
    seconds = to_seconds(nodes[some] - begin)
    fixes, r = gnss_residuals(trajectory)
    wheels = trajectory.data.wheels
    titles = ["accelerometer bias (mm/s²)", "gyroscope bias (mrad/s)"]
    if wheels is not None:
        rates = "bias of the yaw rate (mrad/s)" if wheels.yaw_rate else "minus the rates (mrad/s)"
        titles = ["minus the acceleration (mm/s²)", rates]
    if len(fixes):
        titles.append("GNSS residual (mm)")
    figure = Plot(titles, stacked=True, spacing=0.09)
    force_sigma, gyro_sigma = trajectory.bias_sigmas()
    dashes, axes = ("solid", "dash", "dot"), "xyz"
    states = trajectory.states
    for panel, (values, sigma) in enumerate(
        ((states.force_bias, force_sigma), (states.gyro_bias, gyro_sigma)), start=1
    ):
        for axis, (colour, _) in enumerate(_AXIS_STYLES):
            value, spread = 1e3 * values[some, axis], 1e3 * sigma[some, axis]
            figure.add(
                "scatter",
                x=np.concatenate([seconds, seconds[::-1]]),
                y=small(np.concatenate([value + spread, (value - spread)[::-1]])),
                fill="toself",
                fillcolor=f"{colour}22",
                line={"width": 0},
                mode="lines",
                hoverinfo="skip",
                showlegend=False,
                panel=panel,
            )
            figure.add(
                "scatter",
                x=seconds,
                y=small(value),
                mode="lines",
                line={"color": colour, "dash": dashes[axis]},
                name=f"{axes[axis]} of the {'IMU' if wheels is None else 'axle'}",
                legendgroup=f"bias {axis}",
                showlegend=panel == 1,
                panel=panel,
            )
    if len(fixes):
        few = evenly(len(fixes), MOST_SAMPLES // 3)
        for axis, (colour, symbol) in enumerate(_AXIS_STYLES):
            figure.add(
                "scatter",
                x=to_seconds(fixes[few] - begin),
                y=small(1e3 * r[few, axis]),
                mode="markers",
                marker={"color": colour, "symbol": symbol, "size": 4},
                name=("east", "north", "up")[axis],
                panel=3,
            )
    figure.x_axes(title="seconds", panel=len(titles))
    finish(figure, 200 * len(titles) + 60)
    dropped = len(trajectory.gnss_rejected)
    return Figure(
        f"motion_{drive}",
        f"Recording '{name}': {'IMU biases' if wheels is None else 'motion of the axle'} "
        "(bands: 1 sigma)"
        + (" and residuals of the GNSS fixes used" if len(fixes) else "")
        + (f"; {dropped} fixes were dropped" if dropped else "")
        + ". No GNSS was recorded." * (not len(fixes)),
        figure,
    )


def correction_figure(
    drive: int, trajectory: VehicleTrajectory, solution: Solution, name: str
) -> Figure | None:
    """Change of the vehicle poses by the calibration; None if no pose of this drive was used."""
    used = [(stamp, T) for (d, stamp), T in solution.T_map_vehicle.items() if d == drive]
    if not used:
        return None
    stamps = np.array([stamp for stamp, _ in used], dtype=np.int64)
    R, t = trajectory.poses_at(stamps)
    R_new, t_new = stack([T for _, T in used])
    back = np.swapaxes(R, 1, 2)
    rotation = Rotation.from_matrix(back @ R_new).as_rotvec()
    translation = np.einsum("nij,nj->ni", back, t_new - t)
    figure = Plot(("rotation (mrad)", "position (mm)"), stacked=True, spacing=0.14)
    seconds = to_seconds(stamps - first_stamp(stamps))
    for panel, values in enumerate((rotation, translation), start=1):
        for axis, (colour, symbol) in enumerate(_AXIS_STYLES):
            figure.add(
                "scatter",
                x=seconds,
                y=small(1e3 * values[:, axis]),
                mode="markers",
                marker={"color": colour, "symbol": symbol, "size": 5},
                name=f"{'xyz'[axis]} (vehicle axes)",
                legendgroup=f"correction {axis}",
                showlegend=panel == 1,
                panel=panel,
            )
    figure.x_axes(title="seconds from the first scan used", panel=2)
    finish(figure, 420)
    before = "smoothed" if isinstance(trajectory, SmoothedTrajectory) else "given"
    return Figure(
        f"correction_{drive}",
        f"Recording '{name}': vehicle poses of the solved graph minus the {before} input poses.",
        figure,
    )


def _dots(figure: Plot, points: Array, name: str, colour: str, symbol: str, size: int) -> None:
    some = small(points[evenly(len(points), MOST_SAMPLES)])
    figure.add(
        "scatter",
        x=some[:, 0],
        y=some[:, 1],
        mode="markers",
        marker={"color": colour, "symbol": symbol, "size": size},
        name=name,
        hovertemplate="%{x:.2f}, %{y:.2f} m",
    )
