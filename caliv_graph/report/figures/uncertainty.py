"""Figures of the uncertainty: sigmas, information of the data by direction, correlations."""

from __future__ import annotations

import numpy as np

from caliv_graph.conventions import AXES
from caliv_graph.geometry.covariance import parent_axes_covariance
from caliv_graph.geometry.se3 import right_to_vehicle_axes
from caliv_graph.products import Calibration, Solution
from caliv_graph.report.figures.drawing import (
    BLUE,
    GREY,
    ORANGE,
    VERMILLION,
    Figure,
    finish,
    labels,
    small,
)
from caliv_graph.report.figures.plot import Plot
from caliv_graph.report.numbers import rounded
from caliv_graph.uncertainty.observability import UNDETERMINED_RATIO, WEAK_RATIO, spectrum


def sigma_figure(calibration: Calibration) -> Figure | None:
    """Sigmas before and after the drive, per LiDAR and axis; None if there are none."""
    figure = Plot(("rotation (mrad)", "position (mm)"))
    shown = labels(calibration.lidars)
    prior: dict[int, list[tuple[str, float]]] = {1: [], 2: []}
    known: dict[int, list[tuple[str, float]]] = {1: [], 2: []}
    held: dict[int, list[tuple[str, float]]] = {1: [], 2: []}
    for name, lidar in calibration.lidars.items():
        if lidar.guess is not None and lidar.guess.fixed:
            continue
        after = np.sqrt(np.diag(parent_axes_covariance(lidar.T_vehicle_lidar, lidar.cov)))
        for i, axis in enumerate(AXES):
            panel, at = (1 if i < 3 else 2), f"{shown[name]} {axis}"
            if lidar.guess is not None and not lidar.without_guess:
                prior[panel].append((at, 1e3 * float(lidar.guess.sigmas[i])))
            if lidar.without_guess and not lidar.determined[axis]:
                continue  # nothing is known of it
            (known if lidar.determined[axis] else held)[panel].append((at, 1e3 * float(after[i])))
    if not any((*known.values(), *held.values())):
        return None
    order = {
        c: [f"{shown[n]} {axis}" for n in calibration.lidars for axis in axes]
        for c, axes in ((1, AXES[:3]), (2, AXES[3:]))
    }
    for what, kinds, marker in (
        ("initial guess", prior, {"symbol": "circle-open", "color": GREY, "size": 11}),
        ("determined by this drive", known, {"symbol": "square", "color": BLUE, "size": 9}),
        (
            "not determined: sigma of the initial guess",
            held,
            {"symbol": "x-open", "color": VERMILLION, "size": 11, "line": {"width": 3}},
        ),
    ):
        in_legend = False
        for panel in (1, 2):
            if not kinds[panel]:
                continue
            figure.add(
                "scatter",
                x=[at for at, _ in kinds[panel]],
                y=[rounded(sigma, 4) for _, sigma in kinds[panel]],
                mode="markers",
                marker=marker,
                name=what,
                legendgroup=what,
                showlegend=not in_legend,
                hovertemplate="%{x}: %{y:.3g}",
                panel=panel,
            )
            in_legend = True
    for panel in (1, 2):
        figure.x_axes(categoryorder="array", categoryarray=order[panel], tickangle=-50, panel=panel)
    figure.y_axes(type="log", dtick="D2")
    finish(figure, 400)
    return Figure(
        "sigmas",
        "1 sigma in vehicle axes, before (circles) and after the drive. A cross marks an axis "
        "that this drive did not determine: its sigma comes from the initial guesses.",
        figure,
    )


def spectrum_figure(solution: Solution) -> Figure:
    """Sigma of the data along each direction, compared with that of the initial guesses."""
    split = spectrum(solution.information_data, solution.information_prior)
    order = np.argsort(split.sigma_data, kind="stable")
    data, prior = split.sigma_data[order], split.sigma_prior[order]
    # Without information the sigma is infinite, or nearly so: it is drawn at the upper edge.
    top = 30.0 * float(prior.max())
    number = np.arange(1, len(data) + 1)
    figure = Plot()
    for dash, ratio, what in (
        ("solid", 1.0, "initial guess"),
        ("dash", UNDETERMINED_RATIO, f"{UNDETERMINED_RATIO:g} of it: above, undetermined"),
        ("dot", WEAK_RATIO, f"{WEAK_RATIO:g} of it: above, weak"),
    ):
        figure.add(
            "scatter",
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
            figure.add(
                "scatter",
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
    figure.y_axes(type="log", title="1 sigma (mrad; 1 mrad as 10 mm)", dtick=1)
    figure.x_axes(title="direction, best determined first", dtick=1)
    finish(figure, 380)
    held = (
        f" Mode {solution.mode} holds {', '.join(solution.held)} at the initial guess."
        if solution.held
        else ""
    )
    return Figure(
        "spectrum",
        "Information of the data alone about all extrinsics together, by direction (the "
        "eigenvectors of the information, with 1 mrad counted as 10 mm). A triangle at the upper "
        f"edge: the data have no or almost no information about this direction.{held}",
        figure,
    )


def correlation_figure(calibration: Calibration) -> Figure:
    """Correlations of all extrinsics in vehicle axes."""
    names = [n for n, lidar in calibration.lidars.items() if lidar.has_data]
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
    figure = Plot()
    figure.add(
        "heatmap",
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
    figure.y_axes(autorange="reversed", scaleanchor="x", constrain="domain")
    figure.x_axes(tickangle=-60, constrain="domain")
    finish(figure, min(460 + 14 * len(ticks), 900))
    return Figure(
        "correlation",
        "Correlations of the reported covariance in vehicle axes, priors included. Near -1 or 1, "
        "two errors occur together. (held): not determined by this drive.",
        figure,
    )
