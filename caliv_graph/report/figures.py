"""Figures of the report. Degrees and millimetres exist here only.

Colours are those of Okabe and Ito (2008), told apart by the colour-blind; what matters differs in
its marker or dash as well, for print.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt
import plotly.graph_objects as go
from plotly.io import templates
from plotly.io.json import to_json_plotly
from plotly.subplots import make_subplots
from scipy.spatial.transform import Rotation

from caliv_graph.calibration.refine import STEP_SIGMAS, STEP_TOLERANCE
from caliv_graph.conventions import AXES, NANOSECONDS_PER_SECOND
from caliv_graph.errors import TrajectoryError
from caliv_graph.geometry.covariance import parent_axes_covariance
from caliv_graph.geometry.se3 import right_to_vehicle_axes, stack
from caliv_graph.products import Array, Calibration, IntArray, LidarScan, Solution
from caliv_graph.report.residuals import Residuals, figures_of, gnss_residuals
from caliv_graph.trajectory.deskew import deskew
from caliv_graph.trajectory.select import VehicleTrajectory
from caliv_graph.trajectory.smoothed import SmoothedTrajectory
from caliv_graph.uncertainty.observability import UNDETERMINED_RATIO, WEAK_RATIO, spectrum

BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK, GREY = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#000000",
    "#767676",
)

LIDAR_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK)

SYMBOLS = ("circle", "square", "diamond", "cross", "x", "triangle-up", "star")

WIDTH = 980
"""Pixels; in print the page is scaled to its paper."""

MOST_POINTS = 12000
"""Of a 3-D view, so that ten views stay below the size of plotly itself."""

MOST_SAMPLES = 3000
"""Of a line over time."""

LONGEST_NAME = 20
"""Letters of a name in a figure; the tables have all of them."""


@dataclass(frozen=True)
class Figure:
    """A figure and what to say about it.

    Attributes:
        name: unique, a word for the page's elements.
        caption: what it shows, and how to read it.
        figure: what plotly draws.
        solid: whether it is a 3-D view.
    """

    name: str
    caption: str
    figure: go.Figure
    solid: bool = False


@contextmanager
def without_template() -> Iterator[None]:
    """Figures made inside have no template yet: plotly would check all of it again at each step."""
    before = templates.default
    templates.default = None
    try:
        yield
    finally:
        templates.default = before


def figure_json(figure: Figure) -> str:
    """What plotly.js draws: data, layout, and the template of the page."""
    document = figure.figure.to_plotly_json()
    document["layout"]["template"] = _template()
    return str(to_json_plotly(document))


@cache
def _template() -> Mapping[str, Any]:
    found: Mapping[str, Any] = templates["plotly_white"].to_plotly_json()
    return found


def label(text: str) -> str:
    """A user's name as plotly shows it: its own tags (`<b>`, `<a>`) do not work in there."""
    return escape(text, quote=False)


def labels(lidars: Iterable[str]) -> dict[str, str]:
    """A label per LiDAR: short where a name is long and still tells it from the others."""
    names = list(lidars)
    half = LONGEST_NAME // 2
    short = {
        name: name if len(name) <= LONGEST_NAME else f"{name[:half]}…{name[1 - half :]}"
        for name in names
    }
    distinct = len(set(short.values())) == len(names)
    return {name: label(short[name] if distinct else name) for name in names}


def colours(lidars: Sequence[str]) -> dict[str, str]:
    """A colour per LiDAR, by its place in the config."""
    return {name: LIDAR_COLOURS[i % len(LIDAR_COLOURS)] for i, name in enumerate(lidars)}


