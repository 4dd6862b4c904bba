"""Plots of the distributions of benchmark_tables, as in the paper."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # no display is needed

from matplotlib import pyplot

from caliv_graph.common.files import atomic_write
from caliv_graph.conventions import AXES
from scripts._tables_statistics import Line


def write_plot(path: Path, title: str, lines: Sequence[Line]) -> bool:
    """Boxes and points of the errors of every quantity, as a PNG file.

    Errors on axes that a run did not determine are left out.

    Args:
        path: the file; it is replaced atomically.
        title: title of the plot.
        lines: the runs of a row.

    Returns:
        Whether there was any error to show.
    """
    done = [line for line in lines if line.quantities]
    names = list(dict.fromkeys(name for line in done for name in line.quantities))
    if not names:
        return False
    figure, plots = pyplot.subplots(
        len(names), 2, figsize=(9.0, 2.6 * len(names)), squeeze=False, layout="constrained"
    )
    figure.suptitle(title)
    for row, name in zip(plots, names, strict=True):
        errors = _errors(done, name)
        for plot, axes, unit in zip(
            row, (("x", "y", "z"), ("roll", "pitch", "yaw")), ("mm", "mrad"), strict=True
        ):
            determined = [axis for axis in axes if errors[axis]]
            plot.set_title(f"{name}, error in {unit}", fontsize="medium")
            plot.axhline(0.0, color="0.7", linewidth=0.8)
            if not determined:
                plot.set_yticks([])
                plot.set_xticks([])
                plot.text(0.5, 0.5, "not determined", ha="center", transform=plot.transAxes)
                continue
            plot.boxplot(
                [errors[axis] for axis in determined],
                tick_labels=[f"{axis}\nn = {len(errors[axis])}" for axis in determined],
                flierprops={"markersize": 3},
            )
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=120)
    pyplot.close(figure)
    atomic_write(path, content.getvalue(), force=True)
    return True


def _errors(lines: Sequence[Line], quantity: str) -> Mapping[str, list[float]]:
    """By axis, in mm and mrad."""
    out: dict[str, list[float]] = {axis: [] for axis in AXES}
    for line in lines:
        found = line.quantities.get(quantity)
        if found is None:
            continue
        for axis, error, determined in zip(AXES, found.error, found.determined, strict=True):
            if determined:
                out[axis].append(1e3 * error)
    return out
