"""`caliv-graph inspect`: the content of a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from caliv_graph.cli import streams
from caliv_graph.cli.options import AsJson, Force

if TYPE_CHECKING:
    from caliv_graph.common.progress import Progress
    from caliv_graph.config.model import Config
    from caliv_graph.pipeline import Look
    from caliv_graph.products import Recording
    from caliv_graph.workflows.scene import Scene


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
    html: Annotated[
        Path | None,
        typer.Option(
            "--html",
            metavar="FILE",
            help="Also write a page for a browser: clouds of all LiDARs, drive, timeline.",
        ),
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Show the content of a recording: topics, rates, gaps, clocks, point times, units, the drive.

    With a config, also what the data say against it, and when each LiDAR sees the target.
    The page of --html shows the clouds of all LiDARs together; sliders move their mountings, and
    the drive from above, on which the target's box can be dragged. Both give YAML for the config.

    Example: caliv-graph inspect drive/ --config config.yaml --html drive.html
    """
    from dataclasses import replace

    from caliv_graph.common.files import atomic_write, check_output_file
    from caliv_graph.report.bag_inspection import add_any_targets, inspect_any
    from caliv_graph.report.inspection_table import inspection_table
    from caliv_graph.wording.inspection import untested_guesses_sentence

    if html is not None:
        check_output_file(html, force, [data, config])
    recording, settings, warnings = _opened(data, config)
    seen = None
    with streams.progress_on_stdout(as_json) as progress:
        inspection = inspect_any(recording, progress, settings)
        warnings += inspection.problems
        if settings is not None:
            from caliv_graph.pipeline import look

            seen = look(recording, settings, progress)
            if seen.observations is not None:
                inspection = add_any_targets(inspection, seen.observations)
                warnings += [line for found in seen.observations for line in found.warnings]
            problems = (*inspection.problems, *seen.problems)
            inspection = replace(inspection, findings=seen.findings, problems=problems)
            warnings += [*(found.sentence for found in seen.findings), *seen.problems, *seen.notes]
            given = [name for name, lidar in settings.lidars.items() if lidar.initial is not None]
            if seen.trajectory is not None and not seen.observations and given:
                warnings.append(untested_guesses_sentence(given))
        scene = None if html is None else _scene(data, recording, settings, seen, progress)
        warnings = [*recording.warnings(), *warnings]
    if html is not None and scene is not None:
        from caliv_graph.report.inspection_page import render_inspection

        atomic_write(html, render_inspection(inspection, scene, warnings), force)
    if as_json:
        streams.show_json(inspection.document())
    else:
        streams.show(inspection_table(inspection))
        if html is not None:
            streams.say(f"Written to {html}")
    streams.warn(warnings)


def _opened(data: Path, config: Path | None) -> tuple[Recording, Config | None, list[str]]:
    """The drive, the config if it fits the drive, and warnings about both."""
    from caliv_graph.batch.job import guess_problem, without_zeros
    from caliv_graph.config.load import load_config
    from caliv_graph.errors import RecordingError
    from caliv_graph.readers import open_recording
    from caliv_graph.readers.discover import open_all

    if config is None:
        return open_all(data), None, []
    settings = load_config(config)
    try:
        recording = open_recording(settings, data)
    except RecordingError as error:
        # Its topics can still be shown, if it is a recording at all.
        return open_all(data), None, [str(error)]
    problem = guess_problem(settings, config)
    return recording, without_zeros(settings), [problem] if problem else []


def _scene(
    data: Path,
    recording: Recording,
    config: Config | None,
    seen: Look | None,
    progress: Progress,
) -> Scene:
    """What the page draws; without a config with the one that `init` drafts."""
    from caliv_graph.errors import CalivError
    from caliv_graph.wording.inspection import no_scene_sentence
    from caliv_graph.workflows.scene import drafted, scene_of, without_clouds

    if config is not None:
        return scene_of(recording, config, seen, progress)
    try:
        return scene_of(*drafted(data), seen, progress, origin="as 'init' drafts it")
    except CalivError as error:
        return without_clouds(no_scene_sentence(str(error)))