def sigma_figure(calibration: Calibration) -> Figure | None:
    """What the drive added: sigmas before and after, per LiDAR and axis."""
    figure = make_subplots(1, 2, subplot_titles=("rotation (mrad)", "position (mm)"))
    shown = labels(calibration.lidars)
    prior: dict[int, list[tuple[str, float]]] = {1: [], 2: []}
    told: dict[int, list[tuple[str, float]]] = {1: [], 2: []}
    held: dict[int, list[tuple[str, float]]] = {1: [], 2: []}
    for name, lidar in calibration.lidars.items():
        if lidar.guess is not None and lidar.guess.fixed:
            continue
        after = np.sqrt(np.diag(parent_axes_covariance(lidar.T_vehicle_lidar, lidar.cov)))
        for i, axis in enumerate(AXES):
            column, at = (1 if i < 3 else 2), f"{shown[name]} {axis}"
            if lidar.guess is not None:
                prior[column].append((at, 1e3 * float(lidar.guess.sigmas[i])))
            (told if lidar.determined[axis] else held)[column].append((at, 1e3 * float(after[i])))
    if not any((*told.values(), *held.values())):
        return None
    order = {
        c: [f"{shown[n]} {axis}" for n in calibration.lidars for axis in axes]
        for c, axes in ((1, AXES[:3]), (2, AXES[3:]))
    }
    for what, kinds, marker in (
        ("initial guess", prior, {"symbol": "circle-open", "color": GREY, "size": 11}),
        ("determined by the drive", told, {"symbol": "square", "color": BLUE, "size": 9}),
        (
            "not determined: what the guess leaves",
            held,
            {"symbol": "x-open", "color": VERMILLION, "size": 11, "line": {"width": 3}},
        ),
    ):
        in_legend = False
        for column in (1, 2):
            if not kinds[column]:
                continue
            figure.add_scatter(
                x=[at for at, _ in kinds[column]],
                y=[_short(sigma) for _, sigma in kinds[column]],
                mode="markers",
                marker=marker,
                name=what,
                legendgroup=what,
                showlegend=not in_legend,
                hovertemplate="%{x}: %{y:.3g}",
                row=1,
                col=column,
            )
            in_legend = True
    for column in (1, 2):
        figure.update_xaxes(
            categoryorder="array", categoryarray=order[column], tickangle=-50, row=1, col=column
        )
    figure.update_yaxes(type="log", dtick="D2")
    finish(figure, 400)
    return Figure(
        "sigmas",
        "1 sigma in vehicle axes, before (circles) and after the drive. A cross marks an axis "
        "that the drive did not determine: its sigma is what the initial guesses leave.",
        figure,
    )


def spectrum_figure(solution: Solution) -> Figure:
    """How well the data determine each direction, against the guesses."""
    split = spectrum(solution.information_data, solution.information_prior)
    order = np.argsort(split.sigma_data, kind="stable")
    data, prior = split.sigma_data[order], split.sigma_prior[order]
    # Where the data say nothing the sigma is infinite, or as good as: put at the upper edge.
    top = 30.0 * float(prior.max())
    number = np.arange(1, len(data) + 1)
    figure = go.Figure()
    for dash, ratio, what in (
        ("solid", 1.0, "initial guess"),
        ("dash", UNDETERMINED_RATIO, f"{UNDETERMINED_RATIO:g} of it: above, undetermined"),
        ("dot", WEAK_RATIO, f"{WEAK_RATIO:g} of it: above, weak"),
    ):
        figure.add_scatter(
            x=number,
            y=small(ratio * prior),
            mode="lines",
            line={"color": GREY, "dash": dash, "shape": "hvh"},
            name=what,
            hovertemplate="%{y:.3g}",
        )
    verdicts = (
        ("determined", ~(split.undetermined | split.weak)[order], BLUE, "square"),
        ("weak", split.weak[order], ORANGE, "diamond"),
        ("undetermined", split.undetermined[order], VERMILLION, "x"),
    )
    for what, mask, colour, symbol in verdicts:
        if mask.any():
            beyond = data[mask] > top
            figure.add_scatter(
                x=number[mask],
                y=small(np.minimum(data[mask], top)),
                mode="markers",
                marker={
                    "color": colour,
                    "size": 11,
                    "symbol": ["triangle-up" if b else symbol for b in beyond],
                },
                name=f"data: {what}",
                hovertemplate="direction %{x}: %{y:.3g}",
            )
    figure.update_yaxes(type="log", title="1 sigma (mrad; 1 mrad as 10 mm)", dtick=1)
    figure.update_xaxes(title="direction, best determined first", dtick=1)
    finish(figure, 380)
    held = (
        f" Mode {solution.mode} holds {', '.join(solution.held)} at the guess, whatever the data "
        "say."
        if solution.held
        else ""
    )
    return Figure(
        "spectrum",
        "What the data alone say about all extrinsics together, direction by direction (the "
        "eigenvectors of their information, 1 mrad counted as 10 mm). A triangle at the upper "
        f"edge: nothing, or next to nothing.{held}",
        figure,
    )


