"""`caliv-graph evaluate`: a calibration against the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from caliv_graph.cli import streams
from caliv_graph.cli.options import AsJson, CalibrationArgument


def evaluate(
    calibration: CalibrationArgument,
    truth: Annotated[
        Path,
        typer.Argument(
            metavar="TRUTH.yaml", help="True extrinsics; another calibration.yaml serves as well."
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Compare a calibration with the truth: sensor-to-vehicle and sensor-to-sensor errors, NEES.

    Errors are in vehicle axes. That of a pair leaves out what its two LiDARs have in common, as in
    the paper's Evaluation section. NEES is 6 on average if the covariance is right.

    Example: caliv-graph evaluate result/calibration.yaml drive/truth.yaml
    """
    from caliv_graph.errors import ConfigError
    from caliv_graph.report.tables import evaluation_table
    from caliv_graph.results.calibration_file import read_calibration_file
    from caliv_graph.results.truth_file import read_truth
    from caliv_graph.uncertainty.evaluation import evaluate as evaluate_calibration

    estimate = read_calibration_file(calibration)
    true_T_vehicle_lidar = read_truth(truth)
    names = list(estimate.calibration.lidars)
    unknown = [name for name in names if name not in true_T_vehicle_lidar]
    if len(unknown) == len(names):
        raise ConfigError(
            f"{truth}: has none of the LiDARs of {calibration} ({', '.join(names)}), but "
            f"{', '.join(true_T_vehicle_lidar)}. Give them the same names"
        )
    evaluation = evaluate_calibration(
        estimate.calibration, true_T_vehicle_lidar, estimate.cov_pairs
    )
    if as_json:
        streams.show_json(evaluation)
    else:
        streams.show(evaluation_table(evaluation, estimate.calibration))
    streams.warn(f"{truth}: has no LiDAR '{name}': left out" for name in unknown)
