"""`caliv-graph calibrate`: from drives to mountings."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from caliv_graph.cli import streams
from caliv_graph.cli.exits import INCONSISTENT, UNMET
from caliv_graph.cli.options import ConfigArgument, Drives, Force, ResultAsJson, open_drives

if TYPE_CHECKING:
    from caliv_graph.config import Config
    from caliv_graph.products import Recording


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

    DIR gets calibration.yaml (mountings, covariance, what was not determined), config.yaml (the
    effective one), target.ply (the reconstructed target), graph.gtsam and graph.values.gtsam (the
    mountings as priors that a GTSAM localiser loads), report.html (what the result is worth, in
    one page without any network) and log.jsonl (every stage, for programs).

    Exit code 3: the result is written, but something that 'require' or 'limits' in the config asks
    for was not reached, or a LiDAR never saw the target. Exit code 4: it is written, but the data
    contradict each other, the initial guess, or the earlier calibration given with '--prior'.

    Example: caliv-graph calibrate config.yaml --out result/
    """
    from caliv_graph.config import load_config
    from caliv_graph.files import check_output_folder, output_folder
    from caliv_graph.pipeline import calibrate as run_pipeline
    from caliv_graph.report.log import stage_documents
    from caliv_graph.report.tables import calibration_table
    from caliv_graph.results import (
        RESULT_FILES,
        calibration_document,
        read_calibration,
        without_infinities,
        write_result,
    )

    start = time.monotonic()
    settings = load_config(config)
    _check_guesses(settings, config)
    earlier = None if prior is None else read_calibration(prior)
    # Nobody should wait for a result that then has no place to go.
    check_output_folder(out, RESULT_FILES, force)
    recordings = open_drives(settings, data)
    with streams.progress_on_stdout(as_json) as progress:
        run = run_pipeline(recordings, settings, progress, earlier)
    calibration = run.calibration
    warnings = [
        *_unused_keys(settings),
        *calibration.contradictions,
        *run.warnings,
        *calibration.unmet,
    ]
    effective = _with_data(settings, recordings)
    with output_folder(out, RESULT_FILES, force) as folder:
        write_result(
            folder,
            calibration,
            run.solution,
            effective,
            progress.stages,
            warnings,
            run.evidence,
        )
    if as_json:
        extra = {
            "out": str(out),
            "stages": stage_documents(progress.stages),
            "warnings": warnings,
        }
        document = calibration_document(calibration)
        streams.show_json(without_infinities({**document, **extra}))
    else:
        streams.show(calibration_table(calibration, progress.stages, time.monotonic() - start))
        streams.say(f"Written to {out}")
    streams.warn(warnings)
    if calibration.status == "inconsistent":
        raise typer.Exit(INCONSISTENT)
    if calibration.unmet:
        raise typer.Exit(UNMET)


def _check_guesses(config: Config, path: Path) -> None:
    """Raises if two LiDARs still have the zeros that `init` writes where it knows no better."""
    from caliv_graph.config import Mounting
    from caliv_graph.errors import ConfigError

    unknown = Mounting(xyz=(0.0, 0.0, 0.0))
    zeros = [name for name, lidar in config.lidars.items() if lidar.initial == unknown]
    if len(zeros) > 1:
        fields = " and ".join(f"lidars.{name}.initial" for name in zeros)
        raise ConfigError(
            f"{path}: {fields} are all zeros, but two LiDARs are not in one place. Measure where "
            "they are, or read it off a drawing"
        )


def _unused_keys(config: Config) -> list[str]:
    """A line for each key that is set and has no effect."""
    if config.data.format == "rosbag":
        return []
    sections = {"topics": config.topics, "imu": config.imu, "gnss": config.gnss}
    return [
        f"{name}: has no effect on a CaLiV folder, which brings its poses"
        for name, section in sections.items()
        if section != type(section)()
    ]


def _with_data(config: Config, recordings: Sequence[Recording]) -> Config:
    """The config as it was used: with the (first) drive's path, whole, so that it can move."""
    path = Path(recordings[0].name).resolve()
    return config.model_copy(update={"data": config.data.model_copy(update={"path": path})})