def correlation_figure(calibration: Calibration) -> Figure:
    """Correlations of all extrinsics, vehicle axes."""
    names = [n for n, lidar in calibration.lidars.items() if lidar.saw_target]
    rows = [i for i, n in enumerate(calibration.lidars) if n in names]
    pick = np.concatenate([np.arange(6 * i, 6 * i + 6) for i in rows]) if rows else np.zeros(0, int)
    axes = np.zeros((len(pick), len(pick)))
    for k, name in enumerate(names):
        block = slice(6 * k, 6 * k + 6)
        axes[block, block] = right_to_vehicle_axes(calibration.lidars[name].T_vehicle_lidar)
    cov = axes @ calibration.cov_joint[np.ix_(pick, pick)] @ axes.T
    sigma = np.sqrt(np.diag(cov))
    shown = labels(names)
    ticks = [
        f"{shown[name]} {axis}{'' if calibration.lidars[name].determined[axis] else ' (held)'}"
        for name in names
        for axis in AXES
    ]
    figure = go.Figure(
        go.Heatmap(
            z=np.round(cov / np.outer(sigma, sigma), 2),
            x=ticks,
            y=ticks,
            zmin=-1.0,
            zmax=1.0,
            colorscale=[[0.0, BLUE], [0.5, "#FFFFFF"], [1.0, VERMILLION]],
            colorbar={"title": {"text": "correlation"}},
            hovertemplate="%{y}<br>%{x}<br>%{z:.2f}<extra></extra>",
            xgap=1,
            ygap=1,
        )
    )
    figure.update_yaxes(autorange="reversed", scaleanchor="x", constrain="domain")
    figure.update_xaxes(tickangle=-60, constrain="domain")
    finish(figure, min(460 + 14 * len(ticks), 900))
    return Figure(
        "correlation",
        "Correlations of the reported covariance, vehicle axes, priors included. Numbers near -1 "
        "or 1 mean that two errors go together; (held): not determined by the drive.",
        figure,
    )


def residual_figure(residuals: Residuals, number: int) -> Figure:
    """Whitened residuals against N(0, 1), and what they are in millimetres and milliradians."""
    count = 1 + len(residuals.physical)
    titles = ["whitened, all axes", *(f"{q} ({u})" for q, (u, _) in residuals.physical.items())]
    figure = make_subplots(1, count, subplot_titles=titles)
    edges = np.linspace(-5.0, 5.0, 41)
    white = np.clip(residuals.whitened.ravel(), -4.99, 4.99)
    density, _ = np.histogram(white, edges, density=True)
    middles = 0.5 * (edges[1:] + edges[:-1])
    figure.add_bar(
        x=small(middles), y=small(density), marker={"color": SKY}, name="whitened", row=1, col=1
    )
    x = np.linspace(-5.0, 5.0, 121)
    figure.add_scatter(
        x=small(x),
        y=small(np.exp(-0.5 * x**2) / math.sqrt(2.0 * math.pi)),
        mode="lines",
        line={"color": BLACK, "width": 2},
        name="N(0, 1)",
        row=1,
        col=1,
    )
    for column, values in enumerate((v for _, v in residuals.physical.values()), start=2):
        # A cloud that shows one face of the target says nothing along it: its residual there is
        # any number. What is drawn is the middle; what is outside is in the outermost bars.
        reach = max(6.0 * float(np.median(np.abs(values))), 1e-6)
        heights, bounds = np.histogram(np.clip(values, -reach, reach), 40, (-reach, reach))
        figure.add_bar(
            x=small(0.5 * (bounds[1:] + bounds[:-1])),
            y=heights,
            marker={"color": GREEN},
            name="count",
            row=1,
            col=column,
        )
    figure.update_layout(bargap=0.05, showlegend=False)
    finish(figure, 260)
    n, k = residuals.whitened.shape
    wide = " Wider than assumed: the noise is larger than stated, or something is not in the model."
    return Figure(
        f"residuals_{number}",
        f"{residuals.kind.capitalize() if residuals.kind[1].islower() else residuals.kind}: {n} "
        f"measurements of {k} {'number' if k == 1 else 'numbers each'}. Whitened: root mean square "
        f"{residuals.rms:.2f}, {100.0 * residuals.beyond_three:.1f} % beyond 3 (of a normal "
        f"distribution, 0.3 %; the line is N(0, 1)). "
        + "; ".join(
            f"{quantity}: median |r| {figures_of(np.median(np.abs(v)))} {unit}, 95 % below "
            f"{figures_of(np.percentile(np.abs(v), 95))} {unit}"
            for quantity, (unit, v) in residuals.physical.items()
        )
        + ". What lies outside a panel is in its outermost bars."
        + (wide if residuals.rms > 1.5 else ""),
        figure,
    )


