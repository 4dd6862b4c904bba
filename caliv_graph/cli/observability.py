"""`caliv-graph observability`: what a recorded drive determines, before it is calibrated."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from caliv_graph.cli import streams
from caliv_graph.cli.exits import UNMET


def observability(
    config: Annotated[
        Path, typer.Argument(metavar="CONFIG.yaml", help="The config; 'init' drafts one.")
    ],
    data: Annotated[
        list[Path] | None,
        typer.Option(
            "--data",
            metavar="PATH",
            help="The drive, instead of data.path of the config. Several drives of one vehicle "
            "are looked at together: repeat the option.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Find out what a recorded drive determines, before calibrating.

    The expected sigma per LiDAR and axis, the directions that the drive leaves undetermined or
    weak, each with the manoeuvre that would tell it, and who sees the target. Takes a part of the
    time of 'calibrate', and asks the same of the data.

    Exit code 3: something that 'require' or 'limits' in the config asks for will not be reached, or
    a LiDAR never saw the target.

    Example: caliv-graph observability config.yaml --data drive/
    """
    from caliv_graph.config import load_config
    from caliv_graph.errors import ConfigError
    from caliv_graph.readers import open_recording
    from caliv_graph.report.outlook import survey_document, survey_table
    from caliv_graph.survey import survey

    settings = load_config(config)
    paths = [path.resolve() for path in data or ()]
    for path, resolved in zip(data or (), paths, strict=True):
        if paths.count(resolved) > 1:
            raise ConfigError(f"--data {path}: given twice; a drive counts once")
    recordings = [open_recording(settings, path) for path in data or (None,)]
    with streams.progress_on_stdout(as_json) as progress:
        found = survey(recordings, settings, progress)
    if as_json:
        streams.show_json(survey_document(found))
    else:
        streams.show(survey_table(found))
    streams.warn([*found.warnings, *found.unmet])
    if found.unmet:
        raise typer.Exit(UNMET)
