"""Figures of the fit: residuals, weights of clouds, convergence."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from caliv_graph.calibration.refine import STEP_SIGMAS, STEP_TOLERANCE
from caliv_graph.products import Solution
from caliv_graph.report.figures.drawing import (
    BLACK,
    BLUE,
    GREEN,
    SKY,
    SYMBOLS,
    VERMILLION,
    Figure,
    colours,
    finish,
    first_stamp,
    labels,
    small,
    to_seconds,
)
from caliv_graph.report.figures.plot import Plot
from caliv_graph.report.numbers import two_digits
from caliv_graph.report.residuals import Residuals


def residual_figure(residuals: Residuals, number: int) -> Figure:
    """Whitened residuals compared with N(0, 1), and residuals in millimetres and milliradians.

    The number makes the figure's name unique.
    """
    titles = ["whitened, all axes", *(f"{q} ({u})" for q, (u, _) in residuals.physical.items())]
    figure = Plot(titles)
    edges = np.linspace(-5.0, 5.0, 41)
    white = np.clip(residuals.whitened.ravel(), -4.99, 4.99)
    density, _ = np.histogram(white, edges, density=True)
    middles = 0.5 * (edges[1:] + edges[:-1])
    figure.add("bar", x=small(middles), y=small(density), marker={"color": SKY}, name="whitened")
    x = np.linspace(-5.0, 5.0, 121)
    figure.add(
        "scatter",
        x=small(x),
        y=small(np.exp(-0.5 * x**2) / math.sqrt(2.0 * math.pi)),
        mode="lines",
        line={"color": BLACK, "width": 2},
        name="N(0, 1)",
    )
    for panel, values in enumerate((v for _, v in residuals.physical.values()), start=2):
        # A cloud of one face of the target has no information along that face, so its residual
        # there can be any number. The outermost bars hold all values beyond the drawn range.
        reach = max(6.0 * float(np.median(np.abs(values))), 1e-6)
        heights, bounds = np.histogram(np.clip(values, -reach, reach), 40, (-reach, reach))
        figure.add(
            "bar",
            x=small(0.5 * (bounds[1:] + bounds[:-1])),
            y=heights,
            marker={"color": GREEN},
            name="count",
            panel=panel,
        )
    figure.layout["bargap"] = 0.05
    finish(figure, 260, legend=False)
    n, k = residuals.whitened.shape
    wide = " The residuals are wider than assumed: the noise is larger, or the model is incomplete."
    return Figure(
        f"residuals_{number}",
        f"{residuals.kind.capitalize() if residuals.kind[1].islower() else residuals.kind}: {n} "
        f"measurements of {k} {'number' if k == 1 else 'numbers each'}. Whitened: root mean square "
        f"{residuals.rms:.2f}, {100.0 * residuals.beyond_three:.1f} % beyond 3 (normal "
        f"distribution: 0.3 %; the line is N(0, 1)). "
        + "; ".join(
            f"{quantity}: median |r| {two_digits(np.median(np.abs(v)))} {unit}, 95 % below "
            f"{two_digits(np.percentile(np.abs(v), 95))} {unit}"
            for quantity, (unit, v) in residuals.physical.items()
        )
        + ". The outermost bars hold all values beyond the panel."
        + (wide if residuals.rms > 1.5 else ""),
        figure,
    )


def weight_figure(solution: Solution, lidars: Sequence[str]) -> Figure | None:
    """Robust weight of every cloud over time; None without a target."""
    if not solution.registrations:
        return None
    colour, shown = colours(lidars), labels(lidars)
    begin = first_stamp(c.stamp_ns for r in solution.registrations for c in r.observation.clouds)
    drives = len({c.drive for r in solution.registrations for c in r.observation.clouds})
    figure = Plot()
    for i, name in enumerate(lidars):
        at: list[float] = []
        weight: list[float] = []
        for r, weights in zip(solution.registrations, solution.cloud_weights, strict=True):
            for cloud, w in zip(r.observation.clouds, weights, strict=True):
                if cloud.lidar == name:
                    at.append(to_seconds(cloud.stamp_ns - begin))
                    weight.append(float(w))
        if at:
            figure.add(
                "scatter",
                x=small(np.array(at)),
                y=small(np.array(weight)),
                mode="markers",
                marker={"color": colour[name], "symbol": SYMBOLS[i % len(SYMBOLS)], "size": 7},
                name=shown[name],
                hovertemplate="%{x:.2f} s: weight %{y:.2f}",
            )
    figure.y_axes(title="weight", range=[-0.05, 1.05])
    figure.x_axes(title=f"seconds{' (drives overlaid by their stamps)' * (drives > 1)}")
    finish(figure, 300)
    return Figure(
        "weights",
        "Weight of every cloud of a target in the solve: 1 is full weight, 0 is dropped. Several "
        "low weights in a row mean that a LiDAR contradicts the others during that time. Single "
        "low weights are caused by noise.",
        figure,
    )


def convergence_figure(solution: Solution) -> Figure | None:
    """Steps of the joint EM loop; None if the mode has no such loop."""
    if not solution.course:
        return None
    number = np.arange(1, len(solution.course) + 1)
    figure = Plot()
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
        figure.add(
            "scatter",
            x=number,
            y=small(np.maximum(values, 1e-9)),
            mode="lines+markers",
            line={"color": colour, "dash": dash},
            marker={"symbol": symbol, "size": 8},
            name=f"step, {what}; converged below {limit:g}",
            hovertemplate="iteration %{x}: %{y:.3g}",
        )
    figure.y_axes(type="log", title="largest step of an extrinsic", exponentformat="power")
    figure.x_axes(title="iteration", dtick=1)
    finish(figure, 340)
    return Figure(
        "convergence",
        "Expectation-maximisation with the graph solve as its M-step: the step of the extrinsics "
        "per iteration. The loop ends when the step is small in rotation and position, or in "
        "joint standard deviations of the extrinsics.",
        figure,
    )