def weight_figure(solution: Solution, lidars: Sequence[str]) -> Figure:
    """Robust weight of every cloud over time."""
    colour, shown = colours(lidars), labels(lidars)
    begin = _begin(c.stamp_ns for r in solution.registrations for c in r.observation.clouds)
    drives = len({c.drive for r in solution.registrations for c in r.observation.clouds})
    figure = go.Figure()
    for i, name in enumerate(lidars):
        at: list[float] = []
        weight: list[float] = []
        for r, weights in zip(solution.registrations, solution.cloud_weights, strict=True):
            for cloud, w in zip(r.observation.clouds, weights, strict=True):
                if cloud.lidar == name:
                    at.append(_seconds(cloud.stamp_ns - begin))
                    weight.append(float(w))
        if at:
            figure.add_scatter(
                x=small(np.array(at)),
                y=small(np.array(weight)),
                mode="markers",
                marker={"color": colour[name], "symbol": SYMBOLS[i % len(SYMBOLS)], "size": 7},
                name=shown[name],
                hovertemplate="%{x:.2f} s: weight %{y:.2f}",
            )
    figure.update_yaxes(title="weight", range=[-0.05, 1.05])
    figure.update_xaxes(title=f"seconds{' (drives overlaid by their stamps)' * (drives > 1)}")
    finish(figure, 300)
    return Figure(
        "weights",
        "Weight of every cloud of a target in the solve: 1 full, 0 dropped. A run of low weights "
        "means that a LiDAR contradicts the rest for some time; single ones are the noise's.",
        figure,
    )


def course_figure(solution: Solution) -> Figure | None:
    """Convergence of the joint loop; None if there was none."""
    if not solution.course:
        return None
    number = np.arange(1, len(solution.course) + 1)
    figure = go.Figure()
    for what, values, colour, symbol, dash, limit in (
        (
            "rotation (mrad)",
            [1e3 * i.turn_rad for i in solution.course],
            BLUE,
            "circle",
            "solid",
            1e3 * STEP_TOLERANCE[0],
        ),
        (
            "position (mm)",
            [1e3 * i.shift_m for i in solution.course],
            VERMILLION,
            "square",
            "dash",
            1e3 * STEP_TOLERANCE[1],
        ),
        (
            "joint sigmas",
            [i.sigmas for i in solution.course],
            GREEN,
            "diamond",
            "dot",
            STEP_SIGMAS,
        ),
    ):
        figure.add_scatter(
            x=number,
            y=small(np.maximum(values, 1e-9)),
            mode="lines+markers",
            line={"color": colour, "dash": dash},
            marker={"symbol": symbol, "size": 8},
            name=f"step, {what}; small enough below {limit:g}",
            hovertemplate="iteration %{x}: %{y:.3g}",
        )
    figure.update_yaxes(type="log", title="largest step of a mounting", exponentformat="power")
    figure.update_xaxes(title="iteration", dtick=1)
    finish(figure, 340)
    return Figure(
        "course",
        "Expectation-maximisation whose M-step is the graph solve: the step of the extrinsics per "
        "iteration. It ends when the step is small in rotation and position, or in joint standard "
        "deviations of the extrinsics.",
        figure,
    )


