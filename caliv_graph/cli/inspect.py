"""`caliv-graph inspect`: the content of a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from caliv_graph.cli import streams
from caliv_graph.cli.options import AsJson


def inspect(
    data: Annotated[
        Path, typer.Argument(metavar="DATA", help="The drive: a bag or a CaLiV folder.")
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

    With a config, also when each LiDAR sees the target.

    Example: caliv-graph inspect drive/ --config config.yaml
    """
    from caliv_graph.config.load import load_config
    from caliv_graph.readers import open_recording
    from caliv_graph.readers.discover import open_all
    from caliv_graph.report.bag_inspection import add_any_targets, inspect_any
    from caliv_graph.report.inspection_table import inspection_table

    settings = None if config is None else load_config(config)
    recording = open_all(data) if settings is None else open_recording(settings, data)
    with streams.progress_on_stdout(as_json) as progress:
        inspection = inspect_any(recording, progress)
        warnings: list[str] = []
        if settings is not None:
            from caliv_graph.calibration.choose import choose_static
            from caliv_graph.targets import extract_targets
            from caliv_graph.trajectory.select import smooth_trajectories

            trajectories = smooth_trajectories([recording], settings, [[]])
            observations = extract_targets(
                [recording], trajectories, settings, progress, choose_static
            )
            inspection = add_any_targets(inspection, observations)
            warnings += [line for seen in observations for line in seen.warnings]
        warnings = [*recording.warnings(), *warnings]
    if as_json:
        streams.show_json(inspection.document())
    else:
        streams.show(inspection_table(inspection))
    streams.warn(warnings)
