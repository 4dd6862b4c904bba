"""`caliv-graph plan`: the accuracy that a planned drive will reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from caliv_graph.cli import streams
from caliv_graph.cli.options import AsJson, Drives, Force
from caliv_graph.common.exits import UNMET

if TYPE_CHECKING:
    from caliv_graph.common.progress import SilentProgress
    from caliv_graph.config.model import Config
    from caliv_graph.planning.assumptions import Assumptions, Ground, Source
    from caliv_graph.planning.suggest import Planned


def plan(
    drives: Annotated[
        list[Path],
        typer.Argument(
            metavar="SCENARIO.yaml|CONFIG.yaml",
            help="The drive: a scenario with vehicle, LiDARs, target, walls, or the config of a "
            "recorded drive, from which all this is taken. Several: drives of one vehicle, solved "
            "together; beside a config, the vehicle of a scenario is replaced by the recorded one.",
        ),
    ],
    data: Drives = None,
    sigma: Annotated[
        list[str] | None,
        typer.Option(
            "--sigma",
            metavar="KEY=VALUE",
            help="Limit of a sigma: s2v_ or s2s_, then roll_deg, pitch_deg, yaw_deg, x_m, y_m or "
            "z_m, as in 'limits' of a config. Can be repeated.",
        ),
    ] = None,
    ground: Annotated[
        Literal["none", "plane", "height"] | None,
        typer.Option(
            "--ground",
            help="How the ground is used: not at all, as a plane, or as a plane at a known height "
            "below the vehicle.",
            show_default="height, or as the config says",
        ),
    ] = None,
    poses: Annotated[
        bool,
        typer.Option(
            "--poses", help="The recording has poses (a CaLiV folder) instead of raw sensor data."
        ),
    ] = False,
    time_offset: Annotated[
        bool, typer.Option("--time-offset", help="Also estimate a time offset of each LiDAR.")
    ] = False,
    structure: Annotated[
        bool,
        typer.Option(
            "--structure/--no-structure",
            help="Whether walls are used, and the ground cell by cell.",
        ),
    ] = True,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Write the suggested drive as a scenario."),
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Predict the accuracy of a planned drive: sigma per LiDAR and axis, undetermined directions.

    The prediction uses geometry and noise levels only: it simulates no clouds. What hides a target
    is ignored; walls hide what is behind them. The command names the walls that each LiDAR sees and
    that two LiDARs both see. It also tries other manoeuvres (arc, S-curve, figure-eight, with a
    ramp unless the ground has a known height) and target placements without walls, and names the
    one that keeps all limits in the least space.

    With the config of a recorded drive, vehicle, sensors, noise and target are read off the
    recording, and its own sigmas are predicted, with the walls that it passes. The suggestion is a
    drive of that vehicle to be solved together with the recorded one, unless that alone suffices.
    --out writes it as a scenario; with the config and this scenario the command tells what both
    drives give together. Limits are those of the config unless --sigma names others.

    Exit code 3: the drive does not keep a limit, or a LiDAR never sees the target or a wall.

    Example: caliv-graph plan scenario.yaml --sigma s2v_yaw_deg=0.05 --sigma s2v_x_m=0.01

    Example: caliv-graph plan config.yaml --data drive/
    """
    from caliv_graph.batch.job import check_guesses
    from caliv_graph.common.files import atomic_write, check_output_file
    from caliv_graph.config.load import load_config
    from caliv_graph.errors import OutputError
    from caliv_graph.planning.assumptions import Assumptions
    from caliv_graph.planning.suggest import is_met, parse_goals, shortfall, suggest
    from caliv_graph.report.predicted import plan_document, plan_table
    from caliv_graph.scenario.model import dump_scenario, is_recording_config

    goals = parse_goals(sigma or ())
    if out is not None:
        check_output_file(out, force, [*drives, *(data or ())])
    configs = [path for path in drives if is_recording_config(path)]
    scenarios = [path for path in drives if path not in configs]
    if configs:
        _check_options(configs, poses)
        config = load_config(configs[0])
        if out is not None:
            check_output_file(out, force, [config.data.path, config.data.poses])
        goals = goals or config.limits
        check_guesses(config, configs[0])
        with streams.progress_on_stdout(as_json) as progress:
            planned = _of_recording(
                config, scenarios, data or (), (ground, time_offset, structure), progress
            )
    else:
        source: Source | None = "poses" if poses else None
        assumptions = Assumptions(
            ground=ground or "height", source=source, time_offset=time_offset, structure=structure
        )
        planned = _of_scenarios(scenarios, data or (), assumptions)
    prediction = planned.prediction
    met = prediction is not None and is_met(shortfall(prediction, goals), goals)
    beside = () if met else planned.recorded
    suggestion = suggest(planned.vehicle, goals, planned.assumptions, beside)
    if out is not None:
        if suggestion is None:
            why = "no LiDAR sees the target in any of the manoeuvres tried"
            if not planned.vehicle.world.targets:
                why = "the scenario has no target to place: name one in world.targets"
            raise OutputError(f"{out}: not written: {why}")
        atomic_write(out, dump_scenario(suggestion.scenario), force)
    if as_json:
        streams.show_json(plan_document(planned, goals, met, suggestion))
    else:
        streams.show(plan_table(planned, goals, met, suggestion))
        if out is not None:
            streams.say(f"Written to {out}")
    streams.warn([*planned.notes, *(prediction.warnings if prediction is not None else ())])
    if (goals and not met) or (prediction is not None and prediction.covariance.unseeing):
        raise typer.Exit(UNMET)