def path_figure(
    drive: int,
    trajectory: VehicleTrajectory,
    solution: Solution,
    name: str,
    lidars: Sequence[str],
) -> Figure:
    """The drive from above: path, scans of the target, the target, GNSS."""
    stamps = _samples(trajectory, 1500)
    _, t = trajectory.poses_at(stamps)
    origin = t[0]
    figure = go.Figure()
    _line(figure, t[:, 0] - origin[0], t[:, 1] - origin[1], "vehicle", BLACK)
    if isinstance(trajectory, SmoothedTrajectory):
        fixes, residuals = gnss_residuals(trajectory)
        if len(fixes):
            # The residual is what the estimate predicts less the fix.
            _, at = trajectory.poses_at(np.clip(fixes, *trajectory.span_ns))
            place = at - residuals - origin
            _dots(
                figure,
                place[:, 0],
                place[:, 1],
                "GNSS fixes (their residual from the path)",
                GREY,
                "circle-open",
                5,
            )
        rejected = trajectory.gnss_rejected
        rejected = rejected[
            (rejected >= trajectory.span_ns[0]) & (rejected <= trajectory.span_ns[1])
        ]
        if len(rejected):
            _, at = trajectory.poses_at(rejected)
            place = at - origin
            _dots(
                figure,
                place[:, 0],
                place[:, 1],
                "where GNSS fixes were dropped",
                VERMILLION,
                "x",
                10,
            )
    colour, shown = colours(lidars), labels(lidars)
    for i, lidar in enumerate(lidars):
        seen = np.unique(
            [
                c.stamp_ns
                for r in solution.registrations
                for c in r.observation.clouds
                if c.lidar == lidar and c.drive == drive
            ]
        ).astype(np.int64)
        if len(seen):
            _, at = trajectory.poses_at(np.clip(seen, *trajectory.span_ns))
            side = 0.12 * i
            _dots(
                figure,
                at[:, 0] - origin[0],
                at[:, 1] - origin[1] + side,
                f"{shown[lidar]} sees a target ({len(seen)} scans)",
                colour[lidar],
                SYMBOLS[i % len(SYMBOLS)],
                6,
            )
    for r in solution.registrations:
        if any(c.drive == drive for c in r.observation.clouds):
            x, y, _ = r.observation.centre_map - origin
            _dots(
                figure,
                np.array([x]),
                np.array([y]),
                label(r.observation.name),
                PURPLE,
                "star",
                15,
            )
    figure.update_yaxes(scaleanchor="x", title="m")
    figure.update_xaxes(title="m, from the first pose, map axes", constrain="domain")
    finish(figure, 480)
    return Figure(
        f"path_{drive}",
        f"Recording '{name}' from above. Scans of a second LiDAR are drawn aside.",
        figure,
    )


