"""`caliv-graph calibrate`: from drives to extrinsics."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from caliv_graph.cli import streams
from caliv_graph.cli.options import ConfigArgument, Drives, Force, ResultAsJson


def calibrate(
    config: ConfigArgument,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the result.")],
    data: Drives = None,
    prior: Annotated[
        Path | None,
        typer.Option(
            "--prior",
            metavar="CALIBRATION.yaml",
            help="An earlier calibration of this vehicle: what its drive's data say is added.",
        ),
    ] = None,
    force: Force = False,
    as_json: ResultAsJson = False,
) -> None:
    """Calibrate the LiDARs of a vehicle from one or more drives past a target.

    DIR gets calibration.yaml (extrinsics, covariance, what was not determined), config.yaml (the
    effective one), target.ply (the reconstructed target), graph.gtsam and graph.values.gtsam (the
    extrinsics as priors that a GTSAM localiser loads), report.html (what the result is worth, in
    one page without any network) and log.jsonl (every stage, for programs).

    Exit code 3: the result is written, but something that 'require' or 'limits' in the config asks
    for was not reached, or a LiDAR never saw the target. Exit code 4: it is written, but the data
    contradict each other, the initial guess, or the earlier calibration given with '--prior'.

    Example: caliv-graph calibrate config.yaml --out result/
    """
    from caliv_graph.batch.job import check_guesses, open_recordings, run_job
    from caliv_graph.common.exits import DONE, exit_code
    from caliv_graph.common.files import check_output_folder, output_folder
    from caliv_graph.common.json_text import without_infinities
    from caliv_graph.config.load import load_config
    from caliv_graph.report.log import stage_documents
    from caliv_graph.report.tables import calibration_table
    from caliv_graph.results.calibration_file import calibration_document, read_calibration
    from caliv_graph.results.names import RESULT_FILES

    start = time.monotonic()
    settings = load_config(config)
    check_guesses(settings, config)
    earlier = None if prior is None else read_calibration(prior)
    # Nobody should wait for a result that then has no place to go.
    check_output_folder(out, RESULT_FILES, force)
    recordings = open_recordings(settings, data or ())
    with streams.progress_on_stdout(as_json) as progress:
        job = run_job(recordings, settings, progress, earlier)
    with output_folder(out, RESULT_FILES, force) as folder:
        job.write(folder)
    if as_json:
        extra = {
            "out": str(out),
            "stages": stage_documents(job.stages),
            "warnings": list(job.warnings),
        }
        document = calibration_document(job.calibration)
        streams.show_json(without_infinities({**document, **extra}))
    else:
        table = calibration_table(job.calibration, job.stages, time.monotonic() - start)
        streams.show(table)
        streams.say(f"Written to {out}")
    streams.warn(job.warnings)
    code = exit_code(job.calibration)
    if code != DONE:
        raise typer.Exit(code)
