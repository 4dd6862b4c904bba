"""`caliv-graph plan`: the accuracy that a planned drive will reach."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from caliv_graph.cli import streams
from caliv_graph.cli.options import AsJson, Force
from caliv_graph.common.exits import UNMET


def plan(
    scenarios: Annotated[
        list[Path],
        typer.Argument(
            metavar="SCENARIO.yaml",
            help="The drive: vehicle, LiDARs, target, walls. Several: drives of one vehicle, "
            "solved together.",
        ),
    ],
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
        Literal["none", "plane", "height"],
        typer.Option(
            "--ground",
            help="How the ground is used: not at all, as a plane, or as a plane at a known height "
            "below the vehicle.",
        ),
    ] = "height",
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
            help="Whether walls are used, and the ground cell by cell with them.",
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

    Exit code 3: the drive does not keep a limit, or a LiDAR never sees the target or a wall.

    Example: caliv-graph plan scenario.yaml --sigma s2v_yaw_deg=0.05 --sigma s2v_x_m=0.01
    """
    from caliv_graph.common.files import atomic_write, check_output_file
    from caliv_graph.errors import OutputError
    from caliv_graph.planning.assumptions import Assumptions
    from caliv_graph.planning.predict import predict
    from caliv_graph.planning.suggest import is_met, parse_goals, shortfall, suggest
    from caliv_graph.report.predicted import plan_document, plan_table
    from caliv_graph.scenario.model import dump_scenario, load_scenario

    goals = parse_goals(sigma or ())
    if out is not None:
        check_output_file(out, force)
    first, *others = [load_scenario(path) for path in scenarios]
    assumptions = Assumptions(
        ground=ground,
        source="poses" if poses else None,
        time_offset=time_offset,
        structure=structure,
    )
    prediction = predict(first, others, assumptions)
    met = is_met(shortfall(prediction, goals), goals)
    suggestion = suggest(first, goals, assumptions)
    if out is not None:
        if suggestion is None:
            why = "no LiDAR sees the target in any of the manoeuvres tried"
            if not first.world.targets:
                why = "the scenario has no target to place: name one in world.targets"
            raise OutputError(f"{out}: not written: {why}")
        atomic_write(out, dump_scenario(suggestion.scenario), force)
    if as_json:
        streams.show_json(plan_document(prediction, goals, met, suggestion))
    else:
        streams.show(plan_table(prediction, goals, met, suggestion))
        if out is not None:
            streams.say(f"Written to {out}")
    streams.warn(prediction.warnings)
    if (goals and not met) or prediction.covariance.unseeing:
        raise typer.Exit(UNMET)