def _check_options(configs: Sequence[Path], poses: bool) -> None:
    """Refuses options that a recorded drive has no use for."""
    from caliv_graph.errors import ConfigError

    if len(configs) > 1:
        raise ConfigError(
            f"{configs[1]}: is a second config of a recorded drive. Give one config, and --data "
            "for each drive of the vehicle"
        )
    if poses:
        raise ConfigError(f"--poses: the recording of {configs[0]} tells what it has. Omit it")


def _of_scenarios(paths: Sequence[Path], data: Sequence[Path], assumptions: Assumptions) -> Planned:
    """Drives that scenarios describe."""
    from caliv_graph.errors import ConfigError
    from caliv_graph.planning.predict import predict
    from caliv_graph.planning.suggest import Planned
    from caliv_graph.scenario.model import load_scenario

    if data:
        raise ConfigError(
            f"--data {data[0]}: is a recorded drive, which needs a config. Give it instead of "
            f"{paths[0]}, or beside it"
        )
    first, *others = [load_scenario(path) for path in paths]
    return Planned(predict(first, others, assumptions), first, assumptions)


def _of_recording(
    config: Config,
    scenarios: Sequence[Path],
    data: Sequence[Path],
    options: tuple[Ground | None, bool, bool],
    progress: SilentProgress,
) -> Planned:
    """The recorded drives of a config, with scenarios beside them.

    `options` are the ground (None: as the config says), time offsets, structure.
    """
    from caliv_graph.batch.job import open_recordings
    from caliv_graph.config.model import StructureConfig
    from caliv_graph.scenario.model import load_scenario
    from caliv_graph.workflows.next_drive import next_drive, recorded_drive

    planned = [load_scenario(scenario) for scenario in scenarios]
    ground, time_offset, structure = options
    if not structure:
        config = config.model_copy(update={"structure": StructureConfig(use=False)})
    drives = [recorded_drive(r, config, progress) for r in open_recordings(config, data)]
    assumptions = drives[0].assumptions
    assumptions = replace(
        assumptions,
        ground=ground or assumptions.ground,
        time_offset=time_offset or assumptions.time_offset,
    )
    return next_drive(drives, planned, assumptions)
