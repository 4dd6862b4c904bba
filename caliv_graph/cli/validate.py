"""`caliv-graph validate`: alignment on walls, poles, objects and held-out strips."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from caliv_graph.cli import streams
from caliv_graph.cli.options import P_VALUE, AsJson, CalibrationArgument, Force, PValue
from caliv_graph.common.exits import INCONSISTENT, UNMET


def validate(
    calibration: CalibrationArgument,
    config: Annotated[
        Path,
        typer.Argument(
            metavar="CONFIG.yaml", help="The config: initial guesses, topics, target and ground."
        ),
    ],
    data: Annotated[
        Path | None,
        typer.Option(
            "--data",
            metavar="PATH",
            help="The drive, instead of data.path of the config: the calibrated drive or another "
            "drive of the same vehicle.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder for validation.json and .html."),
    ] = None,
    repeat: Annotated[
        bool,
        typer.Option(
            "--repeat/--no-repeat",
            help="Also calibrate the two halves of the drive and compare them. Where walls are "
            "missing, nothing else tests x, y and yaw.",
        ),
    ] = True,
    p_value: PValue = P_VALUE,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Validate a calibration on walls, poles and objects, and on held-out strips of structure.

    The clouds of all LiDARs are transformed to the map with the initial guesses of the config
    (before) and with the calibration (after), without the target, and without the ground unless the
    config has 'ground: {use: false}'. The command measures the distance between the LiDARs on each
    wall and pole, and the thickness of walls and poles for all LiDARs and for each LiDAR alone. It
    compares them with the values expected from noise, trajectory and the sigmas of the calibration.
    A third of the strips of walls and ground is held out, chosen by place: the drive is calibrated
    without it, and both calibrations are measured on it. DIR contains validation.json and
    validation.html.

    Without motion data the poses are those of the odometry of one LiDAR, as in 'calibrate': only
    the places of the LiDARs to each other are validated then, not those on the vehicle.

    Exit code 3: there is no structure to validate on. Exit code 4: distances between LiDARs, on
    walls and poles or on held-out strips, exceed the expected values by more than 5 sigma, or
    the calibration is as far from one by structure alone or by half the scans of the drive.

    Example: caliv-graph validate result/calibration.yaml config.yaml --data drive/ --out checked/
    """
    import json

    from caliv_graph.common.files import check_output_folder, output_folder
    from caliv_graph.common.json_text import without_infinities
    from caliv_graph.config.load import load_config
    from caliv_graph.readers import open_recording
    from caliv_graph.report.validation import (
        render_validation,
        validation_document,
        validation_table,
    )
    from caliv_graph.results.calibration_file import read_calibration
    from caliv_graph.validation import validate as validate_calibration
    from caliv_graph.workflows.repeatability import split_halves, with_halves

    content = ("validation.json", "validation.html")
    settings = load_config(config)
    result = read_calibration(calibration)
    if out is not None:
        # Checked before the validation, which takes long.
        check_output_folder(out, content, force)
    recording = open_recording(settings, data)
    repeated = None
    with streams.progress_on_stdout(as_json) as progress:
        motion = recording.motion()
        found = validate_calibration(recording, result, settings, progress, motion)
        if repeat:
            repeated = split_halves(recording, settings, progress, p_value, motion)
            found = with_halves(found, result, repeated)
    document = without_infinities(validation_document(found, repeated, p_value))
    if out is not None:
        page = render_validation(found, repeated, p_value)
        with output_folder(out, content, force) as folder:
            text = json.dumps(document, indent=2, allow_nan=False)
            (folder / content[0]).write_text(f"{text}\n", encoding="utf-8")
            (folder / content[1]).write_text(page, encoding="utf-8")
    if as_json:
        streams.show_json(document)
    else:
        streams.show(validation_table(found, repeated, p_value))
        if out is not None:
            streams.say(f"Written to {out}")
    streams.warn(found.warnings)
    if not found.has_structure:
        streams.warn(found.verdict.sentences)
        raise typer.Exit(UNMET)
    if found.verdict.contradicts:
        streams.warn([f"{calibration}: {found.verdict.reason}"])
        raise typer.Exit(INCONSISTENT)
