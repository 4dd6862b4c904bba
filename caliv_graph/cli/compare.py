"""`caliv-graph compare`: tests whether a mount moved between two calibrations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from caliv_graph.cli import streams
from caliv_graph.cli.options import P_VALUE, AsJson, PValue


def compare(
    first: Annotated[
        Path, typer.Argument(metavar="A.yaml", help="The earlier result of 'calibrate'.")
    ],
    second: Annotated[Path, typer.Argument(metavar="B.yaml", help="The later one.")],
    p_value: PValue = P_VALUE,
    as_json: AsJson = False,
) -> None:
    """Test whether the mount of a LiDAR moved between two calibrations of one vehicle.

    The command tests each LiDAR against the vehicle and each pair of LiDARs by a chi-square test on
    the joint covariance of the data of the two drives. The initial guesses are not used: a
    direction that either drive does not determine is not tested. The verdict is corrected for the
    number of tests. The exit code is 0 whether or not a mount has moved; --json has 'moved'.

    Example: caliv-graph compare spring/calibration.yaml autumn/calibration.yaml
    """
    from caliv_graph.fusion.compare import compare as compare_calibrations
    from caliv_graph.report.comparison import comparison_document, comparison_table
    from caliv_graph.results.calibration_file import read_calibration

    labels = (str(first), str(second))
    calibrations = read_calibration(first), read_calibration(second)
    comparison = compare_calibrations(*calibrations, labels, p_value)
    if as_json:
        streams.show_json(comparison_document(comparison, labels, p_value))
    else:
        streams.show(comparison_table(comparison, labels, p_value))
    streams.warn(
        f"{label}: its status is inconsistent, so its data are not reliable"
        for label, calibration in zip(labels, calibrations, strict=True)
        if calibration.status == "inconsistent"
    )
