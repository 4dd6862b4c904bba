"""`caliv-graph inspect`: the content of a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from caliv_graph.cli import streams
from caliv_graph.cli.options import AsJson


def inspect(
    data: Annotated[
        Path,
        typer.Argument(
            metavar="DATA", help="The drive: a bag, a CaLiV folder or folders of clouds."
        ),
    ],
    config: Annotated[
        Path | None,
        typer.Option(
            "--config", metavar="CONFIG", help="Also search for the target with this config."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show the content of a recording: topics, rates, gaps, clocks, point times, units, the drive.

    With a config, also what the data say against it, and when each LiDAR sees the target.

    Example: caliv-graph inspect drive/ --config config.yaml
    """
    from dataclasses import replace

    from caliv_graph.batch.job import guess_problem
    from caliv_graph.config.load import load_config
    from caliv_graph.errors import RecordingError
    from caliv_graph.readers import open_recording
    from caliv_graph.readers.discover import open_all
    from caliv_graph.report.bag_inspection import add_any_targets, inspect_any
    from caliv_graph.report.inspection_table import inspection_table

    settings = None if config is None else load_config(config)
    warnings: list[str] = []
    if settings is None:
        recording = open_all(data)
    else:
        try:
            recording = open_recording(settings, data)
        except RecordingError as error:
            # Its topics can still be shown, if it is a recording at all.
            recording, settings = open_all(data), None
            warnings.append(str(error))
    problem = "" if settings is None or config is None else guess_problem(settings, config)
    if problem:
        warnings.append(f"{problem}. The target is not searched for without them")
    with streams.progress_on_stdout(as_json) as progress:
        inspection = inspect_any(recording, progress, settings)
        if settings is not None and not problem:
            from caliv_graph.pipeline import look

            seen = look(recording, settings, progress)
            if seen.observations is not None:
                inspection = add_any_targets(inspection, seen.observations)
                warnings += [line for found in seen.observations for line in found.warnings]
            inspection = replace(inspection, findings=seen.findings, problems=seen.problems)
            warnings += [*(found.sentence for found in seen.findings), *seen.problems, *seen.notes]
        warnings = [*recording.warnings(), *warnings]
    if as_json:
        streams.show_json(inspection.document())
    else:
        streams.show(inspection_table(inspection))
    streams.warn(warnings)
