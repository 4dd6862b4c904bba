"""`caliv-graph calibrate`: extrinsics from one or more drives."""

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
            help="An earlier calibration of this vehicle: the information of its data is added.",
        ),
    ] = None,
    try_suspects: Annotated[
        bool,
        typer.Option(
            "--try-suspects",
            help="Where an input is most likely wrong: run again with it freed, in DIR/suspect/.",
        ),
    ] = False,
    force: Force = False,
    as_json: ResultAsJson = False,
) -> None:
    """Calibrate the LiDARs of a vehicle from drives past a target or walls.

    DIR contains calibration.yaml (extrinsics, covariance, undetermined directions), config.yaml
    (the effective config), target.ply (the reconstructed target, if there is one), graph.gtsam and
    graph.values.gtsam (the extrinsics as priors for a GTSAM localiser), report.html (quality of the
    result, self-contained) and log.jsonl (all stages, for programs).

    Exit code 3: the result is written, but something that 'require' or 'limits' in the config asks
    for was not reached, or a LiDAR saw neither target nor structure. Exit code 4: the result is
    written, but the data contradict each other, the initial guess, or the calibration given with
    '--prior'.

    With '--try-suspects', where one input explains a contradiction by more than 5 sigma, the run is
    repeated with that input freed or set to the value that it would take; DIR/suspect/ has the
    second result, and the terminal compares the two. The exit code is that of the first.

    Example: caliv-graph calibrate config.yaml --out result/
    """
    from caliv_graph.batch.job import check_guesses, open_recordings, run_job
    from caliv_graph.common.exits import DONE, exit_code
    from caliv_graph.common.files import check_output_folder, output_folder
    from caliv_graph.common.json_text import without_infinities
    from caliv_graph.config.load import load_config
    from caliv_graph.report.comparison import trial_table
    from caliv_graph.report.log import stage_documents
    from caliv_graph.report.tables import calibration_table
    from caliv_graph.results.calibration_file import calibration_document, read_calibration
    from caliv_graph.results.names import FILES_OF_BOTH_RUNS, SUSPECT_FOLDER
    from caliv_graph.workflows.suspects import trial_of

    start = time.monotonic()
    settings = load_config(config)
    check_guesses(settings, config)
    earlier = None if prior is None else read_calibration(prior)
    # Checked before the calibration, which takes long.
    check_output_folder(out, FILES_OF_BOTH_RUNS, force, [prior])
    recordings = open_recordings(settings, data or ())
    with streams.progress_on_stdout(as_json) as progress:
        job = run_job(recordings, settings, progress, earlier)
        trial = trial_of(job.calibration, settings) if try_suspects else None
        second = None if trial is None else run_job(recordings, trial.config, progress, earlier)
    with output_folder(out, FILES_OF_BOTH_RUNS, force) as folder:
        job.write(folder)
        if second is not None:
            (folder / SUSPECT_FOLDER).mkdir()
            second.write(folder / SUSPECT_FOLDER)
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
        if trial is not None and second is not None:
            streams.show(trial_table(job.calibration, second.calibration, trial.change))
        elif try_suspects:
            streams.say("No input that a key of the config frees is suspect: nothing was tried.")
        streams.say(f"Written to {out}")
    streams.warn(job.warnings)
    code = exit_code(job.calibration)
    if code != DONE:
        raise typer.Exit(code)