def motion_figure(drive: int, trajectory: SmoothedTrajectory, name: str) -> Figure:
    """IMU biases and GNSS residuals over time."""
    nodes = trajectory.nodes_ns
    begin = int(nodes[0])
    some = _every(len(nodes), MOST_SAMPLES // 6)
    seconds = _seconds(nodes[some] - begin)
    fixes, r = gnss_residuals(trajectory)
    titles = ["accelerometer bias (mm/s²)", "gyroscope bias (mrad/s)"]
    if len(fixes):
        titles.append("GNSS residual (mm)")
    figure = make_subplots(
        len(titles), 1, shared_xaxes=True, subplot_titles=titles, vertical_spacing=0.09
    )
    force_sigma, gyro_sigma = trajectory.bias_sigmas()
    dashes, axes = ("solid", "dash", "dot"), "xyz"
    states = trajectory.states
    for row, (values, sigma) in enumerate(
        ((states.force_bias, force_sigma), (states.gyro_bias, gyro_sigma)), start=1
    ):
        for axis, colour in enumerate((BLUE, VERMILLION, GREEN)):
            value, spread = 1e3 * values[some, axis], 1e3 * sigma[some, axis]
            figure.add_scatter(
                x=np.concatenate([seconds, seconds[::-1]]),
                y=small(np.concatenate([value + spread, (value - spread)[::-1]])),
                fill="toself",
                fillcolor=f"{colour}22",
                line={"width": 0},
                mode="lines",
                hoverinfo="skip",
                showlegend=False,
                row=row,
                col=1,
            )
            figure.add_scatter(
                x=seconds,
                y=small(value),
                mode="lines",
                line={"color": colour, "dash": dashes[axis]},
                name=f"{axes[axis]} of the IMU",
                legendgroup=f"bias {axis}",
                showlegend=row == 1,
                row=row,
                col=1,
            )
    if len(fixes):
        few = _every(len(fixes), MOST_SAMPLES // 3)
        for axis, (colour, symbol) in enumerate(
            ((BLUE, "circle"), (VERMILLION, "square"), (GREEN, "diamond"))
        ):
            figure.add_scatter(
                x=_seconds(fixes[few] - begin),
                y=small(1e3 * r[few, axis]),
                mode="markers",
                marker={"color": colour, "symbol": symbol, "size": 4},
                name=("east", "north", "up")[axis],
                row=3,
                col=1,
            )
    figure.update_xaxes(title="seconds", row=len(titles), col=1)
    finish(figure, 200 * len(titles) + 60)
    dropped = len(trajectory.gnss_rejected)
    return Figure(
        f"motion_{drive}",
        f"Recording '{name}': biases of the IMU (bands: 1 sigma)"
        + (" and residuals of the GNSS fixes that were used" if len(fixes) else "")
        + (f"; {dropped} fixes were dropped" if dropped else "")
        + ". No GNSS was recorded." * (not len(fixes)),
        figure,
    )


def correction_figure(
    drive: int, trajectory: VehicleTrajectory, solution: Solution, name: str
) -> Figure | None:
    """By how much the LiDARs moved the vehicle's poses."""
    used = [(stamp, T) for (d, stamp), T in solution.T_map_vehicle.items() if d == drive]
    if not used:
        return None
    stamps = np.array([stamp for stamp, _ in used], dtype=np.int64)
    R, t = trajectory.poses_at(stamps)
    R_new, t_new = stack([T for _, T in used])
    back = np.swapaxes(R, 1, 2)
    turn = Rotation.from_matrix(back @ R_new).as_rotvec()
    shift = np.einsum("nij,nj->ni", back, t_new - t)
    figure = make_subplots(
        2,
        1,
        shared_xaxes=True,
        vertical_spacing=0.14,
        subplot_titles=("rotation (mrad)", "position (mm)"),
    )
    seconds = _seconds(stamps - _begin(stamps))
    for row, values in enumerate((turn, shift), start=1):
        for axis, (colour, symbol) in enumerate(
            ((BLUE, "circle"), (VERMILLION, "square"), (GREEN, "diamond"))
        ):
            figure.add_scatter(
                x=seconds,
                y=small(1e3 * values[:, axis]),
                mode="markers",
                marker={"color": colour, "symbol": symbol, "size": 5},
                name=f"{'xyz'[axis]} (vehicle axes)",
                legendgroup=f"correction {axis}",
                showlegend=row == 1,
                row=row,
                col=1,
            )
    figure.update_xaxes(title="seconds from the first scan used", row=2, col=1)
    finish(figure, 420)
    before = "smoothed" if isinstance(trajectory, SmoothedTrajectory) else "given"
    return Figure(
        f"correction_{drive}",
        f"Recording '{name}': vehicle poses of the solved graph against the {before} ones that "
        "went in.",
        figure,
    )


def target_figures(
    placement: int, solution: Solution, calibration: Calibration
) -> tuple[Figure, Figure]:
    """A target with the initial extrinsics and with the solved ones: solid, and in two views."""
    registration = solution.registrations[placement]
    lidars = list(calibration.lidars)
    before = _target_points(placement, solution, calibration, guess=True)
    after = _target_points(placement, solution, calibration, guess=False)
    name = registration.observation.name
    note = (
        f"'{name}' as each LiDAR saw it in all of its scans, put together with the initial "
        "extrinsics (left) and the solved ones (right). Metres from the target's centre, map axes."
    )
    solid = _pair_of_scenes(before, after, lidars, 2)
    flat = make_subplots(
        1,
        4,
        subplot_titles=("before, from above", "after", "before, from the side", "after"),
        horizontal_spacing=0.05,
    )
    colour, shown = colours(lidars), labels(lidars)
    reach = min(_reach(before.values()), 1.6 * _reach(after.values()))
    for column, (points, pick) in enumerate(
        ((before, (0, 1)), (after, (0, 1)), (before, (0, 2)), (after, (0, 2))), start=1
    ):
        for i, lidar in enumerate(lidars):
            if lidar not in points:
                continue
            p = points[lidar][_every(len(points[lidar]), 900)]
            flat.add_scatter(
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
                showlegend=column == 1,
                hoverinfo="skip",
                row=1,
                col=column,
            )
        flat.update_xaxes(range=[-reach, reach], constrain="domain", row=1, col=column)
        flat.update_yaxes(
            range=[-reach, reach],
            scaleanchor=f"x{column if column > 1 else ''}",
            row=1,
            col=column,
        )
    finish(flat, 340)
    return (
        Figure(f"target_{placement}", note, solid, solid=True),
        Figure(f"target_flat_{placement}", f"The same, flat: {note}", flat),
    )


def scene_figure(
    drive: int,
    trajectory: VehicleTrajectory,
    scans: Sequence[LidarScan],
    calibration: Calibration,
    name: str,
) -> Figure | None:
    """The drive with the initial extrinsics and with the solved ones; None if nothing was kept."""
    share = max(MOST_POINTS // max(len(scans), 1), 20)
    before = _scene_points(trajectory, scans, calibration, share, guess=True)
    after = _scene_points(trajectory, scans, calibration, share, guess=False)
    if not after:
        return None
    _, t = trajectory.poses_at(_samples(trajectory, 200))
    return Figure(
        f"scene_{drive}",
        f"Recording '{name}': some scans of every LiDAR in the map, with the initial extrinsics "
        "(left) and the solved ones (right), on the same vehicle poses. What stands twice on the "
        "left and once on the right is what calibration put right. Metres from the first pose; "
        "black: the vehicle.",
        _pair_of_scenes(before, after, list(calibration.lidars), 1.5, t - t[0]),
        solid=True,
    )


# ------------------------------------------------------------------ points


def _target_points(
    placement: int, solution: Solution, calibration: Calibration, guess: bool
) -> dict[str, Array]:
    """Per LiDAR the points (N, 3) of its clouds, metres from the target's centre, map axes."""
    registration = solution.registrations[placement]
    # Not in the target's own axes, which are turned by what the first guess was off.
    centre_map = solution.T_target_map[placement].inverse().translation()
    out: dict[str, list[Array]] = {}
    budget = max(MOST_POINTS // max(len(registration.observation.clouds), 1), 20)
    for cloud in registration.observation.clouds:
        lidar = calibration.lidars[cloud.lidar]
        mounting = lidar.T_vehicle_lidar
        if guess and lidar.guess is not None:
            mounting = lidar.guess.T_vehicle_lidar
        T_map_vehicle = solution.T_map_vehicle[cloud.drive, cloud.stamp_ns]
        R, t = stack([T_map_vehicle.compose(mounting)])
        points = cloud.points_lidar[_every(len(cloud.points_lidar), budget)]
        out.setdefault(cloud.lidar, []).append(points @ R[0].T + t[0] - centre_map)
    return {name: np.concatenate(points) for name, points in out.items()}


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
        lidar = calibration.lidars[scan.lidar]
        mounting = lidar.T_vehicle_lidar
        if guess and lidar.guess is not None:
            mounting = lidar.guess.T_vehicle_lidar
        if not begin <= scan.stamp_ns <= end:
            continue
        try:
            points = deskew(scan, mounting, trajectory).points_lidar
        except TrajectoryError:  # times that are none: the solve has refused or warned already
            continue
        R, t = trajectory.poses_at([scan.stamp_ns])
        R_mount, t_mount = stack([mounting])
        points = points[_every(len(points), budget)] @ R_mount[0].T + t_mount[0]
        out.setdefault(scan.lidar, []).append(points @ R[0].T + t[0] - origin[0])
    return {name: np.concatenate(points) for name, points in out.items()}


def _pair_of_scenes(
    before: Mapping[str, Array],
    after: Mapping[str, Array],
    lidars: Sequence[str],
    size: float,
    path: Array | None = None,
) -> go.Figure:
    figure = make_subplots(
        1,
        2,
        specs=[[{"type": "scene"}, {"type": "scene"}]],
        subplot_titles=("before: initial guess", "after"),
        horizontal_spacing=0.01,
    )
    colour, shown = colours(lidars), labels(lidars)
    for column, points in enumerate((before, after), start=1):
        for name in lidars:
            if name not in points:
                continue
            x, y, z = small(points[name]).T
            figure.add_scatter3d(
                x=x,
                y=y,
                z=z,
                mode="markers",
                marker={"color": colour[name], "size": size},
                name=shown[name],
                legendgroup=shown[name],
                showlegend=column == 1,
                hoverinfo="skip",
                row=1,
                col=column,
            )
        if path is not None:
            x, y, z = small(path).T
            figure.add_scatter3d(
                x=x,
                y=y,
                z=z,
                mode="lines",
                line={"color": BLACK, "width": 5},
                name="vehicle",
                legendgroup="vehicle",
                showlegend=column == 1,
                hoverinfo="skip",
                row=1,
                col=column,
            )
    axis = {"title": {"text": ""}, "backgroundcolor": "#F7F7F7", "gridcolor": "#DDDDDD"}
    # A drive is flat and wide: looked at from higher up, and larger.
    longest, eye = (1.25, (-1.1, -1.1, 0.9)) if path is None else (1.7, (-0.8, -0.8, 1.1))
    camera = {"eye": dict(zip("xyz", eye, strict=True))}
    spans = {}
    everything = np.concatenate([*before.values(), *after.values()])
    low, high = np.percentile(everything, [0.2, 99.8], axis=0)
    for key, a, b in zip(("xaxis", "yaxis", "zaxis"), low, high, strict=True):
        margin = 0.03 * max(float(b - a), 0.1)
        spans[key] = {**axis, "range": [round(float(a) - margin, 3), round(float(b) + margin, 3)]}
    # The same box on both sides, to scale; a flat one would be hard to look into.
    extent: Array = np.maximum(high - low, 0.1)
    aspect = dict(zip("xyz", (longest * extent / extent.max()).round(3).tolist(), strict=True))
    figure.update_scenes(aspectmode="manual", aspectratio=aspect, camera=camera, **spans)
    figure.update_layout(legend={"itemsizing": "constant"})
    finish(figure, 480)
    return figure


# ------------------------------------------------------------------ shared


def finish(figure: go.Figure, height: int) -> None:
    """Gives a figure the report's look.

    Args:
        figure: changed in place.
        height: pixels.
    """
    figure.update_layout(
        width=WIDTH,
        height=height,
        margin={"l": 60, "r": 20, "t": 40, "b": 50},
        font={"family": "system-ui, sans-serif", "size": 12, "color": "#1A1A1A"},
        legend={"orientation": "h", "yanchor": "bottom", "y": 1.08, "x": 0.0},
    )
    if figure.layout.showlegend is not False:
        figure.update_layout(margin={"t": 90})
    figure.update_annotations(font={"size": 12})


def _line(figure: go.Figure, x: Array, y: Array, name: str, colour: str) -> None:
    figure.add_scatter(
        x=small(x), y=small(y), mode="lines", line={"color": colour, "width": 1}, name=name
    )


def _dots(
    figure: go.Figure, x: Array, y: Array, name: str, colour: str, symbol: str, size: int
) -> None:
    some = _every(len(x), MOST_SAMPLES)
    figure.add_scatter(
        x=small(x[some]),
        y=small(y[some]),
        mode="markers",
        marker={"color": colour, "symbol": symbol, "size": size},
        name=name,
        hovertemplate="%{x:.2f}, %{y:.2f} m",
    )


def _samples(trajectory: VehicleTrajectory, count: int) -> IntArray:
    begin, end = trajectory.span_ns
    return np.asarray(begin + (end - begin) * np.arange(count) // (count - 1), dtype=np.int64)


def _every(count: int, most: int) -> IntArray:
    """Indices of at most `most` out of `count`, evenly."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).astype(np.int64))


def _reach(parts: Any) -> float:
    points = np.abs(np.concatenate(list(parts)))
    return 1.15 * float(np.percentile(points, 99.5))


def _begin(stamps_ns: Any) -> int:
    return min((int(stamp) for stamp in stamps_ns), default=0)


def _seconds(ns: Any) -> Any:
    return np.round(np.asarray(ns, np.float64) / NANOSECONDS_PER_SECOND, 3)


def _short(value: float, digits: int = 4) -> float:
    return float(f"{value:.{digits}g}")


def small(values: Any) -> npt.NDArray[np.float32]:
    """Single precision: what the eye sees, in half the space."""
    return np.asarray(values, np.float32)
