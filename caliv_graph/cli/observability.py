"""`caliv-graph observability`: the directions that a recorded drive determines."""

from __future__ import annotations

import typer

from caliv_graph.cli import streams
from caliv_graph.cli.options import AsJson, ConfigArgument, Drives
from caliv_graph.common.exits import UNMET


def observability(
    config: ConfigArgument,
    data: Drives = None,
    as_json: AsJson = False,
) -> None:
    """Show what a recorded drive determines, before the calibration.

    Prints the expected sigma per LiDAR and axis, the undetermined and weak directions with the
    manoeuvre that determines each, and the scans that see the target. Takes less time than
    'calibrate' and needs the same data. 'plan' with the same config suggests the next drive.

    Exit code 3: something that 'require' or 'limits' in the config asks for will not be reached, or
    a LiDAR saw neither target nor structure.

    Example: caliv-graph observability config.yaml --data drive/
    """
    from caliv_graph.batch.job import check_guesses, open_recordings
    from caliv_graph.config.load import load_config
    from caliv_graph.report.predicted import survey_document, survey_table
    from caliv_graph.workflows.survey import survey

    settings = load_config(config)
    check_guesses(settings, config)
    recordings = open_recordings(settings, data or ())
    with streams.progress_on_stdout(as_json) as progress:
        found = survey(recordings, settings, progress)
    if as_json:
        streams.show_json(survey_document(found))
    else:
        streams.show(survey_table(found))
    streams.warn([*found.warnings, *found.unmet])
    if found.unmet:
        raise typer.Exit(UNMET)
